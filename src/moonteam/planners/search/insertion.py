"""Insertion with regret and large-neighbourhood search, compiled with Numba.

Legend: N agents, M targets, K kinds, C coalitions of all targets, L events.

A plan is a list of events, each a target with the coalition that solves it; every agent does
its events in the order of the list, so no two agents can wait for each other for ever. With
`head` the step at which an event happens and `tail` the longest chain of walks and waits from
it to the end, the makespan after putting a new event into the list is
max(makespan before, head + tail of the new event): travel times obey the triangle inequality,
so no chain that avoids the new event gets longer or shorter. That makes trying one place a
matter of a few additions.
"""

from __future__ import annotations

import numpy as np

from moonteam.compilation import njit
from moonteam.planners.search.travel import UNREACHABLE

MOST_COALITIONS = 512
"""Coalitions considered for one target; beyond them only the first found are used."""


@njit(cache=True, nogil=True)
def coalitions(start, skills, need, both):
    """Minimal coalitions: (agent bit masks [C], first of target t [M + 1])."""
    n, m = start.shape
    masks = np.empty(m * MOST_COALITIONS, np.int32)
    first = np.zeros(m + 1, np.int32)
    able, team = np.empty(n, np.int32), np.empty(n, np.int32)
    count = 0
    for t in range(m):
        number = 0
        for a in range(n):
            if skills[a] & need[t] and start[a, t] < UNREACHABLE:
                able[number] = a
                number += 1
        if not both[t]:
            for i in range(number):
                masks[count] = 1 << able[i]
                count += 1
        else:
            count = _teams(skills, need[t], able[:number], team, masks, count)
        first[t + 1] = count
    return masks[:count].copy(), first


@njit(cache=True, nogil=True)
def _teams(skills, need, able, team, masks, count):
    """Adds the minimal coalitions of `able` for one target, largest mask first; the new count.

    Agents are taken in or left out one by one, from the last; nobody joins who would make a member
    one to spare, for such a team only has larger ones like it. All subsets were 2^N.
    """
    most, whole = count + MOST_COALITIONS, 0
    for a in able:
        whole |= skills[a]
    if whole & need != need:
        return count
    size, i = 0, len(able) - 1
    while count < most:
        if i < 0:  # back to the last who was taken in, and leave that one out
            if size == 0:
                break
            size -= 1
            i = team[size] - 1
            continue
        team[size] = i
        if _tight(skills, need, able, team, size + 1):
            have, mask = 0, 0
            for k in range(size + 1):
                have |= skills[able[team[k]]]
                mask |= 1 << able[team[k]]
            if have & need == need:
                masks[count] = mask
                count += 1
            else:
                size += 1
        i -= 1
    return count


@njit(cache=True, nogil=True)
def _tight(skills, need, able, team, size):
    """Whether every member brings something needed that no other brings."""
    once, twice = 0, 0
    for k in range(size):
        brought = skills[able[team[k]]] & need
        twice |= once & brought
        once |= brought
    spare = False
    for k in range(size):
        spare |= skills[able[team[k]]] & need & ~twice == 0
    return not spare


@njit(cache=True, nogil=True)
def measure(start, between, kinds, order, team, length, head, tail, following):
    """Fills head [L], tail [L] and following [L + 1, N]; returns (makespan, moves).

    following[i, a] is the agent's first event at or after place i, or -1.
    """
    n = start.shape[0]
    last = np.full(n, -1, np.int32)
    makespan, moves = 0, 0
    for i in range(length):
        t, when = order[i], 0
        for a in range(n):
            if team[i] >> a & 1:
                if last[a] < 0:
                    way, free = start[a, t], 0
                else:
                    way, free = between[kinds[a], order[last[a]], t], head[last[a]]
                when = max(when, free + way)
                moves += way
                last[a] = i
        head[i] = when
        makespan = max(makespan, when)
    following[length, :] = -1
    for i in range(length - 1, -1, -1):
        t, longest = order[i], 0
        for a in range(n):
            onward = following[i + 1, a]
            following[i, a] = onward
            if team[i] >> a & 1:
                if onward >= 0:
                    way = between[kinds[a], t, order[onward]]
                    longest = max(longest, way + tail[onward])
                following[i, a] = i
        tail[i] = longest
    return makespan, moves


