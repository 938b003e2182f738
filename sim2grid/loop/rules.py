"""The rules of execution, each stated once: arrival, time-out, stuck, lost, solved, unsolvable.

Every function is pure and works on NumPy arrays, on JAX arrays and inside jit and vmap: it takes
the array library from its arguments. The executor on the host and the whole loop as one program
both call them. Who waits for whom, and where robots that share a cell stand, is in
`sim2grid.waypoints`.

Legend: R robots, M targets, T samples of a look. Cells are int32 (x, y), `xy` is in metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from moonteam.problem import rules as grid_rules
from moonteam.robots.base import CONTROL_PERIOD
from sim2grid.frame import Frame, tilt

PRESENT, FALLEN, STUCK, NOT_A_NUMBER, OFF_THE_MAP = range(5)
"""Why a robot left the team."""


@dataclass(frozen=True)
class Rules:
    """When a robot has arrived, is late, has fallen or is stuck."""

    arrive_cells: float = 0.25  # distance to the waypoint, in cells
    arrive_speed: float = 0.5  # of the travelling speed, averaged over a chunk
    chunk_steps: int = 25  # control steps between two looks at the robots
    timeout_base_s: float = 8.0
    timeout_factor: float = 4.0  # times the time the way takes at travelling speed
    fall_s: float = 2.0  # tilted for longer than this, it has fallen
    stuck_progress: float = 0.25  # of a leg; a time-out with less counts towards stuck
    # Such time-outs in a row. Two are not enough: legs that hook on a rock in one direction have
    # come free at the third try, for by then the ground has been closed or they stand otherwise.
    stuck_after: int = 3
    crowd_cells: float = 1.2  # a robot that near, not the ground, is why another was late

    @property
    def chunk_s(self) -> float:
        """Seconds between two looks."""
        return self.chunk_steps * CONTROL_PERIOD


def slack(seconds: Any) -> float:
    """Seconds by which sums of looks may be off in the precision of an array: 1e-8 or 3e-4."""
    return float(np.sqrt(np.finfo(seconds.dtype).eps))


def metres(vectors: Any) -> Any:
    """Lengths [...] of vectors [..., 2] m."""
    return vectors.__array_namespace__().hypot(vectors[..., 0], vectors[..., 1])


def seen(xy: Any, xy_before: Any) -> Any:
    """Where the robots are [R, 2]: as last seen where `xy` is not a number."""
    xp = xy.__array_namespace__()
    return xp.where(xp.isfinite(xy).all(-1, keepdims=True), xy, xy_before)


def tilted(quats: Any, fall_tilt: Any, tilted_s: Any, seconds: float) -> Any:
    """Seconds [R] for which each robot has now been tilted too far without a break.

    `quats` [T, R, 4] are those of a look of so many seconds, `fall_tilt` [R] rad is what each
    may tilt, `tilted_s` [R] what it was before.
    """
    xp = quats.__array_namespace__()
    over = tilt(quats).min(0) > fall_tilt
    return xp.where(over, tilted_s + seconds, xp.zeros_like(tilted_s))


def losses(rules: Rules, frame: Frame, finite: Any, tilted_s: Any, xy: Any) -> Any:
    """[R] int32 why a robot leaves the team, PRESENT if it does not.

    `finite` [R]: all that was seen of it is a number; `tilted_s` [R] as `tilted` gives it;
    `xy` [R, 2] where it is.
    """
    xp = xy.__array_namespace__()
    cause = xp.where(frame.off_map(xy), OFF_THE_MAP, PRESENT)
    cause = xp.where(tilted_s > rules.fall_s + slack(tilted_s), FALLEN, cause)
    return xp.where(finite, cause, NOT_A_NUMBER).astype(xp.int32)


def patience(rules: Rules, way: Any, speeds: Any) -> Any:
    """Seconds [...] that a leg of so many metres may take at that speed before it times out."""
    return rules.timeout_base_s + rules.timeout_factor * way / speeds


def near(rules: Rules, frame: Frame, xy: Any, points: Any) -> Any:
    """[R] True where robots at `xy` [R, 2] are as near to their waypoints as they need to be."""
    return metres(xy - points) <= rules.arrive_cells * frame.cell_m


def slow_enough(rules: Rules, xy: Any, xy_before: Any, speeds: Any, seconds: float) -> Any:
    """[R] True where a robot has come so little farther within a look that it may stop there."""
    return metres(xy - xy_before) <= rules.arrive_speed * speeds * seconds


def arrived(rules: Rules, frame: Frame, xy: Any, points: Any, goals: Any, slow: Any,
            tilted_s: Any) -> Any:
    """[R] True where a robot is where it was sent: `points` [R, 2] m in the cells `goals`.

    Near the waypoint, inside the goal cell, slow enough, and not tilted.
    """
    return (near(rules, frame, xy, points) & frame.inside(xy, goals) & slow
            & (tilted_s == 0.0))


def late(time_s: Any, limit_s: Any) -> Any:
    """[R] True where the mission second `time_s` is at the limit of a leg or past it."""
    return time_s >= limit_s - slack(limit_s)


def stalls(rules: Rules, before: Any, timed_out: Any, came: Any, xy: Any, start_xy: Any,
           points: Any) -> Any:
    """[R] time-outs in a row with too little progress, after a look.

    `before` [R] is their number so far; `timed_out` [R] and `came` [R] (to another cell) say
    how legs from `start_xy` to `points` [R, 2] have just ended.
    """
    xp = xy.__array_namespace__()
    length = metres(points - start_xy)
    stalled = length - metres(points - xy) < rules.stuck_progress * length
    after = xp.where(timed_out, xp.where(stalled, before + 1, 0), before)
    return xp.where(came, 0, after)


def stuck(rules: Rules, timed_out: Any, stalls: Any) -> Any:
    """[R] True where a robot that has just timed out will not come free any more."""
    return timed_out & (stalls >= rules.stuck_after)


def crowded(rules: Rules, frame: Frame, xy: Any, cells: Any, goals: Any, grounded: Any) -> Any:
    """[R] True where another robot stood so near, or in the goal, that it was in the way.

    Flyers, `grounded` [R] False, are in nobody's way and nobody is in theirs.
    """
    xp = xy.__array_namespace__()
    index = xp.arange(len(xy))
    close = metres(xy[None] - xy[:, None]) <= rules.crowd_cells * frame.cell_m
    there = (cells[None] == goals[:, None]).all(-1)
    others = (index[:, None] != index[None]) & grounded[:, None] & grounded[None]
    return ((close | there) & others).any(-1)


def present(frame: Frame, xy: Any, cells: Any, target_cells: Any) -> Any:
    """[R, M] True where a robot counts as in a target's cell: it has that cell and lies in it.

    On a border it keeps the cell that it had, but solves nothing there.
    """
    return ((cells[:, None] == target_cells[None]).all(-1) & frame.inside(xy, cells)[:, None])


def contributing(here: Any, skills: Any, need: Any, both: Any) -> Any:
    """[R, M] True for robots that meet a target together, False for all where they do not.

    `here` [R, M] are those that count (in its cell, or with a way to it), `skills` [R] and
    `need` [M] bit masks, `both` [M] True for AND.
    """
    share = here & ((skills[:, None] & need[None]) != 0)
    return share & met(here, skills, need, both)[None]


def met(here: Any, skills: Any, need: Any, both: Any) -> Any:
    """[M] True where the robots `here` [R, M] meet a target: OR with any of its skills, AND
    with all of them. Arguments as in `contributing`.
    """
    xp = here.__array_namespace__()
    have = xp.zeros_like(need)
    for i in range(len(skills)):
        have = have | xp.where(here[i], skills[i], 0).astype(need.dtype)
    return grid_rules.met(have, need, both)


def unsolvable(reach: Any, in_team: Any, skills: Any, need: Any, both: Any, solved: Any) -> Any:
    """[M] True for open targets that the robots left can never solve.

    `reach` [R, M]: a robot has a way there; the others as in `contributing`.
    """
    return ~solved & ~met(reach & in_team[:, None], skills, need, both)
