"""The exhaustive search that the source paper compares itself with, plain and slow.

ES1 tries everything for the least makespan, ES2 for the fewest moves: every order of the
targets, and for every target every coalition that can solve it. An agent goes from target to
target in that order and waits where it must. No bound, no table, nothing clever: this is the
reference that the exact planner is tested against, and the slow end of the timing figure.
It takes up to 6 open targets.
"""

from __future__ import annotations

import itertools
import math

import numpy as np

from moonteam.errors import InputError
from moonteam.planners.kind import PlannerKind
from moonteam.planners.plans.follow import Answer, RoutePlanner
from moonteam.planners.search.task import Task, weights
from moonteam.planners.search.travel import UNREACHABLE

MAX_TARGETS = 6


def coalitions(task: Task, target: int) -> list[tuple[int, ...]]:
    """Every set of agents that can solve the target with nobody to spare."""
    need = int(task.need[target])
    able = [a for a, skills in enumerate(task.skills.tolist())
            if skills & need and task.start[a, target] < UNREACHABLE]
    if not task.both[target]:
        return [(a,) for a in able]

    def enough(team: tuple[int, ...]) -> bool:
        return int(np.bitwise_or.reduce(task.skills[list(team)], initial=0)) & need == need

    teams = [team for size in range(1, len(able) + 1)
             for team in itertools.combinations(able, size) if enough(team)]
    return [team for team in teams
            if not any(enough(tuple(b for b in team if b != a)) for a in team)]


def follow_order(task: Task, order: tuple[int, ...],
                 teams: dict[int, tuple[int, ...]]) -> tuple[int, int]:
    """(makespan, moves) of solving the targets in this order by these coalitions."""
    agents = len(task.start)
    free = [0] * agents
    place: list[int | None] = [None] * agents
    moves = 0
    for target in order:
        meeting = 0
        for a in teams[target]:
            at = place[a]
            way = int(task.start[a, target] if at is None
                      else task.between[task.kinds[a], at, target])
            moves += way
            meeting = max(meeting, free[a] + way)
        for a in teams[target]:
            free[a], place[a] = meeting, target
    return max(free), moves


def enumerate_all(task: Task, alpha: float, beta: float) -> tuple[list[list[int]], float]:
    """Routes of least alpha * makespan + beta * moves within the horizon, and that value."""
    count = len(task.targets)
    choices = [coalitions(task, t) for t in range(count)]
    best, routes = math.inf, []
    for order in itertools.permutations(range(count)):
        for picked in itertools.product(*choices):
            teams = dict(enumerate(picked))
            makespan, moves = follow_order(task, order, teams)
            value = alpha * makespan + beta * moves
            if makespan <= task.horizon and value < best - 1e-9:
                best = value
                routes = [[t for t in order if a in teams[t]] for a in range(len(task.start))]
    return routes, best


class ExhaustivePlanner(RoutePlanner):
    """Optimal plans for up to 6 open targets, by trying everything.

    Args:
      objective: makespan (ES1), moves (ES2), or weighted.
      alpha: weight of the makespan in the weighted objective.
      beta: weight of the moves in the weighted objective.
    """

    name = "exhaustive"
    most_targets = MAX_TARGETS

    def _answer(self, task: Task, began: float) -> Answer:
        count = len(task.targets)
        if count > MAX_TARGETS:
            raise InputError("--planner exhaustive", f"{count} targets are open; the exhaustive "
                             f"search takes up to {MAX_TARGETS}; use exact or lns")
        alpha, beta = weights(self.objective, self.alpha, self.beta, len(task.start),
                              task.horizon)
        routes, value = enumerate_all(task, alpha, beta)
        if not math.isfinite(value):
            return Answer(None, value, True)
        padded = np.full(task.start.shape, -1, np.int32)
        for a, route in enumerate(routes):
            padded[a, :len(route)] = route
        bound = math.floor(value + 1e-9) if self.objective != "weighted" else value
        return Answer(padded, bound, True)


PLANNER = PlannerKind("exhaustive", lambda options: ExhaustivePlanner(*options.goal),
                      most_targets=MAX_TARGETS)
