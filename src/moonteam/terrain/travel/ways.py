"""From a start down the field to its target: a way of few waypoints, at any angle.

From point to point of the raster, each time to the neighbour over which the target is soonest;
of the polygons over the points passed the quickest is kept (no leg over closed ground), and
its corners are moved while that makes it quicker, as a string is pulled taut. Two corners close
together become one where that costs little.

Legend: P points of a way, in spacings (x, y); `slow` and `field` as in `field`.
"""

from __future__ import annotations

import math

import numpy as np

from moonteam.compilation import njit
from moonteam.terrain.travel.field import DIAGONAL, REACH, leave
from moonteam.terrain.travel.lines import at, line_seconds

CORNER = 1.0
"""What a way may take longer for each waypoint that it does without, in fastest spacings."""

BESIDE = 4.0
"""Two corners this near each other, in spacings, may become one."""

ROUNDS = 60
"""Of moving the corners, at most."""


@njit(cache=True, nogil=True)
def way(slow, field, x, y, to_x, to_y):
    """The way from (x, y) to the target of the field: points [P, 2], and seconds of legs [P - 1].

    Without any way, no points. From closed ground the first leg is the way out of it.
    """
    out_x, out_y, out = x, y, 0.0
    if at(slow, x, y) == np.inf and math.hypot(x - to_x, y - to_y) <= 0.5:
        return np.array([[x, y], [to_x, to_y]]), np.zeros(1)
    if at(slow, x, y) == np.inf:
        soonest, out_x, out_y = leave(slow, field, x, y)
        if soonest == np.inf:
            return np.empty((0, 2)), np.empty(0)
        out = soonest - field[int(out_y) + 1, int(out_x) + 1]
    chain = _descend(slow, field, out_x, out_y, to_x, to_y)
    if len(chain) == 0:
        return chain, np.empty(0)
    fastest = slow.min()
    points = _quickest(slow, chain, CORNER * fastest)
    points = _taut(slow, _merged(slow, _taut(slow, points), CORNER * fastest))
    points = _quickest(slow, points, CORNER * fastest)
    legs = np.empty(len(points) - 1)
    for i in range(len(legs)):
        legs[i] = line_seconds(slow, points[i, 0], points[i, 1], points[i + 1, 0],
                               points[i + 1, 1])
    if out > 0.0:
        points = np.concatenate((np.array([[x, y]]), points))
        legs = np.concatenate((np.array([out]), legs))
    return points, legs


@njit(cache=True, nogil=True)
def _descend(slow, field, x, y, to_x, to_y):
    """Points [P, 2] from (x, y), which is open, over the raster's to the target; none: no way."""
    row, column = math.floor(y + 0.5), math.floor(x + 0.5)
    row, column = min(max(row, 0), slow.shape[0] - 3), min(max(column, 0), slow.shape[1] - 3)
    chain = [(x, y)]
    if field[row + 1, column + 1] == np.inf:
        return np.empty((0, 2))
    while True:
        near = math.hypot(column - to_x, row - to_y) <= REACH
        if near and line_seconds(slow, float(column), float(row), to_x, to_y) < np.inf:
            break
        chain.append((float(column), float(row)))
        here, best, dx, dy = field[row + 1, column + 1], np.inf, 0, 0
        for j in (-1, 0, 1):
            for i in (-1, 0, 1):
                pace = slow[row + 1 + j, column + 1 + i]
                shut = (slow[row + 1 + j, column + 1] == np.inf
                        and slow[row + 1, column + 1 + i] == np.inf)
                if pace == np.inf or shut or field[row + 1 + j, column + 1 + i] >= here:
                    continue
                step = (DIAGONAL if i and j else 1.0) * 0.5 * (pace + slow[row + 1, column + 1])
                if field[row + 1 + j, column + 1 + i] + step < best:
                    best, dx, dy = field[row + 1 + j, column + 1 + i] + step, i, j
        if best == np.inf:
            return np.empty((0, 2))
        row, column = row + dy, column + dx
    if len(chain) > 1 or math.hypot(x - column, y - row) > 0.0:
        chain.append((float(column), float(row)))
    chain.append((to_x, to_y))
    return np.array(chain)


@njit(cache=True, nogil=True)
def _quickest(slow, chain, corner):
    """Of the polygons over points of `chain` [P, 2] in their order, that which takes least time.

    Each point that it keeps counts `corner` s more.
    """
    count, fastest = len(chain), slow.min()
    best, before = np.full(count, np.inf), np.zeros(count, np.int64)
    best[0] = 0.0
    for i in range(1, count):
        x, y = chain[i]
        for j in range(i):
            soonest = best[j] + corner
            if soonest + fastest * math.hypot(x - chain[j, 0], y - chain[j, 1]) >= best[i]:
                continue
            time = soonest + line_seconds(slow, chain[j, 0], chain[j, 1], x, y)
            if time < best[i]:
                best[i], before[i] = time, j
    kept = [count - 1]
    while kept[-1] > 0:
        kept.append(before[kept[-1]])
    return chain[np.array(kept[::-1])]


@njit(cache=True, nogil=True)
def _taut(slow, points):
    """The way, its corners moved by a spacing, then by less, while that makes it quicker."""
    points = points.copy()
    for stride in (1.0, 0.4):
        for _ in range(ROUNDS):
            moved = False
            for i in range(1, len(points) - 1):
                moved |= _moved(slow, points, i, stride)
            if not moved:
                break
    return points


@njit(cache=True, nogil=True)
def _moved(slow, points, i, stride):
    """Moves corner i to the quickest of nine places `stride` apart; whether it moved."""
    x, y = points[i]
    best, moved = _over(slow, points, i, x, y) - 1e-9, False
    for dy in (-stride, 0.0, stride):
        for dx in (-stride, 0.0, stride):
            time = _over(slow, points, i, x + dx, y + dy)
            if time < best:
                best, points[i, 0], points[i, 1], moved = time, x + dx, y + dy, True
    return moved


@njit(cache=True, nogil=True)
def _merged(slow, points, corner):
    """The way with one corner for two beside each other, where it takes at most `corner` s more."""
    points = points.copy()
    i = 1
    while i < len(points) - 2:
        a, b = points[i], points[i + 1]
        if math.hypot(a[0] - b[0], a[1] - b[1]) > BESIDE:
            i += 1
            continue
        best = _over(slow, points, i, a[0], a[1]) + corner + line_seconds(
            slow, b[0], b[1], points[i + 2, 0], points[i + 2, 1])
        fewer = np.concatenate((points[:i + 1], points[i + 2:]))
        found = False
        for y in range(int(min(a[1], b[1])) - 1, int(max(a[1], b[1])) + 2):
            for x in range(int(min(a[0], b[0])) - 1, int(max(a[0], b[0])) + 2):
                time = _over(slow, fewer, i, float(x), float(y))
                if time < best:
                    best, fewer[i, 0], fewer[i, 1], found = time, float(x), float(y), True
        if found:
            points = fewer
        else:
            i += 1
    return points


@njit(cache=True, nogil=True)
def _over(slow, points, i, x, y):
    """Seconds of the two legs at corner i, if it were at (x, y); infinite off the raster."""
    if not (0.0 <= x <= slow.shape[1] - 3 and 0.0 <= y <= slow.shape[0] - 3):
        return np.inf
    time = line_seconds(slow, points[i - 1, 0], points[i - 1, 1], x, y)
    return time + line_seconds(slow, x, y, points[i + 1, 0], points[i + 1, 1])
