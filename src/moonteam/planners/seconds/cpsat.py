"""OR-Tools CP-SAT on the same problem by the clock: bounds and cross-checks. The extra `ortools`.

For every agent a circuit through its start and the targets that it serves, for every target a time
of start. It begins with the plan that a short local search found, and returns at least that.

Legend: N agents, M open targets.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

from moonteam.planners.kind import ortools
from moonteam.planners.seconds.base import NEVER, Moment, TimedPlan, problems
from moonteam.planners.seconds.leaving import sharing
from moonteam.planners.seconds.local import Best, compiled, search
from moonteam.planners.seconds.search.goal import (
    Objective,
    answer,
    check,
    infeasible,
    schedule,
    weights,
)
from moonteam.planners.seconds.search.work import Work, compact, horizon

_SCALE = 1000  # CP-SAT counts in integers: weights are rounded to thousandths
_LOCAL = 0.25  # share of the time for the local search
_MAKING = 0.5  # share of what is left that making the model may take


@dataclass
class Model:
    """The model and its variables."""

    cp: Any
    model: Any
    begin: list[Any]  # [M]
    visit: list[list[Any]]  # [N][M]
    arcs: dict[tuple[int, int, int], Any]  # (agent, from, to); place M is the start and the end
    span: Any


class CpSatPlanner:
    """Plans and bounds by constraint programming.

    Args:
      objective: makespan, effort or weighted.
      alpha: weight of the makespan, ms, rounded to thousandths.
      beta: weight of the effort, rounded to thousandths; so are the agents' own weights.
      time_limit: seconds.
      workers: threads.
    """

    name = "cpsat"

    def __init__(self, objective: Objective = "makespan", alpha: float = 1.0, beta: float = 0.05,
                 time_limit: float | None = 10.0, workers: int = 1):
        self.objective: Objective = check(objective, alpha, beta)
        self.alpha, self.beta, self.workers = alpha, beta, workers
        self.time_limit = 10.0 if time_limit is None else time_limit
        self._cp = ortools("sat.python.cp_model", self.name)

    def plan(self, moment: Moment) -> TimedPlan:
        """The best plan found within the limit, with its bound."""
        compiled()
        return sharing(self, moment)

    def plan_all(self, moment: Moment) -> TimedPlan:
        """The best plan found that serves all that is open."""
        began = time.perf_counter()
        until = began + self.time_limit
        opened = compact(moment)
        if opened.reason:
            return infeasible(self.name, self.objective, opened.reason, began)
        alpha, beta = weights(self.objective, self.alpha, self.beta)
        hint = search(opened, alpha, beta, until=began + _LOCAL * self.time_limit)
        built = self._model(opened.work, alpha, beta, until) if len(opened.targets) else None
        if built is None and len(opened.targets):
            longer = search(opened, alpha, beta, until=until)
            hint = min(hint, longer, key=lambda best: (best.late, best.cost))
        services = schedule(opened, *hint.lists())
        known = not problems(moment, services)
        bound, done = 0.0, not len(opened.targets) and known
        if built is not None:
            if known:
                _hint(built, opened.work, hint)
            solver = self._cp.CpSolver()
            solver.parameters.max_time_in_seconds = max(0.01, until - time.perf_counter())
            solver.parameters.num_workers = self.workers
            status = solver.solve(built.model)
            if status == self._cp.INFEASIBLE:
                return infeasible(self.name, self.objective, "no plan keeps to the limit and the "
                                  "times at which targets lapse", began)
            bound = max(0.0, solver.best_objective_bound / _SCALE / _SCALE)
            done = status == self._cp.OPTIMAL
            if status in (self._cp.OPTIMAL, self._cp.FEASIBLE):
                found = schedule(opened, *_read(built, solver))
                if not known or done or self._cost(moment, found) < self._cost(moment, services):
                    services, known = found, True
        if not known:
            return infeasible(self.name, self.objective, "no plan was found in "
                              f"{self.time_limit:g} s; there may be one", began)
        if bound is not None and self.objective == "makespan":
            bound = math.ceil(bound - 1e-6)
        return answer(self.name, self.objective, moment, services, bound, done, began)

    def _cost(self, moment: Moment, services: tuple[Any, ...]) -> float:
        alpha, beta = weights(self.objective, self.alpha, self.beta)
        plan = answer(self.name, self.objective, moment, services, None, False, 0.0)
        return alpha * (plan.makespan or 0) + beta * (plan.effort or 0.0)

    def _model(self, work: Work, alpha: float, beta: float, until: float) -> Model | None:
        """The model; None where the first circuit shows that there is no time to make it."""
        cp, model = self._cp, self._cp.CpModel()
        agents, count = work.start.shape
        latest = horizon(work)
        begin = [model.new_int_var(int(work.ready[t]), int(min(work.late[t], latest)), "")
                 if work.ready[t] <= work.late[t] else model.new_int_var(1, 0, "")
                 for t in range(count)]
        span = model.new_int_var(int(work.floor), latest, "")
        visit = [[model.new_bool_var("") for _ in range(count)] for _ in range(agents)]
        built = Model(cp, model, begin, visit, {}, span)
        for t in range(count):
            wanted = [s for s in range(work.has.shape[1]) if work.need[t, s] > 0]
            able = [[visit[a][t] for a in range(agents) if work.has[a, s]] for s in wanted]
            if work.either[t]:
                model.add_bool_or([v for some in able for v in some])
            else:
                for s, some in zip(wanted, able, strict=True):
                    model.add(cp.LinearExpr.sum(some) >= int(work.need[t, s]))
            model.add(span >= begin[t] + int(work.service[t]))
            for e in range(work.first_before[t], work.first_before[t + 1]):
                b = int(work.before[e])
                model.add(begin[t] >= begin[b] + int(work.service[b]))
        terms: list[Any] = []
        costs: list[int] = []
        for a in range(agents):
            clock = time.perf_counter()
            for leg, literal in _circuit(built, work, a, until):
                terms.append(literal)
                costs.append(round(beta * float(work.effort[a]) * _SCALE * _SCALE) * leg)
            if (agents - a) * (time.perf_counter() - clock) > _MAKING * (until - clock):
                return None
        goal = round(alpha * _SCALE) * _SCALE * span
        if beta > 0:
            goal = goal + cp.LinearExpr.weighted_sum(terms, costs)
        model.minimize(goal)
        return built


def _circuit(built: Model, work: Work, a: int, until: float) -> list[tuple[int, Any]]:
    """One agent's circuit; its ways (ms) with their literals. Left off where time is up."""
    model, begin, count = built.model, built.begin, work.start.shape[1]
    between = work.between[work.classes[a]]
    arcs, ways = [], []
    for i in range(count + 1):
        for j in range(count + 1):
            if i == j:
                if i < count:
                    arcs.append((i, i, built.visit[a][i].negated()))
                    continue
                leg, here = int(work.idle_way[a]), int(work.free[a])
            elif i == count:
                leg, here = int(work.start[a, j]), int(work.free[a])
            else:
                leg = int(work.home[a, i] if j == count else between[i, j])
                here = begin[i] + int(work.service[i])
            if leg >= NEVER:
                continue
            literal = model.new_bool_var("")
            arcs.append((i, j, literal))
            built.arcs[a, i, j] = literal
            there = built.span if j == count else begin[j]
            model.add(there >= here + leg).only_enforce_if(literal)
            ways.append((leg, literal))
        if time.perf_counter() > until:
            break
    model.add_circuit(arcs)
    return ways


