"""Executions run to their ends by the fused program: `--backend fused` of the commands."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy.typing as npt

from moonteam.errors import InputError
from moonteam.physics.backends import MjxBackend
from sim2grid.loop.execution import Execution
from sim2grid.loop.fused.deciders import decider_of
from sim2grid.loop.fused.program import Fused
from sim2grid.loop.fused.told import record_of

LACKS = ("fused: the whole loop as one program; a policy's likeliest actions without the deadlock "
         "watch, and one sample a look, so that tilts, ways and energy are measured more coarsely")
"""What a table must say of such rows."""


def check(execution: Execution) -> None:
    """Raises InputError for an execution that the program cannot run."""
    asked = execution.asked
    decider_of(asked.planner)
    if asked.mode != "barrier":
        raise InputError("--backend fused", "robots decide together in it; allowed: --mode barrier")
    if asked.route is not None:
        raise InputError("--backend fused", "plans cannot be walked blindly in it; allowed: "
                         "--loop closed and grid")
    if asked.mission.events:
        raise InputError("--backend fused", "takes missions without events; the other backends "
                         "take them: native, mjx")
    if asked.mission.powered():
        raise InputError("--backend fused", "takes missions without batteries; the other backends "
                         "take them: native, mjx")


def run(executions: Sequence[Execution], backend: MjxBackend, starts: npt.NDArray, width: int,
        finished: Callable[[int], None] = lambda index: None, grounds: Sequence[int] = ()
        ) -> tuple[float, float]:
    """Fills in the record of every execution; returns seconds compiling and running.

    Args:
      executions: missions of one scene and policy, none begun.
      backend: MJX with that scene.
      starts: [E, nq] qpos.
      width: missions in the program at a time; the last batch is filled up with copies.
      finished: called with the number of each that is done.
      grounds: index of the ground of each, where the backend's scene has several.

    Raises:
      InputError: see `check`.
    """
    for execution in executions:
        check(execution)
    asked = executions[0].asked
    decider, params = decider_of(asked.planner)
    program = Fused(backend, asked.frame, asked.bodies, decider, seconds=None, rules=asked.rules,
                    max_steps=max(e.asked.mission.max_steps for e in executions))
    compiling = running = 0.0
    for first in range(0, len(executions), width):
        batch = [min(k, len(executions) - 1) for k in range(first, first + width)]
        scenarios = [executions[k].asked.scenario for k in batch]
        poses = starts[batch]
        which = [grounds[k] for k in batch] if grounds else []
        compiling += program.compile(scenarios, poses, params, which)
        begun = time.perf_counter()
        outcome = program.run(scenarios, poses, params, which)
        outcome.progress.status.block_until_ready()
        running += time.perf_counter() - begun
        for row, k in enumerate(range(first, min(first + width, len(executions)))):
            one = executions[k]
            one.book.record = record_of(program.setup, outcome, row, one.asked.mission,
                                        one.asked.scenario)
            finished(k)
    return compiling, running
