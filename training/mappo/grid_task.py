"""The grid world as the learner's task."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from moonteam.grid import env
from moonteam.grid.config import EnvConfig
from moonteam.grid.observe import observe
from moonteam.grid.types import State
from training.mappo.task import Outcome


class GridState(NamedTuple):
    """E grid worlds and the team effort spent in each episode so far."""

    world: State
    moves: Array  # [E] int32


@dataclass(frozen=True)
class GridTask:
    """Batches the pure functions of `moonteam.grid.env`; observes raw cells as int8."""

    config: EnvConfig

    @property
    def num_agents(self) -> int:
        """N."""
        return self.config.num_agents

    @property
    def max_steps(self) -> int:
        """T_max."""
        return self.config.max_steps

    def reset(self, key: Array, count: int) -> GridState:
        """`count` scenarios drawn from the config's family."""
        keys = jax.random.split(key, count)
        world = jax.vmap(lambda k: env.reset(self.config, k)[0])(keys)
        return GridState(world, jnp.zeros(count, jnp.int32))

    def observe(self, state: GridState) -> Array:
        """[E, N, D] int8 where the map's cells fit it, else int16."""
        kind = jnp.int8 if max(self.config.width, self.config.height) <= 128 else jnp.int16
        return jax.vmap(lambda s: observe(self.config, s))(state.world).astype(kind)

    def step(self, key: Array, state: GridState, action: Array) -> Outcome:
        """Action [E, N]; what appears later is drawn with the scenario, so the key is idle."""
        del key
        out = jax.vmap(lambda s, a: env.step(self.config, s, a))(state.world, action)
        moves = state.moves + jnp.sum(action != env.STAY, axis=1, dtype=jnp.int32)
        return Outcome(GridState(out.state, moves), out.reward, out.terminated, out.truncated,
                       out.state.step, moves)
