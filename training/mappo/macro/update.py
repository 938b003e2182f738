"""One PPO update on macro-decisions: collect, judge, improve.

Semi-Markov: a decision lasts until the next one, and its reward is minus the time that passed and
a little of the way that was set out on; with no discount, a return is minus what an episode still
costs. Advantages are the team's; each agent that chose is moved by it.

Legend: T decisions, E environments, B moments of a minibatch, N agents, M targets.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array
from jax.sharding import Mesh, PartitionSpec

from moonteam import trees
from moonteam.grid.macro import world
from moonteam.grid.macro.draw import Draw, asking, draw, paces
from moonteam.grid.macro.types import FAR, MacroProblem, MacroState
from moonteam.policies.pointer import Outlook, PointerSpec, look, point
from training.mappo.gae import advantages
from training.mappo.macro.grounds import at_pace

AXIS = "batch"
"""Of the mesh, see `training.sharding`."""


@dataclass(frozen=True)
class Hyper:
    """What an update needs to know; static under jit."""

    num_steps: int = 16
    """T, decisions of each environment between updates."""
    epochs: int = 1
    """Passes over what was collected."""
    learned: float = 0.625
    """Share of the moments that are learned from; those at which somebody had a choice first, which
    are about as many."""
    minibatches: int = 10
    """Parts of a pass."""
    gae_lambda: float = 0.95
    """Of generalised advantage estimation; the discount is 1."""
    clip_eps: float = 0.2
    """Of the probability ratio."""
    vf_coef: float = 0.5
    """Weight of the critic's squared error."""
    max_grad_norm: float = 0.5
    """Gradient norm above which gradients are scaled down."""
    failure: float = 1.0
    """What each target left costs when an episode is cut off, in units of time."""
    tie: float = 0.02
    """Weight that time and way both keep at either end of the preference."""
    spread: bool = False
    """Preferences drawn from time to effort; else always time."""
    loose: float = 0.0
    """Share of the moments at which those on their way choose again."""
    ema: float = 0.998
    """Decay of the running mean of the weights, which is what is kept."""


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


class Learner(NamedTuple):
    """What learning changes."""

    params: Any
    mean: Any  # running mean of the parameters
    optimiser: optax.OptState
    steps: Array  # [] int32, gradient steps made

    @classmethod
    def begin(cls, params: Any, hyper: Hyper) -> Learner:
        """Copies of the parameters, since a learner is donated, and a fresh optimiser."""
        params, mean = jax.tree.map(jnp.array, params), jax.tree.map(jnp.array, params)
        return cls(params, mean, optimiser(hyper).init(params), jnp.zeros((), jnp.int32))


class Report(NamedTuple):
    """Of one update."""

    success: Array
    seconds: Array  # mean length of the episodes that ended
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
    if hyper.spread:  # a quarter each at the two ends of the preference, the rest in between
        prefer = jnp.clip(jax.random.uniform(wish, (count,), minval=-0.5, maxval=1.5), 0.0, 1.0)
    return Walk(states, prefer)


def optimiser(hyper: Hyper) -> optax.GradientTransformation:
    """Adam behind a gradient-norm clip; the rate is given with each update."""
    return optax.chain(optax.clip_by_global_norm(hyper.max_grad_norm),
                       optax.scale_by_adam(eps=1e-5))


