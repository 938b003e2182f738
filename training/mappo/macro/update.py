"""One PPO update on macro-decisions: collect, judge, improve.

Semi-Markov: a decision lasts until the next one, and its reward is minus the time that passed and
a little of the way that was set out on; with no discount, a return is minus what an episode still
costs. Advantages are the team's; each agent that chose is moved by it.

Legend: T decisions, E environments, B moments of a minibatch, N agents, M targets.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.sharding import Mesh, PartitionSpec

from moonteam import trees
from moonteam.grid.macro import world
from moonteam.grid.macro.draw import Draw, asking, draw, paces
from moonteam.grid.macro.types import FAR, MacroProblem, MacroResult, MacroState
from moonteam.policies.pointer import Outlook, PointerSpec, look, point
from training.mappo.gae import advantages
from training.mappo.macro.grounds import at_pace
from training.mappo.macro.hyper import Hyper
from training.mappo.macro.learner import AXIS, Learner, descend, say


class Walk(NamedTuple):
    """Environments between two updates."""

    states: MacroState  # [E]
    preference: Array  # [E]


class Rows(NamedTuple):
    """What was decided; [T, E, ...]."""

    view: Outlook
    choice: Array  # [.., N]
    options: Array  # [.., N, M + 1] bool, at the agent's turn
    log_prob: Array  # [.., N]
    value: Array
    reward: Array
    ended: Array
    truncated: Array


class Report(NamedTuple):
    """Of one update."""

    success: Array
    episode_seconds: Array  # mean length of the episodes that ended
    entropy: Array
    value_loss: Array
    clipped: Array
    episodes: Array


def fresh(family: Draw, hyper: Hyper, ground: MacroProblem | None, key: Array,
          count: int) -> Walk:
    """New episodes at their start, on open maps or drawn from `ground` [P]."""
    key, wish = jax.random.split(key)

    def one(key: Array) -> MacroState:
        if ground is None:
            return world.reset(draw(family, key))
        which, pace, more = jax.random.split(key, 3)
        place = jax.random.randint(which, (), 0, ground.limit.shape[0])
        problem = at_pace(jax.tree.map(lambda x: x[place], ground), paces(family, pace))
        return world.reset(asking(family, problem, more))

    states = jax.vmap(one)(jax.random.split(key, count))
    prefer = jnp.zeros(count)
    if hyper.spread:  # half at time, three in twenty at effort, the rest in between
        prefer = jnp.clip(jax.random.uniform(wish, (count,), minval=-1.43, maxval=1.43), 0.0, 1.0)
    return Walk(states, prefer)


def among(logits: Array, options: Array) -> tuple[Array, Array]:
    """Log-probabilities [..., M + 1] of the options, far below of what is none; entropy [...]."""
    log_probs = jax.nn.log_softmax(jnp.where(options, logits, -FAR), axis=-1)
    return log_probs, -jnp.sum(jnp.where(options, jnp.exp(log_probs) * log_probs, 0.0), axis=-1)


def chosen(logits: Array, options: Array, choice: Array) -> tuple[Array, Array]:
    """Log-probability [..., N] of the choices among the options, and entropy [..., N]."""
    log_probs, entropy = among(logits, options)
    return jnp.take_along_axis(log_probs, choice[..., None], axis=-1)[..., 0], entropy


def turned(result: MacroResult, who: Array) -> tuple[MacroState, Array]:
    """The states [E] after a decision in which those of `who` [E, N] may turn; and their effort.

    What is left of a way is not yet gone: whoever sets out again pays for it then.
    """
    after = jax.vmap(world.loosen)(result.state, who)
    left = (result.state.travelled - after.travelled) * after.problem.effort
    return after, result.effort - jnp.where(result.terminated, 0.0, jnp.sum(left, axis=-1))


def left(states: MacroState) -> Array:
    """[E] targets that are not solved."""
    return jnp.sum(~states.solved & ~states.problem.looks, axis=-1)


def price(hyper: Hyper, preference: Array, result: MacroResult, effort: Array,
          unit: Array) -> Array:
    """[E] what decisions cost, in units."""
    by_time, by_way = 1.0 - preference + hyper.tie, preference + hyper.tie
    return (by_time * result.seconds + by_way * effort) / unit + hyper.worth * result.missed


def collect(spec: PointerSpec, family: Draw, hyper: Hyper, ground: MacroProblem | None,
            params: Any, walk: Walk, key: Array) -> tuple[Walk, Rows, Array, Array]:
    """T decisions of every environment; the value after them; lengths of ended episodes."""
    pool_key, key = jax.random.split(key)
    pool = fresh(family, hyper, ground, pool_key, walk.preference.shape[0])

    def see(walk: Walk) -> Outlook:
        return jax.vmap(look)(walk.states, walk.preference)

    def decide(walk: Walk, at: tuple[Array, Array]) -> tuple[Walk, tuple]:
        t, key = at
        view = see(walk)
        said = say(params, spec, hyper, view)
        noise = jax.random.gumbel(key, said.logits.shape)
        choice, options = jax.vmap(world.choose)(walk.states, said.logits, noise)
        log_prob, _ = chosen(said.logits, options, choice)
        result = jax.vmap(world.step)(walk.states, choice)
        who = jnp.zeros(choice.shape, bool)
        if hyper.loose:
            again = jax.random.bernoulli(jax.random.fold_in(key, 1), hyper.loose, choice.shape[:1])
            who = jnp.broadcast_to(again[:, None], choice.shape)
        states, effort = turned(result, who)
        reward = -price(hyper, walk.preference, result, effort, walk.states.problem.unit)
        reward = reward - hyper.failure * jnp.where(
            result.truncated, left(result.state), 0)
        ended = result.terminated | result.truncated
        # Fresh episodes come from a pool, each environment's from another place at each step.
        new = jax.tree.map(lambda x: jnp.roll(x, t, axis=0), pool)
        after = trees.where(ended, new, Walk(states, walk.preference))
        row = Rows(view, choice, options, log_prob, said.value, reward, ended, result.truncated)
        return after, (row, jnp.where(ended, walk.states.now + result.seconds, 0.0))

    keys = jax.random.split(key, hyper.num_steps)
    walk, (rows, lengths) = jax.lax.scan(decide, walk, (jnp.arange(hyper.num_steps), keys))
    return walk, rows, say(params, spec, hyper, see(walk)).value, lengths


class Batch(NamedTuple):
    """Moments to learn from; [B, ...]."""

    view: Outlook
    choice: Array
    options: Array
    log_prob: Array
    advantage: Array
    target: Array


def loss(params: Any, spec: PointerSpec, hyper: Hyper, batch: Batch, entropy_weight: Array,
         count: Array, rows: int) -> tuple[Array, Array]:
    """Clipped PPO of every agent that had a choice, critic, entropy.

    A part's share of the mean over `count` choices and `rows` moments.
    """
    said = point(params, spec, batch.view)
    log_prob, entropy = chosen(said.logits, batch.options, batch.choice)
    real = jnp.sum(batch.options, axis=-1) > 1
    ratio = jnp.exp(log_prob - batch.log_prob)
    gain = batch.advantage[:, None]
    limited = jnp.clip(ratio, 1.0 - hyper.clip_eps, 1.0 + hyper.clip_eps)
    policy = -jnp.sum(jnp.where(real, jnp.minimum(ratio * gain, limited * gain), 0.0)) / count
    spread = jnp.sum(jnp.where(real, entropy, 0.0)) / count
    critic = 0.5 * jnp.sum((said.value - batch.target) ** 2) / rows
    clipped = jnp.sum(real & (jnp.abs(ratio - 1.0) > hyper.clip_eps)) / count
    return policy + hyper.vf_coef * critic - entropy_weight * spread, jnp.stack(
        [spread, critic, clipped])


def _on_each(spec: PointerSpec, family: Draw, hyper: Hyper, ground: MacroProblem | None,
             learner: Learner, walk: Walk, key: Array, lr: Array,
             entropy_weight: Array) -> tuple[Learner, Walk, Report]:
    """`update` on one device, with its own environments."""
    collect_key, order_key = jax.random.split(jax.random.fold_in(key, jax.lax.axis_index(AXIS)))
    walk, rows, last, lengths = collect(spec, family, hyper, ground, learner.params, walk,
                                        collect_key)
    following = jnp.concatenate([rows.value[1:], last[None]])
    # A cut-off episode has paid for what it left: an end like any other.
    gain = advantages(rows.reward, rows.value, following, rows.ended, jnp.zeros_like(rows.ended),
                      1.0, hyper.gae_lambda)
    target = gain + rows.value
    mean = jax.lax.pmean(gain.mean(), AXIS)
    gain = (gain - mean) / (jnp.sqrt(jax.lax.pmean(((gain - mean) ** 2).mean(), AXIS)) + 1e-6)
    batch = Batch(rows.view, rows.choice, rows.options, rows.log_prob, gain, target)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), batch)
    choices = jnp.sum(jnp.sum(flat.options, axis=-1) > 1, axis=-1)

    def order(key: Array) -> Array:
        """Random, with the moments at which nobody had a choice last."""
        late = jax.random.uniform(key, choices.shape) + (choices == 0)
        return jnp.argsort(late)[:int(choices.size * hyper.learned)]

    rows_in_order = jax.vmap(order)(jax.random.split(order_key, hyper.epochs))
    rows_in_order = rows_in_order.reshape(hyper.epochs * hyper.minibatches, -1)

    def part_loss(params: Any, part: Batch, count: Array) -> tuple[Array, Array]:
        return loss(params, spec, hyper, part, entropy_weight, count, rows_in_order.shape[1])

    learner, said = descend(learner, hyper, part_loss, flat, choices, rows_in_order, lr)
    episodes, solved, length = jax.lax.psum(
        (jnp.sum(rows.ended), jnp.sum(rows.ended & ~rows.truncated), jnp.sum(lengths)), AXIS)
    count = jnp.maximum(episodes, 1)
    spread, critic, clipped = jax.lax.pmean(said.mean(axis=0), AXIS)
    return learner, walk, Report(solved / count, length / count, spread, critic, clipped, episodes)


@partial(jax.jit, static_argnames=("mesh", "spec", "family", "hyper"),
         donate_argnames=("learner", "walk"))
def update(mesh: Mesh, spec: PointerSpec, family: Draw, hyper: Hyper,
           ground: MacroProblem | None, learner: Learner, walk: Walk, key: Array, lr: Array,
           entropy_weight: Array) -> tuple[Learner, Walk, Report]:
    """Collect, then improve.

    The environments are shared out over the devices of `mesh`; gradients are the mean of theirs.
    """
    whole, shared = PartitionSpec(), PartitionSpec(AXIS)
    return jax.shard_map(
        partial(_on_each, spec, family, hyper), mesh=mesh,
        in_specs=(whole, whole, shared, whole, whole, whole),
        out_specs=(whole, shared, whole), check_vma=False)(
            ground, learner, walk, key, lr, entropy_weight)
