"""The planner by the clock that chooses by itself: exact where done in time, else search."""

from __future__ import annotations

import time
from dataclasses import replace

from moonteam.planners.auto import LIMIT, SHARE, too_many
from moonteam.planners.seconds import exact, local
from moonteam.planners.seconds.base import Moment, TimedPlan
from moonteam.planners.seconds.exact import MAX_TARGETS, ExactPlanner
from moonteam.planners.seconds.local import LocalSearchPlanner
from moonteam.planners.seconds.search.goal import Objective, check
from moonteam.planners.seconds.search.labels import MAX_AGENTS


class AutoPlanner:
    """The exact planner's plan if it is certified in half of the time, else the better of two.

    A plan says in `planner` whose it is and in `reason` why.

    Args:
      objective: makespan, effort or weighted.
      alpha: weight of the makespan, ms, in the weighted objective.
      beta: weight of the effort in the weighted objective.
      time_limit: seconds a plan; unless certified it depends on the machine's speed.
      seed: of local search.
      threads: that local search takes.
    """

    name = "auto"

    def __init__(self, objective: Objective = "makespan", alpha: float = 1.0, beta: float = 0.05,
                 time_limit: float = LIMIT, seed: int = 0, threads: int = 1):
        self.objective: Objective = check(objective, alpha, beta)
        self.alpha, self.beta = alpha, beta
        self.time_limit, self.seed, self.threads = time_limit, seed, threads

    def plan(self, moment: Moment) -> TimedPlan:
        """The better plan."""
        exact.compiled()
        local.compiled()
        began = time.perf_counter()
        goal = self.objective, self.alpha, self.beta
        count, agents = int((~moment.solved).sum()), len(moment.free)
        first, why = None, too_many(count, MAX_TARGETS)
        if agents > MAX_AGENTS:
            why = f"{agents} robots are more than the {MAX_AGENTS} that the exact planner takes"
        if not why:
            first = ExactPlanner(*goal, time_limit=SHARE * self.time_limit).plan(moment)
            if first.status == "optimal":
                return replace(first, planner="auto: exact", reason="certified")
            if first.status == "infeasible":
                return first
            why = f"{count} targets were not certified within {SHARE * self.time_limit:g} s"
        left = max(self.time_limit - (time.perf_counter() - began), 1e-3)
        plan = LocalSearchPlanner(*goal, time_limit=left, seed=self.seed,
                                  threads=self.threads).plan(moment)
        if first is not None:
            better = min((plan, first), key=self._value)
            plan = replace(better, bound=first.bound)
        if plan.status == "infeasible":
            return plan
        return replace(plan, planner=f"auto: {plan.planner}", reason=why,
                       seconds=time.perf_counter() - began)

    def _value(self, plan: TimedPlan) -> float:
        if plan.makespan is None or plan.effort is None:
            return float("inf")
        return {"makespan": plan.makespan, "effort": plan.effort,
                "weighted": self.alpha * plan.makespan + self.beta * plan.effort}[self.objective]
