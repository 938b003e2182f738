"""Who decides inside the program. Legend: B missions, R robots."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from jax import Array

from moonteam.errors import InputError
from moonteam.grid import env
from moonteam.grid.travel import first_step
from moonteam.grid.types import State
from moonteam.planners.base import Planner
from moonteam.planners.learned import LearnedPlanner
from moonteam.planners.pointing import PointingPlanner
from moonteam.policies.brain import Brain


class Decider(Protocol):
    """Who decides: a pure function, hashable, for it is static under jit."""

    def begin(self, missions: int, robots: int) -> Any:
        """Empty memory; every array in it begins with the axis B."""
        ...

    def decide(self, params: Any, memory: Any, states: State, fields: Array | None,
               horizon: Array) -> tuple[Any, Array]:
        """(memory, joint actions [B, R]); `states`, `fields` and `horizon` have the axis B."""
        ...


@dataclass(frozen=True)
class PolicyDecider:
    """The likeliest actions of a policy's network; its `params` are given to `Fused.run`.

    What the planner policy does with plain-argmax: nothing watches for circles.
    """

    brain: Brain
    preference: float = 0.0  # 0 time .. 1 effort

    def begin(self, missions: int, robots: int) -> Any:
        """See `Decider`."""
        return self.brain.begin(missions, robots)

    def decide(self, params: Any, memory: Any, states: State, fields: Array | None,
               horizon: Array) -> tuple[Any, Array]:
        """See `Decider`. Where ground is closed, moves that it turns back are never chosen."""
        memory, logits = self.brain.logits(params, memory, states, fields, horizon,
                                           jnp.full(horizon.shape, self.preference))
        passable = states.problem.passable
        if passable is not None:
            closed = ~passable.all(axis=(1, 2, 3))[:, None, None]
            barred = closed & ~jax.vmap(env.available)(states)
            logits = jnp.where(barred, -1e9, logits)
        return memory, jnp.argmax(logits, axis=-1)


@dataclass(frozen=True)
class FirstOpen:
    """All robots that can help with the first open target go to it; the others stay."""

    def begin(self, missions: int, robots: int) -> Any:
        """Nothing."""
        del missions, robots
        return ()

    def decide(self, params: Any, memory: Any, states: State, fields: Array | None,
               horizon: Array) -> tuple[Any, Array]:
        """See `Decider`."""
        del params, horizon
        if fields is None:
            return memory, jax.vmap(lambda s: self._one(s, None))(states)
        return memory, jax.vmap(self._one)(states, fields)

    def _one(self, state: State, fields: Array | None) -> Array:
        problem = state.problem
        target = jnp.argmax(problem.target_mask & ~state.solved)
        toward = first_step(problem, fields, state.cells)[:, target]  # [R, 4]
        able = (problem.agent_skills & problem.target_skills[target]) != 0
        return jnp.where(able & jnp.any(toward, axis=1), jnp.argmax(toward, axis=1), env.STAY)


def decider_of(planner: Planner) -> tuple[Decider, Any]:
    """A planner as a decider with its parameters. Raises InputError for one that cannot be."""
    if not isinstance(planner, LearnedPlanner | PointingPlanner):
        raise InputError("--backend fused", f"the planner {planner.name} cannot be part of a "
                         "program for MJX; allowed: --planner policy with --decode argmax or "
                         "plain-argmax")
    drawn = planner.decode != "argmax" if isinstance(planner, LearnedPlanner) else (
        planner.decode.sample)
    if drawn:
        raise InputError("--backend fused", "a policy inside the program takes its likeliest "
                         "actions; allowed: --decode argmax or plain-argmax")
    return PolicyDecider(planner.policy.brain, planner.preference), planner.policy.params
