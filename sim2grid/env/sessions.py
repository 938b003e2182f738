"""Sessions by the choices that led to them, so that an environment's state can be plain data.

A state says which mission it is of and every joint choice so far; what comes of one more is a pure
function of that. The session that has come as far is kept and goes on; where there is none (a
state that was branched from, or long ago) the choices are played again from the start.

Legend: B rows, N robots, M targets, S skills, K decisions at most.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import jax
import numpy as np
import numpy.typing as npt
from jax import Array

from moonteam.grid.macro.types import FAR, MacroProblem, plain
from moonteam.planners.seconds.keeper import HOME, WAIT
from moonteam.planners.seconds.macro import problem_of
from sim2grid.env.session import Session, Stage

Int32 = npt.NDArray[np.int32]

KEPT = 32
"""Sessions that are kept at least; of a batch of rows, twice as many as rows."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Seen:
    """A moment at which somebody has to choose, or the end. Choices are numbered as actions."""

    problem: MacroProblem  # what is still to be done; its time 0 is now
    choice: Array  # [N] int32, what each robot is about
    can: Array  # [N] bool, robots that choose now
    now: Array  # [] float32 s of the mission
    success: Array  # [] bool, every target is solved and everybody is home
    failed: Array  # [] bool


@dataclass(frozen=True)
class Sizes:
    """What all missions of an environment have in common."""

    robots: int
    targets: int  # M, of the mission that has most
    skills: tuple[str, ...]

    @classmethod
    def of(cls, stages: Sequence[Stage]) -> Sizes:
        """Of these missions, which have equally many robots."""
        missions = [stage.prepared.mission for stage in stages]
        skills = {skill for mission in missions for robot in mission.robots
                  for skill in robot.skills}
        wanted = {skill for mission in missions
                  for target in (*mission.targets, *(e.target for e in mission.events if e.target))
                  for skill in target.needs()}
        return cls(len(missions[0].robots), max(stage.most_targets for stage in stages),
                   tuple(sorted(skills | wanted)))


class Sessions:
    """Plays missions on the host."""

    def __init__(self, stages: Sequence[Stage], sizes: Sizes):
        self.stages, self.sizes = stages, sizes
        self._kept: OrderedDict[tuple[int, bytes], Session] = OrderedDict()
        self._lock, self._most = threading.Lock(), KEPT

    def session(self, mission: int, history: Int32) -> Session:
        """The session of a mission after the choices [k, N]."""
        with self._lock:
            return self._session(mission, history)

    def seen(self, mission: int, history: Int32) -> Seen:
        """What is seen there (NumPy arrays)."""
        with self._lock:
            session = self._session(mission, history)
            return self._seen(session)

    def rows(self, mission: Array, count: Array, history: Array) -> Seen:
        """The same of any batch of states: mission [..], count [..], history [.., K, N]."""
        missions, counts, histories = (np.asarray(x) for x in (mission, count, history))
        shape = missions.shape
        table = histories.reshape(-1, *histories.shape[-2:])
        with self._lock:
            self._keep(2 * missions.size)
            found = [self._seen(self._session(int(m), rows[:k])) for m, k, rows in zip(
                missions.reshape(-1), counts.reshape(-1).tolist(), table, strict=True)]
        return jax.tree.map(lambda *x: np.stack(x).reshape(shape + np.shape(x[0])), *found)

    def choices(self, actions: npt.ArrayLike) -> Int32:
        """Choices of the executor: M is WAIT, M + 1 is HOME."""
        acts, targets = np.asarray(actions, np.int32), self.sizes.targets
        return np.where(acts == targets, WAIT, np.where(acts > targets, HOME, acts))

    def actions(self, choices: npt.ArrayLike) -> Int32:
        """The other way."""
        told, targets = np.asarray(choices, np.int32), self.sizes.targets
        return np.where(told == WAIT, targets, np.where(told == HOME, targets + 1, told))

    def _session(self, mission: int, history: Int32) -> Session:
        key = (mission, history.tobytes())
        if key in self._kept:
            self._kept.move_to_end(key)
            return self._kept[key]
        session = self._kept.pop((mission, history[:-1].tobytes()), None)
        if session is None:
            session = Session(self.stages[mission])
            for row in history[:-1]:
                session.play(self.choices(row))
        for row in history[-1:]:
            session.play(self.choices(row))
        self._kept[key] = session
        self._keep(0)
        return session

    def _keep(self, rows: int) -> None:
        """Makes room for so many, and forgets who was asked for longest ago."""
        self._most = max(self._most, rows)
        while len(self._kept) > self._most:
            self._kept.popitem(last=False)

    def _seen(self, session: Session) -> Seen:
        execution = session.execution
        told: Any = (self.actions([errand.choice for errand in execution.errands]),
                     session.choosing(), np.float32(execution.book.time),
                     np.bool_(execution.finished and execution.record.success),
                     np.bool_(execution.finished and not execution.record.success))
        return Seen(self._padded(problem_of(session.moment), execution.task.skills), *told)

    def _padded(self, problem: MacroProblem, skills: list[str]) -> MacroProblem:
        """The problem with the sizes that all missions have in common."""
        agents, targets, names = self.sizes.robots, self.sizes.targets, self.sizes.skills
        far, none = np.float32(FAR), np.bool_(False)
        blank = plain(
            np.full((agents, targets), far), np.full((agents, targets, targets), far),
            np.full((agents, len(names)), none), np.zeros((targets, len(names)), np.int32),
            np.full(targets, none), limit=problem.limit, agent_mask=np.full(agents, none),
            target_mask=np.full(targets, none), unit=problem.unit)
        columns = [names.index(skill) for skill in skills]
        whole: dict[str, Any] = {}
        for field in fields(MacroProblem):
            if getattr(problem, field.name) is None:  # of hidden targets a moment says nothing
                continue
            value, room = np.asarray(getattr(problem, field.name)), getattr(blank, field.name)
            whole[field.name] = room = np.array(room)
            if field.name in ("has", "need"):
                room[:len(value), columns] = value
            else:
                room[tuple(slice(length) for length in value.shape)] = value
        return MacroProblem(**whole)
