"""OR-Tools' routing library on the same problem by the clock: a peer of our search.

Every agent that a target needs is a visit, made by one that has the skill. The visits of a target
start at the same time, those for one skill by different agents. Insertion makes the first plan,
guided local search goes on from there. It proves nothing. The extra `ortools`.

Legend: N agents, M open targets, V visits.
"""

from __future__ import annotations

import functools
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from moonteam.planners.kind import ortools
from moonteam.planners.seconds import base
from moonteam.planners.seconds.base import Moment, TimedPlan, problems
from moonteam.planners.seconds.leaving import sharing
from moonteam.planners.seconds.search.goal import (
    Objective,
    answer,
    check,
    infeasible,
    schedule,
    weights,
)
from moonteam.planners.seconds.search.work import Open, Work, compact, horizon

TRIAL_S = 0.05
"""s of a first search that is for loading alone: the library goes on till its time is up."""
_MAKING = 0.5  # share of the time that making the model may take
_SCALE = 1000  # the library counts in integers: weights are rounded to thousandths
_WAY = 0.01  # what a ms of way weighs beside one of makespan, for insertion to go by
_LAST = 2e-4  # s a visit that it takes to read a plan


@dataclass(frozen=True)
class Visits:
    """[V] of whom everybody is one agent's."""

    target: list[int]
    able: list[list[int]]
    skill: list[int]  # -1: any of several

    @classmethod
    def of(cls, work: Work) -> Visits:
        """One for every agent that the open targets need."""
        found = cls([], [], [])
        for t in range(work.start.shape[1]):
            wanted = np.flatnonzero(work.need[t])
            if work.either[t]:
                found._add(t, np.flatnonzero(work.has[:, wanted].any(axis=1)), -1)
                continue
            for s in wanted.tolist():
                for _ in range(int(work.need[t, s])):
                    found._add(t, np.flatnonzero(work.has[:, s]), s)
        return found

    def _add(self, target: int, able: np.ndarray, skill: int) -> None:
        self.target.append(target)
        self.able.append(able.tolist())
        self.skill.append(skill)


class RoutingPlanner:
    """Plans by OR-Tools' routing library.

    Args:
      objective: makespan, effort or weighted.
      alpha: weight of the makespan, ms, rounded to thousandths.
      beta: weight of the effort, rounded to thousandths; so are the agents' own weights.
      time_limit: seconds.
    """

    name = "routing"

    def __init__(self, objective: Objective = "makespan", alpha: float = 1.0, beta: float = 0.05,
                 time_limit: float | None = 1.0):
        self.objective: Objective = check(objective, alpha, beta)
        self.alpha, self.beta = alpha, beta
        self.time_limit = 1.0 if time_limit is None else time_limit
        pywrapcp()

    def plan(self, moment: Moment) -> TimedPlan:
        """The best plan found within the limit."""
        loaded()
        return sharing(self, moment)

    def plan_all(self, moment: Moment) -> TimedPlan:
        """The best plan found that serves all that is open."""
        began = time.perf_counter()
        opened = compact(moment)
        if opened.reason:
            return infeasible(self.name, self.objective, opened.reason, began)
        found = routed(opened, *weights(self.objective, self.alpha, self.beta),
                       began + self.time_limit)
        services = () if found is None else schedule(opened, *found)
        if found is None or problems(moment, services):
            return infeasible(self.name, self.objective, "no plan was found in "
                              f"{self.time_limit:g} s; there may be one", began)
        return answer(self.name, self.objective, moment, services, None, False, began)


def pywrapcp() -> Any:
    """OR-Tools' routing library. Raises InputError without it."""
    return ortools("constraint_solver.pywrapcp", "routing")


def routed(opened: Open, alpha: float, beta: float, until: float
           ) -> tuple[list[int], list[list[int]]] | None:
    """Open targets in order of start and their teams, as `goal.schedule` takes them.

    None where none was found until `time.perf_counter()` says so.
    """
    visits = Visits.of(opened.work)
    if not visits.target:
        return [], []
    built = _Model(opened.work, visits, alpha, beta, until)
    return built.solved(until) if built.whole else None


