"""What is written down in an execution: the legs under way, the clock, the record.

Legend: R robots.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from moonteam.problem.scenario import Cell
from sim2grid.loop import rules
from sim2grid.loop.asked import Asked
from sim2grid.loop.known import Known
from sim2grid.loop.record import Ending, Leg, Loss, LossCause, Record, ReplanCause
from sim2grid.waypoints import kept, waypoints

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int32]


class Logbook:
    """The record of an execution, and of each robot its last leg and where it is sent."""

    def __init__(self, asked: Asked):
        mission, robots = asked.mission, len(asked.bodies)
        self._asked = asked
        self.record = Record(list(mission.targets),
                             [mission.target_name(j) for j in range(len(mission.targets))])
        self.legs: list[Leg | None] = [None] * robots
        self.time = 0.0
        self.decision = 0
        self.points: Floats = np.zeros((robots, 2))  # where each is sent
        self._goals: Ints = np.full((robots, 2), -1, np.int32)  # as last laid out
        self.loss_unnoted = False  # the planner has not heard of it

    def each(self, get: Callable[[Leg], Any], without: npt.NDArray) -> npt.NDArray:
        """[R, ...] something of each robot's leg, or its row of `without` where it has none."""
        return np.array([without[i] if leg is None else get(leg)
                         for i, leg in enumerate(self.legs)], without.dtype)

    def going(self) -> Bools:
        """[R] on a leg that has not ended."""
        return self.each(lambda leg: leg.ended is None, np.zeros(len(self.legs), bool))

    def moving(self) -> Bools:
        """[R] sent to another cell by its last leg."""
        return self.each(lambda leg: leg.moving, np.zeros(len(self.legs), bool))

    def goals(self, cells: Ints) -> Ints:
        """[R, 2] where the last legs led; `cells` [R, 2] are for robots without one."""
        return self.each(lambda leg: leg.goal_cell, cells)

    def ended(self) -> list[int]:
        """Robots that are on no leg."""
        return np.flatnonzero(~self.going()).tolist()

    def note(self, cause: ReplanCause) -> None:
        """Logs why the planner finds another grid than it foresaw; open loop it finds nothing."""
        if self._asked.route is None:
            self.record.replans.append((self.decision, cause))

    def lose(self, robot: int, cause: LossCause) -> None:
        """A robot has left the team. The planner hears of it at the next decision."""
        self.record.losses.append(Loss(robot, cause, self.decision, self.time))
        self.close(robot, "lost")
        self.loss_unnoted = cause != "event"
        if cause == "event":  # it comes with the decision
            self.note("robot_lost")

    def note_losses(self) -> None:
        """Notes once that robots were lost since the last decision."""
        if self.loss_unnoted:
            self.note("robot_lost")
        self.loss_unnoted = False

    def send(self, robot: int, action: int, goal: Ints, known: Known) -> None:
        """Starts a leg to the goal cell [2]: the robot's own where it stays or is barred."""
        centre = self._asked.frame.centre(goal.astype(float))
        xy = known.xy[robot]
        allowed = rules.patience(
            self._asked.rules, float(rules.metres(centre - xy)), float(known.speeds[robot]))
        leg = Leg(robot, self.decision, action, cell_of(known.snapshot.cells[robot]),
                  cell_of(goal), xy.copy(), centre, self.time, self.time + allowed)
        self.legs[robot] = leg
        self.record.legs.append(leg)

    def lay_out(self, known: Known) -> None:
        """Lays out everybody's waypoint; a lost robot keeps its place."""
        cells, grounded, mask = known.snapshot.cells, self._asked.grounded, known.mask
        goals = np.where(mask[:, None], self.goals(cells), cells)
        points = waypoints(self._asked.frame, goals, grounded, known.xy)
        standing = self.each(lambda leg: not leg.moving, np.zeros(len(mask), bool))
        stays = kept(goals, self._goals, grounded, standing)
        self.points = np.where(stays[:, None], self.points, points)
        self._goals = goals
        for i in np.flatnonzero(self.going() & mask).tolist():
            leg = self.legs[i]
            assert leg is not None
            leg.waypoint = self.points[i]

    def close(self, robot: int, ended: Ending) -> None:
        """Ends a robot's leg, if it is on one."""
        leg = self.legs[robot]
        if leg is not None and leg.ended is None:
            leg.ended, leg.end_s = ended, self.time

    def cut(self, known: Known) -> None:
        """Ends all legs where the robots are."""
        cells = self._asked.frame.settle(known.xy, known.snapshot.cells)
        for i, leg in enumerate(self.legs):
            self.close(i, "cut")
            if leg is not None and leg.end_cell is None:
                leg.end_cell = cell_of(cells[i])


def cell_of(cell: Ints) -> Cell:
    """A cell [2] as a pair."""
    return int(cell[0]), int(cell[1])