def chosen(logits: Array, options: Array, choice: Array) -> tuple[Array, Array]:
    """Log-probability [..., N] of the choices among the options, and entropy [..., N]."""
    log_probs = jax.nn.log_softmax(jnp.where(options, logits, -FAR), axis=-1)
    taken = jnp.take_along_axis(log_probs, choice[..., None], axis=-1)[..., 0]
    entropy = -jnp.sum(jnp.where(options, jnp.exp(log_probs) * log_probs, 0.0), axis=-1)
    return taken, entropy


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
        said = point(params, spec, view)
        noise = jax.random.gumbel(key, said.logits.shape)
        choice, options = jax.vmap(world.choose)(walk.states, said.logits, noise)
        log_prob, _ = chosen(said.logits, options, choice)
        result = jax.vmap(world.step)(walk.states, choice)
        by_time = 1.0 - walk.preference + hyper.tie
        by_way = walk.preference + hyper.tie
        open_ = jnp.sum(~result.state.solved, axis=-1)
        states, effort = result.state, result.effort
        if hyper.loose:
            again = jax.random.bernoulli(jax.random.fold_in(key, 1), hyper.loose, open_.shape)
            everyone = jnp.broadcast_to(again[:, None], choice.shape)
            states = jax.vmap(world.loosen)(states, everyone)
            # What is left of a way is not yet gone: whoever sets out again pays for it then.
            unspent = (result.state.travelled - states.travelled) * states.problem.effort
            effort = effort - jnp.where(result.terminated, 0.0, jnp.sum(unspent, axis=-1))
        reward = -(by_time * result.seconds + by_way * effort) / walk.states.problem.unit
        reward = reward - hyper.failure * jnp.where(result.truncated, open_, 0)
        ended = result.terminated | result.truncated
        # Fresh episodes come from a pool, each environment's from another place at each step.
        new = jax.tree.map(lambda x: jnp.roll(x, t, axis=0), pool)
        after = trees.where(ended, new, Walk(states, walk.preference))
        row = Rows(view, choice, options, log_prob, said.value, reward, ended, result.truncated)
        return after, (row, jnp.where(ended, walk.states.now + result.seconds, 0.0))

    keys = jax.random.split(key, hyper.num_steps)
    walk, (rows, lengths) = jax.lax.scan(decide, walk, (jnp.arange(hyper.num_steps), keys))
    return walk, rows, point(params, spec, see(walk)).value, lengths


class Batch(NamedTuple):
    """Moments to learn from; [B, ...]."""

    view: Outlook
    choice: Array
    options: Array
    log_prob: Array
    advantage: Array
    target: Array


def loss(params: Any, spec: PointerSpec, hyper: Hyper, batch: Batch,
         entropy_weight: Array) -> tuple[Array, Array]:
    """Clipped PPO of every agent that had a choice, critic, entropy."""
    said = point(params, spec, batch.view)
    log_prob, entropy = chosen(said.logits, batch.options, batch.choice)
    real = jnp.sum(batch.options, axis=-1) > 1
    count = jnp.maximum(jnp.sum(real), 1)
    ratio = jnp.exp(log_prob - batch.log_prob)
    gain = batch.advantage[:, None]
    limited = jnp.clip(ratio, 1.0 - hyper.clip_eps, 1.0 + hyper.clip_eps)
    policy = -jnp.sum(jnp.where(real, jnp.minimum(ratio * gain, limited * gain), 0.0)) / count
    spread = jnp.sum(jnp.where(real, entropy, 0.0)) / count
    critic = 0.5 * jnp.mean((said.value - batch.target) ** 2)
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
    rule = optimiser(hyper)

    def improve(learner: Learner, index: Array) -> tuple[Learner, Array]:
        part = jax.tree.map(lambda x: x[index], flat)
        (_, said), slope = jax.value_and_grad(loss, has_aux=True)(
            learner.params, spec, hyper, part, entropy_weight)
        way, state = rule.update(jax.lax.pmean(slope, AXIS), learner.optimiser)
        params = jax.tree.map(lambda p, w: p - lr * w, learner.params, way)
        # Young, the mean must not remember how it began.
        count = learner.steps.astype(jnp.float32)
        keep = jnp.minimum(hyper.ema, (1.0 + count) / (10.0 + count))
        mean = jax.tree.map(lambda m, p: keep * m + (1.0 - keep) * p, learner.mean, params)
        return Learner(params, mean, state, learner.steps + 1), said

    forced = jnp.all(jnp.sum(flat.options, axis=-1) == 1, axis=-1)

    def order(key: Array) -> Array:
        """Random, with the moments at which nobody had a choice last."""
        late = jax.random.uniform(key, forced.shape) + forced
        return jnp.argsort(late)[:int(forced.size * hyper.learned)]

    rows_in_order = jax.vmap(order)(jax.random.split(order_key, hyper.epochs))
    learner, said = jax.lax.scan(improve, learner,
                                 rows_in_order.reshape(hyper.epochs * hyper.minibatches, -1))
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
