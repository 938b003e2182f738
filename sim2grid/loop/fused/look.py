"""A look inside the program: what the robots are told, and what came of it.

The rules are those of `sim2grid.loop.rules`. Legend as in `state`; S samples of a look.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from moonteam.grid.types import Problem
from moonteam.robots.base import Command
from moonteam.trees import where
from sim2grid.loop import rules as law
from sim2grid.loop.fused.state import (
    ARRIVED,
    LOST,
    TIMEOUT,
    UNDER_WAY,
    Ground,
    Progress,
    Setup,
    check_solvable,
    lay_out,
)


def command(setup: Setup, now: Progress) -> tuple[Command, ...]:
    """A command for each robot, until the next look."""
    hold = law.near(setup.rules, setup.frame, now.points, now.xy) & ~now.going
    speed = jnp.where(hold, 0.0, jnp.array(setup.speeds))
    return tuple(Command(now.points[i], speed[i], ~now.mask[i])
                 for i in range(len(setup.speeds)))


def observe(setup: Setup, problem: Problem, charted: Ground, now: Progress, qpos: Array
            ) -> Progress:
    """Takes a look's samples qpos [S, nq]: losses, arrivals, time-outs, and whether to decide."""
    poses = jnp.stack([qpos[:, b:b + 7] for b in setup.bases], axis=1)  # [S, R, 7]
    now = now._replace(look=now.look + 1)
    gone = _losses(setup, now, poses)
    fewer = jnp.any(gone.mask != now.mask)
    gone = where(fewer, check_solvable(problem, charted, gone), gone)
    seen = _arrivals(setup, gone, poses[-1, :, :2])
    fewer = jnp.any(seen.mask != gone.mask)
    seen = where(fewer, check_solvable(problem, charted, seen), seen)
    after = where(gone.status == UNDER_WAY, seen, gone)
    after = after._replace(asking=~jnp.any(after.mask & after.going))
    again = jnp.any(after.mask != now.mask) & ~after.asking & (after.status == UNDER_WAY)
    return where(again, lay_out(setup, after), after)


def _losses(setup: Setup, now: Progress, poses: Array) -> Progress:
    """Takes robots out of the team that fell, left the map or are not a number."""
    tilted = law.tilted(poses[..., 3:7], jnp.array(setup.fall_tilts), now.tilted_s,
                        setup.rules.chunk_s)
    finite = jnp.all(jnp.isfinite(poses), axis=(0, 2))
    cause = law.losses(setup.rules, setup.frame, finite, tilted, poses[-1, :, :2])
    return _lose(setup, now._replace(tilted_s=jnp.where(now.mask, tilted, now.tilted_s)), cause)


def _arrivals(setup: Setup, now: Progress, after: Array) -> Progress:
    """Ends the legs of robots that are there, or late; they are at `after` [R, 2]."""
    rules, speeds, seconds = setup.rules, jnp.array(setup.speeds), setup.seconds(now.look)
    xy = law.seen(after, now.xy)
    slow = law.slow_enough(rules, after, now.xy, speeds, rules.chunk_s)
    there = law.arrived(rules, setup.frame, xy, now.points, now.goals, slow, now.tilted_s)
    came = now.going & (~now.moving | there)
    late = now.going & ~came & law.late(seconds, now.limit_s)
    stalls = law.stalls(rules, now.stalls, late, came & now.moving, xy, now.start_xy, now.points)
    now = now._replace(
        xy=xy, stalls=stalls, end_s=jnp.where(came | late, seconds, now.end_s),
        ended=jnp.where(came, ARRIVED, jnp.where(late, TIMEOUT, now.ended)))
    stuck = law.stuck(rules, late, stalls)
    return _lose(setup, now, jnp.where(stuck, law.STUCK, law.PRESENT))


def _lose(setup: Setup, now: Progress, cause: Array) -> Progress:
    """Takes robots with a cause [R] other than PRESENT out of the team."""
    gone = now.mask & (cause != law.PRESENT)
    cut, seconds = gone & now.going, setup.seconds(now.look)
    return now._replace(
        mask=now.mask & ~gone, lost=jnp.where(gone, cause, now.lost),
        lost_s=jnp.where(gone, seconds, now.lost_s),
        lost_at=jnp.where(gone, now.decision, now.lost_at),
        ended=jnp.where(cut, LOST, now.ended), end_s=jnp.where(cut, seconds, now.end_s))
