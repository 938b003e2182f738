"""Straight lines over a raster: seconds along them, compiled with Numba.

Points of the raster stand at whole numbers of spacings (x, y), each in the middle of a square of
its slowness. `slow` is [H + 2, W + 2], the raster within a border of infinity; times are in
seconds where slowness is in seconds a spacing.
"""

from __future__ import annotations

import math

import numpy as np

from moonteam.compilation import njit

TOUCH = 1e-9
"""Share of a line; shorter pieces in a square only touch it."""


@njit(cache=True, nogil=True)
def at(slow, x, y):
    """Slowness at (x, y) spacings, off the raster that of its nearest square."""
    row = min(max(math.floor(y + 0.5), 0), slow.shape[0] - 3)
    column = min(max(math.floor(x + 0.5), 0), slow.shape[1] - 3)
    return slow[row + 1, column + 1]


@njit(cache=True, nogil=True)
def line_seconds(slow, ax, ay, bx, by):
    """Seconds along the straight line from a to b, exact; infinite if it crosses a closed square.

    Squares are visited in order (Amanatides and Woo, 1987). A line through the corner of four
    may touch closed ground on one of its sides, not on both.
    """
    dx, dy = bx - ax, by - ay
    length = math.hypot(dx, dy)
    x, y = math.floor(ax + 0.5), math.floor(ay + 0.5)
    sx, sy = (1.0 if dx > 0 else -1.0), (1.0 if dy > 0 else -1.0)
    tx = (x + 0.5 * sx - ax) / dx if dx != 0.0 else np.inf
    ty = (y + 0.5 * sy - ay) / dy if dy != 0.0 else np.inf
    stride_x = 1.0 / abs(dx) if dx != 0.0 else np.inf
    stride_y = 1.0 / abs(dy) if dy != 0.0 else np.inf
    here, total = 0.0, 0.0
    while True:
        upto = min(tx, ty, 1.0)
        if upto - here > TOUCH:
            pace = at(slow, x, y)
            if pace == np.inf:
                return np.inf
            total += (upto - here) * pace
            here = upto
        if upto >= 1.0 - TOUCH:
            break
        if abs(tx - ty) <= TOUCH:
            if at(slow, x + sx, y) == np.inf and at(slow, x, y + sy) == np.inf:
                return np.inf
            x, y, tx, ty = x + sx, y + sy, tx + stride_x, ty + stride_y
        elif tx < ty:
            x, tx = x + sx, tx + stride_x
        else:
            y, ty = y + sy, ty + stride_y
    return total * length
