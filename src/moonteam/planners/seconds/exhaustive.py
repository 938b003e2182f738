"""Everything tried, plainly: what the exact planner by the clock is tested against.

Every order of the targets that keeps to "after", and for every target every set of agents that is
enough for it, spare agents included; each service starts as early as it can. No bound, no table.
"""

from __future__ import annotations

import itertools
import math
import time
from dataclasses import dataclass, field

import numpy as np

from moonteam.errors import InputError
from moonteam.planners.seconds.base import (
    NEVER,
    Moment,
    Service,
    TimedPlan,
    effort,
    enough,
    makespan,
)
from moonteam.planners.seconds.search.goal import Objective, check, value

MAX_TARGETS = 6


@dataclass
class Best:
    """The best complete plan so far."""

    cost: float = math.inf
    services: tuple[Service, ...] = ()


@dataclass(frozen=True)
class Search:
    """A moment and the goal."""

    now: Moment
    objective: Objective
    alpha: float
    beta: float
    best: Best = field(default_factory=Best)

    def extend(self, done: tuple[Service, ...]) -> None:
        """Tries every next target with every team behind what is done."""
        now = self.now
        ends = {j: int(now.ends[j]) for j in np.flatnonzero(now.solved).tolist()}
        ends |= {one.target: one.end for one in done}
        left = [j for j in range(len(now.solved)) if j not in ends]
        if not left:
            self.compare(done)
        for j in left:
            before = np.flatnonzero(now.after[j]).tolist()
            if all(k in ends for k in before):
                ready = max([int(now.appears[j]), *(ends[k] for k in before)])
                for team in self.teams(j):
                    start = max(ready, *(self.there(a, j, done) for a in team))
                    end = start + int(now.service[j])
                    if start <= now.lapses[j] and end < NEVER:
                        self.extend((*done, Service(j, team, start, end)))

    def teams(self, target: int) -> list[tuple[int, ...]]:
        """Every set of agents of the team that is enough for the target."""
        members = np.flatnonzero(self.now.present).tolist()
        return [team for size in range(1, len(members) + 1)
                for team in itertools.combinations(members, size)
                if enough(team, target, self.now)]

    def there(self, agent: int, target: int, done: tuple[Service, ...]) -> int:
        """ms at which the agent can be at the target after what it has done."""
        now = self.now
        for one in reversed(done):
            if agent in one.agents:
                return one.end + int(now.between[now.classes[agent], one.target, target])
        return int(now.free[agent] + now.start[agent, target])

    def compare(self, done: tuple[Service, ...]) -> None:
        """Keeps a whole plan if it is within the limit and the best."""
        span = makespan(self.now, done)
        if span <= self.now.limit and span < NEVER:
            cost = value(self.objective, self.alpha, self.beta, span, effort(self.now, done))
            if cost < self.best.cost - 1e-9:
                self.best.cost, self.best.services = cost, done


class ExhaustivePlanner:
    """Optimal plans by the clock for up to 6 open targets, by trying everything; very slow.

    Args:
      objective: makespan, effort or weighted.
      alpha: weight of the makespan, ms, in the weighted objective.
      beta: weight of the effort in the weighted objective.
    """

    name = "exhaustive"
    most_targets = MAX_TARGETS

    def __init__(self, objective: Objective = "makespan", alpha: float = 1.0, beta: float = 0.05):
        self.objective: Objective = check(objective, alpha, beta)
        self.alpha, self.beta = alpha, beta

    def plan(self, moment: Moment) -> TimedPlan:
        """The best plan. Raises InputError for too many targets."""
        began = time.perf_counter()
        count = int((~moment.solved).sum())
        if count > MAX_TARGETS:
            raise InputError("--planner exhaustive", f"{count} targets are open; the exhaustive "
                             f"search takes up to {MAX_TARGETS}")
        search = Search(moment, self.objective, self.alpha, self.beta)
        if int(moment.ends.max(initial=0)) <= moment.limit:
            search.extend(())
        best = search.best
        seconds = time.perf_counter() - began
        if not math.isfinite(best.cost):
            return TimedPlan(self.name, self.objective, "infeasible", (), None, None, None, seconds,
                             "no order and no teams lead to a plan")
        services = tuple(sorted(best.services, key=lambda one: one.start))
        return TimedPlan(self.name, self.objective, "optimal", services,
                         makespan(moment, services), effort(moment, services), best.cost, seconds)
