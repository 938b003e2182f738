"""Ways along x and then y, as between the cells of a grid: where somebody is who turns on one.

The same as in the planners' world (`planners.unfolding.ways`).

Legend: N agents, M targets, P places.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jax import Array

from moonteam.grid.macro.apart import apart


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Streets:
    """Where everything is, and from where everybody starts."""

    at: Array  # [M, 2] cells
    here: Array  # [N, 2] cells
    speed: Array  # [N] cells a second
    spread: Array  # [P, 2] where targets may come, evenly; none where nobody can say


def turned(streets: Streets, who: Array, origin: Array, node: Array, gone: Array) -> Streets:
    """Those of `who` [N] bool start where they are now: `gone` [N] s on their way from `origin` [N]
    (a target, or M: their start) to `node` [N].
    """
    last = len(streets.at) - 1
    begin = jnp.where((origin > last)[:, None], streets.here,
                      streets.at[jnp.minimum(origin, last)])
    way = streets.at[jnp.minimum(node, last)] - begin
    along = jnp.minimum(gone * streets.speed, jnp.abs(way[:, 0]))
    across = jnp.clip(gone * streets.speed - along, 0.0, jnp.abs(way[:, 1]))
    place = begin + jnp.sign(way) * jnp.stack([along, across], axis=1)
    return replace(streets, here=jnp.where(who[:, None], place, streets.here))


def ways(streets: Streets) -> Array:
    """[N, M] s from where everybody starts to each target."""
    return apart(streets.here, streets.at, "manhattan") / streets.speed[:, None]


def middle_now(streets: Streets) -> Array:
    """[N] s from where everybody starts to where targets may come, in the mean, by the fastest."""
    if not len(streets.spread):
        return jnp.zeros(len(streets.here))
    far = apart(streets.here, streets.spread, "manhattan")
    return jnp.mean(far, axis=1) / jnp.max(streets.speed)