class _Model:
    """Nodes are the visits, then every agent's start, then every agent's end."""

    def __init__(self, work: Work, visits: Visits, alpha: float, beta: float, until: float):
        self._lib = pywrapcp()
        self._visits = visits
        agents, count = len(work.free), len(visits.target)
        ends = [count + agents + a for a in range(agents)]
        self._manager = self._lib.RoutingIndexManager(
            count + 2 * agents, agents, [count + a for a in range(agents)], ends)
        self._model = self._lib.RoutingModel(self._manager)
        self._horizon = horizon(work)
        self.whole = self._ways(work, alpha, beta, until)
        if self.whole:
            self._rules(work)
            self._time.SetGlobalSpanCostCoefficient(max(0, round(alpha * _SCALE)))

    def _ways(self, work: Work, alpha: float, beta: float, until: float) -> bool:
        """Every agent's times and costs; False where it would take too long to hand them over."""
        agents, began = len(work.free), time.perf_counter()
        passes = []
        for a in range(agents):
            way, stay = _matrices(work, self._visits, a, self._horizon)
            passes.append(self._model.RegisterTransitMatrix((way + stay).tolist()))
            weight = _SCALE * (beta * float(work.effort[a]) + alpha * _WAY)
            cost = np.minimum(np.rint(weight * way), 2**50).astype(np.int64)
            self._model.SetArcCostEvaluatorOfVehicle(
                self._model.RegisterTransitMatrix(cost.tolist()), a)
            spent = time.perf_counter() - began
            if spent * agents > _MAKING * (a + 1) * (until - began):
                return False
        self._model.AddDimensionWithVehicleTransits(passes, self._horizon, self._horizon, False,
                                                    "time")
        self._time = self._model.GetDimensionOrDie("time")
        return True

    def _rules(self, work: Work) -> None:
        model, solver, cumul = self._model, self._model.solver(), self._time.CumulVar
        index = [self._manager.NodeToIndex(v) for v in range(len(self._visits.target))]
        first: dict[int, int] = {}
        by_skill: dict[tuple[int, int], list[int]] = {}
        for v, (t, able, skill) in enumerate(zip(
                self._visits.target, self._visits.able, self._visits.skill, strict=True)):
            model.VehicleVar(index[v]).SetValues(able)
            cumul(index[v]).SetRange(int(work.ready[t]), int(min(work.late[t], self._horizon)))
            model.AddVariableMinimizedByFinalizer(cumul(index[v]))
            if t in first:
                solver.Add(cumul(index[v]) == cumul(index[first[t]]))
            first.setdefault(t, v)
            same = by_skill.setdefault((t, skill), [])
            for u in same:
                solver.Add(model.VehicleVar(index[v]) != model.VehicleVar(index[u]))
            same.append(v)
        for t, v in first.items():
            for e in range(work.first_before[t], work.first_before[t + 1]):
                b = int(work.before[e])
                solver.Add(cumul(index[v]) >= cumul(index[first[b]]) + int(work.service[b]))
        for a, free in enumerate(work.free.tolist()):
            cumul(model.Start(a)).SetRange(free, free)
            model.AddVariableMinimizedByFinalizer(cumul(model.End(a)))
            cumul(model.End(a)).SetMax(int(min(work.limit, self._horizon)))

    def solved(self, until: float) -> tuple[list[int], list[list[int]]] | None:
        """See `routed`."""
        words = ortools("constraint_solver.routing_enums_pb2", "routing")
        asked = self._lib.DefaultRoutingSearchParameters()
        asked.first_solution_strategy = (
            words.FirstSolutionStrategy.PARALLEL_CHEAPEST_INSERTION)
        asked.local_search_metaheuristic = words.LocalSearchMetaheuristic.GUIDED_LOCAL_SEARCH
        left = until - time.perf_counter() - _LAST * len(self._visits.target)
        asked.time_limit.FromMilliseconds(max(1, round(1000 * left)))
        plan = self._model.SolveWithParameters(asked)
        if plan is None:
            return None
        model, moment = self._model, self._time.CumulVar
        began: dict[int, tuple[int, int]] = {}
        teams: dict[int, set[int]] = {}
        for a in range(model.vehicles()):
            at, place = model.Start(a), 0
            while not model.IsEnd(at := plan.Value(model.NextVar(at))):
                t, place = self._visits.target[self._manager.IndexToNode(at)], place + 1
                teams.setdefault(t, set()).add(a)
                began[t] = max(began.get(t, (0, 0)), (plan.Min(moment(at)), place))
        order = sorted(began, key=lambda t: began[t])
        return order, [sorted(teams[t]) for t in order]


def _matrices(work: Work, visits: Visits, agent: int, latest: int
              ) -> tuple[np.ndarray, np.ndarray]:
    """[., .] ms of way, and of service before setting out, between all nodes for one agent."""
    agents, count = len(work.free), len(visits.target)
    nodes = count + 2 * agents
    target = np.array(visits.target)
    way = np.zeros((nodes, nodes), np.int64)
    stay = np.zeros((nodes, nodes), np.int64)
    between = work.between[work.classes[agent]][np.ix_(target, target)]
    same = target[:, None] == target[None]
    way[:count, :count] = np.where(same, 0, between)
    stay[:count, :count] = np.where(same, 0, work.service[target][:, None])
    begin, end = count + agent, count + agents + agent
    way[begin, :count] = work.start[agent, target]
    way[:count, end] = work.home[agent, target]
    stay[:count, end] = work.service[target]
    way[begin, end] = work.idle_way[agent]
    return np.minimum(way, latest + 1), stay


@functools.cache
def loaded() -> None:
    """Loads the library: once a process, which counts for no time limit."""
    opened = compact(base.moment(base.TRIAL))
    routed(opened, 1.0, 0.0, time.perf_counter() + TRIAL_S)
