"""Missions of the macro world played to their ends by a policy's likeliest choices, in few calls.

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
               first: np.ndarray, bound: np.ndarray, preference: np.float32
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

    Returns:
      [rollouts] s to the end, `NOT_DONE` times the limit where it is not reached; [rollouts, T] s
      to each service; [rollouts] worth not served.
    """
    found, rows = [], ROWS if len(row) > 2 * FEW else FEW
    for at in range(0, len(row), rows):
        own = np.minimum(np.arange(at, at + rows), len(row) - 1)
        part = jax.tree.map(lambda x, own=own: x[row[own]], problems)
        found.append(_played(spec, params, part, bound[own], first[own].astype(np.int32),
                             np.int32(min(rows, len(row) - at)), preference))
    whole = zip(*jax.device_get(found), strict=True)
    span, served, missed = (np.concatenate(x)[:len(row)].astype(np.float64) for x in whole)
    return span, served, missed


class _Pool(NamedTuple):
    rollout: Array  # [P] int32; those past the last stand still
    states: MacroState  # [P]
    turn: Array  # [P] int32, decisions so far
    span: Array  # [R] s
    served: Array  # [R, T] s
    missed: Array  # [R]
    following: Array  # [] int32, the next rollout


@partial(jax.jit, static_argnames="spec")
def _played(spec: PointerSpec, params: Any, problems: MacroProblem, bound: Array, first: Array,
            count: Array, preference: Array) -> tuple[Array, Array, Array]:
    """Of the first `count` of R rollouts, see `rolled_out`."""
    size, agents = first.shape
    places = min(size, max(PLACES, PAIRS // (agents + problems.service.shape[1])**2))
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
        over = ended & (pool.rollout < count)
        put = jnp.where(over, pool.rollout, size)
        span = jnp.where(result.terminated, pool.states.now + result.seconds, none)
        late = after.lapsed | (~after.solved & ~after.serving)
        served = jnp.where(late, none[:, None], after.served)
        missed = jnp.sum(jnp.where(late, after.problem.worth, 0.0), axis=1)
        rollout, following = refilled(over, pool.rollout, pool.following)
        return _Pool(
            rollout, trees.where(over, begin(rollout), after), jnp.where(over, 0, pool.turn + 1),
            pool.span.at[put].set(span, mode="drop"),
            pool.served.at[put].set(served, mode="drop"),
            pool.missed.at[put].set(missed, mode="drop"), following)

    each = jnp.arange(places, dtype=jnp.int32)
    start = _Pool(each, begin(each), jnp.zeros(places, jnp.int32), jnp.zeros(size),
                  jnp.zeros(problems.service.shape), jnp.zeros(size), jnp.int32(places))
    end = jax.lax.while_loop(lambda pool: jnp.any(pool.rollout < count), decide, start)
    return cast(tuple[Array, Array, Array], (end.span, end.served, end.missed))
