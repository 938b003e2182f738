"""One update by branches: what another choice would have led to, played out.

Moments that the policy comes to are branched, as in the vine procedure of Schulman et al. (2015,
"Trust Region Policy Optimization", section 5.2): one agent takes several of its options in turn,
and from each the team goes on by its likeliest choices to the end. The world is known and
certain, so two branches differ by the advantage itself, free of luck and of a critic's error. The
policy then moves to the maximiser of the expected return under a Kullback-Leibler penalty (the
penalised objective of PPO, which among so few options can be solved exactly): the probability of
an option tried becomes proportional to pi(a) exp(Q(a) / tau).

Legend: I episodes, T decisions, S moments, K options tried of each, P places of the pool, N
agents, M targets.
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
from training.mappo.macro.hyper import Hyper, Vine
from training.mappo.macro.learner import AXIS, Learner, descend, say
from training.mappo.macro.update import among, fresh, left, price, turned


class Moments(NamedTuple):
    """Where somebody has a choice; [S, ...]."""

    states: MacroState
    view: Outlook
    preference: Array  # [S]
    who: Array  # [S] int32, the agent that tries
    options: Array  # [S, M + 1] bool, what it can choose from at its turn
    log_probs: Array  # [S, M + 1] the policy's, among them
    entropy: Array  # [S]
    choice: Array  # [S] int32, its likeliest
    real: Array  # [S] bool; False fills up where there were too few


class Branch(NamedTuple):
    """What is learned from a moment; [S, ...]."""

    view: Outlook
    who: Array  # [S] int32
    options: Array  # [S, M + 1] bool
    goal: Array  # [S, M + 1] probabilities to move to
    value: Array  # [S] return of the likeliest course, in units
    real: Array  # [S] bool


class Grown(NamedTuple):
    """Of one update."""

    success: Array  # share of the branches that solved everything
    entropy: Array
    value_loss: Array
    regret: Array  # mean of the best tried over the likeliest, in units
    episodes: Array  # branches played


class _Pool(NamedTuple):
    branch: Array  # [P] int32; those past the last stand still
    states: MacroState  # [P]
    turn: Array  # [P] int32, decisions so far
    sum: Array  # [P] return so far
    value: Array  # [S * K]
    solved: Array  # [S * K] bool
    following: Array  # [] int32, the next branch


def met(spec: PointerSpec, family: Draw, hyper: Hyper, vine: Vine, ground: MacroProblem | None,
        params: Any, key: Array) -> Moments:
    """Plays fresh episodes and takes S moments from them, the undecided first."""
    begin, play, pick_key, who_key = jax.random.split(key, 4)
    walk = fresh(family, hyper, ground, begin, vine.episodes)

    def step(carry: tuple, key: Array) -> tuple[tuple, tuple]:
        states, over = carry
        logits = say(params, spec, hyper, jax.vmap(look)(states, walk.preference)).logits
        noise = vine.heat * jax.random.gumbel(key, logits.shape)
        choice, _ = jax.vmap(world.choose)(states, logits, noise)
        result = jax.vmap(world.step)(states, choice)
        after, _ = turned(result, jnp.ones(choice.shape, bool))
        ended = over | result.terminated | result.truncated
        return (trees.where(ended, states, after), ended), (states, logits, ~over)

    _, rows = jax.lax.scan(step, (walk.states, jnp.zeros(vine.episodes, bool)),
                           jax.random.split(play, vine.num_steps))
    states, logits, live = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rows)
    # What others choose beside the branch is their likeliest.
    choice, options = jax.vmap(world.choose)(states, logits, jnp.zeros_like(logits))
    log_probs, spread = among(logits, options)
    real = (jnp.sum(options, axis=-1) > 1) & live[:, None]  # [I * T, N]
    weight = jnp.log(jnp.where(real, spread + vine.floor, 0.0))
    most = jax.nn.logsumexp(weight, axis=-1) + jax.random.gumbel(pick_key, live.shape)
    pick = jnp.argsort(-most)[:vine.moments]
    drawn = weight[pick] + jax.random.gumbel(who_key, weight[pick].shape)
    who = jnp.argmax(drawn, axis=-1).astype(jnp.int32)
    chosen = jax.tree.map(lambda x: x[pick, who], (options, log_probs, spread, choice))
    states, liking = jax.tree.map(lambda x: x[pick],
                                  (states, jnp.tile(walk.preference, vine.num_steps)))
    return Moments(states, jax.vmap(look)(states, liking), liking, who, *chosen,
                   real=jnp.any(real[pick], axis=-1))


def tried(spec: PointerSpec, hyper: Hyper, vine: Vine, params: Any, moments: Moments,
          option: Array, valid: Array) -> tuple[Array, Array]:
    """[S, K] return of each branch in units of its moment, and whether it solved everything.

    Args:
      spec: of the network.
      hyper: prices.
      vine: when a branch is given up.
      params: of the network.
      moments: [S].
      option: [S, K] int32, what their agents try.
      valid: [S, K] bool, those to be played; the others are 0 and False.
    """
    size, k = option.shape
    order = jnp.argsort(~valid.reshape(-1))  # stable, so those to be played come first
    count = jnp.sum(valid)
    places = min(max(32, 2 * hyper.rows(moments.view)), size)
    columns = moments.options.shape[1]

    def at(branch: Array) -> Array:
        return order[jnp.minimum(branch, size * k - 1)]

    def begun(branch: Array) -> MacroState:
        return jax.tree.map(lambda x: x[at(branch) // k], moments.states)

    def decide(pool: _Pool) -> _Pool:
        spot = at(pool.branch)
        row = spot // k
        liking, agents = moments.preference[row], pool.states.goal.shape[1]
        logits = say(params, spec, hyper, jax.vmap(look)(pool.states, liking)).logits
        own = jax.nn.one_hot(moments.who[row], agents)[:, :, None]
        forced = own * jax.nn.one_hot(option.reshape(-1)[spot], columns)[:, None]
        forced = jnp.where((pool.turn == 0)[:, None, None], forced * FAR / 2, 0.0)
        choice, _ = jax.vmap(world.choose)(pool.states, logits, forced)
        result = jax.vmap(world.step)(pool.states, choice)
        after, effort = turned(result, jnp.ones(choice.shape, bool))
        ended = result.terminated | result.truncated | (pool.turn + 1 >= vine.longest)
        undone = jnp.where(ended, left(result.state), 0)
        paid = price(hyper, liking, result, effort, pool.states.problem.unit)
        total = pool.sum - paid - hyper.failure * undone
        over = ended & (pool.branch < count)
        put = jnp.where(over, spot, size * k)
        branch, following = refilled(over, pool.branch, pool.following)
        return _Pool(branch, trees.where(over, begun(branch), after),
                     jnp.where(over, 0, pool.turn + 1), jnp.where(over, 0.0, total),
                     pool.value.at[put].set(total, mode="drop"),
                     pool.solved.at[put].set(result.terminated, mode="drop"), following)

    first = jnp.arange(places, dtype=jnp.int32)
    start = _Pool(first, begun(first), jnp.zeros(places, jnp.int32), jnp.zeros(places),
                  jnp.zeros(size * k), jnp.zeros(size * k, bool), jnp.int32(places))
    end = jax.lax.while_loop(lambda pool: jnp.any(pool.branch < count), decide, start)
    return end.value.reshape(size, k), end.solved.reshape(size, k)


def aim(vine: Vine, log_probs: Array, option: Array, valid: Array, value: Array) -> Array:
    """[S, M + 1] probabilities to move to; what was not tried keeps its own.

    Args:
      vine: its `tau`.
      log_probs: [S, M + 1] the policy's.
      option: [S, K] int32, tried.
      valid: [S, K] bool, those of them that were.
      value: [S, K] their returns.
    """
    old = jnp.take_along_axis(log_probs, option, axis=1)
    mass = jnp.sum(jnp.where(valid, jnp.exp(old), 0.0), axis=1, keepdims=True)
    moved = mass * jax.nn.softmax(jnp.where(valid, old + value / vine.tau, -FAR), axis=1)
    row = jnp.arange(len(option))[:, None]
    column = jnp.where(valid, option, log_probs.shape[1])
    return jnp.exp(log_probs).at[row, column].set(moved, mode="drop")


def grow(spec: PointerSpec, family: Draw, hyper: Hyper, vine: Vine, ground: MacroProblem | None,
         params: Any, key: Array) -> tuple[Branch, Array]:
    """Moments with what to move to; and branches played, those of them solved, entropy, regret."""
    met_key, other = jax.random.split(key)
    moments = met(spec, family, hyper, vine, ground, params, met_key)
    drawn = moments.log_probs + vine.wide * jax.random.gumbel(other, moments.log_probs.shape)
    likeliest = jax.nn.one_hot(moments.choice, drawn.shape[1], dtype=bool)
    drawn = jnp.where(moments.options, jnp.where(likeliest, FAR, drawn), -FAR)
    _, option = jax.lax.top_k(drawn, min(vine.options, drawn.shape[1]))
    valid = jnp.take_along_axis(moments.options, option, axis=1) & moments.real[:, None]
    value, solved = tried(spec, hyper, vine, params, moments, option, valid)
    goal = aim(vine, moments.log_probs, option, valid, value)

    def mean(x: Array) -> Array:
        return jnp.sum(jnp.where(moments.real, x, 0.0)) / jnp.maximum(jnp.sum(moments.real), 1)

    best = jnp.max(jnp.where(valid, value, -FAR), axis=1)
    branch = Branch(moments.view, moments.who, moments.options, goal, value[:, 0], moments.real)
    return branch, jnp.stack([jnp.sum(valid), jnp.sum(solved), mean(moments.entropy),
                              mean(best - value[:, 0])])


def loss(params: Any, spec: PointerSpec, hyper: Hyper, rows: Branch,
         count: Array) -> tuple[Array, Array]:
    """Cross-entropy to what to move to, and the critic's squared error, which also stands alone.

    A part's share of the mean over `count` moments.
    """
    said = point(params, spec, rows.view)
    own = jnp.take_along_axis(said.logits, rows.who[:, None, None], axis=1)[:, 0]
    log_probs, _ = among(own, rows.options)
    told = jnp.where(rows.options & rows.real[:, None], rows.goal * log_probs, 0.0)
    off = jnp.where(rows.real, said.value - rows.value, 0.0)
    critic = 0.5 * jnp.sum(off**2) / count
    return hyper.vf_coef * critic - jnp.sum(told) / count, critic


def _on_each(spec: PointerSpec, family: Draw, hyper: Hyper, vine: Vine,
             ground: MacroProblem | None, learner: Learner, key: Array,
             lr: Array) -> tuple[Learner, Grown]:
    """`improve` on one device, with its own episodes; `vine` is the device's share."""
    grow_key, order_key = jax.random.split(jax.random.fold_in(key, jax.lax.axis_index(AXIS)))
    rows, said = grow(spec, family, hyper, vine, ground, learner.params, grow_key)
    order = jax.vmap(lambda k: jax.random.permutation(k, vine.moments))(
        jax.random.split(order_key, vine.epochs))

    def part_loss(params: Any, part: Branch, count: Array) -> tuple[Array, Array]:
        return loss(params, spec, hyper, part, count)

    learner, critic = descend(learner, hyper, part_loss, rows, rows.real,
                              order.reshape(vine.epochs * vine.minibatches, -1), lr)
    played, solved = jax.lax.psum((said[0], said[1]), AXIS)
    entropy, regret, error = jax.lax.pmean((said[2], said[3], critic.mean()), AXIS)
    return learner, Grown(solved / jnp.maximum(played, 1), entropy, error, regret, played)


@partial(jax.jit, static_argnames=("mesh", "spec", "family", "hyper", "vine"),
         donate_argnames=("learner",))
def improve(mesh: Mesh, spec: PointerSpec, family: Draw, hyper: Hyper, vine: Vine,
            ground: MacroProblem | None, learner: Learner, key: Array,
            lr: Array) -> tuple[Learner, Grown]:
    """Branches moments of fresh episodes, then moves the policy to what was better.

    Episodes and moments are shared out over the devices of `mesh`; gradients are the mean of
    theirs.
    """
    whole = PartitionSpec()
    return jax.shard_map(
        partial(_on_each, spec, family, hyper, vine.over(mesh.size)), mesh=mesh,
        in_specs=(whole, whole, whole, whole), out_specs=(whole, whole), check_vma=False)(
            ground, learner, key, lr)
