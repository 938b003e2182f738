"""OR-Tools CP-SAT on the same problem: bounds and cross-checks. The extra `ortools`.

The model: for every target a coalition; for every agent a circuit through its start and the
targets it visits (the way back costs nothing); a target's time is at least each visitor's
previous time plus the walk. Makespan is the latest time, moves the sum of the walks.

Legend: N agents, M open targets.
"""

from __future__ import annotations

import itertools
import math
import time
from typing import Any

import numpy as np

from moonteam.errors import InputError
from moonteam.planners.base import IntArray, Objective
from moonteam.planners.kind import PlannerKind, PlannerOptions, ortools
from moonteam.planners.lns import Events, Weights, best_insertion, improve, measure
from moonteam.planners.plans.follow import Answer, RoutePlanner
from moonteam.planners.search.task import Task, weights
from moonteam.planners.search.teams import teams_of
from moonteam.planners.search.travel import UNREACHABLE

Arc = tuple[int, int, int]
"""(agent, from, to); place -1 is the agent's start."""

_SCALE = 1000  # CP-SAT counts in integers: weights are rounded to thousandths
_LOCAL = 0.3  # share of the time for the plan that it starts from
_MAKING = 0.5  # share of what is left that making the model may take


class CpSatPlanner(RoutePlanner):
    """Plans and bounds by constraint programming.

    Args:
      objective: makespan, moves or weighted.
      alpha: weight of the makespan in the weighted objective, rounded to thousandths.
      beta: weight of the moves in the weighted objective, rounded to thousandths.
      time_limit: seconds.
      workers: threads; one makes the search repeatable while the time suffices.
    """

    name = "cpsat"

    def __init__(self, objective: Objective = "makespan", alpha: float = 1.0, beta: float = 0.05,
                 time_limit: float | None = 10.0, workers: int = 1):
        super().__init__(objective, alpha, beta)
        self.time_limit = self.limit = 10.0 if time_limit is None else time_limit
        self.workers = workers
        self._cp = ortools("sat.python.cp_model", self.name)

    @classmethod
    def _trial(cls) -> CpSatPlanner:
        return cls()

    def _answer(self, task: Task, began: float) -> Answer:
        until = began + self.limit
        goal = Weights.of(self.objective, self.alpha, self.beta, task)
        known = improve(task, goal, best_insertion(task, goal), 0, 500,
                        began + _LOCAL * self.limit)
        built = self._model(task, until)
        if built is None:
            known = improve(task, goal, known, 0, None, until)
            return Answer(_within(task, known), 0.0, False)
        model, arcs, span = built
        moves = sum(way * arc for way, arc in arcs.values())
        alpha, beta = weights(self.objective, self.alpha, self.beta, len(task.start),
                              task.horizon)
        whole = (1, 0) if self.objective == "makespan" else (
            (0, 1) if self.objective == "moves" else (round(alpha * _SCALE), round(beta * _SCALE)))
        if max(whole) == 0:
            raise InputError("--planner cpsat", f"alpha {alpha} and beta {beta} are too small; "
                             f"they are rounded to {1 / _SCALE}")
        model.minimize(whole[0] * span + whole[1] * moves)
        _hint(model, task, arcs, known)
        solver = self._cp.CpSolver()
        solver.parameters.max_time_in_seconds = max(0.01, until - time.perf_counter())
        solver.parameters.num_workers = self.workers
        status = solver.solve(model)
        scale = _SCALE if self.objective == "weighted" else 1
        bound = solver.best_objective_bound / scale
        if self.objective != "weighted":
            bound = math.ceil(bound - 1e-6)
        if status == self._cp.INFEASIBLE:
            return Answer(None, math.inf, True)
        if status not in (self._cp.OPTIMAL, self._cp.FEASIBLE):
            return Answer(_within(task, known), bound, False)
        routes = np.full(task.start.shape, -1, np.int32)
        for a in range(len(task.start)):
            onward = {i: j for (b, i, j), (_, arc) in arcs.items()
                      if b == a and i != j and solver.value(arc)}
            at, place = onward.get(-1, -1), 0
            while at >= 0:
                routes[a, place] = at
                at, place = onward[at], place + 1
        return Answer(routes, bound, status == self._cp.OPTIMAL)

    def _model(self, task: Task, until: float
               ) -> tuple[Any, dict[Arc, tuple[int, Any]], Any] | None:
        """The model, its arcs with their steps and literals, and the makespan.

        The arc from a place to itself means "not visited". None where the first agent's part shows
        that there is no time to make it and to search.
        """
        model = self._cp.CpModel()
        agents, count = task.start.shape
        times = [model.new_int_var(0, task.horizon, f"time{t}") for t in range(count)]
        span = model.new_int_var(0, task.horizon, "makespan")
        for moment in times:
            model.add(span >= moment)
        arcs: dict[Arc, tuple[int, Any]] = {}
        visits = [[model.new_bool_var(f"visit{a}_{t}") for t in range(count)]
                  for a in range(agents)]
        every = teams_of(task.start, task.skills, task.need, task.both)
        for t in range(count):
            teams = every.masks[every.first[t]:every.first[t + 1]].tolist()
            picked = [model.new_bool_var(f"team{t}_{c}") for c in range(len(teams))]
            model.add_exactly_one(picked)
            for a in range(agents):
                model.add(sum(p for p, team in zip(picked, teams, strict=True) if team >> a & 1)
                          == visits[a][t])
        for a in range(agents):
            clock = time.perf_counter()
            self._circuit(model, task, a, visits[a], times, arcs, until)
            if (agents - a) * (time.perf_counter() - clock) > _MAKING * (until - clock):
                return None
        return model, arcs, span

    def _circuit(self, model: Any, task: Task, agent: int, visits: list, times: list,
                 arcs: dict[Arc, tuple[int, Any]], until: float) -> None:
        """One agent's circuit: start, its targets, back at no cost. Left off where time is up."""
        count = len(times)
        between = task.between[task.kinds[agent]]
        mine = {}
        for i in range(-1, count):
            for j in range(-1, count):
                literal = model.new_bool_var(f"arc{agent}_{i}_{j}")
                way = 0
                if j >= 0 and i != j:
                    way = int(task.start[agent, j] if i < 0 else between[i, j])
                if way >= UNREACHABLE:
                    model.add(literal == 0)
                    way = 0
                elif j >= 0 and i != j:
                    before = 0 if i < 0 else times[i]
                    model.add(times[j] >= before + way).only_enforce_if(literal)
                if i == j and i >= 0:
                    model.add(literal == 1 - visits[i])
                mine[agent, i, j] = (way, literal)
            if time.perf_counter() > until:
                break
        model.add_circuit([(i + 1, j + 1, lit) for (_, i, j), (_, lit) in mine.items()])
        arcs.update(mine)


def _within(task: Task, events: Events) -> IntArray | None:
    """A list's routes; None where it takes longer than the steps left."""
    late = measure(task, events)[0] > task.horizon
    return None if late else events.routes(len(task.start))


def _hint(model: Any, task: Task, arcs: dict[Arc, tuple[int, Any]], events: Events) -> None:
    """Starts the solver from a plan of the large-neighbourhood search."""
    used = set()
    for a, route in enumerate(events.routes(len(task.start)).tolist()):
        places = [-1, *[t for t in route if t >= 0], -1]
        used |= {(a, i, j) for i, j in itertools.pairwise(places)}
        used |= {(a, t, t) for t in range(len(task.targets)) if t not in places}
    for key, (_, literal) in arcs.items():
        model.add_hint(literal, key in used)


def _planner(options: PlannerOptions) -> CpSatPlanner:
    return CpSatPlanner(*options.goal, time_limit=options.time_limit)


PLANNER = PlannerKind("cpsat", _planner, anytime=True)
