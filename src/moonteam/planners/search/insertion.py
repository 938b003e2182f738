"""Insertion of targets into a plan, with regret or not, compiled with Numba.

Legend: N agents, M targets, K kinds, C coalitions of all targets, S most members of one, L events.

A plan is a list of events, each a target with the coalition that solves it; every agent does
its events in the order of the list, so no two agents can wait for each other for ever. With
`head` the step at which an event happens and `tail` the longest chain of walks and waits from
it to the end, the makespan after putting a new event into the list is
max(makespan before, head + tail of the new event): travel times obey the triangle inequality,
so no chain that avoids the new event gets longer or shorter. That makes trying one place a
matter of a few additions; and along the list only what the agents of the last event could do
changes from one place to the next.

What Python calls (`inserted`, `measured`, `neighbourhoods.improved` and `teams.teams_of`) hands
Numba plain arrays, and returns none: to pass a named tuple, or to return an array, Numba runs
Python, where a signal may come, and then the process crashes or ends in a SystemError.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from moonteam.compilation import LOOP, njit
from moonteam.planners.base import IntArray
from moonteam.planners.search.teams import Teams

SOME = 2
"""Targets looked at anew for each that is put back."""


class Ways(NamedTuple):
    """Travel times in steps."""

    start: IntArray  # [N, M] from each agent
    between: IntArray  # [K, M, M] between targets
    kinds: IntArray  # [N] index into `between`


class Timeline(NamedTuple):
    """A list of events with what follows from it; only the first L of each count."""

    order: IntArray  # [M] targets
    crew: IntArray  # [M] coalitions
    head: IntArray  # [M] step at which it happens
    tail: IntArray  # [M] steps from it to the end
    onward: IntArray  # [M, S] the member's next event, or -1
    opening: IntArray  # [N] the agent's first event, or -1
    space: IntArray  # [3, N] to work in


@njit(cache=True, nogil=True)
def empty(ways, teams):
    """A list that is empty."""
    n, m = ways.start.shape
    size = teams.members.shape[1]
    return Timeline(np.zeros(m, np.int32), np.zeros(m, np.int32), np.zeros(m, np.int32),
                  np.zeros(m, np.int32), np.full((m, size), -1, np.int32),
                  np.full(n, -1, np.int32), np.zeros((3, n), np.int32))


@njit(**LOOP)
def measure(ways, teams, line, length):
    """Fills what follows from the first `length` events; returns (makespan, moves)."""
    size = teams.members.shape[1]
    order, crew, head, tail, onward, opening, space = line
    last, slot = space[0], space[1]
    last[:] = -1
    opening[:] = -1
    makespan, moves = 0, 0
    for i in range(length):
        t, when = order[i], 0
        for s in range(size):
            a = teams.members[crew[i], s]
            if a < 0:
                break
            before = last[a]
            if before < 0:
                way, free = ways.start[a, t], 0
                opening[a] = i
            else:
                way, free = ways.between[ways.kinds[a], order[before], t], head[before]
                onward[before, slot[a]] = i
            when = max(when, free + way)
            moves += way
            last[a], slot[a] = i, s
            onward[i, s] = -1
        head[i] = when
        makespan = max(makespan, when)
    for i in range(length - 1, -1, -1):
        t, longest = order[i], 0
        for s in range(size):
            a = teams.members[crew[i], s]
            if a < 0:
                break
            after = onward[i, s]
            if after >= 0:
                longest = max(longest, ways.between[ways.kinds[a], t, order[after]] + tail[after])
        tail[i] = longest
    return makespan, moves


@njit(**LOOP)
def price(makespan, moves, alpha, beta, horizon):
    """Cost of a plan; steps past the horizon weigh as much as anything else can."""
    over = max(0, makespan - horizon)
    return alpha * makespan + beta * moves + 100.0 * (alpha + beta) * over


@njit(**LOOP)
def best_place(t, ways, teams, line, length, makespan, moves, alpha, beta, horizon, hold, noise):
    """Cheapest place for target t: (cost, runner-up's cost, place, coalition).

    The runner-up is the best of any other coalition; infinity if there is none. `hold` is what a
    step of the longest chain through the place costs, critical or not: what is put where there is
    time to spare leaves the rest free to move. `noise`: at most so much luck.
    """
    n, size = ways.start.shape[0], teams.members.shape[1]
    order, crew, head, tail, onward, opening, space = line
    reach, rest, detour = space[0], space[1], space[2]
    reach[:] = 0  # step at which the agent could be at t
    rest[:] = 0  # longest chain from t on
    detour[:] = 0
    best, second, place, pick = np.inf, np.inf, -1, -1
    for p in range(length + 1):
        many = n if p == 0 else size
        for s in range(many):
            a = s if p == 0 else teams.members[crew[p - 1], s]
            if a < 0:
                break
            if teams.begin[t * n + a] == teams.begin[t * n + a + 1]:
                continue
            if p == 0:
                way, free, after = ways.start[a, t], 0, opening[a]
            else:
                way, free = ways.between[ways.kinds[a], order[p - 1], t], head[p - 1]
                after = onward[p - 1, s]
            reach[a], rest[a], detour[a] = free + way, 0, way
            if after >= 0:
                leg = ways.between[ways.kinds[a], t, order[after]]
                if p == 0:
                    direct = ways.start[a, order[after]]
                else:
                    direct = ways.between[ways.kinds[a], order[p - 1], order[after]]
                rest[a] = leg + tail[after]
                detour[a] = way + leg - direct
        for s in range(many):
            a = s if p == 0 else teams.members[crew[p - 1], s]
            if a < 0:
                break
            chain = reach[a] + rest[a]
            least = price(max(makespan, chain), moves + detour[a], alpha, beta, horizon)
            if least + hold * chain >= second:
                continue  # with others it costs no less, and would change nothing
            for k in range(teams.begin[t * n + a], teams.begin[t * n + a + 1]):
                c = teams.having[k]
                early, late, more = 0, 0, 0
                for u in range(size):
                    b = teams.members[c, u]
                    if b < 0:
                        break
                    early = max(early, reach[b])
                    late = max(late, rest[b])
                    more += detour[b]
                cost = price(max(makespan, early + late), moves + more, alpha, beta, horizon)
                cost += hold * (early + late)
                if noise > 0.0:
                    cost += noise * np.random.random()
                if c == pick:
                    if cost < best:
                        best, place = cost, p
                elif cost < best:
                    best, second, place, pick = cost, best, p, c
                else:
                    second = min(second, cost)
    return best, second, place, pick


@njit(**LOOP)
def put(line, length, place, target, coalition):
    """Puts an event into the list at `place`."""
    for i in range(length, place, -1):
        line.order[i], line.crew[i] = line.order[i - 1], line.crew[i - 1]
    line.order[place], line.crew[place] = target, coalition


@njit(cache=True, nogil=True)
def insert_all(missing, regret, ways, teams, line, length, alpha, beta, horizon, hold, noise,
               some):
    """Puts the missing targets into the list; returns (length, makespan, moves, places tried).

    With `regret` the target that loses most by missing its best coalition goes first,
    else the one that costs least. Of those that wait only the `some` that were foremost are
    looked at anew each time: what an insertion changes is mostly elsewhere.
    """
    makespan, moves = measure(ways, teams, line, length)
    waiting, tried = missing.shape[0], length
    score = np.full(waiting, np.inf)
    fresh = np.zeros(waiting, np.bool_)
    first = True
    while waiting:
        pick, pick_place, pick_team, pick_score = -1, 0, 0, -np.inf
        fresh[:waiting] = False
        for _ in range(waiting if first else min(some, waiting)):
            i, most = -1, -np.inf
            for j in range(waiting):
                if not fresh[j] and score[j] > most:
                    i, most = j, score[j]
            fresh[i] = True
            cost, second, place, coalition = best_place(
                missing[i], ways, teams, line, length, makespan, moves, alpha, beta, horizon,
                hold, noise)
            tried += length + 1
            score[i] = -cost
            if regret:
                score[i] = min(second, 1e12) - cost + 1e-6 * cost
            if score[i] > pick_score:
                pick, pick_place, pick_team, pick_score = i, place, coalition, score[i]
        first = False
        put(line, length, pick_place, missing[pick], pick_team)
        length += 1
        waiting -= 1
        missing[pick], score[pick] = missing[waiting], score[waiting]
        makespan, moves = measure(ways, teams, line, length)
        tried += length
    return length, makespan, moves, tried


@njit(cache=True, nogil=True)
def _inserted(start, between, kinds, masks, first, members, having, begin, regret, alpha, beta,
              horizon, some, order, crew):
    ways, teams = Ways(start, between, kinds), Teams(masks, first, members, having, begin)
    line = empty(ways, teams)
    every = np.arange(start.shape[1]).astype(np.int32)
    insert_all(every, regret, ways, teams, line, 0, alpha, beta, horizon, 0.0, 0.0, some)
    order[:], crew[:] = line.order, line.crew


@njit(cache=True, nogil=True)
def _measured(start, between, kinds, masks, first, members, having, begin, order, crew):
    ways, teams = Ways(start, between, kinds), Teams(masks, first, members, having, begin)
    line = empty(ways, teams)
    line.order[:], line.crew[:] = order, crew
    return measure(ways, teams, line, len(order))


def inserted(ways: Ways, teams: Teams, regret: bool, alpha: float, beta: float, horizon: int,
             some: int) -> tuple[IntArray, IntArray]:
    """Targets [M] and coalitions [M] of a list made by `insert_all`."""
    order, crew = np.zeros((2, ways.start.shape[1]), np.int32)
    _inserted(*ways, *teams, regret, alpha, beta, horizon, some, order, crew)
    return order, crew


def measured(ways: Ways, teams: Teams, order: IntArray, crew: IntArray) -> tuple[int, int]:
    """(makespan, moves) of a list of all targets."""
    return _measured(*ways, *teams, order, crew)
