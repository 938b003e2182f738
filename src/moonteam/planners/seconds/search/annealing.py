"""Annealing over lists of targets and their teams. For Numba.

Legend: N agents, M targets, P places in a team, L changed targets of a move.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from moonteam.compilation import LOOP, njit
from moonteam.planners.seconds.search.decode import choose, enough


class Plan(NamedTuple):
    """A list of targets and their teams, and what the schedule looks like before each of them."""

    order: Any  # [M] int64
    place: Any  # [M] int64 where each target is in the order
    team: Any  # [M, P] int64
    size: Any  # [M] int64 of each target's team; 0: to be chosen
    begin: Any  # [M] int64 ms of start of each target's service
    tail: Any  # [M] int64 ms from there to the end of all that waits for it, ways home included
    sums: Any  # [M + 1, 3] float64 so far: latest end, weighted travel, ms of lateness


class Goal(NamedTuple):
    """Cost = makespan * alpha + effort * beta + soft * (the agents' ends, their fourth mean)."""

    alpha: float
    beta: float
    soft: float
    fine: float  # cost of a ms of lateness


class Scratch(NamedTuple):
    """Space to work in."""

    clock: Any  # [N]
    last: Any  # [N]
    begin: Any  # [M]
    reach: Any  # [N]
    want: Any  # [S]
    changed: Any  # [M] targets whose teams the move changes
    old_team: Any  # [M, P]
    old_size: Any  # [M]
    result: Any  # [4] float64: cost, makespan, effort, lateness


@njit(**LOOP)
def stand(work, plan, first, clock, last):
    """Fills `last` [N] and `clock` [N]: where agents are before place `first`, since when."""
    order, team, size, begin, service = plan.order, plan.team, plan.size, plan.begin, work.service
    left = clock.shape[0]
    for a in range(left):
        last[a] = -1
        clock[a] = work.free[a]
    for i in range(first - 1, -1, -1):
        t = order[i]
        for k in range(size[t]):
            a = team[t, k]
            if last[a] < 0:
                last[a] = t
                clock[a] = begin[t] + service[t]
                left -= 1
        if left == 0:
            break


@njit(**LOOP)
def decode(work, plan, space, goal, first, stable, most, rest, near, noise):
    """The cost of the list, or infinity as soon as it will be above `most`.

    Its first `first` services are as they were, and those from place `stable` on but for their
    times. `rest` is what the cost without the makespan is at least. Fills the teams that are to be
    chosen, `space.begin` of the others, and `space.result`.
    """
    order, place, team, size, begin = plan.order, plan.place, plan.team, plan.size, plan.begin
    start, between, classes, ready, late = (work.start, work.between, work.classes, work.ready,
                                            work.late)
    service, effort, home, idle_way = work.service, work.effort, work.home, work.idle_way
    first_before, before = work.first_before, work.before
    clock, last, trial = space.clock, space.last, space.begin
    m, n = order.shape[0], clock.shape[0]
    stand(work, plan, first, clock, last)
    latest, way, over = plan.sums[first, 0], plan.sums[first, 1], plan.sums[first, 2]
    alpha, beta, fine, tail = goal.alpha, goal.beta, goal.fine, plan.tail
    for i in range(first, m):
        t = np.uint64(order[i])  # without a sign no index is looked at for being negative
        when = ready[t]
        for e in range(first_before[t], first_before[t + 1]):
            b = before[e]
            when = max(when, (begin[b] if place[b] < first else trial[b]) + service[b])
        if size[t] == 0:
            size[t] = choose(work, order[i], last, clock, when, near, noise, team[t], space.reach,
                             space.want)
            if size[t] == 0:
                return np.inf
        for k in range(size[t]):
            a = np.uint64(team[t, k])
            leg = start[a, t] if last[a] < 0 else (
                between[np.uint64(classes[a]), np.uint64(last[a]), t])
            way += effort[a] * leg
            when = max(when, clock[a] + leg)
        trial[t] = when
        end = when + service[t]
        for k in range(size[t]):
            a = np.uint64(team[t, k])
            clock[a] = end
            last[a] = order[i]
        latest = max(latest, float(end))
        if when > late[t]:
            over += when - late[t]
        onward = when + tail[t] if i >= stable else end + home[team[t, 0], t]
        last_end = max(latest, float(onward))
        if alpha * last_end + max(rest, beta * way) + fine * over > most:
            return np.inf
    fourth = 0.0
    for a in range(n):
        leg = idle_way[a] if last[a] < 0 else home[a, last[a]]
        end = float(clock[a] + leg)
        way += effort[a] * leg
        latest = max(latest, end)
        fourth += end * end * end * end
    over += max(0.0, latest - work.limit)
    fourth = np.sqrt(np.sqrt(fourth / n))
    result = space.result
    result[0] = goal.alpha * latest + beta * way + goal.soft * fourth + fine * over
    result[1], result[2], result[3] = latest, way, over
    return result[0]


@njit(**LOOP)
def settle(work, plan, space, first):
    """Takes down the schedule just made: the list sorted by start, what is before each place."""
    order, begin, place, team, size = plan.order, plan.begin, plan.place, plan.team, plan.size
    start, between, classes, effort = work.start, work.between, work.classes, work.effort
    last, sums = space.last, plan.sums
    m = order.shape[0]
    low = first
    for i in range(first, m):
        t = order[i]
        when = space.begin[t]
        begin[t] = when
        j = i
        while j > 0 and begin[order[j - 1]] > when:
            order[j] = order[j - 1]
            j -= 1
        order[j] = t
        low = min(low, j)
    stand(work, plan, low, space.clock, last)
    for i in range(low, m):
        t = order[i]
        place[t] = i
        end = begin[t] + work.service[t]
        way = 0.0
        for k in range(size[t]):
            a = team[t, k]
            way += effort[a] * (start[a, t] if last[a] < 0 else between[classes[a], last[a], t])
            last[a] = t
        sums[i + 1, 0] = max(sums[i, 0], float(end))
        sums[i + 1, 1] = sums[i, 1] + way
        sums[i + 1, 2] = sums[i, 2] + max(0, begin[t] - work.late[t])
    onward = space.last
    for a in range(onward.shape[0]):
        onward[a] = -1
    for i in range(m - 1, -1, -1):
        t = order[i]
        longest = 0
        for e in range(work.first_then[t], work.first_then[t + 1]):
            longest = max(longest, plan.tail[work.then[e]])
        for k in range(size[t]):
            a = team[t, k]
            after = onward[a]
            longest = max(longest, work.home[a, t] if after < 0
                          else between[classes[a], t, after] + plan.tail[after])
            onward[a] = t
        plan.tail[t] = work.service[t] + longest


@njit(**LOOP)
def shift(plan, i, j):
    """Takes the target at place i to place j."""
    order, place = plan.order, plan.place
    t = order[i]
    step = 1 if j > i else -1
    for k in range(i, j, step):
        order[k] = order[k + step]
        place[order[k]] = k
    order[j] = t
    place[t] = j


@njit(**LOOP)
def room(work, plan, i):
    """First and last place to which the target at place i can be taken."""
    t = plan.order[i]
    low, high = 0, plan.order.shape[0] - 1
    for e in range(work.first_before[t], work.first_before[t + 1]):
        low = max(low, plan.place[work.before[e]] + 1)
    for e in range(work.first_then[t], work.first_then[t + 1]):
        high = min(high, plan.place[work.then[e]] - 1)
    return low, high


@njit(**LOOP)
def keep(plan, space, count, t):
    """Remembers the team of target t before it is changed."""
    space.changed[count] = t
    space.old_size[count] = plan.size[t]
    for i in range(plan.size[t]):
        space.old_team[count, i] = plan.team[t, i]
    return count + 1


@njit(**LOOP)
def exchange_tails(work, plan, space, p):
    """Two agents take over each other's services from place p on; how many teams it changes."""
    order, team, size = plan.order, plan.team, plan.size
    m = order.shape[0]
    n = work.free.shape[0]
    a, b = np.random.randint(n), np.random.randint(n)
    if a == b:
        return 0
    count = 0
    for i in range(p, m):
        t = order[i]
        at, bt = -1, -1
        for k in range(size[t]):
            if team[t, k] == a:
                at = k
            elif team[t, k] == b:
                bt = k
        if (at < 0) == (bt < 0):
            continue
        spot, other = (at, b) if at >= 0 else (bt, a)
        if not enough(work, t, team[t], size[t], spot, other):
            continue
        count = keep(plan, space, count, t)
        team[t, spot] = other
    return count


@njit(**LOOP)
def replace(work, plan, space, t, count):
    """Another agent for one of the team of t."""
    n = work.free.shape[0]
    spot = np.random.randint(plan.size[t])
    for _ in range(4):
        a = np.random.randint(n)
        inside = False
        for k in range(plan.size[t]):
            inside |= plan.team[t, k] == a
        if not inside and enough(work, t, plan.team[t], plan.size[t], spot, a):
            count = keep(plan, space, count, t)
            plan.team[t, spot] = a
            return count
    return count


@njit(**LOOP)
def note(plan, best_order, best_team, best_size):
    """Takes down the list."""
    order, team, size = plan.order, plan.team, plan.size
    for i in range(order.shape[0]):
        t = order[i]
        best_order[i] = t
        best_size[t] = size[t]
        for k in range(size[t]):
            best_team[t, k] = team[t, k]


@njit(**LOOP)
def anneal(work, plan, space, goal, true, now, rest, warm, iterations, seed, mix, best_order,
           best_team, best_size, best):
    """`iterations` moves at temperature `warm`, in units of cost.

    `now` is the plan's cost, `rest` the part that is not makespan; returns both as they are in
    the end. `best` [4] is the best list's true cost, makespan, effort and lateness.
    """
    np.random.seed(seed)
    m = plan.order.shape[0]
    for _ in range(iterations):
        i = np.random.randint(m)
        if np.random.random() < mix[9]:  # rather one that has little time to spare
            o = np.random.randint(m)
            if plan.begin[plan.order[o]] + plan.tail[plan.order[o]] > (
                    plan.begin[plan.order[i]] + plan.tail[plan.order[i]]):
                i = o
        t = plan.order[i]
        first, count, kind, j, stable = i, 0, 0, i, i + 1
        u = np.random.random()
        if u < mix[0]:  # to another place
            low, high = room(work, plan, i)
            reach = max(2, int(m * mix[4]))
            low, high = max(low, i - reach), min(high, i + reach)
            j = low + np.random.randint(high - low + 1)
            if j == i:
                continue
            kind = 1
            first, stable = min(i, j), max(i, j) + 1
            shift(plan, i, j)
            if np.random.random() < mix[10]:  # all that follow get their teams anew
                stable = m
                for k in range(first, m):
                    o = plan.order[k]
                    count = keep(plan, space, count, o)
                    plan.size[o] = 0
            elif np.random.random() < mix[5]:
                count = keep(plan, space, count, t)
                plan.size[t] = 0
        elif u < mix[1]:  # another team, chosen anew
            count = keep(plan, space, count, t)
            plan.size[t] = 0
        elif u < mix[2]:  # one of the team replaced
            count = replace(work, plan, space, t, count)
        elif u < mix[3]:
            count = exchange_tails(work, plan, space, i)
            if count > 0:
                stable = plan.place[space.changed[count - 1]] + 1
        else:  # two targets change their places
            reach = max(2, int(m * mix[4]))
            j = min(m - 1, i + 1 + np.random.randint(reach))
            o = plan.order[j]
            if room(work, plan, i)[1] < j or room(work, plan, j)[0] > i or j == i:
                continue
            kind, stable = 2, j + 1
            plan.order[i], plan.order[j] = o, t
            plan.place[t], plan.place[o] = j, i
            if np.random.random() < mix[5]:
                count = keep(plan, space, count, t)
                plan.size[t] = 0
                count = keep(plan, space, count, o)
                plan.size[o] = 0
        if kind == 0 and count == 0:
            continue
        most = now - warm * np.log(1.0 - np.random.random())
        cost = decode(work, plan, space, goal, first, stable, most, rest - mix[8] * warm,
                      -1.0 if np.random.random() < mix[11] else mix[6] * np.random.random(), 0.0)
        if cost <= most:
            now = cost
            rest = cost - goal.alpha * space.result[1] - goal.fine * space.result[3]
            settle(work, plan, space, first)
            real = space.result[1] * true.alpha + space.result[2] * true.beta + true.fine * (
                space.result[3])
            if real < best[0]:
                best[0] = real
                for k in range(1, 4):
                    best[k] = space.result[k]
                note(plan, best_order, best_team, best_size)
            continue
        if kind == 1:
            shift(plan, j, i)
        elif kind == 2:
            o = plan.order[i]
            plan.order[i], plan.order[j] = t, o
            plan.place[t], plan.place[o] = i, j
        for c in range(count - 1, -1, -1):
            o = space.changed[c]
            plan.size[o] = space.old_size[c]
            for k in range(plan.size[o]):
                plan.team[o, k] = space.old_team[c, k]
    return now, rest