@njit(cache=True, nogil=True)
def price(makespan, moves, alpha, beta, horizon):
    """Cost of a plan; steps past the horizon weigh as much as anything else can."""
    over = max(0, makespan - horizon)
    return alpha * makespan + beta * moves + 100.0 * (alpha + beta) * over


@njit(cache=True, nogil=True)
def best_place(t, start, between, kinds, order, team, length, head, tail, following, makespan,
               moves, masks, first, alpha, beta, horizon, noise):
    """Cheapest place for target t: (cost, runner-up's cost, place, coalition).

    The runner-up is the best of any other coalition; infinity if there is none.
    """
    n = start.shape[0]
    reach = np.empty(n, np.int32)  # step at which the agent could be at t
    onward = np.empty(n, np.int32)  # longest chain from t on
    detour = np.empty(n, np.int32)
    count = first[t + 1] - first[t]
    costs = np.full(count, np.inf)
    best, place, mask = np.inf, -1, 0
    for p in range(length + 1):
        changed = (1 << n) - 1 if p == 0 else team[p - 1]
        for a in range(n):
            if not changed >> a & 1:
                continue
            nxt = following[p, a]
            if p == 0:
                way, free = start[a, t], 0
            else:
                way, free = between[kinds[a], order[p - 1], t], head[p - 1]
            reach[a] = free + way
            onward[a], detour[a] = 0, way
            if nxt >= 0:
                leg = between[kinds[a], t, order[nxt]]
                if p == 0:
                    direct = start[a, order[nxt]]
                else:
                    direct = between[kinds[a], order[p - 1], order[nxt]]
                onward[a] = leg + tail[nxt]
                detour[a] = way + leg - direct
        for c in range(count):
            members = masks[first[t] + c]
            if not members & changed:
                continue
            early, late, more = 0, 0, 0
            for a in range(n):
                if members >> a & 1:
                    early = max(early, reach[a])
                    late = max(late, onward[a])
                    more += detour[a]
            cost = price(max(makespan, early + late), moves + more, alpha, beta, horizon)
            if noise > 0.0:
                cost += noise * np.random.random()
            costs[c] = min(costs[c], cost)
            if cost < best:
                best, place, mask = cost, p, members
    second = np.inf
    for c in range(count):
        if masks[first[t] + c] != mask:
            second = min(second, costs[c])
    return best, second, place, mask


@njit(cache=True, nogil=True)
def insert_all(missing, regret, start, between, kinds, order, team, length, head, tail,
               following, masks, first, alpha, beta, horizon, noise):
    """Puts the missing targets into the list; returns (length, makespan, moves).

    With `regret` the target that loses most by missing its best coalition goes first,
    else the one that costs least.
    """
    makespan, moves = measure(start, between, kinds, order, team, length, head, tail, following)
    waiting = missing.shape[0]
    while waiting:
        pick, pick_place, pick_mask, pick_score = -1, 0, 0, -np.inf
        for i in range(waiting):
            cost, second, place, mask = best_place(
                missing[i], start, between, kinds, order, team, length, head, tail, following,
                makespan, moves, masks, first, alpha, beta, horizon, noise)
            score = -cost
            if regret:
                score = min(second, 1e12) - cost + 1e-6 * cost
            if score > pick_score:
                pick, pick_place, pick_mask, pick_score = i, place, mask, score
        for i in range(length, pick_place, -1):
            order[i], team[i] = order[i - 1], team[i - 1]
        order[pick_place], team[pick_place] = missing[pick], pick_mask
        length += 1
        waiting -= 1
        missing[pick] = missing[waiting]
        makespan, moves = measure(start, between, kinds, order, team, length, head, tail,
                                  following)
    return length, makespan, moves


