"""How fast missions are executed: as one fused program, and step by step on both engines."""

from __future__ import annotations

import time
from typing import Any

import jax
import numpy as np
import numpy.typing as npt

from moonteam.grid.travel import problem_fields
from moonteam.physics.backends import MjxBackend, make_backend
from moonteam.physics.trials.speed import peak_memory_mb
from moonteam.planners.base import Snapshot
from moonteam.planners.learned import state_of
from sim2grid.loop.drive import run
from sim2grid.loop.execution import Execution
from sim2grid.loop.fused.deciders import Decider
from sim2grid.loop.fused.program import Fused
from sim2grid.loop.fused.state import SUCCESS
from sim2grid.study.fleet import Fleet


class DeciderPlanner:
    """A decider without memory as a planner for `execute`: the decisions of `fused`, one by one."""

    name = "decider"

    def __init__(self, decider: Decider, params: Any = None):
        self._decider, self._params = decider, params
        self._decide, self._search = jax.jit(decider.decide), jax.jit(problem_fields)

    def reset(self, snapshot: Snapshot, seed: int = 0) -> None:
        """Nothing is remembered."""

    def act(self, snapshot: Snapshot) -> npt.NDArray[np.int32]:
        """Joint action [R]."""
        state = state_of(snapshot)
        fields = self._search(state.problem)
        states = jax.tree.map(lambda a: np.asarray(a)[None], state)
        memory = self._decider.begin(1, len(snapshot.cells))
        _, actions = self._decide(
            self._params, memory, states, None if fields is None else fields[None],
            np.full(1, snapshot.max_steps, np.int32))
        return np.asarray(actions[0], np.int32)


def measure(fleet: Fleet, engine: str, decider: Decider, params: Any, max_steps: int,
            seconds: float) -> dict[str, Any]:
    """One row: all missions of a fleet on an engine: `fused`, `native` or `mjx`.

    Keys: compile_s; wall_s, cpu_s of the run alone; missions_per_s; simulated_s of all missions
    together until each was over; real_time_factor of these; solved missions.
    """
    if engine == "fused":
        compile_s, wall, cpu, looks, solved = _fused(fleet, decider, params, max_steps, seconds)
    else:
        compile_s, wall, cpu, looks, solved = _stepwise(fleet, engine, decider, params)
    count = len(fleet.missions)
    return {"engine": engine, "missions": count, "solved": solved, "compile_s": compile_s,
            "wall_s": wall, "cpu_s": cpu, "missions_per_s": count / wall,
            "simulated_s": looks, "real_time_factor": looks / wall,
            "peak_memory_mb": peak_memory_mb()}


def _fused(fleet: Fleet, decider: Decider, params: Any, max_steps: int, seconds: float
           ) -> tuple[float, float, float, float, int]:
    program = Fused(MjxBackend(fleet.scene), fleet.frame, fleet.bodies, decider,
                    max_steps=max_steps, seconds=seconds)
    compile_s = program.compile(fleet.scenarios, fleet.starts, params, fleet.grounds)
    begun, cpu = time.perf_counter(), time.process_time()
    outcome = jax.block_until_ready(
        program.run(fleet.scenarios, fleet.starts, params, fleet.grounds))
    wall, cpu = time.perf_counter() - begun, time.process_time() - cpu
    now = outcome.progress
    simulated = float(np.asarray(now.look).sum()) * program.setup.rules.chunk_s
    return compile_s, wall, cpu, simulated, int((np.asarray(now.status) == SUCCESS).sum())


def _stepwise(fleet: Fleet, engine: str, decider: Decider, params: Any
              ) -> tuple[float, float, float, float, int]:
    planner = DeciderPlanner(decider, params)
    executions = [Execution(mission, scenario, planner, fleet.bodies, fleet.frame)
                  for mission, scenario in zip(fleet.missions, fleet.scenarios, strict=True)]
    backend = make_backend(engine, fleet.scene)
    compile_s = backend.compile(len(executions), executions[0].asked.rules.chunk_steps)
    begun = time.perf_counter()
    planner.act(executions[0].snapshot)
    compile_s += time.perf_counter() - begun
    begun, cpu = time.perf_counter(), time.process_time()
    run(executions, backend, fleet.starts, grounds=fleet.grounds)
    wall, cpu = time.perf_counter() - begun, time.process_time() - cpu
    simulated = sum(execution.record.seconds() for execution in executions)
    return compile_s, wall, cpu, simulated, sum(e.record.success for e in executions)
