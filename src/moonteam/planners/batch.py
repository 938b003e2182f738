"""Exact plans for many states at once, on all cores: the teacher of imitation learning.

Legend: B states, N agents, M targets, K kinds, H rows, W columns. Arrays are padded as in
`moonteam.grid.types`: agents with `agent_mask` False and targets that are `solved` are left
out, so padding costs nothing.

Numba's cache of this file looks at this file's own date alone, and holds what it inlined from
`search` and `travel`: after a change in those, save this file again or empty `__pycache__`.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from moonteam.compilation import cores, njit
from moonteam.errors import InputError
from moonteam.planners.base import IntArray, Objective
from moonteam.planners.exact import MAX_TARGETS
from moonteam.planners.search import insertion, schedules
from moonteam.planners.search.guides import PLAIN
from moonteam.planners.search.neighbourhoods import guide_of, improve
from moonteam.planners.search.task import weights
from moonteam.planners.search.teams import coalitions
from moonteam.planners.search.travel import UNREACHABLE, distance_field

OPTIMAL, FEASIBLE, INFEASIBLE, UNFINISHED = 0, 1, 2, 3
"""Status of one state: proved; best found; not solvable as a whole (in time), the labels then
serve what can be solved; stopped before any plan was found, no labels."""


@dataclass(frozen=True)
class BatchPlans:
    """What `solve_batch` returns; -1 where there is nothing."""

    status: IntArray  # [B] OPTIMAL, FEASIBLE, INFEASIBLE or UNFINISHED
    makespan: IntArray  # [B] steps until the last target is solved
    moves: IntArray  # [B] moves of the whole team
    routes: IntArray  # [B, N, M] each agent's targets in order, then -1
    next_target: IntArray  # [B, N] where each agent goes next; -1: it stays for good
    arrival: IntArray  # [B, N] steps until it is there
    meeting: IntArray  # [B, N] steps until that target is solved, its waiting included


@njit(cache=True, nogil=True)
def timetable(start, between, kinds, routes, solved_at):
    """Fills `solved_at` [M] with the step at which each visited target's team is complete.

    Targets nobody visits get -1. Routes must not wait for each other.
    """
    n, m = start.shape
    width = routes.shape[1]
    at = np.zeros(n, np.int32)
    free = np.zeros(n, np.int32)
    solved_at[:] = -1
    progress = True
    while progress:
        progress = False
        for t in range(m):
            if solved_at[t] >= 0:
                continue
            size, ready, latest = 0, 0, 0
            for a in range(n):
                for i in range(width):
                    if routes[a, i] == t:
                        size += 1
                        if i == at[a]:
                            ready += 1
                            before = routes[a, i - 1]
                            way = start[a, t] if i == 0 else between[kinds[a], before, t]
                            latest = max(latest, free[a] + way)
            if size > 0 and size == ready:
                solved_at[t] = latest
                progress = True
                for a in range(n):
                    if at[a] < width and routes[a, at[a]] == t:
                        at[a] += 1
                        free[a] = latest


@njit(cache=True, nogil=True)
def _open_targets(cells, skills, target_cells, target_skills, target_and, solved, index):
    """Indices of targets neither solved nor holding now; returns their number."""
    count = 0
    for t in range(target_cells.shape[0]):
        here = 0
        for a in range(cells.shape[0]):
            if cells[a, 0] == target_cells[t, 0] and cells[a, 1] == target_cells[t, 1]:
                here |= skills[a]
        here &= target_skills[t]
        holds = here == target_skills[t] if target_and[t] else here != 0
        if not solved[t] and not holds:
            index[count] = t
            count += 1
    return count


@njit(cache=True, nogil=True)
def _travel(cells, kinds, target_cells, index, count, passable, start, between):
    """Fills start [N, count] and between [K, count, count]; an open map has no `passable`."""
    n = cells.shape[0]
    open_map = passable.shape[0] == 0
    for j in range(count):
        x, y = target_cells[index[j], 0], target_cells[index[j], 1]
        if open_map:
            for a in range(n):
                start[a, j] = abs(cells[a, 0] - x) + abs(cells[a, 1] - y)
            for i in range(count):
                other = target_cells[index[i]]
                between[0, i, j] = abs(other[0] - x) + abs(other[1] - y)
            continue
        field = np.empty(passable.shape[1:], np.int32)
        for k in range(passable.shape[0]):
            distance_field(passable[k], x, y, field)
            for a in range(n):
                if kinds[a] == k:
                    start[a, j] = field[cells[a, 1], cells[a, 0]]
            for i in range(count):
                other = target_cells[index[i]]
                between[k, i, j] = field[other[1], other[0]]


@njit(cache=True, nogil=True)
def _drop_hopeless(start, skills, target_skills, target_and, index, count):
    """Keeps the targets that somebody can solve; returns how many of `index` are left."""
    kept = 0
    for j in range(count):
        able = 0
        for a in range(start.shape[0]):
            if start[a, j] < UNREACHABLE:
                able |= skills[a]
        able &= target_skills[index[j]]
        enough = able == target_skills[index[j]] if target_and[index[j]] else able != 0
        if enough:
            index[kept] = index[j]
            kept += 1
    return kept


@njit(cache=True, nogil=True)
def _search_near(start, between, kinds, skills, need, both, alpha, beta, horizon, iterations, seed,
                 found):
    """Insertion, then a large-neighbourhood search; fills routes `found` [N, M] and returns
    (makespan, moves).
    """
    n, m = start.shape
    ways = insertion.Ways(start, between, kinds)
    teams = coalitions(start, skills, need, both)
    line, other = insertion.empty(ways, teams), insertion.empty(ways, teams)
    every = np.arange(m).astype(np.int32)
    _, makespan, moves, _ = insertion.insert_all(
        every.copy(), True, ways, teams, line, 0, alpha, beta, horizon, 0.0, 0.0, m)
    cost = insertion.price(makespan, moves, alpha, beta, horizon)
    _, makespan, moves, _ = insertion.insert_all(
        every, False, ways, teams, other, 0, alpha, beta, horizon, 0.0, 0.0, m)
    if insertion.price(makespan, moves, alpha, beta, horizon) < cost:
        line = other
    best_order, best_crew = line.order.copy(), line.crew.copy()
    order, crew = line.order.copy(), line.crew.copy()
    improve(guide_of(PLAIN), ways, teams, order, crew, alpha, beta, alpha, beta, horizon,
            max(alpha, beta), iterations, np.inf, 0.0, 1.0, seed, best_order, best_crew)
    for a in range(n):
        count = 0
        for i in range(m):
            if teams.masks[best_crew[i]] >> a & 1:
                found[a, count] = best_order[i]
                count += 1
    line.order[:], line.crew[:] = best_order, best_crew
    return insertion.measure(ways, teams, line, m)


@njit(cache=True, nogil=True)
def _solve_one(cells, kinds, skills, target_cells, target_skills, target_and, solved, horizon,
               passable, alpha, beta, limit, exact_to, iterations, seed, routes, next_target,
               arrival, meeting):
    """One state; returns (status, makespan, moves) and fills the four last arguments."""
    n, m = cells.shape[0], target_cells.shape[0]
    index = np.empty(m, np.int32)
    count = _open_targets(cells, skills, target_cells, target_skills, target_and, solved, index)
    if count == 0:
        return OPTIMAL, 0, 0
    num_kinds = max(1, passable.shape[0])
    start = np.empty((n, count), np.int32)
    between = np.empty((num_kinds, count, count), np.int32)
    _travel(cells, kinds, target_cells, index, count, passable, start, between)
    kept = _drop_hopeless(start, skills, target_skills, target_and, index, count)
    if kept == 0:
        return INFEASIBLE, -1, -1
    if kept < count:
        start = np.empty((n, kept), np.int32)
        between = np.empty((num_kinds, kept, kept), np.int32)
        _travel(cells, kinds, target_cells, index, kept, passable, start, between)
    need = target_skills[index[:kept]]
    both = target_and[index[:kept]]
    which = kinds if passable.shape[0] else np.zeros(n, np.int32)
    found = np.full((n, kept), -1, np.int32)
    if kept > exact_to:
        makespan, moves = _search_near(start, between, which, skills, need, both, alpha, beta,
                                       horizon, iterations, seed, found)
        outcome, status, bound = schedules.FEASIBLE, FEASIBLE, 0.0
    else:
        outcome, makespan, moves, bound = schedules.solve(
            start, between, which, skills, need, both, alpha, beta, horizon, 0.0, np.inf, limit,
            found)
        status = OPTIMAL if outcome == schedules.OPTIMAL else FEASIBLE
    if outcome == schedules.NONE:
        status = UNFINISHED
        if np.isinf(bound):
            status = INFEASIBLE
            outcome, makespan, moves, bound = schedules.solve(
                start, between, which, skills, need, both, alpha, beta, 64 * (horizon + 64),
                0.0, np.inf, limit, found)
    if kept < count:
        status = max(status, INFEASIBLE)
    if outcome == schedules.NONE:
        return status, -1, -1
    solved_at = np.empty(kept, np.int32)
    timetable(start, between, which, found, solved_at)
    for a in range(n):
        for i in range(kept):
            routes[a, i] = index[found[a, i]] if found[a, i] >= 0 else -1
        if found[a, 0] >= 0:
            next_target[a] = routes[a, 0]
            arrival[a] = start[a, found[a, 0]]
            meeting[a] = solved_at[found[a, 0]]
    return status, makespan, moves


@njit(cache=True, nogil=True)
def _solve_range(first, last, cells, kinds, skills, target_cells, target_skills, target_and,
                 solved, horizon, passable, alpha, beta, limit, exact_to, iterations, status,
                 makespan, moves, routes, next_target, arrival, meeting):
    """States first..last-1 of a batch; `passable` is [1 or B, K, H, W], K = 0 if open."""
    for b in range(first, last):
        ground = passable[b] if passable.shape[0] > 1 else passable[0]
        status[b], makespan[b], moves[b] = _solve_one(
            cells[b], kinds[b], skills[b], target_cells[b], target_skills[b], target_and[b],
            solved[b], horizon[b], ground, alpha[b], beta[b], limit, exact_to, iterations, b,
            routes[b], next_target[b], arrival[b], meeting[b])


def solve_batch(
    cells: npt.ArrayLike,
    agent_skills: npt.ArrayLike,
    target_cells: npt.ArrayLike,
    target_skills: npt.ArrayLike,
    target_and: npt.ArrayLike,
    solved: npt.ArrayLike | None = None,
    agent_mask: npt.ArrayLike | None = None,
    steps_left: npt.ArrayLike = 128,
    agent_kinds: npt.ArrayLike | None = None,
    passable: npt.ArrayLike | None = None,
    objective: Objective = "weighted",
    alpha: npt.ArrayLike = 1.0,
    beta: npt.ArrayLike = 0.05,
    node_limit: int = 20_000_000,
    threads: int | None = None,
    exact_to: int = MAX_TARGETS,
    iterations: int = 0,
) -> BatchPlans:
    """Optimal plans of B states, each with at most 12 targets still open; good plans of larger.

    Args:
      cells: [B, N, 2] cells (x, y).
      agent_skills: [B, N] bit masks.
      target_cells: [B, M, 2] cells.
      target_skills: [B, M] bit masks.
      target_and: [B, M] bool.
      solved: [B, M] bool, True for padded targets too; None: none is solved.
      agent_mask: [B, N] bool; None: all are in the team.
      steps_left: [B] or one number, longest makespan allowed.
      agent_kinds: [B, N] index into `passable`; needed with it.
      passable: [K, H, W] or [B, K, H, W] bool, indexed [kind, y, x]; None: open map.
      objective: makespan, moves or weighted (see `ExactPlanner`).
      alpha: weight of the makespan if weighted, one or [B].
      beta: weight of the moves if weighted, one or [B].
      node_limit: search nodes a state may take; far above what is usual.
      threads: cores to use; None: all.
      exact_to: open targets up to which plans are optimal, at most 12.
      iterations: of large-neighbourhood search where more targets are open (FEASIBLE); 0:
        no such state is allowed.

    Raises:
      InputError: more than 12 open targets and no iterations.
    """
    places = np.ascontiguousarray(cells, np.int32)
    size, n = places.shape[:2]
    goals = np.ascontiguousarray(target_cells, np.int32)
    m = goals.shape[1]
    mask = np.ones((size, n), bool) if agent_mask is None else np.asarray(agent_mask, bool)
    skills = np.where(mask, np.asarray(agent_skills, np.int32), 0).astype(np.int32)
    done = np.zeros((size, m), bool) if solved is None else np.ascontiguousarray(solved, bool)
    most = int((~done).sum(1).max(initial=0))
    if most > min(exact_to, MAX_TARGETS) and not iterations:
        raise InputError("solve_batch", f"{most} targets are open; at most {MAX_TARGETS}")
    horizon = np.ascontiguousarray(np.broadcast_to(np.asarray(steps_left, np.int64), (size,)))
    kinds = np.zeros((size, n), np.int32) if agent_kinds is None else agent_kinds
    ground = np.zeros((1, 0, 0, 0), bool) if passable is None else np.asarray(passable, bool)
    ground = np.ascontiguousarray(ground if ground.ndim == 4 else ground[None])
    both = [weights(objective, a, b, n, max(int(h), 1)) for a, b, h in zip(
        np.broadcast_to(np.asarray(alpha, float), (size,)).tolist(),
        np.broadcast_to(np.asarray(beta, float), (size,)).tolist(), horizon, strict=True)]
    pairs = np.array(both, np.float64).reshape(size, 2)
    out = BatchPlans(*(np.full(shape, -1, np.int32) for shape in (
        (size,), (size,), (size,), (size, n, m), (size, n), (size, n), (size, n))))
    arguments = (
        places, np.ascontiguousarray(kinds, np.int32), skills, goals,
        np.ascontiguousarray(target_skills, np.int32), np.ascontiguousarray(target_and, bool),
        done, horizon, ground, pairs[:, 0].copy(), pairs[:, 1].copy(), node_limit,
        min(exact_to, MAX_TARGETS), iterations,
        out.status, out.makespan, out.moves, out.routes, out.next_target, out.arrival,
        out.meeting)
    workers = threads or cores()
    chunk = max(1, -(-size // (workers * 8)))
    ranges = [(i, min(i + chunk, size)) for i in range(0, size, chunk)]
    if workers == 1 or len(ranges) <= 1:
        _solve_range(0, size, *arguments)
        return out
    with ThreadPoolExecutor(workers) as pool:
        for task in [pool.submit(_solve_range, i, j, *arguments) for i, j in ranges]:
            task.result()
    return out
