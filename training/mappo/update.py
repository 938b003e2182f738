"""One PPO update, and a jitted chunk of them.

Legend: T steps, E environments, N agents.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array
from jax.sharding import Mesh
from jax.typing import ArrayLike

from training import sharding
from training.mappo import gae, losses, rollout
from training.mappo.hyper import Hyper
from training.mappo.losses import ActorReport, Minibatch
from training.mappo.networks import Networks, Pair
from training.mappo.rollout import Carry, Rollout, Tally
from training.mappo.task import Task


class Learner(NamedTuple):
    """Everything that a resumed run needs to go on as if never stopped."""

    params: Pair
    optimiser: Pair
    carry: Carry
    key: Array
    update: Array  # [] int32, updates done in this phase


class Report(NamedTuple):
    """One update, reduced on the device."""

    actor: ActorReport
    value_loss: Array
    mean_reward: Array  # per agent and step
    tally: Tally


def optimiser(hyper: Hyper) -> optax.GradientTransformation:
    """Adam behind a gradient-norm clip; the rate falls linearly, once an update."""
    per_update = hyper.num_minibatches * hyper.update_epochs

    def rate(count: ArrayLike) -> Array:
        return hyper.lr * (1.0 - (jnp.asarray(count) // per_update) / hyper.updates)

    return optax.chain(optax.clip_by_global_norm(hyper.max_grad_norm),
                       optax.adam(rate, eps=hyper.adam_eps))


def begin(networks: Networks, task: Task, hyper: Hyper, num_envs: int, key: Array,
          params: Pair | None = None) -> Learner:
    """A phase's first state; `params` from the phase before, else fresh ones."""
    init_key, env_key, key = jax.random.split(key, 3)
    params = networks.init(init_key) if params is None else params
    fresh = optimiser(hyper)
    return Learner(params, Pair(fresh.init(params.actor), fresh.init(params.critic)),
                   rollout.begin(networks, task, env_key, num_envs), key,
                   jnp.zeros((), jnp.int32))


def shared(mesh: Mesh, learner: Learner) -> Learner:
    """Environments shared out over the devices, everything else on each of them."""
    whole = sharding.everywhere(mesh, learner._replace(carry=()))
    return whole._replace(carry=sharding.spread(mesh, learner.carry))


def targets(batch: Rollout, hyper: Hyper) -> tuple[Array, Array]:
    """Advantages and value targets [T, E, N] of a rollout."""
    steps = batch.steps
    shape = steps.value.shape
    terminated = jnp.broadcast_to(steps.terminated[..., None], shape)
    truncated = jnp.broadcast_to(steps.truncated[..., None], shape)
    if hyper.timeout_is_terminal:
        terminated, truncated = terminated | truncated, jnp.zeros_like(truncated)
    following = gae.successor_values(steps.value, batch.last_value, batch.cut_value, truncated)
    advantage = gae.advantages(steps.reward, steps.value, following, terminated, truncated,
                               hyper.gamma, hyper.gae_lambda)
    return advantage, advantage + steps.value


def order(key: Array, num_envs: int, count: int) -> Array:
    """[count, E / count] environments in random order, one row a minibatch."""
    return jax.random.permutation(key, num_envs).reshape(count, num_envs // count)


def minibatch(batch: Rollout, advantage: Array, target: Array, index: Array) -> Minibatch:
    """The whole sequences of the environments `index`, shared out over the devices."""
    sequences = jax.tree.map(lambda x: x[:, index], (batch.steps, advantage, target))
    memory = jax.tree.map(lambda x: x[index], batch.before)
    return Minibatch(sharding.along(memory, 0), *sharding.along(sequences, 1))


def descend(networks: Networks, hyper: Hyper, params: Pair, state: Pair,
            batch: Minibatch) -> tuple[Pair, Pair, tuple[ActorReport, Array]]:
    """One gradient step of both networks, each with its own norm clip."""
    rule = optimiser(hyper)
    (_, report), actor_grad = jax.value_and_grad(losses.actor_loss, has_aux=True)(
        params.actor, networks, batch, hyper.clip_eps, hyper.ent_coef)
    value_loss, critic_grad = jax.value_and_grad(losses.critic_loss)(
        params.critic, networks, batch, hyper.clip_eps, hyper.vf_coef)
    actor_step, actor_state = rule.update(actor_grad, state.actor)
    critic_step, critic_state = rule.update(critic_grad, state.critic)
    params = Pair(optax.apply_updates(params.actor, actor_step),
                  optax.apply_updates(params.critic, critic_step))
    return params, Pair(actor_state, critic_state), (report, value_loss)


def improve(networks: Networks, hyper: Hyper, learner: Learner, batch: Rollout,
            key: Array) -> tuple[Pair, Pair, tuple[ActorReport, Array]]:
    """All epochs of one update -> (params, optimiser states, mean reports)."""
    advantage, target = targets(batch, hyper)

    def one(both: tuple[Pair, Pair], index: Array) -> tuple:
        part = minibatch(batch, advantage, target, index)
        params, state, report = descend(networks, hyper, *both, part)
        return (params, state), report

    def epoch(both: tuple[Pair, Pair], key: Array) -> tuple:
        return jax.lax.scan(one, both, order(key, advantage.shape[1], hyper.num_minibatches))

    keys = jax.random.split(key, hyper.update_epochs)
    (params, state), reports = jax.lax.scan(epoch, (learner.params, learner.optimiser), keys)
    return params, state, jax.tree.map(jnp.mean, reports)


def update(networks: Networks, task: Task, hyper: Hyper,
           learner: Learner) -> tuple[Learner, Report]:
    """Collect, then improve."""
    key, collect_key, improve_key = jax.random.split(learner.key, 3)
    carry, batch = rollout.collect(networks, task, learner.params, learner.carry, collect_key,
                                   hyper.num_steps)
    params, state, (report, value_loss) = improve(networks, hyper, learner, batch, improve_key)
    params, state = sharding.whole((params, state))
    learner = Learner(params, state, sharding.along(carry, 0), key, learner.update + 1)
    return learner, Report(report, value_loss, batch.steps.reward.mean(), batch.tally)


def several(networks: Networks, task: Task, hyper: Hyper, learner: Learner,
            count: int) -> tuple[Learner, Report]:
    """`count` updates, to be jitted; the report's leaves are [count]."""
    def body(learner: Learner, _: None) -> tuple[Learner, Report]:
        return update(networks, task, hyper, learner)

    return jax.lax.scan(body, learner, length=count)


_several = jax.jit(several, static_argnames=("networks", "task", "hyper", "count"),
                   donate_argnames="learner")


def compiled(networks: Networks, task: Task, hyper: Hyper, learner: Learner,
             count: int) -> jax.stages.Compiled:
    """`chunk` compiled on one device and not run; `learner` may be shapes alone."""
    return _several.lower(networks, task, hyper, learner, count).compile()


def chunk(networks: Networks, task: Task, hyper: Hyper, learner: Learner,
          count: int) -> tuple[Learner, Report]:
    """`several` in one call, on the devices that the learner is spread over; donates it."""
    with sharding.mesh_of(learner.carry.reset_before):
        return _several(networks, task, hyper, learner, count)
