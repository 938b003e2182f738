"""Actor and critic as the learner calls them: on [T, E, N, ...] arrays of raw observations.

Legend: T steps, E environments, N agents, D observation length, H width, A actions.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from moonteam.policies import recurrent
from moonteam.policies.recurrent import Recurrent, RecurrentSpec


class Pair(NamedTuple):
    """Something that actor and critic each have: parameters, optimiser state, memory."""

    actor: Any
    critic: Any


@dataclass(frozen=True)
class Networks:
    """Static description of both networks; parameters travel apart from it."""

    actor: Recurrent
    critic: Recurrent
    scale: tuple[float, ...]  # [D] from raw observations to network input
    num_agents: int
    shared_value: bool = False
    """The critic reads all observations in the agents' order, the same for each agent: it runs
    once for the team, and its memory is [E, 1, H]. Otherwise each agent's own comes first."""

    def init(self, key: Array) -> Pair:
        """Fresh parameters."""
        keys = jax.random.split(key)
        own, flags = len(self.scale), jnp.zeros((1, 1), bool)
        memory = jnp.zeros((1, self.width))
        return Pair(
            self.actor.init(keys[0], memory, jnp.zeros((1, 1, own)), flags)["params"],
            self.critic.init(keys[1], memory, jnp.zeros((1, 1, own * self.num_agents)),
                             flags)["params"])

    @property
    def width(self) -> int:
        """H, length of the memory."""
        return self.actor.width

    def empty(self, num_envs: int) -> Pair:
        """Memory at the start, each [E, N, H]."""
        critics = 1 if self.shared_value else self.num_agents
        # two buffers: each can be donated
        return Pair(jnp.zeros((num_envs, self.num_agents, self.width)),
                    jnp.zeros((num_envs, critics, self.width)))

    def inputs(self, obs: Array) -> Array:
        """Raw observations [..., D] -> network input, float32."""
        scale = np.asarray(self.scale, np.float32).reshape((1,) * (obs.ndim - 1) + (-1,))
        return obs.astype(jnp.float32) * scale

    def logits(self, params: dict, hidden: Array, obs: Array, reset: Array) -> tuple[Array, Array]:
        """hidden [E, N, H], obs [T, E, N, D], reset [T, E] -> (hidden, [T, E, N, A])."""
        return _apply(self.actor, params, hidden, self.inputs(obs), reset)

    def values(self, params: dict, hidden: Array, obs: Array, reset: Array) -> tuple[Array, Array]:
        """hidden [E, N, H] or shared [E, 1, H], obs [T, E, N, D], reset [T, E] -> (hidden,
        [T, E, N]).
        """
        inputs = self.inputs(obs)
        if self.shared_value:
            everyone = inputs.reshape(*inputs.shape[:2], 1, -1)
        else:
            everyone = recurrent.own_first(inputs)
        hidden, values = _apply(self.critic, params, hidden, everyone, reset)
        return hidden, jnp.broadcast_to(values[..., 0], obs.shape[:-1])


def _apply(net: Recurrent, params: dict, hidden: Array, inputs: Array,
           reset: Array) -> tuple[Array, Array]:
    steps, envs, agents = inputs.shape[:3]
    flat = inputs.reshape(steps, envs * agents, inputs.shape[3])
    flags = jnp.repeat(reset, agents, axis=1)
    result: Any = net.apply({"params": params}, hidden.reshape(envs * agents, -1), flat, flags)
    after, out = result
    return after.reshape(hidden.shape), out.reshape(steps, envs, agents, -1)


def for_spec(spec: RecurrentSpec, precision: str = "float32") -> Networks:
    """The paper's networks for a policy spec. `precision`: float32, tf32 or bfloat16."""
    dtype = jnp.dtype(jnp.bfloat16) if precision == "bfloat16" else None
    return Networks(recurrent.actor(spec, dtype), recurrent.critic(spec, dtype),
                    tuple(float(s) for s in spec.obs_scale()), spec.num_agents)


@contextmanager
def matmul_precision(precision: str) -> Iterator[None]:
    """How float32 matrix products are done inside: in full, or as TF32 where the device can."""
    with jax.default_matmul_precision("tensorfloat32" if precision == "tf32" else "float32"):
        yield
