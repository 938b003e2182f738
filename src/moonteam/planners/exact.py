"""The exact planner: certified optimal plans for makespan, moves and their weighted sum.

Why a plan over travel times is optimal on the grid: any run of the grid that solves all
targets yields, for each target, the step at which it was solved and a minimal coalition of
agents then in its cell; walking between those events takes each agent at least the travel
time, so the schedule of these events costs no more than the run. Conversely every schedule
can be walked: agents do not hinder each other, may share a cell, and waiting is free. On its
way an agent may solve another target by passing through, earlier than scheduled; that can
only make a plan cheaper than its schedule, and an optimal one cannot be made cheaper. So the
least cost over schedules is the least cost over runs. The search itself is in `search`.

Legend: N agents, M targets, B instances of a batch, K kinds, H rows, W columns.
"""

from __future__ import annotations

import math
import time

import numpy as np

from moonteam.errors import InputError
from moonteam.planners.base import IntArray, Objective
from moonteam.planners.kind import PlannerKind, PlannerOptions
from moonteam.planners.lns import Weights, best_insertion, measure
from moonteam.planners.plans.follow import Answer, RoutePlanner
from moonteam.planners.search import schedules
from moonteam.planners.search.task import Task, weights

MAX_TARGETS = 12
"""Open targets that the exact planner takes on: its tables grow as 2^M."""

_NO_LIMIT = 1 << 62
_FIRST_NODES = 1 << 17


class ExactPlanner(RoutePlanner):
    """Optimal plans for up to 12 open targets.

    Args:
      objective: makespan (fewest moves among the fastest), moves, or weighted.
      alpha: weight of the makespan in the weighted objective.
      beta: weight of the moves in the weighted objective.
      time_limit: seconds after which the best plan so far is returned, with its bound and the
        status feasible; None to search to the end. The tables that the search needs are always
        made: some milliseconds at 10 targets, a tenth of a second at 12.
    """

    name = "exact"
    most_targets = MAX_TARGETS

    def __init__(self, objective: Objective = "makespan", alpha: float = 1.0, beta: float = 0.05,
                 time_limit: float | None = None):
        super().__init__(objective, alpha, beta)
        self.time_limit = time_limit

    @classmethod
    def _trial(cls) -> ExactPlanner:
        return cls(time_limit=60.0)

    def _answer(self, task: Task, began: float) -> Answer:
        if len(task.targets) > MAX_TARGETS:
            raise InputError("--planner exact", f"{len(task.targets)} targets are open; the exact "
                             f"planner takes up to {MAX_TARGETS}; use lns")
        alpha, beta = weights(self.objective, self.alpha, self.beta, len(task.start),
                              task.horizon)
        best: IntArray | None = None
        lower, upper = 0.0, math.inf
        limit = _NO_LIMIT
        if self.time_limit is not None:
            limit = _FIRST_NODES
            best, upper = self._first_plan(task, alpha, beta)
        while True:
            clock = time.perf_counter()
            routes = np.full(task.start.shape, -1, np.int32)
            outcome, makespan, moves, lower = schedules.solve(
                task.start, task.between, task.kinds, task.skills, task.need, task.both,
                alpha, beta, task.horizon, lower, upper, limit, routes)
            if outcome != schedules.NONE:
                best, upper = routes, alpha * makespan + beta * moves
            if outcome == schedules.OPTIMAL or lower >= upper - 1e-9:
                return Answer(best, self._bound(upper), True)
            spent = time.perf_counter() - clock
            left = (self.time_limit or 0.0) - (time.perf_counter() - began)
            if left < spent:
                return Answer(best, self._bound(lower), False)
            limit = int(limit * min(2.0, left / max(spent, 1e-9)))

    def _first_plan(self, task: Task, alpha: float, beta: float) -> tuple[IntArray | None, float]:
        """Routes made by insertion and their value, to fall back on."""
        goal = Weights.of(self.objective, self.alpha, self.beta, task)
        events = best_insertion(task, goal)
        makespan, moves = measure(task, events)
        if makespan > task.horizon:
            return None, math.inf
        return events.routes(len(task.start)), alpha * makespan + beta * moves

    def _bound(self, bound: float) -> float:
        """A bound of the search's value as one of the objective."""
        if not math.isfinite(bound):
            return bound
        if self.objective == "makespan":
            return math.floor(bound + 1e-6)
        if self.objective == "moves":
            return math.ceil(bound - 1e-6)
        return bound


def _planner(options: PlannerOptions) -> ExactPlanner:
    return ExactPlanner(*options.goal, time_limit=options.time_limit)


PLANNER = PlannerKind("exact", _planner, anytime=True, most_targets=MAX_TARGETS)
