"""Which ground lies in sunlight: a ray to the sun from each point, over elevations and boulders.

The sun is a point (the real one is half a degree wide: 4 degrees high, the edge of a shadow is two
metres wide for each metre of what throws it), and nothing stands beyond the site's edge: hills
there keep no light off.

Legend: ny, nx elevation samples, row 0 in the south; B boulders. Inside, points are (x, y) in
spacings from the first sample, heights in metres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from moonteam.compilation import njit
from moonteam.problem.sun import SunPosition
from moonteam.terrain.site import Site

PANEL = 0.3
"""Metres above the ground at which a robot's panel takes light."""

TOUCH = 1e-4
"""Metres by which ground has to stand above a ray to stop it; finer are its numbers not."""

BLOCK = 16
"""Spacings a side of a block, over which a ray goes in one step if it is above all of it."""

BORDER = 1e-6
"""Spacings past the outer samples that count as theirs."""

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]


def lit(site: Site, sun: SunPosition, above: float = 0.0) -> Bools:
    """[ny, nx] whether what is `above` m over each elevation sample lies in sunlight.

    Exact for the surface that the engines collide with, see `terrain.surface`, and for boulders as
    spheres. A sun on or below the horizon lights nothing.
    """
    y, x = (site.spacing * (np.arange(n) - (n - 1) / 2) for n in site.heights.shape)
    return lit_at(site, sun, np.stack(np.meshgrid(x, y), axis=-1), above)


def lit_at(site: Site, sun: SunPosition, xy: npt.ArrayLike, above: float = 0.0) -> Bools:
    """[...] as `lit`, at points xy [..., 2] m; off the site the ground is as high as its border."""
    points = np.asarray(xy, np.float64)
    if sun.elevation <= 0.0:
        return np.zeros(points.shape[:-1], np.bool_)
    last = np.array(site.heights.shape[::-1], float) - 1.0
    places = np.clip(points / site.spacing + last / 2.0, 0.0, last)
    rocks = np.array([[*boulder.centre, boulder.radius] for boulder in site.boulders], float)
    found = _lit(site.heights.astype(np.float64), site.spacing, places.reshape(-1, 2), above,
                 np.array(sun.toward), rocks.reshape(-1, 4))
    return found.reshape(points.shape[:-1])


@dataclass(frozen=True, eq=False)
class Sunlight:
    """The light that robots' panels have on a site that has a sun."""

    site: Site

    @property
    def elevation(self) -> float:
        """Of the sun, rad."""
        return self._sun.elevation

    @property
    def _sun(self) -> SunPosition:
        assert self.site.sun is not None
        return self.site.sun

    def at(self, xy: npt.ArrayLike) -> Bools:
        """[...] whether a panel has light at xy [..., 2] m, PANEL above the ground."""
        return lit_at(self.site, self._sun, xy, PANEL)


@njit(cache=True, nogil=True)
def _lit(heights, spacing, places, above, sun, rocks):
    """[P] bool: points `places` [P, 2], `sun` unit vector [3] to it, `rocks` [B, 4] m."""
    flat = math.hypot(sun[0], sun[1])
    dx, dy = (sun[0] / flat, sun[1] / flat) if flat > 0.0 else (1.0, 0.0)
    climb = spacing * sun[2] / max(flat, 1e-9)  # m a spacing
    tops = _tops(heights)
    top = tops.max()
    middle_x, middle_y = (heights.shape[1] - 1) / 2.0, (heights.shape[0] - 1) / 2.0
    found = np.empty(len(places), np.bool_)
    for i in range(len(places)):
        x, y = places[i]
        z = height_at(heights, x, y) + above
        found[i] = not _behind_rock(
            rocks, (x - middle_x) * spacing, (y - middle_y) * spacing, z, sun
        ) and not _behind_ground(heights, tops, top, x, y, z, dx, dy, climb)
    return found


@njit(cache=True, nogil=True)
def _tops(heights):
    """The highest elevation of each block of BLOCK by BLOCK spacings, its borders included."""
    rows, columns = (heights.shape[0] - 1) // BLOCK + 1, (heights.shape[1] - 1) // BLOCK + 1
    tops = np.empty((rows, columns))
    for i in range(rows):
        for j in range(columns):
            tops[i, j] = heights[i * BLOCK:(i + 1) * BLOCK + 1,
                                 j * BLOCK:(j + 1) * BLOCK + 1].max()
    return tops


@njit(cache=True, nogil=True)
def _behind_ground(heights, tops, top, x, y, z, dx, dy, climb):
    """Whether ground stands above the ray from (x, y) at z m.

    Along a ray ground is straight between crossings of the samples' rows, columns and the
    triangles' diagonals, so it is compared there alone.
    """
    # A ray along the border stays on it, whatever its direction is rounded to.
    most_x, most_y = heights.shape[1] - 1.0 + BORDER, heights.shape[0] - 1.0 + BORDER
    for u, du in ((x, dx), (y, dy), (x - y, dx - dy)):
        if abs(du) < 1e-12:
            continue
        part = u - math.floor(u)
        ahead = 1.0 - part if du > 0.0 else (part if part > 0.0 else 1.0)
        along, stride = ahead / abs(du), 1.0 / abs(du)
        while True:
            at_x, at_y, ray = x + along * dx, y + along * dy, z + along * climb + TOUCH
            if ray > top or not (
                    -BORDER <= at_x <= most_x and -BORDER <= at_y <= most_y):
                break
            column, row = int(at_x) // BLOCK, int(at_y) // BLOCK
            if tops[row, column] <= ray:
                room_x = _room(at_x, dx, column)
                room_y = _room(at_y, dy, row)
                along += stride * max(1.0, math.ceil(min(room_x, room_y) / stride))
                continue
            if height_at(heights, at_x, at_y) > ray:
                return True
            along += stride
    return False


@njit(cache=True, nogil=True)
def _room(at, step, block):
    """How far along a ray that goes `step` a spacing its block ends."""
    if step > 0.0:
        return ((block + 1) * BLOCK - at) / step
    return (block * BLOCK - at) / step if step < 0.0 else np.inf


@njit(cache=True, nogil=True)
def height_at(heights, x, y):
    """Height m at (x, y), as `terrain.surface.Surface.height` has it."""
    column = min(int(x), heights.shape[1] - 2)
    row = min(int(y), heights.shape[0] - 2)
    fx, fy = x - column, y - row
    sw, ne = heights[row, column], heights[row + 1, column + 1]
    if fx >= fy:
        se = heights[row, column + 1]
        return sw + (se - sw) * fx + (ne - se) * fy
    nw = heights[row + 1, column]
    return sw + (ne - nw) * fx + (nw - sw) * fy


@njit(cache=True, nogil=True)
def _behind_rock(rocks, x, y, z, sun):
    """Whether the ray from (x, y, z) m to the sun begins in a sphere, or passes through one."""
    for i in range(len(rocks)):
        ax, ay, az = rocks[i, 0] - x, rocks[i, 1] - y, rocks[i, 2] - z
        square = rocks[i, 3] * rocks[i, 3]
        away = ax * ax + ay * ay + az * az
        along = ax * sun[0] + ay * sun[1] + az * sun[2]
        if away < square or (along > 0.0 and away - along * along < square):
            return True
    return False
