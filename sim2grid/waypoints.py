"""The grid to physics: a point in its goal cell for each robot, and who waits for whom.

A waypoint is the centre of the robot's cell. Where several robots that stand on the ground
are bound for one cell, each gets its own quarter, so that a target that needs two of them does not
ask for two bodies in one place. Flyers keep to the centre: they pass above.

Where it is known how two such robots come, they keep to the two sides of the way by which the
one that has farther to go comes, so that each can go on past the other. Two robots that would
change places head-on cannot: one of them has to wait for the other (`yielding`), and they pass
each other from the cell that they then share.

Every function works on NumPy arrays, on JAX arrays and inside jit and vmap: it takes the array
library from its first array. Legend: R robots; cells are int32 (x, y), points are in metres.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sim2grid.frame import Frame

SLOTS = 0.22 * np.array([[-1, -1], [1, 1], [-1, 1], [1, -1]])
"""Places [4, 2] of robots that share a cell, in cells from its centre."""

LANE = 0.3
"""Of two that share a cell, how far each keeps to its side, in cells: 0.6 m between two bodies."""

KEEP_RIGHT = 0.2
"""Metres that a robot goes farther to keep to the right."""


def same_cell(a: Any, b: Any) -> Any:
    """[R, R] True where cell `a[i]` is cell `b[k]`: cells [R, 2]."""
    return (a[:, None, :] == b[None, :, :]).all(-1)


def crowds(goals: Any, grounded: Any) -> Any:
    """[R, R] True where two robots on the ground are bound for one cell, or are one robot.

    `goals` [R, 2] are their cells, `grounded` [R] is False for a flyer.
    """
    return same_cell(goals, goals) & grounded[:, None] & grounded[None, :]


def waypoints(frame: Frame, goals: Any, grounded: Any, at: Any = None) -> Any:
    """Points [R, 2] m for robots bound for `goals` [R, 2]; `grounded` [R] is False for a flyer.

    `at` [R, 2] m is where they are, if two that share a cell are to keep to the sides of it.
    A robot that is lost but lies on the ground is still in the way: give it with its cell.
    """
    xp = goals.__array_namespace__()
    centres = frame.centre(goals.astype(float if at is None else at.dtype))
    together = crowds(goals, grounded)
    rank = (together & _before(xp, len(goals))).sum(-1)
    places = xp.asarray(SLOTS, dtype=centres.dtype)[rank % len(SLOTS)]
    count = together.sum(-1)[:, None]
    if at is not None:
        places = xp.where(count == 2, _sides(together, at - centres), places)
    return centres + xp.where(count > 1, places * frame.cell_m, xp.zeros_like(places))


def kept(goals: Any, goals_before: Any, grounded: Any, standing: Any) -> Any:
    """[R] True where a robot keeps the waypoint that it had: who stays need not change places.

    So do robots that share a cell with the same others as before, and robots alone in theirs
    that are `standing` [R]: not sent to another cell. `goals` and `goals_before` [R, 2] are the
    cells for which waypoints are laid out now, and were laid out last.
    """
    now, before = crowds(goals, grounded), crowds(goals_before, grounded)
    shares = now.sum(-1) > 1
    stays = (goals == goals_before).all(-1)
    return stays & ((shares & (now == before).all(-1)) | (~shares & standing))


def yielding(goals: Any, cells: Any, free: Any, grounded: Any) -> Any:
    """[R] True for robots that have to wait since they would change places with another.

    `goals` [R, 2] is where they are bound, `cells` [R, 2] where they are, or have set out from.
    Only those that are `free` [R] can wait; of two that both set out now the one with the
    higher index does.
    """
    xp = goals.__array_namespace__()
    swaps = same_cell(cells, goals) & same_cell(goals, cells) & ~same_cell(goals, goals)
    gives_way = _before(xp, len(goals)) | ~free[None, :]
    ground = grounded[:, None] & grounded[None, :]
    return free & (swaps & ground & gives_way).any(-1)


def _before(xp: Any, robots: int) -> Any:
    """[R, R] True where robot k has a lower index than robot i."""
    index = xp.arange(robots)
    return index[None, :] < index[:, None]


def _sides(together: Any, at: Any) -> Any:
    """Places [R, 2] to either side of the way, for the two robots of a cell.

    `at` [R, 2] m is where each is, from the centre of its goal. Rows of robots that are not two
    to a cell mean nothing.
    """
    xp = at.__array_namespace__()
    index = xp.arange(len(at))
    other = (together & (index[None, :] != index[:, None])).argmax(-1)
    far = xp.hypot(at[:, 0], at[:, 1])
    comes = (far > far[other]) | ((far == far[other]) & (index < other))
    along = -xp.where(comes[:, None], at, at[other])
    east = xp.abs(along[:, 0]) >= xp.abs(along[:, 1])
    x = xp.where(east, xp.where(along[:, 0] > 0, 1.0, -1.0), 0.0)
    y = xp.where(east, 0.0, xp.where(along[:, 1] > 0, 1.0, -1.0))
    right = LANE * xp.stack([y, -x], axis=-1)
    place = xp.where(comes[:, None], right, -right)

    def way(side: Any) -> Any:
        """Metres of both robots together to their places."""
        mine, theirs = side - at, -side - at[other]
        return xp.hypot(mine[:, 0], mine[:, 1]) + xp.hypot(theirs[:, 0], theirs[:, 1])

    keeps = way(place) <= way(-place) + KEEP_RIGHT
    return xp.where(keeps[:, None], place, -place).astype(at.dtype)
