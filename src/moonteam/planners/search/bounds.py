"""Lower bounds of makespan and moves for problems too large to solve exactly.

Legend: N agents, M open targets, K kinds.
"""

from __future__ import annotations

import math

import numpy as np

from moonteam.compilation import njit
from moonteam.planners.search import schedules
from moonteam.planners.search.task import Task
from moonteam.planners.search.teams import teams_of
from moonteam.planners.search.travel import UNREACHABLE

ROUNDS = 300  # subgradient steps; more add little
HASTY = 30  # the same for a plan that is due in milliseconds
PART = 9  # targets of the parts solved exactly


@njit(cache=True, nogil=True)
def forest_bound(start, between, kinds, skills, need, both, rounds):
    """A lower bound of the team's moves, by penalised spanning trees (Held and Karp, 1970).

    The ways of all agents, seen as edges, connect every target with some agent's start. A
    target that one agent alone can solve needs no more than one arrival and one departure,
    so its edges beyond two are charged; the charges are raised by subgradient steps.
    """
    n, m = start.shape
    first = np.full(m, UNREACHABLE, np.int64)
    edge = np.full((m, m), UNREACHABLE, np.int64)
    single = np.ones(m, np.bool_)
    for a in range(n):
        for t in range(m):
            if not skills[a] & need[t]:
                continue
            if both[t] and skills[a] & need[t] != need[t]:
                single[t] = False
            first[t] = min(first[t], start[a, t])
            for u in range(m):
                if skills[a] & need[u]:
                    way = min(between[kinds[a], t, u], between[kinds[a], u, t])
                    edge[t, u] = min(edge[t, u], way)
    charge = np.zeros(m)
    best = 0.0
    size = 2.0
    for _ in range(rounds):
        cost, parent, degree = np.empty(m), np.full(m, -1, np.int32), np.zeros(m, np.int32)
        joined = np.zeros(m, np.bool_)
        for t in range(m):
            cost[t] = first[t] + charge[t]
        total = 0.0
        for _ in range(m):
            pick = -1
            for t in range(m):
                if not joined[t] and (pick < 0 or cost[t] < cost[pick]):
                    pick = t
            joined[pick] = True
            total += cost[pick]
            degree[pick] += 1
            if parent[pick] >= 0:
                degree[parent[pick]] += 1
            for t in range(m):
                way = edge[pick, t] + charge[pick] + charge[t]
                if not joined[t] and way < cost[t]:
                    cost[t], parent[t] = way, pick
        norm = 0.0
        for t in range(m):
            total -= 2.0 * charge[t]
            if single[t] and (degree[t] > 2 or charge[t] > 0.0):
                norm += (degree[t] - 2) ** 2
        best = max(best, total)
        if norm == 0.0:
            break
        for t in range(m):
            if single[t]:
                charge[t] = max(0.0, charge[t] + size * (degree[t] - 2) / np.sqrt(norm))
        size *= 0.985
    return best


@njit(cache=True, nogil=True)
def earliest(start, first, members):
    """Steps until some coalition can be at the target that is last to be reached, each straight."""
    farthest = 0
    for t in range(start.shape[1]):
        soonest = UNREACHABLE
        for c in range(first[t], first[t + 1]):
            latest = 0
            for a in members[c]:
                if a >= 0:
                    latest = max(latest, start[a, t])
            soonest = min(soonest, latest)
        farthest = max(farthest, soonest)
    return farthest


def lower_bounds(task: Task, parts: int = 0, rounds: int = ROUNDS) -> tuple[int, int]:
    """(makespan, moves) that no plan can beat; ignores the horizon.

    The moves' bound shared evenly among the team also bounds the makespan.

    Args:
      task: what is to be done; must be feasible.
      parts: so many parts of 9 targets, drawn at random, are solved exactly as well: leaving
        targets out can only make a plan cheaper.
      rounds: of raising the bound of the moves.
    """
    if not len(task.targets):
        return 0, 0
    teams = teams_of(task.start, task.skills, task.need, task.both)
    makespan = int(earliest(task.start, teams.first, teams.members))
    moves = math.ceil(forest_bound(task.start, task.between, task.kinds, task.skills, task.need,
                                   task.both, rounds) - 1e-6)
    rng = np.random.default_rng(0)
    count = len(task.targets)
    for _ in range(parts):
        part = task.part(rng.permutation(count)[:PART].tolist())
        for alpha, beta in ((1.0, 0.0), (0.0, 1.0)):
            routes = np.empty(part.start.shape, np.int32)
            _, _, _, low = schedules.solve(
                part.start, part.between, part.kinds, part.skills, part.need, part.both,
                alpha, beta, UNREACHABLE - 1, 0.0, math.inf, 100_000, routes)
            if alpha and math.isfinite(low):
                makespan = max(makespan, math.ceil(low - 1e-6))
            elif math.isfinite(low):
                moves = max(moves, math.ceil(low - 1e-6))
    useful = int(np.count_nonzero(task.skills))
    return max(makespan, math.ceil(moves / useful)), moves
