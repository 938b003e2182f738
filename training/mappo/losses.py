"""The two losses of clipped PPO, on whole sequences so that the memory is replayed.

Schulman et al. 2017; value clipping as in Yu et al. 2022 (MAPPO).

Legend: T steps, E environments of the minibatch, N agents.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from training.mappo.networks import Networks, Pair
from training.mappo.rollout import Transition, log_prob


class Minibatch(NamedTuple):
    """Whole sequences of some environments."""

    memory: Pair  # [E, N, H] at the first step
    steps: Transition  # [T, E, ...]
    advantage: Array  # [T, E, N]
    target: Array  # [T, E, N] value target


class ActorReport(NamedTuple):
    """Means over the minibatch."""

    policy_loss: Array
    entropy: Array
    approx_kl: Array
    clipped: Array


def actor_loss(params: dict, networks: Networks, batch: Minibatch, clip_eps: float,
               ent_coef: float) -> tuple[Array, ActorReport]:
    """-min(r A, clip(r, 1 - e, 1 + e) A) - c H(pi), A normalised over the minibatch."""
    steps = batch.steps
    _, logits = networks.logits(params, batch.memory.actor, steps.obs, steps.reset_before)
    log_ratio = log_prob(logits, steps.action) - steps.log_prob
    ratio = jnp.exp(log_ratio)
    advantage = (batch.advantage - batch.advantage.mean()) / (batch.advantage.std() + 1e-8)
    limited = jnp.clip(ratio, 1.0 - clip_eps, 1.0 + clip_eps)
    loss = -jnp.minimum(ratio * advantage, limited * advantage).mean()
    log_probs = jax.nn.log_softmax(logits)
    entropy = -jnp.sum(jnp.exp(log_probs) * log_probs, axis=-1).mean()
    report = ActorReport(loss, entropy, (ratio - 1.0 - log_ratio).mean(),
                         (jnp.abs(ratio - 1.0) > clip_eps).mean())
    return loss - ent_coef * entropy, report


def critic_loss(params: dict, networks: Networks, batch: Minibatch, clip_eps: float,
                vf_coef: float) -> Array:
    """c/2 max((V - G)^2, (V_old + clip(V - V_old, -e, e) - G)^2)."""
    steps = batch.steps
    _, values = networks.values(params, batch.memory.critic, steps.obs, steps.reset_before)
    near = steps.value + jnp.clip(values - steps.value, -clip_eps, clip_eps)
    worst = jnp.maximum((values - batch.target) ** 2, (near - batch.target) ** 2)
    return vf_coef * 0.5 * worst.mean()
