"""Generalised advantage estimation, with true ends and cut-offs kept apart.

Schulman et al. 2016, equations 11 to 16:
delta_t = r_t + gamma * (1 - terminated_t) * V(s'_t) - V(s_t),
A_t = delta_t + gamma * lambda * (1 - terminated_t) * (1 - truncated_t) * A_{t+1}.
V(s'_t) is the value of the state that step t really led to: where an episode was cut off,
that is its final observation, not the first one of the next episode.

Legend: T steps, any batch axes after it.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array


def advantages(rewards: Array, values: Array, next_values: Array, terminated: Array,
               truncated: Array, gamma: float, gae_lambda: float) -> Array:
    """All arguments [T, ...] of one shape -> advantages [T, ...]."""
    alive = 1.0 - terminated.astype(rewards.dtype)
    deltas = rewards + gamma * alive * next_values - values
    decay = gamma * gae_lambda * alive * (1.0 - truncated.astype(rewards.dtype))

    def back(following: Array, at: tuple[Array, Array]) -> tuple[Array, Array]:
        delta, factor = at
        advantage = delta + factor * following
        return advantage, advantage

    return jax.lax.scan(back, jnp.zeros_like(deltas[0]), (deltas, decay), reverse=True)[1]


def successor_values(values: Array, last: Array, cut: Array, truncated: Array) -> Array:
    """V(s'_t) [T, ...]: the next step's value, or `cut` [...] where step t was truncated.

    `last` [...] is the value of the state after the last step. At most one truncation an
    environment fits in T steps (T <= max_steps), so one `cut` value suffices.
    """
    following = jnp.concatenate([values[1:], last[None]])
    return jnp.where(truncated, cut[None], following)
