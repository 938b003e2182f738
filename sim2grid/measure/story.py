"""What a record tells a person: what each robot was doing, and where and why plans changed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from moonteam.problem.mission import Mission, Place
from moonteam.problem.scenario import Cell
from sim2grid.frame import Frame
from sim2grid.loop.record import Leg, Record

SPEED_WINDOW_S = 0.6
"""A robot's speed is over this long: less would show every step of its feet."""

WORDS = {
    "timeout": "late", "wrong_cell": "in another cell than planned", "robot_lost": "lost"}
"""Of the causes of new plans; the others are their own words."""

NEWS = ("new_target", "found")
"""Causes that are a target of which nobody knew."""


@dataclass(frozen=True)
class Replan:
    """One cause for a new plan. `xy` [2] m is where it arose, None where it has no place."""

    time_s: float
    decision: int
    cause: str
    robot: int | None
    xy: npt.NDArray | None
    words: str  # "rover late"


class Story:
    """Reads a record; `bases` is the index of each robot's free joint in qpos."""

    def __init__(self, mission: Mission, record: Record, frame: Frame, bases: Sequence[int]):
        self.mission, self.record, self.frame = mission, record, frame
        self.times = np.concatenate(record.times)
        self.qpos = np.concatenate(record.qpos)
        self.paths = [self.qpos[:, b:b + 2].astype(float) for b in bases]  # R times [T, 2] m
        self.replans = self._replans()

    def index(self, time_s: float) -> int:
        """Of the logged pose that shows a mission second."""
        return min(int(np.searchsorted(self.times, time_s - 1e-9)), len(self.times) - 1)

    def speed(self, robot: int, time_s: float) -> float:
        """Horizontal speed m/s about a mission second."""
        first = self.index(max(time_s - SPEED_WINDOW_S / 2, 0.0))
        last = self.index(time_s + SPEED_WINDOW_S / 2)
        if last <= first:
            return 0.0
        moved = self.paths[robot][last] - self.paths[robot][first]
        return float(np.nan_to_num(np.hypot(*moved) / (self.times[last] - self.times[first])))

    def state(self, robot: int, time_s: float) -> tuple[str, npt.NDArray]:
        """moving, waiting, late or lost; and the point [2] m that it is bound for."""
        goal, word = self.paths[robot][0], "waiting"
        for leg in self.record.legs:
            if leg.robot != robot or leg.start_s > time_s + 1e-9:
                continue
            goal = leg.waypoint
            under_way = leg.end_s is None or time_s < leg.end_s - 1e-9
            word = "moving" if leg.moving and under_way else "waiting"
            if leg.ended == "timeout" and not under_way:
                word = "late"
        for loss in self.record.losses:
            if loss.robot == robot and loss.time_s <= time_s + 1e-9:
                why = "" if loss.cause == "event" else f": {loss.cause.replace('_', ' ')}"
                word = f"lost{why}"
        return word, goal

    def targets_at(self, decision: int) -> int:
        """How many targets were known once `decision` joint actions had been taken."""
        late = sum(1 for d, cause in self.record.replans if cause in NEWS and d >= decision)
        return len(self.record.targets) - late

    def _replans(self) -> list[Replan]:
        """Causes in order of time. A cause that several robots share has a place for each."""
        asked = {d.decision: d.time_s for d in self.record.decisions}
        found: list[Replan] = []
        new = len(self.mission.targets)
        for decision, cause in dict.fromkeys(self.record.replans):
            time_s = asked.get(decision, self.record.seconds())
            if cause in NEWS:
                for _ in range(self.record.replans.count((decision, cause))):
                    name = self.record.target_names[new]
                    found.append(Replan(
                        time_s, decision, cause, None, self._centre(self.record.targets[new].at),
                        f"new target {name}" if cause == "new_target" else f"{name} is found"))
                    new += 1
            elif cause == "impassable":
                found += [Replan(time_s, decision, cause, None, self._centre(at),
                                 f"{kind}: no way over {at[0]}, {at[1]}")
                          for kind, at in self._closed(decision)]
            else:
                robots = self._robots_of(decision, cause)
                words = WORDS.get(cause, cause.replace("_", " "))
                found += [Replan(time_s, decision, cause, i, self._place(i, time_s),
                                 f"{self.mission.robots[i].name} {words}") for i in robots]
                if not robots:
                    found.append(Replan(time_s, decision, cause, None, None, words))
        return sorted(found, key=lambda replan: replan.time_s)

    def _centre(self, cell: Place) -> npt.NDArray:
        return self.frame.centre(np.array(cell, float))

    def _place(self, robot: int, time_s: float) -> npt.NDArray | None:
        place = self.paths[robot][self.index(time_s)]
        return place if np.isfinite(place).all() else None

    def _closed(self, decision: int) -> list[tuple[str, Cell]]:
        """Kinds and cells of ground learned to be impassable at a decision."""
        told = [(e.impassable.kind, e.impassable.at) for e in self.mission.events
                if e.impassable is not None and e.at_decision == decision]
        late = [leg for leg in self._noted(decision)
                if leg.ended == "timeout" and leg.end_cell != leg.goal_cell]
        return [*told, *((self.mission.robots[leg.robot].kind, leg.goal_cell) for leg in late)]

    def _robots_of(self, decision: int, cause: str) -> list[int]:
        """The robots that gave a cause at a decision."""
        names = [robot.name for robot in self.mission.robots]
        if cause == "robot_lost":
            earlier = [d for d, c in self.record.replans if c == cause and d < decision]
            return [x.robot for x in self.record.losses
                    if max(earlier, default=-1) < x.decision <= decision]
        if cause in ("slowed", "silent", "heard_again"):
            told = []
            for event in self.mission.events:
                if cause == "slowed" and event.slow and event.at_decision == decision:
                    told.append(event.slow.robot)
                if event.silent and cause != "slowed":
                    after = event.silent.decisions if cause == "heard_again" else 0
                    if event.at_decision + after == decision:
                        told.append(event.silent.robot)
            return [names.index(name) for name in told]
        return sorted(leg.robot for leg in self._noted(decision) if (
            leg.ended == "timeout" if cause == "timeout"
            else leg.ended == "arrived" and leg.end_cell != leg.goal_cell))

    def _noted(self, decision: int) -> list[Leg]:
        """Legs whose ends were looked at when a decision was due: each robot's latest but one
        that began with it, or its last.
        """
        gone = {x.robot for x in self.record.losses if x.decision <= decision}
        following: dict[int, Leg] = {}
        noted = []
        for leg in reversed(self.record.legs):
            after = following.get(leg.robot)
            following[leg.robot] = leg
            due = after.decision == decision if after else leg.decision < decision
            if due and leg.robot not in gone and leg.end_cell is not None:
                noted.append(leg)
        return noted