def _hint(built: Model, work: Work, best: Best) -> None:
    """The local search's plan, whole."""
    agents, count = work.start.shape
    last, used = [count] * agents, set()
    begin = [0] * count
    clock = work.free.tolist()
    for t, team in zip(*best.lists(), strict=True):
        first, stop = work.first_before[t], work.first_before[t + 1]
        when = max([int(work.ready[t]), *(begin[int(b)] + int(work.service[int(b)])
                                          for b in work.before[first:stop])])
        for a in team:
            when = max(when, clock[a] + int(work.start[a, t] if last[a] == count else
                                            work.between[work.classes[a], last[a], t]))
        begin[t] = when
        for a in team:
            used.add((a, last[a], t))
            clock[a], last[a] = when + int(work.service[t]), t
        built.model.add_hint(built.begin[t], when)
        for a in range(agents):
            built.model.add_hint(built.visit[a][t], a in team)
    used |= {(a, last[a], count) for a in range(agents)}
    for key, literal in built.arcs.items():
        built.model.add_hint(literal, key in used)


def _read(built: Model, solver: Any) -> tuple[list[int], list[list[int]]]:
    """Targets in order of start, and their teams."""
    count = len(built.begin)
    after = {}
    for (_, i, j), literal in built.arcs.items():
        if i < count and j < count and solver.value(literal):
            after.setdefault(j, set()).add(i)
    order: list[int] = []
    left = sorted(range(count), key=lambda t: solver.value(built.begin[t]))
    while left:  # of those that start at one time, first what somebody comes from
        t = next(t for t in left if not after.get(t, set()) & set(left))
        order.append(t)
        left.remove(t)
    return order, [[a for a, row in enumerate(built.visit) if solver.value(row[t])] for t in order]
