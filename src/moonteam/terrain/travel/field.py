"""Seconds from everywhere to one target: the eikonal equation |grad T| = slowness, solved.

Fast marching (Tsitsiklis, 1995; Sethian, 1996): points are accepted in the order of their
times, and each gives its neighbours theirs. A neighbour's time is the least over the segment
between two accepted points, of the eight triangles about it instead of the usual four quarters,
which makes the error about a third (Tsitsiklis' own scheme for eight neighbours). Within REACH
of the target, and from there on by marching, times begin as those of straight lines.

Legend: `slow` and `field` are [H + 2, W + 2], s a spacing and s, within a border of infinity.
"""

from __future__ import annotations

import math

import numpy as np

from moonteam.compilation import njit
from moonteam.terrain.travel.lines import at, line_seconds

REACH = 8.0
"""Steps about a target in which times begin as those of straight lines."""

LEAVE = 4.0
"""Steps over which a robot that stands on closed ground may leave it."""

WIDTH = 0.7
"""Of a bucket of the queue, in times over the fastest spacing."""

DIAGONAL = math.sqrt(2.0)


@njit(cache=True, nogil=True)
def solve(slow, x, y):
    """The field [H + 2, W + 2] of a target at (x, y) spacings; infinite where no way is."""
    field = np.full(slow.shape, np.inf)
    first = np.zeros(slow.shape, np.bool_)
    if at(slow, x, y) < np.inf:
        rows, columns = slow.shape[0] - 2, slow.shape[1] - 2
        for row in range(max(0, int(y - REACH)), min(rows, int(y + REACH) + 2)):
            for column in range(max(0, int(x - REACH)), min(columns, int(x + REACH) + 2)):
                open_here = slow[row + 1, column + 1] < np.inf
                if open_here and math.hypot(column - x, row - y) <= REACH:
                    field[row + 1, column + 1] = line_seconds(
                        slow, x, y, float(column), float(row))
                    first[row + 1, column + 1] = field[row + 1, column + 1] < np.inf
    return _marched(slow, field, first)


@njit(cache=True, nogil=True)
def renew(slow, known, until):
    """The field after ground was closed that nobody within `until` s of the target comes over.

    `known` [H + 2, W + 2] is the field before: times grow along ways, so those up to `until`
    stand.
    """
    field, done = np.full(slow.shape, np.inf), known <= until
    first = np.zeros(slow.shape, np.bool_)
    for row in range(1, slow.shape[0] - 1):
        for column in range(1, slow.shape[1] - 1):
            if done[row, column]:
                field[row, column] = known[row, column]
                first[row, column] = not done[row - 1:row + 2, column - 1:column + 2].all()
    return _marched(slow, field, first)


@njit(cache=True, nogil=True)
def _marched(slow, field, first):
    """The field, filled from the points that are `first` [H + 2, W + 2]."""
    room = 4 * (slow.shape[0] + slow.shape[1])
    while True:
        found = field.copy()
        if _march(slow.ravel(), found.ravel(), first.ravel(), slow.shape[1], room):
            return found
        room *= 4


@njit(cache=True, nogil=True)
def _march(pace, times, first, width, room):
    """Fills `times` [N] from the points that are `first` [N]; rows are `width` points apart.

    Points wait in buckets by time, and in no order within one (Yatziv et al., 2006); one whose
    time falls once more waits once more, so that the times are those of strict order. False if
    more than `room` points had to wait in one bucket.
    """
    rate, buckets, soonest = _buckets(pace, times, first)
    waiting, size = np.empty((buckets, room), np.int32), np.zeros(buckets, np.int32)
    where = np.full(times.size, -1, np.int64)  # the bucket that a point is in
    around = np.array([1, width + 1, width, width - 1, -1, -width - 1, -width, -width + 1])
    mask, left, bucket = buckets - 1, 0, int(soonest * rate)
    for node in range(times.size):
        if not first[node]:
            continue
        here = int(times[node] * rate)
        if size[here & mask] == room:
            return False
        where[node], waiting[here & mask, size[here & mask]] = here, node
        size[here & mask] += 1
        left += 1
    while left > 0:
        here = bucket & mask
        if size[here] == 0:
            bucket += 1
            continue
        size[here] -= 1
        left -= 1
        node = waiting[here, size[here]]
        if where[node] != bucket:
            continue
        where[node] = -1
        for turn in range(8):
            there = node + around[turn]
            if times[there] <= times[node] or pace[there] == np.inf:
                continue
            if turn & 1:
                time = _across(pace, times, node, there, node + around[turn - 1])
            else:
                time = _straight(pace, times, node, there, around[(turn + 2) & 7])
            if time >= times[there]:
                continue
            times[there] = time
            later = int(time * rate)
            if where[there] != later:
                if size[later & mask] == room:
                    return False
                where[there], waiting[later & mask, size[later & mask]] = later, there
                size[later & mask] += 1
                left += 1
    return True


