"""Insertion with regret and large-neighbourhood search, compiled with Numba.

Legend: N agents, M targets, K kinds, C coalitions of all targets, S most members of one, L events.

A plan is a list of events, each a target with the coalition that solves it; every agent does
its events in the order of the list, so no two agents can wait for each other for ever. With
`head` the step at which an event happens and `tail` the longest chain of walks and waits from
it to the end, the makespan after putting a new event into the list is
max(makespan before, head + tail of the new event): travel times obey the triangle inequality,
so no chain that avoids the new event gets longer or shorter. That makes trying one place a
matter of a few additions; and along the list only what the agents of the last event could do
changes from one place to the next.

What Python calls (`inserted`, `measured`, `improved`, and `teams.teams_of`) hands Numba plain
arrays, and returns none: to pass a named tuple, or to return an array, Numba runs Python, where a
signal may come, and then the process crashes or ends in a SystemError.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from moonteam.compilation import njit
from moonteam.planners.base import IntArray
from moonteam.planners.search.teams import Teams

MOST = 24
"""Events taken out at once, and never more than two thirds of them: the last step of a makespan
goes only where much is made anew.
"""

SOME = 2
"""Targets looked at anew for each that is put back."""

CRITICAL = 0.75
"""Share of the removals near an event that is about one on the critical chain: others leave the
makespan as it is.
"""


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


@njit(cache=True, nogil=True)
def empty(ways, teams):
    """A list that is empty."""
    n, m = ways.start.shape
    size = teams.members.shape[1]
    return Timeline(np.zeros(m, np.int32), np.zeros(m, np.int32), np.zeros(m, np.int32),
                  np.zeros(m, np.int32), np.full((m, size), -1, np.int32),
                  np.full(n, -1, np.int32))


@njit(cache=True, nogil=True)
def measure(ways, teams, line, length):
    """Fills what follows from the first `length` events; returns (makespan, moves)."""
    n, size = ways.start.shape[0], teams.members.shape[1]
    order, crew, head, tail, onward, opening = line
    last, slot = np.full(n, -1, np.int32), np.zeros(n, np.int32)
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


@njit(cache=True, nogil=True)
def price(makespan, moves, alpha, beta, horizon):
    """Cost of a plan; steps past the horizon weigh as much as anything else can."""
    over = max(0, makespan - horizon)
    return alpha * makespan + beta * moves + 100.0 * (alpha + beta) * over


@njit(cache=True, nogil=True)
def best_place(t, ways, teams, line, length, makespan, moves, alpha, beta, horizon, noise):
    """Cheapest place for target t: (cost, runner-up's cost, place, coalition).

    The runner-up is the best of any other coalition; infinity if there is none.
    """
    n, size = ways.start.shape[0], teams.members.shape[1]
    order, crew, head, tail, onward, opening = line
    reach = np.zeros(n, np.int32)  # step at which the agent could be at t
    rest = np.zeros(n, np.int32)  # longest chain from t on
    detour = np.zeros(n, np.int32)
    low = teams.first[t]
    costs = np.full(teams.first[t + 1] - low, np.inf)
    best, place, pick = np.inf, -1, -1
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
                if noise > 0.0:
                    cost += noise * np.random.random()
                costs[c - low] = min(costs[c - low], cost)
                if cost < best:
                    best, place, pick = cost, p, c
    second = np.inf
    for c in range(len(costs)):
        if c + low != pick:
            second = min(second, costs[c])
    return best, second, place, pick


@njit(cache=True, nogil=True)
def put(line, length, place, target, coalition):
    """Puts an event into the list at `place`."""
    for i in range(length, place, -1):
        line.order[i], line.crew[i] = line.order[i - 1], line.crew[i - 1]
    line.order[place], line.crew[place] = target, coalition


@njit(cache=True, nogil=True)
def insert_all(missing, regret, ways, teams, line, length, alpha, beta, horizon, noise, some):
    """Puts the missing targets into the list; returns (length, makespan, moves).

    With `regret` the target that loses most by missing its best coalition goes first,
    else the one that costs least. Of those that wait only the `some` that were foremost are
    looked at anew each time: what an insertion changes is mostly elsewhere.
    """
    makespan, moves = measure(ways, teams, line, length)
    waiting = missing.shape[0]
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
                noise)
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
    return length, makespan, moves


@njit(cache=True, nogil=True)
def choose_removed(ways, teams, line, length, makespan, most, removed):
    """Marks the events to take out in `removed` [L]; returns how many.

    One of four ways at random: anywhere, near one another, along the critical chain, or in a
    row of one agent's route.
    """
    order, crew, head, tail, _, _ = line
    removed[:length] = False
    wanted = min(length, 1 + np.random.randint(most))
    way = np.random.randint(4)
    seed = np.random.randint(length)
    if way == 2 or (way != 0 and np.random.random() < CRITICAL):
        tries = 0
        while head[seed] + tail[seed] < makespan and tries < 4 * length:
            seed = np.random.randint(length)
            tries += 1
    count = 0
    if way == 0:
        while count < wanted:
            i = np.random.randint(length)
            if not removed[i]:
                removed[i] = True
                count += 1
        return count
    score = np.empty(length)
    mate = -1
    for a in teams.members[crew[seed]]:
        if a >= 0 and (mate < 0 or np.random.random() < 0.5):
            mate = a
    for i in range(length):
        apart = ways.between[0, order[seed], order[i]] * (0.5 + np.random.random())
        if way == 3:
            with_mate = teams.masks[crew[i]] >> mate & 1
            apart = abs(head[i] - head[seed]) if with_mate else 1e6 + apart
        elif way == 2:
            slack = makespan - head[i] - tail[i]
            apart = 0.5 * apart + slack
        score[i] = -1.0 if i == seed else apart
    for _ in range(wanted):
        nearest = np.argmin(score)
        removed[nearest], score[nearest] = True, np.inf
    return wanted


@njit(cache=True, nogil=True)
def improve(ways, teams, order, crew, alpha, beta, true_alpha, true_beta, horizon, iterations,
            hot, cold, seed, best_order, best_crew):
    """Large-neighbourhood search with annealed acceptance.

    Args:
      ways, teams: travel times and coalitions.
      order, crew: [M] int32 the current list of events; changed in place.
      alpha, beta: weights that steer the search.
      true_alpha, true_beta: weights of the objective, by which the best is kept.
      horizon: longest makespan wanted.
      iterations: how often to take out and put back.
      hot, cold: temperature at the first and the last iteration, in units of cost.
      seed: of the random numbers.
      best_order, best_crew: [M] int32 the best list; read and overwritten.

    Returns:
      cost of the best list in the true objective.
    """
    np.random.seed(seed)
    m = order.shape[0]
    line, removed = empty(ways, teams), np.zeros(m, np.bool_)
    line.order[:], line.crew[:] = best_order, best_crew
    makespan, moves = measure(ways, teams, line, m)
    best = price(makespan, moves, true_alpha, true_beta, horizon)
    line.order[:], line.crew[:] = order, crew
    makespan, moves = measure(ways, teams, line, m)
    now = price(makespan, moves, alpha, beta, horizon)
    most = max(2, min(MOST, (2 * m) // 3))
    for step in range(iterations):
        warmth = hot * (cold / hot) ** (step / max(1, iterations))
        line.order[:], line.crew[:] = order, crew
        makespan, moves = measure(ways, teams, line, m)
        count = choose_removed(ways, teams, line, m, makespan, most, removed)
        missing = np.empty(count, np.int32)
        length, out = 0, 0
        for i in range(m):
            if removed[i]:
                missing[out] = order[i]
                out += 1
            else:
                line.order[length], line.crew[length] = order[i], crew[i]
                length += 1
        noise = warmth if np.random.random() < 0.5 else 0.0
        length, makespan, moves = insert_all(
            missing, np.random.random() < 0.5, ways, teams, line, length, alpha, beta, horizon,
            noise, SOME)
        cost = price(makespan, moves, alpha, beta, horizon)
        true_cost = price(makespan, moves, true_alpha, true_beta, horizon)
        if true_cost < best - 1e-9:
            best = true_cost
            best_order[:], best_crew[:] = line.order, line.crew
        if cost < now - warmth * np.log(1.0 - np.random.random()):
            now = cost
            order[:], crew[:] = line.order, line.crew
    return best


@njit(cache=True, nogil=True)
def _inserted(start, between, kinds, masks, first, members, having, begin, regret, alpha, beta,
              horizon, some, order, crew):
    ways, teams = Ways(start, between, kinds), Teams(masks, first, members, having, begin)
    line = empty(ways, teams)
    every = np.arange(start.shape[1]).astype(np.int32)
    insert_all(every, regret, ways, teams, line, 0, alpha, beta, horizon, 0.0, some)
    order[:], crew[:] = line.order, line.crew


@njit(cache=True, nogil=True)
def _measured(start, between, kinds, masks, first, members, having, begin, order, crew):
    ways, teams = Ways(start, between, kinds), Teams(masks, first, members, having, begin)
    line = empty(ways, teams)
    line.order[:], line.crew[:] = order, crew
    return measure(ways, teams, line, len(order))


@njit(cache=True, nogil=True)
def _improved(start, between, kinds, masks, first, members, having, begin, order, crew, alpha,
              beta, true_alpha, true_beta, horizon, iterations, hot, cold, seed, best_order,
              best_crew):
    return improve(Ways(start, between, kinds), Teams(masks, first, members, having, begin), order,
                   crew, alpha, beta, true_alpha, true_beta, horizon, iterations, hot, cold, seed,
                   best_order, best_crew)


def inserted(ways: Ways, teams: Teams, regret: bool, alpha: float, beta: float, horizon: int,
             some: int) -> tuple[IntArray, IntArray]:
    """Targets [M] and coalitions [M] of a list made by `insert_all`."""
    order, crew = np.zeros((2, ways.start.shape[1]), np.int32)
    _inserted(*ways, *teams, regret, alpha, beta, horizon, some, order, crew)
    return order, crew


def measured(ways: Ways, teams: Teams, order: IntArray, crew: IntArray) -> tuple[int, int]:
    """(makespan, moves) of a list of all targets."""
    return _measured(*ways, *teams, order, crew)


def improved(ways: Ways, teams: Teams, *rest) -> float:
    """`improve`, from Python."""
    return _improved(*ways, *teams, *rest)
