"""OR-Tools' routing library in steps: a peer of our search, see `seconds.routing`.

Legend: N agents, M open targets, S skills.
"""

from __future__ import annotations

import numpy as np

from moonteam.planners.base import Objective
from moonteam.planners.kind import PlannerKind, PlannerOptions
from moonteam.planners.plans.follow import Answer, RoutePlanner
from moonteam.planners.search.task import Task, weights
from moonteam.planners.search.travel import UNREACHABLE
from moonteam.planners.seconds import routing
from moonteam.planners.seconds.base import NEVER, Moment
from moonteam.planners.seconds.search.work import compact


class RoutingPlanner(RoutePlanner):
    """Plans by OR-Tools' routing library.

    Args:
      objective: makespan (few moves count a little too), moves or weighted.
      alpha: weight of the makespan in the weighted objective, rounded to thousandths.
      beta: weight of the moves in the weighted objective, rounded to thousandths.
      time_limit: seconds.
    """

    name = "routing"

    def __init__(self, objective: Objective = "makespan", alpha: float = 1.0, beta: float = 0.05,
                 time_limit: float | None = 1.0):
        super().__init__(objective, alpha, beta)
        self.time_limit = self._limit = 1.0 if time_limit is None else time_limit
        routing.pywrapcp()

    @classmethod
    def _trial(cls) -> RoutingPlanner:
        return cls(time_limit=routing.TRIAL_S)

    def _answer(self, task: Task, began: float) -> Answer:
        goal = (1.0, 0.0) if self.objective == "makespan" else weights(
            self.objective, self.alpha, self.beta, *task.start.shape)
        found = routing.routed(compact(moment_of(task)), *goal, began + self._limit)
        if found is None:
            return Answer(None, None, False)
        routes = np.full(task.start.shape, -1, np.int32)
        length = np.zeros(len(routes), np.int64)
        present = np.flatnonzero(task.skills)
        for t, team in zip(*found, strict=True):
            for a in present[team].tolist():
                routes[a, length[a]] = t
                length[a] += 1
        return Answer(routes, None, False)


def moment_of(task: Task) -> Moment:
    """The task by a clock that counts steps where `Moment` says ms."""
    agents, count = task.start.shape
    bits = np.arange(max(int(task.need.max(initial=0)), int(task.skills.max(initial=0)), 1)
                     .bit_length())
    start, between = (np.where(x >= UNREACHABLE, NEVER, x.astype(np.int64))
                      for x in (task.start, task.between))
    of_agents, of_targets = np.zeros(agents, np.int64), np.zeros(count, np.int64)
    return Moment(
        start=start, between=between, home=np.zeros((agents, count), np.int64),
        home_now=of_agents, classes=task.kinds.astype(np.int64),
        has=(task.skills[:, None] >> bits & 1).astype(bool),
        need=(task.need[:, None] >> bits & 1).astype(np.int64), either=~task.both,
        service=of_targets, after=np.zeros((count, count), bool), appears=of_targets,
        lapses=of_targets + NEVER, free=of_agents, present=task.skills > 0,
        solved=np.zeros(count, bool), ends=of_targets, effort=np.ones(agents),
        limit=task.horizon)


def _planner(options: PlannerOptions) -> RoutingPlanner:
    return RoutingPlanner(*options.goal, time_limit=options.time_limit)


PLANNER = PlannerKind("routing", _planner, anytime=True)
