"""An environment of JaxMARL as the learner's task, for comparisons; jaxmarl itself is optional.

Legend: E environments, N agents, D observation length.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from moonteam.errors import InputError
from training.mappo.task import Outcome


class JaxmarlState(NamedTuple):
    """E environments' own states and the steps of each episode so far."""

    world: Any  # leading axis E
    steps: Array  # [E] int32


@dataclass(frozen=True)
class JaxmarlTask:
    """Agents stacked in the env's order; all of them observe and act alike, all end together.

    An env that is done after its `max_steps` or more ran out of time, an earlier end is a true
    one. Renewal of ended episodes is the learner's: the env's own `step_env` is called.
    """

    name: str

    @property
    def env(self) -> Any:
        """The MultiAgentEnv. Raises InputError where jaxmarl, or the env in it, is missing."""
        return _make(self.name)

    @property
    def num_agents(self) -> int:
        """N."""
        return self.env.num_agents

    @property
    def num_actions(self) -> int:
        """Actions of each agent."""
        return int(self.env.action_space(self.env.agents[0]).n)

    @property
    def obs_size(self) -> int:
        """D."""
        return int(self.env.observation_space(self.env.agents[0]).shape[0])

    @property
    def max_steps(self) -> int:
        """Of the env's own making."""
        return self.env.max_steps

    def reset(self, key: Array, count: int) -> JaxmarlState:
        """`count` fresh episodes."""
        _, world = jax.vmap(self.env.reset)(jax.random.split(key, count))
        return JaxmarlState(world, jnp.zeros(count, jnp.int32))

    def observe(self, state: JaxmarlState) -> Array:
        """[E, N, D] float32."""
        return self._stack(jax.vmap(self.env.get_obs)(state.world))

    def step(self, key: Array, state: JaxmarlState, action: Array) -> Outcome:
        """Action [E, N]; team effort is not counted."""
        named = {name: action[:, i] for i, name in enumerate(self.env.agents)}
        keys = jax.random.split(key, action.shape[0])
        _, world, reward, done, _ = jax.vmap(self.env.step_env)(keys, state.world, named)
        steps = state.steps + 1
        ended, late = done["__all__"], steps >= self.max_steps
        return Outcome(JaxmarlState(world, steps), self._stack(reward), ended & ~late,
                       ended & late, steps, jnp.zeros_like(steps))

    def _stack(self, named: dict[str, Array]) -> Array:
        """[E, ...] of each agent -> [E, N, ...]."""
        return jnp.stack([named[name] for name in self.env.agents], axis=1)


@lru_cache
def _make(name: str) -> Any:
    try:
        import jaxmarl
    except ImportError as error:
        raise InputError("jaxmarl", f"{error}; pip install 'moonteam[test]' or pip install jaxmarl "
                         "six") from None
    try:
        return jaxmarl.make(name)
    except ValueError:
        raise InputError(name, "no such environment in jaxmarl") from None
