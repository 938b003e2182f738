"""A mission's plan beside the best there is, which the exact planner proves.

In steps both are counted in steps, and in the seconds that they take at travelling speed, where all
wait for the slowest of those that move; by the clock in the seconds of ways, services and windows.

Legend: T steps, R robots.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from moonteam.planners import registry
from moonteam.planners.base import Snapshot
from moonteam.planners.kind import PlannerOptions
from moonteam.planners.seconds import registry as by_the_clock
from moonteam.planners.seconds.base import MS, Moment
from moonteam.problem.scenario import ACTIONS
from sim2grid.loop.asked import Body
from sim2grid.measure.metrics import Optimum

EXACT = "exact"
LIMIT_S = 5.0
"""s in which the optimum is to be proved."""


def in_steps(start: Snapshot, actions: npt.NDArray[np.int32], bodies: Sequence[Body],
             cell_m: float) -> Optimum | None:
    """Of a plan that solves a mission in steps; None where the optimum is not proved in time.

    Args:
      start: the mission's first moment.
      actions: [T, R] the plan, to the step that solves the last target.
      bodies: [R] of the robots.
      cell_m: metres a side of a cell.
    """
    kind = registry.find(EXACT)
    if kind.most_targets is not None and len(start.solved) > kind.most_targets:
        return None
    best = registry.make(EXACT, PlannerOptions(time_limit=LIMIT_S)).plan(start)
    if best.status != "optimal" or best.makespan is None:
        return None
    return Optimum(
        plan_s=_seconds(actions, bodies, cell_m), plan_steps=len(actions),
        optimum_s=_seconds(best.actions[:best.makespan], bodies, cell_m),
        optimum_steps=best.makespan)


def in_seconds(planner: str, options: PlannerOptions, first: Moment) -> Optimum | None:
    """Of what a planner by the clock plans at first; None where it or the proof is missing."""
    exact, kind = (by_the_clock.find(name) for name in (EXACT, planner))
    if exact.most_targets is not None and len(first.solved) > exact.most_targets:
        return None
    best = exact.make(PlannerOptions(time_limit=LIMIT_S)).plan(first)
    own = best if kind is exact else kind.make(options).plan(first)
    if best.status != "optimal" or best.makespan is None or own.makespan is None:
        return None
    return Optimum(plan_s=round(own.makespan / MS, 4), optimum_s=round(best.makespan / MS, 4))


def words(found: Optimum) -> str:
    """For people: both, and by how much the one is longer, in what is planned."""
    if found.plan_steps is None or found.optimum_steps is None:
        over = found.plan_s / found.optimum_s - 1
        return (f"plan {found.plan_s:.1f} s, certified optimum {found.optimum_s:.1f} s: "
                f"{max(over, 0.0):.1%} over")
    over = found.plan_steps / found.optimum_steps - 1
    return (f"plan {found.plan_steps} steps ({found.plan_s:.1f} s at travelling speed), certified "
            f"optimum {found.optimum_steps} steps ({found.optimum_s:.1f} s): {over:.1%} over in "
            "steps")


def lines(found: Optimum | None) -> tuple[str, ...]:
    """The same as lines for a picture; one that says so where no optimum is proved."""
    if found is None:
        return ("the optimum is not proved",)
    if found.plan_steps is None or found.optimum_steps is None:
        return (f"certified optimum: {found.optimum_s:.1f} s", f"plan: {found.plan_s:.1f} s")
    return (f"certified optimum: {found.optimum_steps} steps, {found.optimum_s:.1f} s at "
            "travelling speed", f"plan: {found.plan_steps} steps, {found.plan_s:.1f} s")


def _seconds(actions: npt.NDArray[np.int32], bodies: Sequence[Body], cell_m: float) -> float:
    """Seconds of joint actions [T, R] at travelling speed."""
    each = cell_m / np.array([body.speed for body in bodies])
    moving = np.asarray(actions) != ACTIONS.index("stay")
    return round(float(np.max(np.where(moving, each, 0.0), axis=1, initial=0.0).sum()), 4)
