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
from dataclasses import dataclass

import numpy as np

from moonteam.errors import InputError
from moonteam.planners import search
from moonteam.planners.base import IntArray, Objective, Plan, Snapshot
from moonteam.planners.follow import Follower
from moonteam.planners.routes import (
    Certificate,
    infeasible,
    obstacles,
    plan_of_routes,
)
from moonteam.planners.simulate import holding
from moonteam.planners.travel import Travel, travel_times

MAX_TARGETS = 12
"""Open targets that the exact planner takes on: its tables grow as 2^M."""

_NO_LIMIT = 1 << 62
_FIRST_NODES = 1 << 17


def weights(objective: Objective, alpha: float, beta: float, agents: int,
            horizon: int) -> tuple[float, float]:
    """Weights of makespan and moves in the search.

    Among plans of least makespan the one of fewest moves is wanted: moves get a weight so
    small that all of them together weigh less than one step.
    """
    if objective == "makespan":
        return 1.0, 1.0 / (agents * horizon + 1)
    if objective == "moves":
        return 0.0, 1.0
    if objective != "weighted":
        raise InputError("--objective", f"{objective!r} is not allowed; makespan, moves, weighted")
    if alpha < 0 or beta < 0 or alpha + beta <= 0 or not math.isfinite(alpha + beta):
        raise InputError("--objective weighted", f"alpha {alpha} and beta {beta} are not allowed; "
                         "both at least 0, one above 0")
    return alpha, beta


@dataclass(frozen=True)
class _Open:
    """The open part of a snapshot in the shapes that `search.solve` takes."""

    targets: IntArray  # [M'] indices of open targets
    start: IntArray  # [N, M']
    between: IntArray  # [K, M', M']
    kinds: IntArray  # [N]
    skills: IntArray  # [N] bitmask, 0 for lost agents
    need: IntArray  # [M']
    both: np.ndarray  # [M'] bool

    @classmethod
    def of(cls, snapshot: Snapshot, travel: Travel) -> _Open:
        index = np.flatnonzero(~holding(snapshot)).astype(np.int32)
        return cls(
            targets=index,
            start=np.ascontiguousarray(travel.start[:, index], np.int32),
            between=np.ascontiguousarray(travel.between[:, index][:, :, index], np.int32),
            kinds=np.ascontiguousarray(travel.kinds, np.int32),
            skills=np.where(snapshot.agent_mask, snapshot.agent_skills, 0).astype(np.int32),
            need=snapshot.target_skills[index].astype(np.int32),
            both=np.ascontiguousarray(snapshot.target_and[index]))


class ExactPlanner(Follower):
    """Optimal plans for up to 12 open targets.

    Args:
      objective: makespan (fewest moves among the fastest), moves, or weighted.
      alpha: weight of the makespan in the weighted objective.
      beta: weight of the moves in the weighted objective.
      time_limit: seconds after which the best plan so far is returned, with its bound and the
        status feasible; None to search to the end.
    """

    name = "exact"

    def __init__(self, objective: Objective = "makespan", alpha: float = 1.0, beta: float = 0.05,
                 time_limit: float | None = None):
        super().__init__()
        self.objective: Objective = objective
        self.alpha, self.beta, self.time_limit = alpha, beta, time_limit
        weights(objective, alpha, beta, 1, 1)

    def plan(self, snapshot: Snapshot) -> Plan:
        """The optimal plan. Raises InputError where too many targets are open."""
        began = time.perf_counter()
        travel = travel_times(snapshot)
        agents = len(snapshot.cells)
        blocked = obstacles(snapshot, travel)
        if blocked:
            return infeasible(self.name, self.objective, "; ".join(blocked.values()),
                              time.perf_counter() - began, agents)
        task = _Open.of(snapshot, travel)
        if len(task.targets) > MAX_TARGETS:
            raise InputError("--planner exact", f"{len(task.targets)} targets are open; the exact "
                             f"planner takes up to {MAX_TARGETS}; use lns")
        horizon = snapshot.max_steps - snapshot.step
        alpha, beta = weights(self.objective, self.alpha, self.beta, agents, max(horizon, 1))
        routes, bound, proved = self._search(task, alpha, beta, horizon, began)
        if routes is None:
            return infeasible(self.name, self.objective, f"no plan within {horizon} steps",
                              time.perf_counter() - began, agents)
        named = [[int(task.targets[t]) for t in route if t >= 0] for route in routes.tolist()]
        claim = Certificate(self.name, self.objective, "optimal" if proved else "feasible",
                            self._bound(bound))
        return plan_of_routes(snapshot, travel, named, claim, time.perf_counter() - began)

    def _bound(self, bound: float) -> float:
        """A bound of the search's value as one of the objective."""
        if self.objective == "makespan":
            return math.floor(bound + 1e-6)
        if self.objective == "moves":
            return math.ceil(bound - 1e-6)
        return bound

    def _search(self, task: _Open, alpha: float, beta: float, horizon: int,
                began: float) -> tuple[IntArray | None, float, bool]:
        """(routes or None, bound of the value, whether they are proved best)."""
        best: IntArray | None = None
        lower, upper = 0.0, math.inf
        limit = _NO_LIMIT if self.time_limit is None else _FIRST_NODES
        while len(task.targets):
            routes = np.full(task.start.shape, -1, np.int32)
            outcome, makespan, moves, lower = search.solve(
                task.start, task.between, task.kinds, task.skills, task.need, task.both,
                alpha, beta, horizon, lower, upper, limit, routes)
            if outcome != search.NONE:
                best, upper = routes, alpha * makespan + beta * moves
            if outcome == search.OPTIMAL or lower >= upper - 1e-9 or math.isinf(lower):
                return best, upper, best is not None
            if time.perf_counter() - began >= (self.time_limit or math.inf):
                return best, lower, False
            limit *= 2
        return np.full((len(task.start), 0), -1, np.int32), 0.0, True
