"""One update by whole tries: several of each problem, each one's advantage over the others' mean.

The others are the baseline (Kwon et al. 2020, "POMO: Policy Optimization with Multiple Optima",
and Kool et al. 2019, "Buy 4 REINFORCE samples, get a baseline for free"). A try judges all that
was chosen along it at once, roughly; a branch (see `vine`) judges one choice, exactly but for what
comes after it. With many robots and targets what comes after differs by more than the choice
itself, and a try says something of a hundred of them for the price of one.

What is tried, and learned, is the policy at a low temperature, nearly what is played in the end.

Legend: I problems, K tries of each, F tries (I * K), L decisions of the longest, P places of the
pool, S moments, N agents, M targets.
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
from moonteam.grid.macro.draw import Draw
from moonteam.grid.macro.types import FAR, MacroProblem, MacroState
from moonteam.planners.macro import refilled
from moonteam.policies.pointer import Outlook, PointerSpec, look, point
from training.mappo.macro.hyper import Hyper, Tries
from training.mappo.macro.learner import AXIS, Learner, descend, say
from training.mappo.macro.update import Walk, chosen, fresh, left, price, turned

EQUAL = 1e-4
"""Units of cost that make no difference."""
FLOOR = 0.01
"""Weight of a moment beside the entropy."""


class Played(NamedTuple):
    """Episodes played; [F, ...], those of one problem side by side."""

    cost: Array  # [F] in units
    solved: Array  # [F] bool, everything
    turns: Array  # [F] int32, decisions
    choice: Array  # [F, L, N] int32
    options: Array  # [F, L, N, M + 1] bool, at the agent's turn
    log_prob: Array  # [F, L, N]
    entropy: Array  # [F, L] of all of a decision


class Moments(NamedTuple):
    """What is learned from; [S, ...]."""

    view: Outlook
    choice: Array  # [S, N] int32
    options: Array  # [S, N, M + 1] bool; of what is not to be learned from, none
    log_prob: Array  # [S, N] before
    advantage: Array  # [S] of the whole try over the others of its problem
    value: Array  # [S] return from there to the end, in units


class Compared(NamedTuple):
    """Of one update."""

    success: Array  # share of the tries that solved everything
    entropy: Array  # of a choice, along the tries
    value_loss: Array
    gain: Array  # of the best of a problem's tries over their mean, in units
    episodes: Array  # tries


class _Pool(NamedTuple):
    episode: Array  # [P] int32; those past the last stand still
    states: MacroState  # [P]
    turn: Array  # [P] int32, decisions so far
    sum: Array  # [P] cost so far
    done: Played  # [F]
    following: Array  # [] int32, the next episode


def tried(spec: PointerSpec, hyper: Hyper, tries: Tries, params: Any, walk: Walk,
          key: Array) -> Played:
    """Plays each problem K times to its end, everybody free to turn at every event.

    Args:
      spec: of the network.
      hyper: prices.
      tries: how many, their heat and length.
      params: of the network.
      walk: [I] starts.
      key: of the draws.
    """
    problems, agents = walk.states.goal.shape
    columns, count = walk.states.solved.shape[1] + 1, problems * tries.each
    pairs = (agents + columns - 1) ** 2
    places = min(max(32, 2 * hyper.part // pairs), count)

    def of(episode: Array) -> Array:
        return jnp.minimum(episode // tries.each, problems - 1)

    def begun(episode: Array) -> MacroState:
        return jax.tree.map(lambda x: x[of(episode)], walk.states)

    def noise(episode: Array, turn: Array) -> Array:
        own = jax.random.fold_in(jax.random.fold_in(key, episode), turn)
        return jax.random.gumbel(own, (agents, columns))

    def decide(pool: _Pool) -> _Pool:
        liking = walk.preference[of(pool.episode)]
        logits = say(params, spec, hyper, jax.vmap(look)(pool.states, liking)).logits
        drawn = tries.heat * jax.vmap(noise)(pool.episode, pool.turn)
        choice, options = jax.vmap(world.choose)(pool.states, logits, drawn)
        log_prob, entropy = chosen(logits / tries.heat, options, choice)
        result = jax.vmap(world.step)(pool.states, choice)
        after, effort = turned(result, jnp.ones(choice.shape, bool))
        ended = result.terminated | result.truncated | (pool.turn + 1 >= tries.num_steps)
        undone = jnp.where(ended, left(result.state), 0)
        total = (pool.sum + price(hyper, liking, result, effort, pool.states.problem.unit)
                 + hyper.failure * undone)
        over = ended & (pool.episode < count)
        put, done = jnp.where(over, pool.episode, count), pool.done
        done = Played(  # what is past the last episode is dropped
            done.cost.at[put].set(total, mode="drop"),
            done.solved.at[put].set(result.terminated, mode="drop"),
            done.turns.at[put].set(pool.turn + 1, mode="drop"),
            done.choice.at[pool.episode, pool.turn].set(choice, mode="drop"),
            done.options.at[pool.episode, pool.turn].set(options, mode="drop"),
            done.log_prob.at[pool.episode, pool.turn].set(log_prob, mode="drop"),
            done.entropy.at[pool.episode, pool.turn].set(jnp.sum(entropy, axis=-1), mode="drop"))
        episode, following = refilled(over, pool.episode, pool.following)
        return _Pool(episode, trees.where(over, begun(episode), after),
                     jnp.where(over, 0, pool.turn + 1), jnp.where(over, 0.0, total), done,
                     following)

    shape = count, tries.num_steps, agents
    blank = Played(jnp.zeros(count), jnp.zeros(count, bool), jnp.zeros(count, jnp.int32),
                  jnp.zeros(shape, jnp.int32), jnp.zeros((*shape, columns), bool),
                  jnp.zeros(shape), jnp.zeros(shape[:2]))
    first = jnp.arange(places, dtype=jnp.int32)
    start = _Pool(first, begun(first), jnp.zeros(places, jnp.int32), jnp.zeros(places), blank,
                  jnp.int32(places))
    return jax.lax.while_loop(lambda pool: jnp.any(pool.episode < count), decide, start).done


def met(hyper: Hyper, tries: Tries, walk: Walk, played: Played, better: Array,
        key: Array) -> Moments:
    """Plays the tries again, and takes S moments of these, the undecided first.

    Args:
      hyper: prices.
      tries: how many.
      walk: [I] starts.
      played: [F].
      better: [F] advantage of each.
      key: of the draw.
    """
    starts, liking = jax.tree.map(lambda x: jnp.repeat(x, tries.each, axis=0),
                                  (walk.states, walk.preference))

    def step(states: MacroState, at: tuple[Array, Array]) -> tuple[MacroState, tuple]:
        turn, choice = at
        view = jax.vmap(look)(states, liking)
        result = jax.vmap(world.step)(states, choice)
        after, effort = turned(result, jnp.ones(choice.shape, bool))
        paid = price(hyper, liking, result, effort, states.problem.unit)
        undone = jnp.where(turn + 1 == played.turns, left(result.state), 0)
        paid = jnp.where(turn < played.turns, paid + hyper.failure * undone, 0.0)
        return after, (view, paid)

    def turn_first(x: Array) -> Array:
        return jnp.swapaxes(x, 0, 1)

    turns = jnp.arange(tries.num_steps)
    _, (view, paid) = jax.lax.scan(step, starts, (turns, turn_first(played.choice)))
    value = -jnp.cumsum(paid[::-1], axis=0)[::-1]  # [L, F]
    made = turns[:, None] < played.turns[None]  # [L, F]
    options = turn_first(played.options) & made[..., None, None]
    rows = Moments(view, turn_first(played.choice), options, turn_first(played.log_prob),
                   jnp.broadcast_to(better, made.shape), value)
    flat: Moments = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rows)
    open_ = (choices(flat) > 0) & (jnp.abs(flat.advantage) > EQUAL)
    weight = jnp.where(open_, jnp.log(turn_first(played.entropy).reshape(-1) + FLOOR), -FAR)
    most = weight + jax.random.gumbel(key, weight.shape)
    pick = jnp.argsort(-most)[:tries.moments]
    rows = jax.tree.map(lambda x: x[pick], flat)
    return rows._replace(options=rows.options & open_[pick][:, None, None])


def over_others(cost: Array) -> Array:
    """[I, K] how much less a try costs than the other tries of its problem do, in the mean."""
    total, count = jnp.sum(cost, axis=1, keepdims=True), cost.shape[1]
    return (total - cost) / (count - 1) - cost


def choices(rows: Moments) -> Array:
    """[S] agents that had a choice."""
    return jnp.sum(jnp.sum(rows.options, axis=-1) > 1, axis=-1)


def loss(params: Any, spec: PointerSpec, hyper: Hyper, tries: Tries, rows: Moments,
         count: Array) -> tuple[Array, Array]:
    """Clipped PPO of every agent that had a choice, and the critic; entropy and critic's error.

    A part's share of the mean over `count` choices.
    """
    said = point(params, spec, rows.view)
    log_prob, entropy = chosen(said.logits / tries.heat, rows.options, rows.choice)
    real = jnp.sum(rows.options, axis=-1) > 1
    ratio, gain = jnp.exp(log_prob - rows.log_prob), rows.advantage[:, None]
    limited = jnp.clip(ratio, 1.0 - hyper.clip_eps, 1.0 + hyper.clip_eps)
    told = jnp.sum(jnp.where(real, jnp.minimum(ratio * gain, limited * gain), 0.0)) / count
    spread = jnp.sum(jnp.where(real, entropy, 0.0)) / count
    off = jnp.where(jnp.any(real, axis=-1), said.value - rows.value, 0.0)
    critic = 0.5 * jnp.sum(off**2) / count
    return hyper.vf_coef * critic - told, jnp.stack([spread, critic])


def _on_each(spec: PointerSpec, family: Draw, hyper: Hyper, tries: Tries,
             ground: MacroProblem | None, learner: Learner, key: Array,
             lr: Array) -> tuple[Learner, Compared]:
    """`improve` on one device, with its own problems; `tries` is the device's share."""
    begin, play, pick, order_key = jax.random.split(
        jax.random.fold_in(key, jax.lax.axis_index(AXIS)), 4)
    walk = fresh(family, hyper, ground, begin, tries.problems)
    played = tried(spec, hyper, tries, learner.params, walk, play)
    cost = played.cost.reshape(-1, tries.each)
    better = over_others(cost).reshape(-1)
    better = better / (jnp.sqrt(jax.lax.pmean(jnp.mean(better**2), AXIS)) + 1e-6)
    rows = met(hyper, tries, walk, played, better, pick)
    order = jax.vmap(lambda k: jax.random.permutation(k, tries.moments))(
        jax.random.split(order_key, tries.epochs))

    def part_loss(params: Any, part: Moments, count: Array) -> tuple[Array, Array]:
        return loss(params, spec, hyper, tries, part, count)

    learner, said = descend(learner, hyper, part_loss, rows, choices(rows),
                            order.reshape(tries.epochs * tries.minibatches, -1), lr)
    spread, critic = said.mean(axis=0)
    gain = jnp.mean(cost - jnp.min(cost, axis=1, keepdims=True))
    success, spread, critic, gain = jax.lax.pmean(
        (jnp.mean(played.solved), spread, critic, gain), AXIS)
    return learner, Compared(success, spread, critic, gain, jax.lax.psum(cost.size, AXIS))


@partial(jax.jit, static_argnames=("mesh", "spec", "family", "hyper", "tries"),
         donate_argnames=("learner",))
def improve(mesh: Mesh, spec: PointerSpec, family: Draw, hyper: Hyper, tries: Tries,
            ground: MacroProblem | None, learner: Learner, key: Array,
            lr: Array) -> tuple[Learner, Compared]:
    """Tries fresh problems, then moves the policy to the tries that were better than others.

    Problems are shared out over the devices of `mesh`; gradients are the mean of theirs.
    """
    whole = PartitionSpec()
    return jax.shard_map(
        partial(_on_each, spec, family, hyper, tries.over(mesh.size)), mesh=mesh,
        in_specs=(whole, whole, whole, whole), out_specs=(whole, whole), check_vma=False)(
            ground, learner, key, lr)
