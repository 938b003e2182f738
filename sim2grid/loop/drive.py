"""Drives executions on the rows of an engine until all of them have ended.

Legend: B rows of the backend, R robots, T samples of a look.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import jax
import numpy as np
import numpy.typing as npt

from moonteam.robots.base import CONTROL_PERIOD, Command
from moonteam.trees import where
from sim2grid.loop.asked import Asked


class Decider(Protocol):
    """Who answers an execution's questions."""

    def act(self, question: Any, /) -> Any:
        """The answer."""
        ...


class Driven(Protocol):
    """A mission under way: `execution.Execution`, or `sim2grid.clock`'s."""

    finished: bool
    question: Any  # None where nothing is asked

    @property
    def asked(self) -> Asked:
        """What does not change."""
        ...

    @property
    def planner(self) -> Decider:
        """Who answers."""
        ...

    def start(self, qpos: npt.ArrayLike) -> None:
        """Takes the first pose [nq]."""
        ...

    def commands(self) -> list[tuple[npt.NDArray, float, bool]]:
        """Waypoint [2] m, speed m/s and lost, for each robot."""
        ...

    def observe(self, qpos: npt.NDArray, power: npt.NDArray, propellant: npt.NDArray,
                period: float) -> None:
        """Takes what happened: qpos [T, nq], power, propellant [T, R]."""
        ...

    def answer(self, answer: Any, /) -> None:
        """Takes the answer to its question."""
        ...

    def diverged(self) -> None:
        """The engine could not go on."""
        ...

    def interrupt(self) -> None:
        """It ends where it stands."""
        ...


class Backend(Protocol):
    """What `run` needs of a physics backend; see moonteam.physics.backends."""

    log_every: int  # control steps between two samples of the log

    def reset(self, qpos: Any = None, batch: int = 1, /) -> Any:
        """Worlds at rest at qpos [B, nq]; a state's arrays have B rows, `diverged` is [B] bool.

        Of an engine whose scene has several grounds, `which` [B] comes third.
        """
        ...

    def advance(self, state: Any, commands: tuple[Command, ...],
                num_control_steps: int) -> tuple[Any, Any]:
        """Steps all worlds; the log holds qpos [B, T, nq], power and propellant_rate [B, T, R]."""
        ...


def run(executions: Sequence[Driven], backend: Backend, qpos: npt.ArrayLike,
        progress: Callable[[], None] = lambda: None, *, width: int = 0,
        rows: Sequence[int] = (), finished: Callable[[int], None] = lambda index: None,
        grounds: Sequence[int] = ()) -> None:
    """Drives executions on the rows of a backend to their ends.

    Executions of one row run one after the other. Floating point can differ between rows but
    not with what other rows hold, so a mission that keeps row and width keeps its outcome to
    the bit, alone or among others.

    Args:
      executions: not started; all with the same robots and rules.
      backend: of their scene.
      qpos: [nq] the pose in which all start, or [len(executions), nq].
      progress: called at each look.
      width: B; 0 for as many as there are executions.
      rows: the row of each execution; empty: they are dealt out in order.
      finished: called with the index of each execution that has ended.
      grounds: index of the ground of each execution, where the backend's scene has several.

    Ctrl-C ends those under way where they stand and is raised again.
    """
    width = width or len(executions)
    poses = np.asarray(qpos, float)
    poses = np.broadcast_to(poses, (len(executions), poses.shape[-1]))
    rows = rows or [k % width for k in range(len(executions))]
    queues = [[k for k, row in enumerate(rows) if row == b] for b in range(width)]
    fleet = Rows(executions, backend, poses, queues, grounds)
    try:
        while fleet.load(finished):
            fleet.answer()
            fleet.advance()
            progress()
    except KeyboardInterrupt:
        for index in fleet.busy():
            executions[index].interrupt()
        raise


class Rows:
    """The rows of a backend and the executions that take turns in them."""

    def __init__(self, executions: Sequence[Driven], backend: Backend, poses: npt.NDArray,
                 queues: list[list[int]], grounds: Sequence[int] = ()):
        self._executions, self._backend, self._queues = executions, backend, queues
        self._poses, self._rules, self._grounds = poses, executions[0].asked.rules, grounds
        self._now: list[int | None] = [None] * len(queues)
        self._idle = np.ones(len(queues), bool)
        self._state: Any = None

    def busy(self) -> list[int]:
        """Indices of executions under way."""
        return [k for k in self._now if k is not None and not self._executions[k].finished]

    def load(self, finished: Callable[[int], None]) -> bool:
        """Reports what has ended, starts what comes next; False when nothing is left."""
        fresh = np.zeros(len(self._queues), bool)
        for b, k in enumerate(self._now):
            while k is None or self._executions[k].finished:
                if k is not None:
                    finished(k)
                self._now[b] = k = self._queues[b].pop(0) if self._queues[b] else None
                if k is None:
                    break
                self._executions[k].start(self._poses[k])
                fresh[b] = True
        if fresh.any():
            self._reset(fresh)
        self._idle = np.array([k is None for k in self._now])
        return not self._idle.all()

    def answer(self) -> None:
        """Has the planners answer all questions at once."""
        busy = [self._executions[k] for k in self.busy()]
        asking = [execution for execution in busy if execution.question is not None]
        answers = [e.planner.act(e.question) for e in asking]
        for execution, actions in zip(asking, answers, strict=True):
            execution.answer(actions)

    def _reset(self, fresh: npt.NDArray[np.bool_]) -> None:
        """Puts the rows that are fresh [B] at their starts."""
        shown = [0 if k is None else k for k in self._now]
        which = [[self._grounds[k] for k in shown]] if self._grounds else []
        start = self._backend.reset(self._poses[shown], len(shown), *which)
        if self._state is None:
            self._state = start
            return
        self._state = where(fresh, jax.tree.map(np.asarray, start),
                            jax.tree.map(np.asarray, self._state))

    def advance(self) -> None:
        """Runs the engine to the next look and tells the executions; idle rows stand still."""
        if self._idle.any():
            still = np.asarray(self._state.diverged) | self._idle
            self._state = self._state._replace(diverged=still)
        self._state, log = self._backend.advance(
            self._state, self._commands(), self._rules.chunk_steps)
        poses, power = np.asarray(log.qpos), np.asarray(log.power)
        rate, gone = np.asarray(log.propellant_rate), np.asarray(self._state.diverged)
        period = CONTROL_PERIOD * self._backend.log_every
        for b, k in enumerate(self._now):
            if k is None:
                continue
            execution = self._executions[k]
            execution.observe(poses[b], power[b], rate[b], period)
            if gone[b] and not execution.finished:
                execution.diverged()

    def _commands(self) -> tuple[Command, ...]:
        """One Command a robot, its arrays with leading axis B."""
        asked = [None if k is None else self._executions[k].commands() for k in self._now]
        nothing = (np.zeros(2), 0.0, True)
        robots = len(next(rows for rows in asked if rows is not None))
        table = [[nothing] * robots if rows is None else rows for rows in asked]
        def column(robot: int, part: int, kind: type) -> Any:
            return np.array([row[robot][part] for row in table], kind)

        return tuple(Command(column(i, 0, np.float32), column(i, 1, np.float32),
                             column(i, 2, bool)) for i in range(robots))