@njit(cache=True, nogil=True)
def choose_removed(between, kinds, order, team, length, head, tail, makespan, most, removed):
    """Marks the events to take out in `removed` [L]; returns how many.

    One of four ways at random: anywhere, near one another, along the critical chain, or in a
    row of one agent's route.
    """
    removed[:length] = False
    wanted = min(length, 1 + np.random.randint(most))
    way = np.random.randint(4)
    seed = np.random.randint(length)
    if way == 2:
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
    for a in range(31):
        if team[seed] >> a & 1 and (mate < 0 or np.random.random() < 0.5):
            mate = a
    for i in range(length):
        apart = between[0, order[seed], order[i]] * (0.5 + np.random.random())
        if way == 3:
            apart = abs(head[i] - head[seed]) if team[i] >> mate & 1 else 1e6 + apart
        elif way == 2:
            slack = makespan - head[i] - tail[i]
            apart = 0.5 * apart + slack
        score[i] = -1.0 if i == seed else apart
    ranks = np.argsort(score)
    for r in range(wanted):
        removed[ranks[r]] = True
    return wanted


@njit(cache=True, nogil=True)
def improve(start, between, kinds, masks, first, order, team, alpha, beta, true_alpha, true_beta,
            horizon, iterations, hot, cold, seed, best_order, best_team):
    """Large-neighbourhood search with annealed acceptance.

    Args:
      start, between, kinds: travel times as in `search.solve`.
      masks, first: from `coalitions`.
      order, team: [M] int32 the current list of events; changed in place.
      alpha, beta: weights that steer the search.
      true_alpha, true_beta: weights of the objective, by which the best is kept.
      horizon: longest makespan wanted.
      iterations: how often to take out and put back.
      hot, cold: temperature at the first and the last iteration, in units of cost.
      seed: of the random numbers.
      best_order, best_team: [M] int32 the best list; read and overwritten.

    Returns:
      cost of the best list in the true objective.
    """
    np.random.seed(seed)
    m = order.shape[0]
    n = start.shape[0]
    head = np.zeros(m, np.int32)
    tail = np.zeros(m, np.int32)
    following = np.zeros((m + 1, n), np.int32)
    removed = np.zeros(m, np.bool_)
    new_order, new_team = order.copy(), team.copy()
    makespan, moves = measure(start, between, kinds, best_order, best_team, m, head, tail,
                              following)
    best = price(makespan, moves, true_alpha, true_beta, horizon)
    makespan, moves = measure(start, between, kinds, order, team, m, head, tail, following)
    now = price(makespan, moves, alpha, beta, horizon)
    most = max(2, min(12, (2 * m) // 3))
    for step in range(iterations):
        warmth = hot * (cold / hot) ** (step / max(1, iterations))
        makespan, moves = measure(start, between, kinds, order, team, m, head, tail, following)
        count = choose_removed(between, kinds, order, team, m, head, tail, makespan, most,
                               removed)
        missing = np.empty(count, np.int32)
        length, out = 0, 0
        for i in range(m):
            if removed[i]:
                missing[out] = order[i]
                out += 1
            else:
                new_order[length], new_team[length] = order[i], team[i]
                length += 1
        noise = warmth if np.random.random() < 0.5 else 0.0
        length, makespan, moves = insert_all(
            missing, np.random.random() < 0.5, start, between, kinds, new_order, new_team,
            length, head, tail, following, masks, first, alpha, beta, horizon, noise)
        cost = price(makespan, moves, alpha, beta, horizon)
        true_cost = price(makespan, moves, true_alpha, true_beta, horizon)
        if true_cost < best - 1e-9:
            best = true_cost
            best_order[:] = new_order
            best_team[:] = new_team
        if cost < now - warmth * np.log(1.0 - np.random.random()):
            now = cost
            order[:] = new_order
            team[:] = new_team
    return best
