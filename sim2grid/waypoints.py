"""The grid to physics: a point in its goal cell for each robot.

A waypoint is the centre of the robot's cell. Where several robots that stand on the ground
are bound for one cell, each gets its own quarter, so that a target that needs two of them does not
ask for two bodies in one place. Flyers keep to the centre: they pass above.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from moonteam.scenario import Cell
from sim2grid.frames import Frame

SLOTS = 0.22 * np.array([[-1, -1], [1, 1], [-1, 1], [1, -1]])
"""Places [4, 2] of robots that share a cell, in cells from its centre."""


def waypoints(frame: Frame, goals: Sequence[Cell], grounded: Sequence[bool]) -> npt.NDArray:
    """Points [R, 2] m for robots bound for `goals`; `grounded[i]` is False for a flyer.

    A robot that is lost but lies on the ground is still in the way: give it with its cell.
    """
    points = frame.centre(np.array(goals, float).reshape(-1, 2))
    for i, goal in enumerate(goals):
        sharing = [k for k, other in enumerate(goals) if other == goal and grounded[k]]
        if grounded[i] and len(sharing) > 1:
            points[i] += SLOTS[sharing.index(i) % len(SLOTS)] * frame.cell_m
    return points
