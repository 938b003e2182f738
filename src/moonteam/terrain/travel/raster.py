"""Seconds per metre for one kind of robot, at points over a mission's map.

The points stand where the cell maps judge a cell: every raster has points on the centres and
borders of the cells. A point is open if the kind can stand on it and on all points as far off
as robots stray, so that whoever can go from cell to cell by the cell maps can go along the
same lines here.

Legend: H, W rows and columns of points, row 0 in the south, column 0 in the west.
"""

from __future__ import annotations

import math
import weakref
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from moonteam.terrain.site import Site
from moonteam.terrain.traversability import (
    POINT_SPACING,
    STRAY,
    BoolMap,
    FloatMap,
    Limits,
    ground_under,
    judge,
)

REMEMBERED = 32
"""Rasters kept for the next call."""


@dataclass(frozen=True)
class Raster:
    """Points `spacing` m apart over a map of `size` (W, H) cells, its centre at the origin."""

    size: tuple[int, int]
    cell_m: float  # m, side of a cell

    @property
    def parts(self) -> int:
        """Spacings in a cell's side: even, so that there is a point on its centre."""
        return 2 * math.ceil(self.cell_m / 2 / POINT_SPACING - 1e-9)

    @property
    def spacing(self) -> float:
        """Between two points, m; at most POINT_SPACING."""
        return self.cell_m / self.parts

    @property
    def stray(self) -> float:
        """How far robots stray from their ways, m."""
        return min(STRAY, self.cell_m / 4)

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W) points."""
        width, height = self.size
        return height * self.parts + 1, width * self.parts + 1

    @property
    def half(self) -> tuple[float, float]:
        """Half widths (x, y) of the map, m."""
        width, height = self.size
        return width * self.cell_m / 2, height * self.cell_m / 2

    def points(self) -> npt.NDArray[np.float64]:
        """Where the points are, [H, W, 2] m."""
        rows, columns = self.shape
        x, y = (self.spacing * (np.arange(n) - (n - 1) / 2) for n in (columns, rows))
        return np.stack(np.meshgrid(x, y), axis=-1).astype(np.float64)

    def within(self, centre: npt.ArrayLike, reach: tuple[float, float]) -> BoolMap:
        """[H, W] the points at most `reach` (x, y) m off `centre` [2] m."""
        off = np.abs(self.points() - np.asarray(centre, np.float64))
        return np.all(off <= np.asarray(reach) + 1e-9, axis=-1)


def slowness(site: Site, raster: Raster, limits: Limits) -> FloatMap:
    """[H, W] s/m at the raster's points for a kind with these limits; infinite where closed.

    Speed falls with the slope of the plane under the footprint, as in the cell maps. The
    result is remembered for as long as the site lives; do not write into it.
    """
    key = (id(site), raster, limits)
    if key in _KNOWN and _KNOWN[key][0]() is site:
        return _KNOWN[key][1]
    found = fresh_slowness(site, raster, limits)
    found.setflags(write=False)
    while len(_KNOWN) >= REMEMBERED:
        del _KNOWN[next(iter(_KNOWN))]
    _KNOWN[key] = (weakref.ref(site), found)
    return found


_KNOWN: dict[tuple[int, Raster, Limits], tuple[weakref.ref[Site], FloatMap]] = {}


def fresh_slowness(site: Site, raster: Raster, limits: Limits) -> FloatMap:
    """`slowness`, made anew."""
    points = raster.points()
    if limits.flies:
        slope = step = np.zeros(raster.shape)
    else:
        slope, step = ground_under(site, points, limits.footprint)
    able = _kept_clear(judge(site, points, limits, slope, step), raster)
    with np.errstate(divide="ignore"):  # a kind may lose all of its speed
        return np.where(able, 1.0 / (limits.speed * _kept_speed(slope, limits)), np.inf)


def _kept_speed(slope: FloatMap, limits: Limits) -> FloatMap:
    """Share of its speed that a kind keeps on a slope."""
    return 1.0 - limits.slowing * np.minimum(slope / limits.max_slope, 1.0)


def costs(site: Site, raster: Raster, limits: Limits, thrift: float) -> FloatMap:
    """[H, W] what a second counts at the raster's points, for a kind that saves energy.

    A metre costs (1 - thrift) times its time and thrift times its energy, each as a share of that
    on the level; `limits.joules` says the energy by slope.
    """
    slope, _ = ground_under(site, raster.points(), limits.footprint)
    slopes, joules = np.array(limits.joules).T
    energy = np.interp(slope, slopes, joules) / joules[0]
    return 1.0 - thrift + thrift * energy * _kept_speed(slope, limits)


def _kept_clear(able: BoolMap, raster: Raster) -> BoolMap:
    """[H, W] points that are able and have none about them, within `stray` m, that is not.

    What lies off the map is not asked for: who strays there is as safe as its border.
    """
    reach = int(raster.stray / raster.spacing + 1e-9)
    padded = np.pad(able, reach, mode="edge")
    rows, columns = able.shape
    clear = np.ones_like(able)
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            if math.hypot(dx, dy) * raster.spacing <= raster.stray + 1e-9:
                clear &= padded[reach + dy:reach + dy + rows, reach + dx:reach + dx + columns]
    return clear


