"""Whole missions as one jitted program on MJX: decisions, waypoints, controllers, physics, cells.

What an `Execution` does in barrier mode, by the same rules: any number of missions of one scene
run side by side without coming back to Python, on a CPU or an accelerator. What it lacks:

- events, async mode and open loops;
- planners other than a policy's likeliest actions, and the watch for circles over these;
- time is single precision, so a leg may time out, or a fall be noticed, one look apart;
- one sample is kept of each look, not five, so tilts and ways are measured more coarsely;
- a mission that lasts longer than `seconds` is cut off.

Legend as in `state`.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array

from moonteam.grid import scenarios
from moonteam.grid.types import Problem
from moonteam.physics.backends import MjxBackend, WorldState, in_order
from moonteam.problem.scenario import Scenario
from moonteam.trees import where
from sim2grid.frame import Frame
from sim2grid.loop.asked import Body
from sim2grid.loop.fused.decide import decide
from sim2grid.loop.fused.deciders import Decider
from sim2grid.loop.fused.look import command, observe
from sim2grid.loop.fused.state import (
    ENGINE,
    UNDER_WAY,
    Outcome,
    Progress,
    Setup,
    Trace,
    begin,
    ground_of,
    keep_look,
)
from sim2grid.loop.rules import Rules, patience


class _Carry(NamedTuple):
    worlds: WorldState
    progress: Progress
    trace: Trace
    memory: Any


class Fused:
    """Missions of one scene in one program.

    Args:
      backend: MJX with the scene of all missions.
      frame: the map on the ground.
      bodies: the scene's robots.
      decider: who decides.
      max_steps: D, decisions after which a mission has failed.
      rules: as in `execute`.
      seconds: mission seconds after which a mission is cut off; None: late enough for every
        leg to time out.
    """

    def __init__(self, backend: MjxBackend, frame: Frame, bodies: Sequence[Body],
                 decider: Decider, *, max_steps: int = 128, rules: Rules | None = None,
                 seconds: float | None = 600.0):
        self.backend, self.decider = backend, decider
        rules = rules or Rules()
        longest = patience(rules, 2.0 * frame.cell_m, min(body.speed for body in bodies))
        most = max_steps * (longest + rules.chunk_s) if seconds is None else seconds
        self.setup = Setup(
            frame, rules, tuple(b.base for b in bodies), tuple(b.speed for b in bodies),
            tuple(b.flies for b in bodies), tuple(b.fall_tilt for b in bodies), max_steps,
            round(most / rules.chunk_s))
        self._programs: dict[Any, jax.stages.Compiled] = {}

    def run(self, missions: Sequence[Scenario], starts: npt.ArrayLike, params: Any = None,
            grounds: Sequence[int] = ()) -> Outcome:
        """Runs missions from qpos `starts` [nq] or [B, nq] to their ends.

        `grounds` [B]: the ground of each, where the backend's scene has several.
        """
        arguments = self._arguments(missions, starts, params, grounds)
        return self._program(arguments)(*arguments)

    def compile(self, missions: Sequence[Scenario], starts: npt.ArrayLike, params: Any = None,
                grounds: Sequence[int] = ()) -> float:
        """Compiles for missions of that size; returns the seconds it took."""
        begun = time.perf_counter()
        self._program(self._arguments(missions, starts, params, grounds))
        return time.perf_counter() - begun

    def _arguments(self, missions: Sequence[Scenario], starts: npt.ArrayLike, params: Any,
                   grounds: Sequence[int] = ()) -> tuple[Any, ...]:
        problems, _ = scenarios.stack([scenarios.to_problem(mission) for mission in missions])
        poses = np.asarray(starts, np.float32)
        poses = np.broadcast_to(poses, (len(missions), poses.shape[-1]))
        return (self.backend.model, self.backend.scene.ground, params, _charted(problems),
                self.backend.reset(poses, len(poses), grounds or None))

    def _program(self, arguments: tuple[Any, ...]) -> jax.stages.Compiled:
        shapes = jax.tree.map(lambda a: (jnp.shape(a), jnp.result_type(a)), arguments[2:])
        leaves, treedef = jax.tree.flatten(shapes)
        key = (tuple(leaves), treedef)
        if key not in self._programs:
            program = jax.jit(partial(_run, self.setup, self.decider, self.backend.traced))
            self._programs[key] = program.lower(*arguments).compile(in_order())
        return self._programs[key]


def _charted(problems: Problem) -> Problem:
    """Problems whose ground is a map even where all of it is open: some may be learned."""
    if problems.passable is not None:
        return problems
    batch, (width, height) = problems.size.shape[0], np.max(problems.size, axis=0).tolist()
    kinds = int(np.max(problems.agent_kinds)) + 1
    return replace(problems, passable=jnp.ones((batch, kinds, height, width), bool))


def _run(setup: Setup, decider: Decider, advance: Any, model: Any, ground: Any, params: Any,
         problems: Problem, worlds: WorldState) -> Outcome:
    """The loop over looks; all arrays have the leading axis B."""
    batch, robots = problems.agent_mask.shape
    charted = jax.vmap(ground_of)(problems)
    progress, trace = jax.vmap(partial(begin, setup))(problems, worlds.qpos)

    def under_way(carry: _Carry) -> Array:
        now = carry.progress
        return jnp.any((now.status == UNDER_WAY) & (now.look < setup.looks))

    def ask(carry: _Carry) -> _Carry:
        return _Carry(carry.worlds, *decide(setup, decider, params, problems, charted,
                                            carry.progress, carry.trace, carry.memory))

    def look(carry: _Carry) -> _Carry:
        # A true branch: the network is only asked at looks where some mission decides.
        carry = jax.lax.cond(jnp.any(carry.progress.asking), ask, lambda c: c, carry)
        progress = carry.progress
        active = progress.status == UNDER_WAY
        commands = jax.vmap(partial(command, setup))(progress)
        worlds, log = advance(model, ground, carry.worlds, commands, setup.rules.chunk_steps)
        after = jax.vmap(partial(observe, setup))(problems, charted, progress, log.qpos)
        gone = worlds.diverged & (after.status == UNDER_WAY)
        after = after._replace(status=jnp.where(gone, ENGINE, after.status))
        trace = jax.vmap(keep_look)(active, progress.look, after, log, carry.trace)
        return _Carry(worlds, where(active, after, progress), trace, carry.memory)

    carry = jax.lax.while_loop(
        under_way, look, _Carry(worlds, progress, trace, decider.begin(batch, robots)))
    return Outcome(worlds.qpos, carry.progress, carry.trace)
