"""The paper's case by the clock, handed to the exact search in steps: its tables know all of it.

Travel and minimal coalitions alone. A service folds into the last leg to its target where only the
makespan counts: a team that meets at s and stays d leaves at the time at which it would have met
had everybody's way there been d longer.

Legend: N agents, M open targets.
"""

from __future__ import annotations

import numpy as np

from moonteam.compilation import njit
from moonteam.planners.search import schedules
from moonteam.planners.search.travel import UNREACHABLE
from moonteam.planners.seconds.search.labels import shortcut
from moonteam.planners.seconds.search.work import Work

MOST_SKILLS = 8
"""That the search in steps tells apart."""
NO_LIMIT = 1 << 62
"""Nodes of the search that it never comes to."""


@njit(cache=True, nogil=True)
def _roundabout(work, pay):
    """Whether some agent may gain by going by way of a target."""
    n, m = work.start.shape
    for a in range(n):
        for k in range(m):
            if shortcut(work, a, k, pay):
                return True
    return False


def fits(work: Work, alpha: float, beta: float) -> bool:
    """Whether the search in steps solves this problem."""
    asks = (len(work.before) or work.ready.any() or work.free.any() or work.home.any()
            or work.idle_way.any() or (work.need > 1).any() or work.floor
            or (work.late < work.limit - work.service).any()
            or work.has.shape[1] > MOST_SKILLS)
    if asks or (beta > 0.0 and (work.service.any() or (work.effort != work.effort[0]).any())):
        return False
    return not _roundabout(work, beta == 0.0)


def solve(work: Work, alpha: float,
          beta: float) -> tuple[float, list[int], list[list[int]]] | None:
    """(cost, targets in order, their teams) of the best plan; None: to be searched by other means.

    The search in steps counts no way longer than 2^20 ms; a better plan that it may have missed
    would have had one that alone costs more.
    """
    bits = 1 << np.arange(work.has.shape[1])
    stay = work.service if beta == 0.0 else 0
    weight = beta * float(work.effort[0])
    horizon = min(work.limit, UNREACHABLE - 1)
    fine = weight if beta > 0.0 else 1.0 / (len(work.free) * horizon + 1)
    routes = np.empty(work.start.shape, np.int32)
    outcome, span, moves, _ = schedules.solve(
        _whole(work.start + stay), _whole(work.between + stay), work.classes.astype(np.int32),
        (work.has @ bits).astype(np.int32), ((work.need > 0) @ bits).astype(np.int32),
        ~work.either, alpha, fine, horizon, 0.0, np.inf, NO_LIMIT, routes)
    cost = alpha * span + weight * moves
    if outcome != schedules.OPTIMAL or cost >= (alpha + weight) * UNREACHABLE:
        return None
    return cost, *in_order(routes)


def _whole(ways: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.minimum(ways, UNREACHABLE), np.int32)


def in_order(routes: np.ndarray) -> tuple[list[int], list[list[int]]]:
    """Routes [N, M], padded by -1, as targets in an order that all agents keep, and their teams."""
    rows = [[t for t in row if t >= 0] for row in routes.tolist()]
    teams: dict[int, list[int]] = {}
    for a, row in enumerate(rows):
        for t in row:
            teams.setdefault(t, []).append(a)
    order: list[int] = []
    at = [0] * len(rows)
    while len(order) < len(teams):
        for a, row in enumerate(rows):
            if at[a] < len(row):
                t = row[at[a]]
                if all(rows[b][at[b]] == t for b in teams[t] if at[b] < len(rows[b])):
                    order.append(t)
                    for b in teams[t]:
                        at[b] += 1
                    break
        else:
            raise ValueError("agents wait for each other")
    return order, [teams[t] for t in order]
