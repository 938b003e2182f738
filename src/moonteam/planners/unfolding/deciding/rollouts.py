"""Missions of the macro world played to their ends by a policy's likeliest choices, in few calls.

Where the exact search can tell how soon the rest is done, a rollout ends once all is known.

All rollouts of a call share a pool of a size that fits the cache of a core; a place whose rollout
has ended takes the next one, so that nobody waits for the longest.

Legend: B problems, R rollouts of a call, P places of the pool, N robots, T targets.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from moonteam import trees
from moonteam.grid.macro import world
from moonteam.grid.macro.types import MacroProblem, MacroState
from moonteam.planners.macro import refilled
from moonteam.planners.unfolding.deciding import finished
from moonteam.planners.unfolding.deciding.deciders import NOT_DONE
from moonteam.planners.unfolding.deciding.pointing import begun, said
from moonteam.policies.pointer import PointerSpec

FEW, ROWS = 64, 512
"""R, of few rollouts and of many."""
LONGEST = 64
"""Decisions after which a rollout is given up."""
PAIRS, PLACES = 12_800, 32
"""Pairs of tokens of all the pool's places, and places at least."""


def rolled_out(spec: PointerSpec, params: Any, problems: MacroProblem, row: np.ndarray,
               first: np.ndarray, bound: np.ndarray, preference: np.float32, finish: bool = False
               ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What comes of rollouts, any number of them.

    Args:
      spec: of the network.
      params: of the network.
      problems: [B] NumPy arrays.
      row: [rollouts] the problem of each.
      first: [rollouts, N] what everybody does first, T to wait.
      bound: [rollouts, N] who waits at which target for others; -1: at none.
      preference: 0 time .. 1 effort.
      finish: whether only the first counts, and what is left once all is known is planned, where
        the exact search in steps can do it.

    Returns:
      [rollouts] s to the end, `NOT_DONE` times the limit where it is not reached; [rollouts, T] s
      to each service; [rollouts] worth not served.
    """
    known = finished.fits(problems)[row] & finish
    found, rows = [], ROWS if len(row) > 2 * FEW else FEW
    for at in range(0, len(row), rows):
        own = np.minimum(np.arange(at, at + rows), len(row) - 1)
        part = jax.tree.map(lambda x, own=own: x[row[own]], problems)
        found.append(_played(spec, params, part, bound[own], first[own].astype(np.int32),
                             known[own], np.int32(min(rows, len(row) - at)), preference))
    ended = jax.tree.map(lambda *x: np.concatenate(x)[:len(row)], *jax.device_get(found))
    span = ended.span.astype(np.float64)
    left = np.flatnonzero(ended.known)
    span[left] += np.maximum(ended.floor[left], finished.ends(
        problems, row[left], ended.ways[left], ended.open_[left]))
    limit = problems.limit[row]
    span = np.where(ended.known & (span > limit), NOT_DONE * limit, span)
    return span, ended.served.astype(np.float64), ended.missed.astype(np.float64)


class _Ended(NamedTuple):
    """[R] what came of rollouts; of those that ended when all was known, as it was then."""

    span: Array  # [R] s
    served: Array  # [R, T] s
    missed: Array  # [R]
    known: Array  # [R] bool, what is left is to be planned
    floor: Array  # [R] s until services under way end
    open_: Array  # [R, T] bool
    ways: Array  # [R, N, T] s


class _Pool(NamedTuple):
    rollout: Array  # [P] int32; those past the last stand still
    states: MacroState  # [P]
    turn: Array  # [P] int32, decisions so far
    ended: _Ended
    following: Array  # [] int32, the next rollout


@partial(jax.jit, static_argnames="spec")
def _played(spec: PointerSpec, params: Any, problems: MacroProblem, bound: Array, first: Array,
            finish: Array, count: Array, preference: Array) -> _Ended:
    """Of the first `count` of R rollouts, see `rolled_out`; `finish` [R] bool, with a plan."""
    size, agents = first.shape
    targets = problems.service.shape[1]
    places = min(size, max(PLACES, PAIRS // (agents + targets)**2))
    starts, worst = begun(problems, bound), NOT_DONE * problems.limit

    def of(rollout: Array) -> Array:
        return jnp.minimum(rollout, size - 1)

    def begin(rollout: Array) -> MacroState:
        return jax.tree.map(lambda x: x[of(rollout)], starts)

    def decide(pool: _Pool) -> _Pool:
        logits = said(spec, params, pool.states, preference)
        choice = jax.vmap(world.choose)(pool.states, logits, jnp.zeros_like(logits))[0]
        own, none = of(pool.rollout), worst[of(pool.rollout)]
        choice = jnp.where((pool.turn == 0)[:, None], first[own], choice)
        result = jax.vmap(world.step)(pool.states, choice)
        after = jax.vmap(world.loosen)(result.state, jnp.ones(choice.shape, bool))
        ended = result.terminated | result.truncated | (pool.turn + 1 >= LONGEST)
        known = finish[own] & ~ended & (jax.vmap(world.coming)(after) == 0)
        over = (ended | known) & (pool.rollout < count)
        put = jnp.where(over, pool.rollout, size)
        span = jnp.where(result.terminated | known, pool.states.now + result.seconds, none)
        late = after.lapsed | (~after.solved & ~after.serving)
        served = jnp.where(late, none[:, None], after.served)
        missed = jnp.sum(jnp.where(late, after.problem.worth, 0.0), axis=1)
        ways = after.busy[..., None] + jax.vmap(world.legs)(after.problem, after.node)
        serves = jnp.take_along_axis(after.serving, jnp.minimum(after.goal, targets - 1), axis=1)
        floor = jnp.max(jnp.where(serves & (after.goal < targets), after.busy, 0.0), axis=1)
        row = _Ended(span, served, missed, known, floor, ~after.solved & ~after.serving, ways)
        done = jax.tree.map(lambda all_, x: all_.at[put].set(x, mode="drop"), pool.ended, row)
        rollout, following = refilled(over, pool.rollout, pool.following)
        return _Pool(rollout, trees.where(over, begin(rollout), after),
                     jnp.where(over, 0, pool.turn + 1), done, following)

    each = jnp.arange(places, dtype=jnp.int32)
    none, each_target = jnp.zeros(size), jnp.zeros((size, targets))
    start = _Pool(each, begin(each), jnp.zeros(places, jnp.int32), _Ended(
        none, each_target, none, none > 0, none, each_target > 0, jnp.zeros(problems.start.shape)),
        jnp.int32(places))
    end = jax.lax.while_loop(lambda pool: jnp.any(pool.rollout < count), decide, start)
    return cast(_Ended, end.ended)
