"""Hidden targets in the macro world: what robots see on their way, and where to look next.

The same as in the planners' world (`planners.unfolding`): ways are straight, what comes within
reach of one is seen, and whoever goes to a place to look from stops where all that is not seen of
its part of the ground is in reach. So it matters which way somebody takes, not only where to.

Legend: N agents, M targets and places to look from, Q points of each of the L parts of the ground,
a metre apart.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from moonteam.grid.macro.apart import apart

INSIDE = 0.98
"""Share of a sensor's reach from which a point is looked at."""
HAIR = 1e-3
"""m by which a point may be out of reach and is seen all the same: times are float32."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Sight:
    """Where everybody and everything is, and what has been seen."""

    at: Array  # [M, 2] m; of a place to look from, the middle of what is not seen of its part
    hidden: Array  # [M] bool, nobody knows of it before it is `found`
    speed: Array  # [N] m/s
    reach: Array  # [N] m that each agent sees; 0: it has no eyes
    points: Array  # [L, Q, 2] m
    part: Array  # [L, M] bool, the place from which each part is looked at; padding: none
    size: Array  # [L] points that are none of padding
    seen: Array  # [L, Q] bool; padding counts as seen
    found: Array  # [M] bool
    here: Array  # [N, 2] m
    aim: Array  # [N, 2] m, where its way ends, of those on their way

    @property
    def unseen(self) -> Array:
        """[M] share that nobody has seen of the part that is looked at from there; 0 of targets."""
        share = jnp.sum(~self.seen, axis=-1) / jnp.maximum(self.size, 1)
        return share.astype(jnp.float32) @ self.part

    @property
    def looked(self) -> Array:
        """[M] bool, places to look from at whose parts nothing is left to see."""
        return jnp.any(self.part & jnp.all(self.seen, axis=1)[:, None], axis=0)


def parts(side: int, along: int) -> tuple[np.ndarray, np.ndarray]:
    """[L, Q, 2] m, the points of `along` times `along` parts of a square from 0 to `side` - 1, row
    by row; and [L, Q] bool, padding.
    """
    cuts = np.array_split(np.arange(side), along)
    most = max(map(len, cuts))
    line = np.stack([np.pad(cut, (0, most - len(cut)), "edge") for cut in cuts])  # [along, most]
    over = np.stack([np.arange(most) >= len(cut) for cut in cuts])
    y, x = line[:, None, :, None], line[None, :, None, :]
    shape = along, along, most, most
    points = np.stack([np.broadcast_to(x, shape), np.broadcast_to(y, shape)], -1)
    padding = over[:, None, :, None] | over[None, :, None, :]
    return (points.reshape(along**2, -1, 2).astype(np.float32), padding.reshape(along**2, -1))


def begun(sight: Sight) -> Sight:
    """What is seen where everybody stands."""
    return _seen(sight, sight.here)


def first_find(sight: Sight, busy: Array, moving: Array, never: float) -> Array:
    """[] s until the next hidden target comes within reach of somebody's way; `never` if none does.

    Args:
      sight: now.
      busy: [N] s until each comes to its aim.
      moving: [N] bool.
      never: s.
    """
    way = sight.aim - sight.here
    length = jnp.maximum(jnp.hypot(way[:, 0], way[:, 1]), 1e-6)
    ahead = way / length[:, None]
    off = sight.at[None] - sight.here[:, None]  # [N, M, 2]
    along = jnp.sum(off * ahead[:, None], axis=-1)
    inside = sight.reach[:, None]**2 - (jnp.sum(off**2, axis=-1) - along**2)
    enters = along - jnp.sqrt(jnp.maximum(inside, 0.0))
    looks = (moving & (sight.reach > 0))[:, None] & (sight.hidden & ~sight.found)[None]
    meets = looks & (inside >= 0) & (along >= 0) & (enters <= length[:, None])
    share = jnp.maximum(enters, 0.0) / length[:, None]
    return jnp.min(jnp.where(meets, share * busy[:, None], never))


def gone_on(sight: Sight, busy: Array, moving: Array, wait: Array) -> Sight:
    """`wait` s later: those who are `moving` have gone on, and what they passed is seen."""
    share = jnp.where(moving, jnp.clip(wait / jnp.maximum(busy, 1e-6), 0.0, 1.0), 0.0)
    return _seen(sight, sight.here + share[:, None] * (sight.aim - sight.here))


def _seen(sight: Sight, to: Array) -> Sight:
    """Everybody goes straight `to` [N, 2]; places to look from move to what is left to see."""
    def passed(points: Array) -> Array:
        near = jax.vmap(_near, (0, 0, 0, None))(sight.here, to, sight.reach, points)
        return jnp.any(near, axis=0)

    seen = sight.seen | passed(sight.points.reshape(-1, 2)).reshape(sight.seen.shape)
    found = sight.found | passed(sight.at)
    hides = ~seen[..., None]
    low = jnp.min(jnp.where(hides, sight.points, jnp.inf), axis=1)
    high = jnp.max(jnp.where(hides, sight.points, -jnp.inf), axis=1)
    middle = jnp.where(jnp.any(hides, axis=1), (low + high) / 2, 0.0)
    moved = sight.part & ~jnp.all(seen, axis=1)[:, None]
    at = jnp.where(jnp.any(moved, axis=0)[:, None], moved.T.astype(jnp.float32) @ middle, sight.at)
    return replace(sight, here=to, seen=seen, found=found & sight.hidden, at=at)


def _near(a: Array, b: Array, reach: Array, points: Array) -> Array:
    """[P] bool, which points [P, 2] are within reach of the way from a to b."""
    run, shift = b - a, points - a[None]
    share = jnp.clip(shift @ run / jnp.maximum(run @ run, 1e-6), 0.0, 1.0)
    gap = shift - share[:, None] * run[None]
    return (jnp.sum(gap**2, axis=-1) <= (reach + HAIR)**2) & (reach > 0)


def aimed(sight: Sight, choice: Array) -> Array:
    """[N, 2] m, where the way of each agent to its `choice` [N] ends.

    To look it goes no further than to the first place on the straight way from which all that is
    not seen of the part is in reach.
    """
    goal = sight.at[jnp.minimum(choice, len(sight.at) - 1)]
    own = sight.part[:, jnp.minimum(choice, len(sight.at) - 1)]  # [L, N]
    part = jnp.argmax(own, axis=0)
    way = (goal - sight.here)[:, None]  # [N, 1, 2]
    off = sight.here[:, None] - sight.points[part]  # [N, Q, 2]
    run = jnp.maximum(jnp.sum(way**2, axis=-1), 1e-6)
    slope = jnp.sum(way * off, axis=-1)
    out = jnp.sum(off**2, axis=-1) - (INSIDE * sight.reach[:, None])**2
    enters = (-slope - jnp.sqrt(jnp.maximum(slope**2 - run * out, 0.0))) / run
    share = jnp.where((out > 0) & ~sight.seen[part], enters, 0.0)
    share = jnp.where(jnp.any(own, axis=0), jnp.clip(jnp.max(share, axis=1), 0.0, 1.0), 1.0)
    return sight.here + share[:, None] * way[:, 0]


def ways(sight: Sight) -> tuple[Array, Array]:
    """[N, M] s from where everybody is to each target, and [N, M, M] s between these."""
    return (apart(sight.here, sight.at, "straight") / sight.speed[:, None],
            apart(sight.at, sight.at, "straight")[None] / sight.speed[:, None, None])


def middles(sight: Sight) -> tuple[Array, Array]:
    """[M] s from each target to the parts of the ground, in the mean and by the fastest; and [N]
    from where everybody is.
    """
    spread = jnp.mean(sight.points, axis=1)

    def mean(places: Array) -> Array:
        return jnp.mean(apart(places, spread, "straight"), axis=1) / jnp.max(sight.speed)

    return mean(sight.at), mean(sight.here)
