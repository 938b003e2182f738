"""What a mission by the clock has in store: its events, and targets that appear and lapse.

Targets come by the clock, when so many others are solved, or once a robot that sees is near them.

Legend: R robots.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from moonteam.planners.seconds.base import Bools
from moonteam.problem.mission import Event, Target
from sim2grid.clock.roads import Floats
from sim2grid.clock.task import Task
from sim2grid.loop.asked import Asked
from sim2grid.loop.known import Known
from sim2grid.loop.logbook import Logbook
from sim2grid.loop.record import LossCause, ReplanCause
from sim2grid.loop.rules import metres

LATE_S = 0.01
"""s after which a target that has lapsed is given up."""


class UnderWay(Protocol):
    """What happens happens to this: `execution.TimedExecution`."""

    asked: Asked
    known: Known
    book: Logbook
    task: Task

    @property
    def solved(self) -> Bools:
        """[M] targets whose services have ended."""
        ...

    def ask(self, cause: ReplanCause | None = None) -> None:
        """A decision is due."""
        ...

    def let_go(self, target: int) -> None:
        """A target's window has closed."""
        ...

    def lose(self, robot: int, cause: LossCause) -> None:
        """A robot has left the team."""
        ...

    def learn(self, robot: int, xy: Floats, told: bool = False) -> None:
        """Ground about xy [2] is closed to a robot's kind."""
        ...

    def again(self, robot: int) -> None:
        """A robot's way is looked for anew."""
        ...


class Happenings:
    """The events that are still to come, and the moments at which windows open and close."""

    def __init__(self, execution: UnderWay):
        self._its = execution
        mission = execution.asked.mission
        timed = [event for event in mission.events if not event.at_solved and not event.on_sight]
        self._left = sorted(timed, key=lambda event: event.at_s or 0.0)
        self._following = [event for event in mission.events if event.at_solved]
        self._hidden = [event for event in mission.events if event.on_sight]
        self._sensors = np.array([robot.sensor_m or -np.inf for robot in mission.robots])
        self._names = [robot.name for robot in mission.robots]
        self._windows: list[tuple[float, ReplanCause, int]] = []
        for j, target in enumerate(mission.targets):
            self._watch(j, target)
        self.silent_until = np.zeros(len(mission.robots))  # [R] mission seconds

    @property
    def coming(self) -> int:
        """Targets that are still to come."""
        return sum(event.target is not None
                   for event in (*self._left, *self._following, *self._hidden))

    def apply(self) -> None:
        """All that is due by now."""
        now = self._its.book.time
        heard = (self.silent_until > 0) & (self.silent_until <= now)
        if heard.any():
            self.silent_until[heard] = 0.0
            self._its.ask("heard_again")
        while self._left and (self._left[0].at_s or 0.0) <= now + 1e-6:
            self._one(self._left.pop(0))
        self._follow()
        self._find()
        while self._windows and self._windows[0][0] <= now + 1e-6:
            _, cause, target = self._windows.pop(0)
            if cause == "lapsed":
                self._its.let_go(target)
            else:
                self._its.ask(cause)

    def _watch(self, number: int, target: Target) -> None:
        if target.appears > 0:
            self._windows.append((target.appears, "appeared", number))
        if target.lapses is not None:
            self._windows.append((target.lapses + LATE_S, "lapsed", number))
        self._windows.sort()

    def _follow(self) -> None:
        """Targets that come when so many others are solved."""
        solved = int(self._its.solved.sum())
        for event in [event for event in self._following if event.at_solved <= solved]:
            self._following.remove(event)
            self._one(event)

    def _find(self) -> None:
        """Hidden targets that a robot of the team sees."""
        its = self._its
        for event in [*self._hidden]:
            assert event.target is not None
            gap = metres(its.known.xy - its.task.place(event.target.at))
            if (its.known.mask & (gap <= self._sensors)).any():
                self._hidden.remove(event)
                self._one(event, "found")

    def _one(self, event: Event, cause: ReplanCause = "new_target") -> None:
        its = self._its
        if event.lost is not None and its.known.mask[self._names.index(event.lost)]:
            its.lose(self._names.index(event.lost), "event")
        if event.target is not None:
            its.task.add(event.target)
            its.book.record.targets.append(event.target)
            its.book.record.target_names.append(its.task.names[-1])
            known = its.known
            known.snapshot = its.asked.with_targets(known.snapshot, [event.target])
            self._watch(len(its.task.targets) - 1, event.target)
            its.ask(cause)
        if event.slow is not None:
            robot = self._names.index(event.slow.robot)
            its.known.speeds[robot] = event.slow.factor * its.task.speeds[robot]
            its.again(robot)
            its.ask("slowed")
        if event.silent is not None:
            robot = self._names.index(event.silent.robot)
            self.silent_until[robot] = its.book.time + event.silent.seconds
            its.ask("silent")
        if event.impassable is not None:
            kinds = its.task.kinds
            if event.impassable.kind in kinds:
                its.learn(kinds.index(event.impassable.kind),
                          its.task.place(event.impassable.at), told=True)
                for i, kind in enumerate(kinds):
                    if kind == event.impassable.kind:
                        its.again(i)
