"""The grid to physics: a point in its goal cell for each robot.

A waypoint is the centre of the robot's cell. Where several robots that stand on the ground
are bound for one cell, each gets its own quarter, so that a target that needs two of them does not
ask for two bodies in one place. Flyers keep to the centre: they pass above.

Where it is known how two such robots come, they keep to the two sides of the way by which the
one that has farther to go comes, so that each can go on past the other. Two robots that would
change places head-on cannot: one of them has to wait for the other (`yielding`), and they pass
each other from the cell that they then share.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from moonteam.problem.scenario import Cell
from sim2grid.frame import Frame

SLOTS = 0.22 * np.array([[-1, -1], [1, 1], [-1, 1], [1, -1]])
"""Places [4, 2] of robots that share a cell, in cells from its centre."""

LANE = 0.3
"""Of two that share a cell, how far each keeps to its side, in cells: 0.6 m between two bodies."""

KEEP_RIGHT = 0.2
"""Metres that a robot goes farther to keep to the right."""


def waypoints(frame: Frame, goals: Sequence[Cell], grounded: Sequence[bool],
              at: npt.NDArray | None = None) -> npt.NDArray:
    """Points [R, 2] m for robots bound for `goals`; `grounded[i]` is False for a flyer.

    `at` [R, 2] m is where they are, if two that share a cell are to keep to the sides of it.
    A robot that is lost but lies on the ground is still in the way: give it with its cell.
    """
    points = frame.centre(np.array(goals, float).reshape(-1, 2))
    for sharing in crowds(goals, grounded):
        places = SLOTS[np.arange(len(sharing)) % len(SLOTS)]
        if at is not None and len(sharing) == 2:
            places = _sides(at[sharing] - points[sharing[0]])
        points[sharing] += places * frame.cell_m
    return points


def crowds(goals: Sequence[Cell], grounded: Sequence[bool]) -> list[list[int]]:
    """Groups of two or more robots on the ground that are bound for one cell."""
    cells: dict[Cell, list[int]] = {}
    for i, goal in enumerate(goals):
        if grounded[i]:
            cells.setdefault(goal, []).append(i)
    return [group for group in cells.values() if len(group) > 1]


def yielding(goals: Sequence[Cell], cells: Sequence[Cell], free: Sequence[int],
             grounded: Sequence[bool]) -> list[int]:
    """Robots among `free` that have to wait since they would change places with another.

    `cells` are those that the robots are in, or have set out from; of two that both set out
    now the one with the higher index waits.
    """
    waits: list[int] = []
    for i in sorted(free):
        for k, goal in enumerate(goals):
            swaps = goal == cells[i] and goals[i] == cells[k] and goal != goals[i]
            if swaps and grounded[i] and grounded[k] and (k < i or k not in free):
                waits.append(i)
                break
    return waits


def _sides(at: npt.NDArray) -> npt.NDArray:
    """Places [2, 2] of two robots at [2, 2] from the cell's centre, to either side of the way."""
    comer = int(np.hypot(*at.T).argmax())
    along = -at[comer]
    axis = int(np.abs(along).argmax())
    ahead = np.zeros(2)
    ahead[axis] = 1.0 if along[axis] > 0 else -1.0
    right = LANE * np.array([ahead[1], -ahead[0]])
    places = np.stack([right, -right]) if comer == 0 else np.stack([-right, right])
    ways = [float(np.hypot(*(sign * places - at).T).sum()) for sign in (1.0, -1.0)]
    return places if ways[0] <= ways[1] + KEEP_RIGHT else -places
