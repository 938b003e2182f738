"""One update by the policy's own best episodes: every problem tried several times, the best kept.

Whole episodes of each problem are drawn from the policy as it is, its likeliest course among them;
the policy then moves towards what was chosen along the best of them (self-labelling, Corsini et
al. 2024, "Self-Labeling the Job Shop Scheduling Problem"; self-improvement, Pirnay and Grimm 2024,
"Self-Improvement for Neural Combinatorial Optimization"). Nobody else says what is good: the best
of a few draws is better than the likeliest, and learning makes the next draws better.

Legend: I problems, K tries of each, F episodes (I * K), L decisions of the longest, P places of
the pool, S moments, N agents, M targets.
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
from moonteam.grid.macro.types import MacroProblem, MacroState
from moonteam.planners.macro import coolest, refilled
from moonteam.policies.pointer import Outlook, PointerSpec, look, point
from training.mappo.macro.hyper import Best, Hyper
from training.mappo.macro.learner import AXIS, Learner, descend, say
from training.mappo.macro.update import Walk, chosen, fresh, left, price, turned

EQUAL = 1e-4
"""Units of cost that make no difference."""


class Tries(NamedTuple):
    """Episodes played; [F, ...], those of one problem side by side, its likeliest first."""

    cost: Array  # [F] in units
    solved: Array  # [F] bool, everything
    turns: Array  # [F] int32, decisions
    choice: Array  # [F, L, N] int32
    options: Array  # [F, L, N, M + 1] bool, at the agent's turn


class Moments(NamedTuple):
    """What is learned from; [S, ...]."""

    view: Outlook
    choice: Array  # [S, N] int32
    options: Array  # [S, N, M + 1] bool; of what is not to be learned from, none
    value: Array  # [S] return from there to the end, in units


class Kept(NamedTuple):
    """Of one update."""

    success: Array  # share of the tries that solved everything
    entropy: Array  # of a choice, along the best
    value_loss: Array
    gain: Array  # of the best over the likeliest, in units
    episodes: Array  # tries


class _Pool(NamedTuple):
    episode: Array  # [P] int32; those past the last stand still
    states: MacroState  # [P]
    turn: Array  # [P] int32, decisions so far
    sum: Array  # [P] cost so far
    done: Tries  # [F]
    following: Array  # [] int32, the next episode


def tried(spec: PointerSpec, hyper: Hyper, best: Best, params: Any, walk: Walk,
          key: Array) -> Tries:
    """Plays each problem K times to its end, everybody free to turn at every event.

    Args:
      spec: of the network.
      hyper: prices.
      best: tries, their heat and length.
      params: of the network.
      walk: [I] starts.
      key: of the draws.
    """
    problems, agents = walk.states.goal.shape
    columns, count = walk.states.solved.shape[1] + 1, problems * best.tries
    pairs = (agents + columns - 1) ** 2
    places = min(max(32, 2 * hyper.part // pairs), count)

    def of(episode: Array) -> Array:
        return jnp.minimum(episode // best.tries, problems - 1)

    def begun(episode: Array) -> MacroState:
        return jax.tree.map(lambda x: x[of(episode)], walk.states)

    def noise(episode: Array, turn: Array) -> Array:
        own = jax.random.fold_in(jax.random.fold_in(key, episode), turn)
        return jax.random.gumbel(own, (agents, columns))

    def decide(pool: _Pool) -> _Pool:
        liking = walk.preference[of(pool.episode)]
        logits = say(params, spec, hyper, jax.vmap(look)(pool.states, liking)).logits
        number = pool.episode % best.tries
        share = (number - 1) / max(best.tries - 2, 1)
        heat = best.heat * coolest(pool.states.problem.target_mask) ** share
        heat = jnp.where(number == 0, 0.0, heat)[:, None, None]
        drawn = heat * jax.vmap(noise)(pool.episode, pool.turn)
        choice, options = jax.vmap(world.choose)(pool.states, logits, drawn)
        result = jax.vmap(world.step)(pool.states, choice)
        after, effort = turned(result, jnp.ones(choice.shape, bool))
        ended = result.terminated | result.truncated | (pool.turn + 1 >= best.num_steps)
        undone = jnp.where(ended, left(result.state), 0)
        total = (pool.sum + price(hyper, liking, result, effort, pool.states.problem.unit)
                 + hyper.failure * undone)
        over = ended & (pool.episode < count)
        put, done = jnp.where(over, pool.episode, count), pool.done
        done = Tries(  # what is past the last episode is dropped
            done.cost.at[put].set(total, mode="drop"),
            done.solved.at[put].set(result.terminated, mode="drop"),
            done.turns.at[put].set(pool.turn + 1, mode="drop"),
            done.choice.at[pool.episode, pool.turn].set(choice, mode="drop"),
            done.options.at[pool.episode, pool.turn].set(options, mode="drop"))
        episode, following = refilled(over, pool.episode, pool.following)
        return _Pool(episode, trees.where(over, begun(episode), after),
                     jnp.where(over, 0, pool.turn + 1), jnp.where(over, 0.0, total), done,
                     following)

    shape = count, best.num_steps, agents
    blank = Tries(jnp.zeros(count), jnp.zeros(count, bool), jnp.zeros(count, jnp.int32),
                  jnp.zeros(shape, jnp.int32), jnp.zeros((*shape, columns), bool))
    first = jnp.arange(places, dtype=jnp.int32)
    start = _Pool(first, begun(first), jnp.zeros(places, jnp.int32), jnp.zeros(places), blank,
                  jnp.int32(places))
    return jax.lax.while_loop(lambda pool: jnp.any(pool.episode < count), decide, start).done


def kept(hyper: Hyper, best: Best, walk: Walk, tries: Tries, key: Array) -> Moments:
    """Plays the best try of each problem again, and draws S moments of these.

    Args:
      hyper: prices.
      best: how many.
      walk: [I] starts.
      tries: [F].
      key: of the draw.
    """
    problems, (draw_key, tie_key) = walk.preference.shape[0], jax.random.split(key)
    # Any of several that are as good: what makes no difference is then left as it is.
    among_equals = EQUAL * jax.random.uniform(tie_key, tries.cost.shape)
    which = jnp.argmin((tries.cost + among_equals).reshape(problems, best.tries), axis=1)
    own: Tries = jax.tree.map(lambda x: x[jnp.arange(problems) * best.tries + which], tries)

    def step(states: MacroState, at: tuple[Array, Array]) -> tuple[MacroState, tuple]:
        turn, choice = at
        view = jax.vmap(look)(states, walk.preference)
        result = jax.vmap(world.step)(states, choice)
        after, effort = turned(result, jnp.ones(choice.shape, bool))
        paid = price(hyper, walk.preference, result, effort, states.problem.unit)
        undone = jnp.where(turn + 1 == own.turns, left(result.state), 0)
        paid = jnp.where(turn < own.turns, paid + hyper.failure * undone, 0.0)
        return after, (view, paid)

    turns = jnp.arange(best.num_steps)
    _, (view, paid) = jax.lax.scan(step, walk.states, (turns, jnp.swapaxes(own.choice, 0, 1)))
    value = -jnp.cumsum(paid[::-1], axis=0)[::-1]  # [L, I]
    made = turns[:, None] < own.turns[None]  # [L, I]
    options = jnp.swapaxes(own.options, 0, 1) & made[..., None, None]
    rows = Moments(view, jnp.swapaxes(own.choice, 0, 1), options, value)
    flat: Moments = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rows)
    late = jax.random.uniform(draw_key, (flat.value.size,)) + (choices(flat) == 0)
    return jax.tree.map(lambda x: x[jnp.argsort(late)[:best.moments]], flat)


def choices(rows: Moments) -> Array:
    """[S] agents that had a choice."""
    return jnp.sum(jnp.sum(rows.options, axis=-1) > 1, axis=-1)


def loss(params: Any, spec: PointerSpec, hyper: Hyper, rows: Moments,
         count: Array) -> tuple[Array, Array]:
    """Cross-entropy to what was chosen, and the critic's squared error; entropy and that error.

    A part's share of the mean over `count` choices.
    """
    said = point(params, spec, rows.view)
    log_prob, entropy = chosen(said.logits, rows.options, rows.choice)
    real = jnp.sum(rows.options, axis=-1) > 1
    told = jnp.sum(jnp.where(real, log_prob, 0.0)) / count
    spread = jnp.sum(jnp.where(real, entropy, 0.0)) / count
    off = jnp.where(jnp.any(real, axis=-1), said.value - rows.value, 0.0)
    critic = 0.5 * jnp.sum(off**2) / count
    return hyper.vf_coef * critic - told, jnp.stack([spread, critic])


def _on_each(spec: PointerSpec, family: Draw, hyper: Hyper, best: Best,
             ground: MacroProblem | None, learner: Learner, key: Array,
             lr: Array) -> tuple[Learner, Kept]:
    """`improve` on one device, with its own problems; `best` is the device's share."""
    begin, play, pick, order_key = jax.random.split(
        jax.random.fold_in(key, jax.lax.axis_index(AXIS)), 4)
    walk = fresh(family, hyper, ground, begin, best.problems)
    tries = tried(spec, hyper, best, learner.params, walk, play)
    rows = kept(hyper, best, walk, tries, pick)
    order = jax.vmap(lambda k: jax.random.permutation(k, best.moments))(
        jax.random.split(order_key, best.epochs))

    def part_loss(params: Any, part: Moments, count: Array) -> tuple[Array, Array]:
        return loss(params, spec, hyper, part, count)

    learner, said = descend(learner, hyper, part_loss, rows, choices(rows),
                            order.reshape(best.epochs * best.minibatches, -1), lr)
    cost = tries.cost.reshape(-1, best.tries)
    spread, critic = said.mean(axis=0)
    means = jnp.stack([jnp.mean(tries.solved), spread, critic,
                       jnp.mean(cost[:, 0] - jnp.min(cost, axis=1))])
    return learner, Kept(*jax.lax.pmean(means, AXIS), jax.lax.psum(cost.size, AXIS))


@partial(jax.jit, static_argnames=("mesh", "spec", "family", "hyper", "best"),
         donate_argnames=("learner",))
def improve(mesh: Mesh, spec: PointerSpec, family: Draw, hyper: Hyper, best: Best,
            ground: MacroProblem | None, learner: Learner, key: Array,
            lr: Array) -> tuple[Learner, Kept]:
    """Tries fresh problems, then moves the policy towards the best try of each.

    Problems are shared out over the devices of `mesh`; gradients are the mean of theirs.
    """
    whole = PartitionSpec()
    return jax.shard_map(
        partial(_on_each, spec, family, hyper, best.over(mesh.size)), mesh=mesh,
        in_specs=(whole, whole, whole, whole), out_specs=(whole, whole), check_vma=False)(
            ground, learner, key, lr)
