"""The planner that chooses by itself: exact where that is done in time, else guided search."""

from __future__ import annotations

import time
from dataclasses import replace

from moonteam.planners.base import Objective, Plan, Snapshot, check_objective
from moonteam.planners.exact import ExactPlanner
from moonteam.planners.guided import GuidedPlanner
from moonteam.planners.kind import PlannerKind, PlannerOptions
from moonteam.planners.plans.follow import PlanFollower, compiled

LIMIT = 1.0
"""s a plan may take if nobody says how long."""
SHARE = 0.5
"""Of the time, that the exact planner may have before local search takes over."""


class AutoPlanner(PlanFollower):
    """The exact planner's plan if it is certified in half of the time, else the better of two.

    A plan says in `planner` whose it is and in `reason` why.

    Args:
      objective: makespan (fewest moves among the fastest), moves, or weighted.
      alpha: weight of the makespan in the weighted objective.
      beta: weight of the moves in the weighted objective.
      time_limit: seconds a plan; unless certified it depends on the machine's speed.
      seed: of local search.
      threads: of local search.
    """

    name = "auto"

    def __init__(self, objective: Objective = "makespan", alpha: float = 1.0, beta: float = 0.05,
                 time_limit: float = LIMIT, seed: int = 0, threads: int = 1):
        super().__init__()
        self.objective: Objective = check_objective(objective, alpha, beta)
        self.alpha, self.beta = alpha, beta
        self.time_limit, self.seed, self.threads = time_limit, seed, threads

    def reset(self, snapshot: Snapshot, seed: int = 0) -> None:
        """Starts a mission; the seed is that of local search."""
        super().reset(snapshot, seed)
        self.seed = seed

    def plan(self, snapshot: Snapshot) -> Plan:
        """A whole plan from this moment. Raises InputError if no planner can serve it."""
        compiled(ExactPlanner)
        compiled(GuidedPlanner)
        began = time.perf_counter()
        goal = self.objective, self.alpha, self.beta
        count = int((~snapshot.solved).sum())
        first, why = None, too_many(count, ExactPlanner.most_targets)
        if not why:
            first = ExactPlanner(*goal, time_limit=SHARE * self.time_limit).plan(snapshot)
            if first.status != "feasible":
                return _said(first, "certified") if first.status == "optimal" else first
            why = f"{count} targets were not certified within {SHARE * self.time_limit:g} s"
        left = max(self.time_limit - (time.perf_counter() - began), 1e-3)
        plan = GuidedPlanner(*goal, time_limit=left, seed=self.seed,
                             threads=self.threads).plan(snapshot)
        if first is not None:
            bound = max((b for b in (first.bound, plan.bound) if b is not None), default=None)
            better = min((plan, first), key=self._value)
            plan = replace(better, bound=bound)
        seconds = time.perf_counter() - began
        return _said(plan, why, seconds) if plan.status != "infeasible" else plan

    def _value(self, plan: Plan) -> tuple[float, float]:
        if plan.makespan is None or plan.moves is None:
            return float("inf"), 0.0
        return {"makespan": (plan.makespan, plan.moves), "moves": (plan.moves, plan.makespan),
                "weighted": (self.alpha * plan.makespan + self.beta * plan.moves, 0.0),
                }[self.objective]


def too_many(count: int, most: int | None) -> str:
    """Why the exact planner is not asked; empty if it is."""
    if most is None or count <= most:
        return ""
    return f"{count} targets are more than the {most} that the exact planner takes"


def _said(plan: Plan, why: str, seconds: float | None = None) -> Plan:
    return replace(plan, planner=f"auto: {plan.planner}", reason=why,
                   seconds=plan.seconds if seconds is None else seconds)


def _planner(options: PlannerOptions) -> AutoPlanner:
    return AutoPlanner(*options.goal, time_limit=options.time_limit or LIMIT, seed=options.seed,
                       threads=options.threads)


PLANNER = PlannerKind("auto", _planner, anytime=True, parallel=True)
