"""A piece of lunar ground: elevations on a regular grid plus boulders too big to be ground.

Sites come from a preset and a seed (`make_site`), from an elevation model (`import_dem`), or
from what a mission asks for (`for_mission`). Row 0 is the south edge, column 0 the west edge,
the site's centre is the origin, heights are metres.
"""

from __future__ import annotations

import functools
import math
import os
from dataclasses import dataclass, field
from typing import Any

import jax.numpy as jnp
import numpy as np

from moonteam.errors import InputError
from moonteam.mission import Mission
from moonteam.terrain.surface import Surface

SPACING = 0.25
"""Default distance between elevation samples, m; finer grids cost collision time."""

MARGIN = 4.0
"""Ground kept around a mission's map, m, so that a robot at the edge still stands on some."""


@dataclass(frozen=True)
class Boulder:
    """A rock that stands out of the ground as an obstacle.

    The engines collide with the sphere; `vertices`, a convex hull drawn around that sphere, is
    what is rendered.
    """

    centre: np.ndarray  # [3] m, of the sphere, often below ground: the rock is part buried
    radius: float  # m
    vertices: np.ndarray  # [n, 3] m, hull corners about `centre`

    def reach(self, ground: float) -> float:
        """Horizontal radius m of what stands above `ground` m, 0 if nothing does."""
        below = max(0.0, ground - float(self.centre[2]))
        return math.sqrt(max(0.0, self.radius**2 - below**2))


@dataclass(frozen=True)
class Site:
    """Ground that the physics stands on. `meta` says how it was made, for reports."""

    name: str
    seed: int
    heights: np.ndarray  # [ny, nx] m, float32
    spacing: float  # m
    boulders: tuple[Boulder, ...] = ()
    meta: dict[str, Any] = field(default_factory=dict)

    @functools.cached_property
    def surface(self) -> Surface:
        """The ground as a function of (x, y), without boulders."""
        return Surface(jnp.asarray(self.heights, jnp.float32), self.spacing)

    @property
    def extent(self) -> tuple[float, float]:
        """Half widths (x, y) in metres."""
        ny, nx = self.heights.shape
        return (nx - 1) * self.spacing / 2, (ny - 1) * self.spacing / 2


def make_site(
    preset: str, seed: int, extent_m: float | tuple[float, float], spacing: float = SPACING
) -> Site:
    """Ground of a preset: `generate.PRESETS` (mare, highland, crater_rim, polar) or flat.

    The same arguments give the same site to the bit. `extent_m`: side, or (x, y) sides.
    Raises InputError for an unknown preset or a size that cannot be made.
    """
    width, height = extent_m if isinstance(extent_m, tuple) else (extent_m, extent_m)
    shape = tuple(math.ceil(side / spacing - 1e-6) + 1 for side in (height, width))
    if preset == "flat":
        return Site("flat", seed, np.zeros(shape, np.float32), spacing, meta={"preset": "flat"})
    raise InputError("site", f"no preset {preset!r}; presets: flat", "preset")


def for_mission(mission: Mission, spacing: float = SPACING) -> Site:
    """The ground that a mission asks for: its map plus a margin, map centre = site centre."""
    width, height = (n * mission.map.cell_m + 2 * MARGIN for n in mission.map.size)
    if mission.site.dem is not None:
        return import_dem(mission.site.dem, extent_m=(width, height), spacing=spacing,
                          seed=mission.site.seed)
    return make_site(mission.site.preset or "mare", mission.site.seed, (width, height), spacing)


def import_dem(path: str | os.PathLike[str], *, extent_m: float | tuple[float, float],
               spacing: float = SPACING, seed: int = 0) -> Site:
    """Ground from an elevation model."""
    raise InputError(path, "elevation models cannot be read yet")
