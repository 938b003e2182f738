"""What a mission has in store: robots lost, slowed or silent, new targets, closed ground."""

from __future__ import annotations

import numpy as np

from moonteam.problem.mission import Event, Slow
from sim2grid.loop.asked import Asked
from sim2grid.loop.known import Known
from sim2grid.loop.logbook import Logbook


class Events:
    """The events of a mission that are still to come."""

    def __init__(self, asked: Asked):
        self._asked = asked
        self._left = sorted(asked.mission.events, key=lambda event: event.at_decision)
        self._names = [robot.name for robot in asked.mission.robots]

    @property
    def bring_targets(self) -> bool:
        """Whether a target is still to come."""
        return any(event.target for event in self._left)

    def apply(self, known: Known, book: Logbook) -> None:
        """All that is due at this decision."""
        for i in np.flatnonzero((known.silent_until == book.decision) & (known.silent_until > 0)):
            if known.mask[i]:
                book.note("heard_again")
        while self._left and self._left[0].at_decision <= book.decision:
            self._one(self._left.pop(0), known, book)

    def _one(self, event: Event, known: Known, book: Logbook) -> None:
        if event.lost is not None and known.mask[self._names.index(event.lost)]:
            known.drop(self._names.index(event.lost))
            book.lose(self._names.index(event.lost), "event")
        if event.target is not None:
            record = book.record
            record.targets.append(event.target)
            record.target_names.append(event.target.name or f"T{len(record.targets)}")
            known.snapshot = self._asked.with_targets(known.snapshot, [event.target])
            book.note("new_target")
        if event.slow is not None:
            self._slow(event.slow, known, book)
        if event.silent is not None:
            until = book.decision + event.silent.decisions
            known.silent_until[self._names.index(event.silent.robot)] = until
            book.note("silent")
        if event.impassable is not None:
            kinds = [robot.kind for robot in self._asked.mission.robots]
            if self._asked.route is None and event.impassable.kind in kinds:
                robot = kinds.index(event.impassable.kind)
                if known.learn(robot, np.array(event.impassable.at)):
                    book.note("impassable")

    def _slow(self, slow: Slow, known: Known, book: Logbook) -> None:
        """From now on a robot travels at a factor of its speed, and is given the time for it."""
        robot = self._names.index(slow.robot)
        before = float(known.speeds[robot])
        known.speeds[robot] = slow.factor * self._asked.bodies[robot].speed
        leg = book.legs[robot]
        if leg is not None and leg.ended is None:
            leg.limit_s = book.time + (leg.limit_s - book.time) * before / known.speeds[robot]
        book.note("slowed")
