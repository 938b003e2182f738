"""One kind's travel to one place, as `moonteam site` shows it: a document and a picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from moonteam.errors import InputError
from moonteam.terrain import preview
from moonteam.terrain.site import Site
from moonteam.terrain.travel.roads import Place, Roads, Way
from moonteam.terrain.traversability import Limits

INWARDS = 0.08
"""How far from the map's corners ways begin, as a share of its sides."""


@dataclass(frozen=True)
class Shown:
    """Travel of `kind` to `to` m, from everywhere, and some ways."""

    site: Site
    roads: Roads
    kind: str
    to: Place
    ways: tuple[Way, ...]

    @property
    def document(self) -> dict[str, Any]:
        """As the report holds it: seconds, metres and points m of the ways."""
        seconds = self.roads.field(self.kind, self.to)
        able = seconds[np.isfinite(seconds)]
        return {"kind": self.kind, "to": list(self.to),
                "reached": round(able.size / seconds.size, 4),
                "most_seconds": round(float(able.max()), 3),
                "ways": [{"seconds": round(way.seconds, 3), "metres": round(way.metres, 3),
                          "points": np.round(way.points, 3).tolist(),
                          "arrivals": np.round(way.arrivals(), 3).tolist()} for way in self.ways]}

    def draw(self, path: Path) -> Path:
        """Isochrones and ways over the shaded ground; the picture's path."""
        title = (f"{self.site.name}, seed {self.site.seed}: seconds of a {self.kind} robot to "
                 f"({self.to[0]:g}, {self.to[1]:g}) m; red: closed or cut off")
        return preview.draw_travel(
            self.site, path, title, self.roads.raster.half, self.roads.field(self.kind, self.to),
            [(way.points, way.seconds) for way in self.ways])


def show(site: Site, size: tuple[int, int], cell_m: float, kind: str, limits: Limits, to: Place,
         start: Place | None) -> Shown:
    """Travel to `to` m over a map of `size` (W, H) cells, with a way from `start` m.

    Without a start, ways from the reachable places nearest to four that are near the map's
    corners. Raises InputError off the map, and where there is no way.
    """
    roads = Roads.over(site, size, cell_m, {kind: limits})
    if not roads.passable(kind, to):
        raise InputError("--to", f"({to[0]:g}, {to[1]:g}) m is ground that a {kind} robot cannot "
                         "cross (slope or boulder); choose another place")
    starts = [start] if start is not None else _corners(roads, kind, to)
    return Shown(site, roads, kind, to, tuple(roads.way(kind, at, to) for at in starts))


def _corners(roads: Roads, kind: str, to: Place) -> list[Place]:
    reached = roads.raster.points()[np.isfinite(roads.field(kind, to))]  # [P, 2] m
    corners = [np.array([x, y]) * roads.raster.half * (1 - 2 * INWARDS)
               for x in (-1, 1) for y in (-1, 1)]
    nearest = [reached[np.linalg.norm(reached - at, axis=1).argmin()] for at in corners]
    return [(float(x), float(y)) for x, y in nearest]
