"""One mission by the clock in physics, played from decision to decision.

It drives the executor of `moonteam rollout` on the rows of the same engine; robots move by their
actuators and contacts alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NoReturn

import numpy as np
import numpy.typing as npt

from moonteam.errors import InputError
from moonteam.physics.backends import Backend, make_backend
from moonteam.planners.seconds.base import Moment
from moonteam.problem.mission import Mission
from moonteam.terrain.travel import Roads
from sim2grid.clock.prepare import by_the_clock, execution_of, roads_of
from sim2grid.loop.drive import Rows
from sim2grid.loop.prepare import Prepared, prepare

ENGINES = ("native", "mjx")

STILL_S = 10.0
"""s of standstill after which everybody is asked again: nobody under way, nothing to come."""


@dataclass(frozen=True)
class Stage:
    """A mission on its ground with its engine, which any number of sessions share."""

    prepared: Prepared
    roads: Roads
    backend: Backend

    @classmethod
    def of(cls, mission: Mission, source: object, engine: str) -> Stage:
        """Raises InputError for a mission that cannot be run by the clock, one with batteries, or
        no such engine.
        """
        if engine not in ENGINES:
            raise InputError("backend", f"{engine!r} is not allowed; {' or '.join(ENGINES)}")
        for i in mission.powered():
            raise InputError(source, "environments count no power; leave it out, or execute the "
                             "mission by moonteam rollout", f"robots[{i}].battery")
        prepared = prepare(by_the_clock(mission, source), source)
        return cls(prepared, roads_of(prepared), make_backend(engine, prepared.scene))

    @property
    def most_targets(self) -> int:
        """Targets of the mission, those that events bring included."""
        mission = self.prepared.mission
        return len(mission.targets) + sum(event.target is not None for event in mission.events)


class _Caller:
    """Decides nothing: whoever plays the session says what is done."""

    name = "actions"

    def reset(self, moment: Moment, seed: int = 0) -> None:
        """Nothing to start."""

    def act(self, moment: Moment) -> NoReturn:
        """Never asked."""
        raise AssertionError("a session is told its choices")

    def expected(self, moment: Moment) -> None:
        """Nothing is planned."""


class Session:
    """A mission under way, standing at a decision or at its end."""

    def __init__(self, stage: Stage):
        start = stage.prepared.scene.qpos0
        self.execution = execution_of(stage.prepared, _Caller(), 0, stage.roads)
        self._rows = Rows([self.execution], stage.backend, start[None], [[0]])
        self._rows.load(lambda index: None)

    @property
    def moment(self) -> Moment:
        """The mission as it stands."""
        return self.execution.moment()

    def play(self, choices: npt.ArrayLike | Sequence[int]) -> None:
        """To the next decision, or the end.

        `choices` [R] are what every robot goes for: the number of a target, `errand.HOME` or
        `errand.WAIT`; of robots that do not choose now they are not looked at.
        """
        execution, still_s = self.execution, 0.0
        if execution.finished:
            return
        execution.answer(np.asarray(choices, np.int64))
        while not execution.finished and execution.question is None:
            before = execution.book.time
            self._rows.advance()
            still_s = 0.0 if self._stirring() else still_s + execution.book.time - before
            if still_s >= STILL_S:
                execution.ask()

    def _stirring(self) -> bool:
        """Whether somebody is under way, or something is to come that asks by itself."""
        its = self.execution
        if any(errand.phase in ("going", "serving")
               for errand, here in zip(its.errands, its.known.mask, strict=True) if here):
            return True
        later = [0.0]
        for event in its.asked.mission.events:
            silence = event.silent.seconds if event.silent is not None else 0.0
            later.append((event.at_s or 0.0) + silence)
        for target, solved in zip(its.task.targets, its.solved, strict=True):
            later += [] if solved else [target.appears, target.lapses or 0.0]
        return max(later) > its.book.time

    def choosing(self) -> npt.NDArray[np.bool_]:
        """[R] who can choose now; nobody at the end."""
        return self.execution.choosing & (not self.execution.finished)
