"""Collection: E environments step side by side under the current policy.

Three flags, never one: `reset_before` (an episode begins at this observation, the memory is
emptied), `terminated` (this step was a true end), `truncated` (this step was cut off).

Episodes begin from a pool of E fresh starts drawn once a rollout and dealt out in turn, so
that drawing scenarios costs one draw an environment and rollout, not one a step.

Legend: T steps, E environments, N agents, D observation length, H width.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from moonteam import trees
from training import sharding
from training.mappo.networks import Networks, Pair
from training.mappo.task import EnvState, Task


class Carry(NamedTuple):
    """Where collection stopped and goes on from."""

    state: EnvState
    obs: Array  # [E, N, D]
    reset_before: Array  # [E] bool
    memory: Pair  # [E, N, H] each


class Transition(NamedTuple):
    """What the update needs of one step; stacked over T by the scan."""

    obs: Array  # [E, N, D] as the task gives it (small integers)
    reset_before: Array  # [E] bool
    action: Array  # [E, N] int8
    log_prob: Array  # [E, N]
    value: Array  # [E, N]
    reward: Array  # [E, N]
    terminated: Array  # [E] bool
    truncated: Array  # [E] bool


class Cut(NamedTuple):
    """The final observation and critic memory of each environment's last truncation."""

    obs: Array  # [E, N, D]
    memory: Array  # [E, N, H]


class Tally(NamedTuple):
    """Sums over the episodes that ended."""

    episodes: Array
    solved: Array
    steps: Array
    moves: Array


class Rollout(NamedTuple):
    """A collected batch, with the value of what followed it."""

    before: Pair  # memory at the first step, [E, N, H] each
    steps: Transition  # [T, ...]
    last_value: Array  # [E, N] value after the last step
    cut_value: Array  # [E, N] value of the final observation where truncated
    tally: Tally


class _Walk(NamedTuple):
    carry: Carry
    cut: Cut
    tally: Tally  # of each environment, [E]


def begin(networks: Networks, task: Task, key: Array, num_envs: int) -> Carry:
    """Fresh episodes in all environments, empty memory."""
    state = task.reset(key, num_envs)
    return Carry(state, task.observe(state), jnp.ones(num_envs, bool), networks.empty(num_envs))


def collect(networks: Networks, task: Task, params: Pair, carry: Carry, key: Array,
            num_steps: int) -> tuple[Carry, Rollout]:
    """Steps every environment `num_steps` times with sampled actions."""
    num_envs = carry.reset_before.shape[0]
    pool_key, walk_key = jax.random.split(key)
    pool = task.reset(pool_key, num_envs)
    # Dealt out across devices: fetched once, not at every step.
    starts = sharding.whole(sharding.along((pool, task.observe(pool)), 0))

    def step(walk: _Walk, t: Array) -> tuple[_Walk, Transition]:
        return _step(networks, task, params, walk, starts, jax.random.fold_in(walk_key, t), t)

    zero = jnp.zeros(num_envs, jnp.int32)
    walk = _Walk(carry, Cut(carry.obs, carry.memory.critic), Tally(zero, zero, zero, zero))
    walk, steps = jax.lax.scan(step, walk, jnp.arange(num_steps))
    last_value, cut_value = _following_values(networks, params, walk)
    tally = jax.tree.map(jnp.sum, walk.tally)
    return walk.carry, Rollout(carry.memory, steps, last_value, cut_value, tally)


def _step(networks: Networks, task: Task, params: Pair, walk: _Walk, starts: tuple[EnvState, Array],
          key: Array, t: Array) -> tuple[_Walk, Transition]:
    carry, (pool, pool_obs) = walk.carry, starts
    act_key, env_key = jax.random.split(key)
    obs, reset = carry.obs[None], carry.reset_before[None]
    actor_memory, logits = networks.logits(params.actor, carry.memory.actor, obs, reset)
    critic_memory, value = networks.values(params.critic, carry.memory.critic, obs, reset)
    action = jax.random.categorical(act_key, logits[0])
    out = task.step(env_key, carry.state, action)
    final_obs = task.observe(out.state)

    ended = out.terminated | out.truncated
    fresh, fresh_obs = jax.tree.map(lambda x: jnp.roll(x, t, axis=0), (pool, pool_obs))
    state, obs_next = trees.where(ended, (fresh, fresh_obs), (out.state, final_obs))
    following = Carry(state, obs_next, ended, Pair(actor_memory, critic_memory))
    cut = trees.where(out.truncated, Cut(final_obs, critic_memory), walk.cut)
    tally = Tally(*(total + new for total, new in zip(walk.tally, (
        ended, out.terminated, jnp.where(ended, out.steps, 0), jnp.where(ended, out.moves, 0)),
        strict=True)))
    transition = Transition(
        carry.obs, carry.reset_before, action.astype(jnp.int8), log_prob(logits[0], action),
        value[0], out.reward, out.terminated, out.truncated)
    return _Walk(following, cut, tally), transition


def _following_values(networks: Networks, params: Pair, walk: _Walk) -> tuple[Array, Array]:
    """[E, N] values of the states after the rollout and of the cut-off final states."""
    carry, cut = walk.carry, walk.cut
    obs = jnp.concatenate([carry.obs, cut.obs])[None]
    memory = jnp.concatenate([carry.memory.critic, cut.memory])
    reset = jnp.concatenate([carry.reset_before, jnp.zeros_like(carry.reset_before)])[None]
    _, values = networks.values(params.critic, memory, obs, reset)
    last, cut_value = jnp.split(values[0], 2)
    return last, cut_value


def log_prob(logits: Array, action: Array) -> Array:
    """Log-probability [...] of action [...] under logits [..., A]."""
    chosen = jax.nn.one_hot(action, logits.shape[-1], dtype=logits.dtype)
    return jnp.sum(jax.nn.log_softmax(logits) * chosen, axis=-1)