@njit(cache=True, nogil=True)
def _buckets(pace, times, first):
    """Buckets a second, how many are in use at once, a power of two, and the first of times."""
    least, most, soonest, latest = np.inf, 0.0, np.inf, 0.0
    for node in range(times.size):
        if pace[node] < np.inf:
            least, most = min(least, pace[node]), max(most, pace[node])
        if first[node]:
            soonest, latest = min(soonest, times[node]), max(latest, times[node])
    if soonest == np.inf:
        return 1.0, 1, 0.0
    width, buckets = WIDTH * least, 4
    while buckets * width < latest - soonest + 2.0 * most + 2.0 * width:
        buckets *= 2
    return 1.0 / width, buckets, soonest


@njit(cache=True, nogil=True)
def _straight(pace, times, node, there, side):
    """Time at the next point `there`, from `node` or, better, from an edge at `node`."""
    here, mean = times[node], 0.5 * (pace[node] + pace[there])
    gain = here - min(times[node + side], times[node - side])
    if gain > 0.0 and 2.0 * gain * gain < mean * mean:
        return here + math.sqrt(mean * mean - gain * gain)
    return here + mean


@njit(cache=True, nogil=True)
def _across(pace, times, node, there, beside):
    """Time at the next point `there` on the diagonal, from `node`, past open ground."""
    if pace[beside] == np.inf and pace[node + there - beside] == np.inf:
        return np.inf
    return times[node] + DIAGONAL * 0.5 * (pace[node] + pace[there])


@njit(cache=True, nogil=True)
def look_up(slow, field, to, x, y):
    """Seconds from (x, y) spacings to the target `to` [2] of the field; infinite where no way is.

    Near the target that of the straight line, beside closed ground that over a point that can be
    seen, elsewhere bilinear. From closed ground, the nearest way out first; who stands within half
    a spacing of the target is there even so.
    """
    away = math.hypot(x - to[0], y - to[1])
    if away <= REACH:
        time = line_seconds(slow, x, y, to[0], to[1])
        if time < np.inf:
            return time
        if away <= 0.5:
            return 0.0
    if at(slow, x, y) == np.inf:
        return leave(slow, field, x, y)[0]
    row = min(max(math.floor(y), 0), slow.shape[0] - 4)
    column = min(max(math.floor(x), 0), slow.shape[1] - 4)
    fx, fy = min(max(x - column, 0.0), 1.0), min(max(y - row, 0.0), 1.0)
    near = field[row + 1:row + 3, column + 1:column + 3]
    time = ((near[0, 0] * (1 - fx) + near[0, 1] * fx) * (1 - fy)
            + (near[1, 0] * (1 - fx) + near[1, 1] * fx) * fy)
    if near.max() < np.inf:
        return time
    best = np.inf
    for i in range(2):
        for j in range(2):
            if near[i, j] < best:
                time = near[i, j] + line_seconds(slow, x, y, float(column + j), float(row + i))
                best = min(best, time)
    return best


@njit(cache=True, nogil=True)
def leave(slow, field, x, y):
    """The way out of closed ground at (x, y): seconds to the target, and the point (x, y).

    It is taken straight, over at most LEAVE spacings, and counted at half the slowest speed.
    """
    pace = 0.0
    for value in slow.ravel():
        pace = max(pace, 2.0 * value) if value < np.inf else pace
    best, to_x, to_y = np.inf, x, y
    for row in range(max(0, int(y - LEAVE)), min(slow.shape[0] - 2, int(y + LEAVE) + 2)):
        for column in range(max(0, int(x - LEAVE)), min(slow.shape[1] - 2, int(x + LEAVE) + 2)):
            away = math.hypot(column - x, row - y)
            if away <= LEAVE and field[row + 1, column + 1] + pace * away < best:
                best = field[row + 1, column + 1] + pace * away
                to_x, to_y = float(column), float(row)
    return best, to_x, to_y


@njit(cache=True, nogil=True)
def look_ups(slow, field, to, points):
    """`look_up` from each of `points` [P, 2] spacings: [P] s."""
    return np.array([look_up(slow, field, to, point[0], point[1]) for point in points])
