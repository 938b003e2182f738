"""Travel in seconds over a site: rasters of slowness, a field for each target, ways, `Roads`."""

from moonteam.terrain.travel.roads import Roads, Way

__all__ = ["Roads", "Way"]
