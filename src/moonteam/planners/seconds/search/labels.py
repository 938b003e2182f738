"""Exact search by the clock, compiled: layers of partial schedules, the dominated ones left out.

Legend: N agents, M open targets (at most 16), S skills, C teams of all targets, L labels.

A label is a partial schedule: the set of targets served, where each agent served last, when each is
free. Services are added in the order of their starts, one a layer, and one that would start before
the last is left out: the same schedule is made with the two the other way round. Of two labels with
the same set and the same places, the one that is later in everything leads to nothing better and is
left out; so is one whose lower bound does not beat the best plan known.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from moonteam.compilation import njit
from moonteam.planners.seconds.base import NEVER
from moonteam.planners.seconds.search.decode import enough

MAX_AGENTS = 24
"""Teams are listed by trying all subsets of the agents that are able."""


class Tables(NamedTuple):
    """What is known of the targets before the search."""

    mask: Any  # [C] int64 teams as bit masks
    first: Any  # [M + 1] int64 first team of each target
    ways: Any  # [N, M + 1, M] int64 least ms from each target (or start, M) to each, via others
    back: Any  # [N, M + 1] int64 least ms home
    path: Any  # [N, 2^M, M + 1] int64 least ms through a set of targets, then home
    toll: Any  # as `path`, ways alone: without services
    forced: Any  # [N] int64 mask of targets that cannot do without the agent
    inward: Any  # [M] int64 least ms of anybody's last leg to the target
    tail: Any  # [M] int64 least ms from the target's start to the end of the plan
    depth: Any  # [M] int64 an order in which what comes before comes first
    behind: Any  # [M] int64 mask of the targets that come before it
    twin: Any  # [N] int64 an agent just like it, of lower number, or -1
    fewest: Any  # [M] int64 agents of the smallest team


class Labels(NamedTuple):
    """One layer."""

    served: Any  # [L] int64 mask
    last: Any  # [L, N] int64 target or -1
    clock: Any  # [L, N] int64 ms
    ready: Any  # [L, M] int64 ms before which each open target cannot start
    now: Any  # [L] int64 start of the last service
    effort: Any  # [L] float64
    bound: Any  # [L] float64 lower bound of the cost
    parent: Any  # [L] int64 label of the layer before
    team: Any  # [L] int64 team just served, index into `mask`
    target: Any  # [L] int64
    dead: Any  # [L] bool dominated
    link: Any  # [L] int64 next label with the same hash


class Aim(NamedTuple):
    """Cost = alpha * makespan + beta * effort."""

    alpha: float
    beta: float
    timeless: bool  # time costs nothing and ends nothing: only ways count


@njit(cache=True, nogil=True)
def closed_ways(work):
    """(ways [N, M + 1, M], back [N, M + 1]): least ms, going by way of other targets for free."""
    n, m = work.start.shape
    ways = np.empty((n, m + 1, m), np.int64)
    back = np.empty((n, m + 1), np.int64)
    for a in range(n):
        for j in range(m):
            ways[a, m, j] = work.start[a, j]
            for i in range(m):
                ways[a, i, j] = 0 if i == j else work.between[work.classes[a], i, j]
        for k in range(m):
            for i in range(m + 1):
                for j in range(m):
                    ways[a, i, j] = min(ways[a, i, j], ways[a, i, k] + ways[a, k, j])
        for i in range(m + 1):
            back[a, i] = work.idle_way[a] if i == m else work.home[a, i]
            for j in range(m):
                back[a, i] = min(back[a, i], ways[a, i, j] + work.home[a, j])
    return ways, back


@njit(cache=True, nogil=True)
def shortcut(work, a, k, pay):
    """Whether agent a may gain by serving k on its way although it is not needed there.

    Ways that are rounded, or measured over rough ground, may be longer than by way of k.
    """
    m = work.start.shape[1]
    kind = work.classes[a]
    wait = work.service[k] if pay else 0
    for i in range(-1, m):
        if i == k:
            continue
        here = work.start[a, k] if i < 0 else work.between[kind, i, k]
        straight = work.idle_way[a] if i < 0 else work.home[a, i]
        if here + wait + work.home[a, k] < straight:
            return True
        for j in range(m):
            if j != i and j != k:
                straight = work.start[a, j] if i < 0 else work.between[kind, i, j]
                if here + wait + work.between[kind, k, j] < straight:
                    return True
    return False


@njit(cache=True, nogil=True)
def teams(work, pay, tries):
    """Teams with nobody to spare who gains nothing: (masks [C], first of each target [M + 1], all).

    Agents are taken in or left out one by one; who can never be of use does not join, for a larger
    team needs them no more. `all` is False where that took more than so many tries.
    """
    n, m = work.start.shape
    masks = np.empty(256, np.int64)
    first = np.zeros(m + 1, np.int64)
    able, team, places = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n, np.int64)
    loose = np.empty(n, np.bool_)
    count = 0
    for t in range(m):
        number = 0
        for a in range(n):
            useful = False
            for s in range(work.has.shape[1]):
                useful |= work.has[a, s] and work.need[t, s] > 0
            loose[a] = shortcut(work, a, t, pay)
            if useful or loose[a]:
                able[number] = a
                number += 1
        size, i = 0, 0
        while True:
            if i == number:  # back to the last who was taken in, and leave that one out
                if size == 0:
                    break
                size -= 1
                i = places[size] + 1
                continue
            tries -= 1
            if tries < 0:
                return masks[:count].copy(), first, False
            team[size], places[size] = able[i], i
            if tight(work, t, team, size + 1, loose):
                size += 1
                if enough(work, t, team, size, -1, -1):
                    if count == masks.shape[0]:
                        masks = np.concatenate((masks, np.empty_like(masks)))
                    masks[count] = 0
                    for k in range(size):
                        masks[count] |= 1 << team[k]
                    count += 1
            i += 1
        masks[first[t]:count] = np.sort(masks[first[t]:count])
        first[t + 1] = count
    return masks[:count].copy(), first, True


@njit(cache=True, nogil=True)
def tight(work, t, team, size, loose):
    """Whether all of the team but those who are loose bring what the others have too little of."""
    for k in range(size):
        a = team[k]
        brings = loose[a]
        for s in range(work.has.shape[1]):
            if brings or work.need[t, s] == 0 or not work.has[a, s]:
                continue
            others = 0
            for i in range(size):
                for q in range(work.has.shape[1]):
                    if i != k and work.has[team[i], q] and work.need[t, q] > 0 and (
                            q == s or work.either[t]):
                        others += 1
            brings = others == 0 if work.either[t] else others < work.need[t, s]
        if not brings:
            return False
    return True


@njit(cache=True, nogil=True)
def paths(work, ways, back, forced, pay):
    """Least ms [N, 2^M, M + 1] from each place through a set of forced targets, then home."""
    n, m = work.start.shape
    path = np.full((n, 1 << m, m + 1), NEVER, np.int64)
    for a in range(n):
        path[a, 0] = back[a]
        v = 0
        while True:  # subsets of the forced targets, in rising order
            v = (v - forced[a]) & forced[a]
            if v == 0:
                break
            for i in range(m + 1):
                best = NEVER
                for j in range(m):
                    if v >> j & 1:
                        length = ways[a, i, j] + path[a, v ^ (1 << j), j]
                        if pay:
                            length += work.service[j]
                        best = min(best, length)
                path[a, v, i] = best
    return path


@njit(cache=True, nogil=True)
def ranked(work, times, t, spare):
    """The least time by which enough of those who arrive at `times` [N] are there for target t."""
    n, skills = work.has.shape
    worst, soonest = 0, NEVER
    for s in range(skills):
        number = work.need[t, s]
        if number == 0:
            continue
        count = 0
        for a in range(n):
            if work.has[a, s]:
                spare[count] = times[a]
                count += 1
        if work.either[t]:
            number = 1
        if number > count:
            reached = NEVER
        elif number == 1:
            reached = spare[0]
            for i in range(1, count):
                reached = min(reached, spare[i])
        else:
            reached = np.sort(spare[:count])[number - 1]
        worst = max(worst, reached)
        soonest = min(soonest, reached)
    return soonest if work.either[t] else worst


@njit(cache=True, nogil=True)
def prepare(work, pay, mask, first):
    """All that is known before the search, teams included."""
    n, m = work.start.shape
    ways, back = closed_ways(work)
    forced = np.zeros(n, np.int64)
    fewest = np.full(m, n, np.int64)
    for t in range(m):
        always = (1 << n) - 1
        for c in range(first[t], first[t + 1]):
            always &= mask[c]
            size = 0
            for a in range(n):
                size += mask[c] >> a & 1
            fewest[t] = min(fewest[t], size)
        for a in range(n):
            if always >> a & 1:
                forced[a] |= 1 << t
    inward = np.full(m, NEVER, np.int64)
    for t in range(m):
        for a in range(n):
            for i in range(m + 1):
                if i != t:
                    inward[t] = min(inward[t], ways[a, i, t])
    behind = np.zeros(m, np.int64)
    for t in range(m):
        for e in range(work.first_before[t], work.first_before[t + 1]):
            behind[t] |= 1 << work.before[e]
    depth = np.empty(m, np.int64)
    done, count = 0, 0
    while count < m:
        for t in range(m):
            if not done >> t & 1 and behind[t] & ~done == 0:
                depth[count] = t
                count += 1
                done |= 1 << t
    tail = np.zeros(m, np.int64)
    spare = np.empty(n, np.int64)
    for i in range(m - 1, -1, -1):
        t = depth[i]
        onward = ranked(work, back[:, t], t, spare)
        for e in range(work.first_then[t], work.first_then[t + 1]):
            onward = max(onward, tail[work.then[e]])
        tail[t] = work.service[t] + onward
    twin = np.full(n, -1, np.int64)
    for a in range(n):
        for b in range(a):
            same = (work.classes[a] == work.classes[b] and work.free[a] == work.free[b]
                    and work.effort[a] == work.effort[b]
                    and work.idle_way[a] == work.idle_way[b])
            if same and (work.start[a] == work.start[b]).all() and (
                    work.home[a] == work.home[b]).all() and (work.has[a] == work.has[b]).all():
                twin[a] = b
    path = paths(work, ways, back, forced, True)
    toll = paths(work, ways, back, forced, False)
    return Tables(mask, first, ways, back, path, toll, forced, inward, tail, depth, behind, twin,
                  fewest)


@njit(cache=True, nogil=True)
def estimate(work, tables, aim, served, last, clock, ready, now, way, space):
    """A lower bound of the cost of all plans that begin like this; infinity where none do."""
    n, m = work.start.shape
    reach, soon, spare = space[0], space[1], space[2]
    span, travel, slots = work.floor, 0.0, 0.0
    for a in range(n):
        place = m if last[a] < 0 else last[a]
        left = tables.forced[a] & ~served
        span = max(span, clock[a] + tables.path[a, left, place])
        travel += work.effort[a] * tables.toll[a, left, place]
    if travel >= NEVER:
        return np.inf
    if not aim.timeless:
        for i in range(m):
            t = tables.depth[i]
            if served >> t & 1:
                continue
            for a in range(n):
                place = m if last[a] < 0 else last[a]
                reach[a] = clock[a] + tables.ways[a, place, t]
            when = max(max(ready[t], now), ranked(work, reach, t, spare))
            for e in range(work.first_before[t], work.first_before[t + 1]):
                b = work.before[e]
                if not served >> b & 1:
                    when = max(when, soon[b] + work.service[b])
            soon[t] = when
            if when > work.late[t]:
                return np.inf
            span = max(span, when + tables.tail[t])
        span = max(span, shared(work, tables, served, last, clock))
        if span > work.limit or span >= NEVER:
            return np.inf
    if aim.beta > 0.0:
        least = work.effort[0]
        for a in range(1, n):
            least = min(least, work.effort[a])
        for t in range(m):
            if not served >> t & 1:
                slots += tables.fewest[t] * tables.inward[t]
        travel = max(travel, least * slots)
    return aim.alpha * span + aim.beta * (way + travel)


@njit(cache=True, nogil=True)
def shared(work, tables, served, last, clock):
    """Least makespan if the work left were shared evenly among those who can do it."""
    n, m = work.start.shape
    skills = work.has.shape[1]
    best = 0
    for s in range(-1, skills):
        busy, number = 0, 0
        for a in range(n):
            if s < 0 or work.has[a, s]:
                place = m if last[a] < 0 else last[a]
                nearest = tables.back[a, place]
                for t in range(m):
                    if not served >> t & 1:
                        nearest = min(nearest, tables.back[a, t])
                busy += clock[a] + nearest
                number += 1
        if number == 0:
            continue
        for t in range(m):
            if served >> t & 1:
                continue
            if s < 0:
                busy += tables.fewest[t] * (work.service[t] + tables.inward[t])
            elif not work.either[t]:
                busy += work.need[t, s] * (work.service[t] + tables.inward[t])
        best = max(best, -(-busy // number))
    return best


@njit(cache=True, nogil=True)
def hashed(served, last, size):
    """Bucket of a set and the agents' places."""
    key = served * 0x1E3779B97F4A7C15
    for a in range(last.shape[0]):
        key = (key ^ (last[a] + 1)) * 0x100000001B3
        key ^= (key >> 29) & 0x7FFFFFFFF
    return key & (size - 1)


@njit(cache=True, nogil=True)
def below(labels, i, j, aim):
    """Whether label i is in everything at most as late and as dear as label j."""
    if aim.beta > 0.0 and labels.effort[i] > labels.effort[j]:
        return False
    if aim.timeless:
        return True
    if labels.now[i] > labels.now[j]:
        return False
    for a in range(labels.clock.shape[1]):
        if labels.clock[i, a] > labels.clock[j, a]:
            return False
    late = False
    for t in range(labels.ready.shape[1]):
        late |= labels.ready[i, t] > labels.ready[j, t]
    return not late


@njit(cache=True, nogil=True)
def admit(labels, count, heads, aim):
    """Files label `count`, just written, unless one like it is better; returns the new count."""
    slot = hashed(labels.served[count], labels.last[count], heads.shape[0])
    before, i = -1, heads[slot]
    while i >= 0:
        onward = labels.link[i]
        same = labels.served[i] == labels.served[count]
        for a in range(labels.last.shape[1]):
            same = same and labels.last[i, a] == labels.last[count, a]
        if same:
            if below(labels, i, count, aim):
                return count
            if below(labels, count, i, aim):
                labels.dead[i] = True
                if before < 0:
                    heads[slot] = onward
                else:
                    labels.link[before] = onward
                i = onward
                continue
        before, i = i, onward
    labels.link[count] = heads[slot]
    labels.dead[count] = False
    heads[slot] = count
    return count + 1


@njit(cache=True, nogil=True)
def refile(labels, count, heads):
    """Files all labels anew in a larger table."""
    heads[:] = -1
    for i in range(count):
        if not labels.dead[i]:
            slot = hashed(labels.served[i], labels.last[i], heads.shape[0])
            labels.link[i] = heads[slot]
            heads[slot] = i


@njit(cache=True, nogil=True)
def raise_clocks(work, served, last, clock, ready, now):
    """Lets agents wait where it costs nothing, so that more labels are alike."""
    n, m = work.start.shape
    for t in range(m):
        ready[t] = 0 if served >> t & 1 else max(ready[t], now)
    for a in range(n):
        longest = work.idle_way[a] if last[a] < 0 else work.home[a, last[a]]
        for t in range(m):
            if not served >> t & 1:
                leg = (work.start[a, t] if last[a] < 0
                       else work.between[work.classes[a], last[a], t])
                if leg < NEVER:  # where there is no way there is nothing to be late for
                    longest = max(longest, leg)
        clock[a] = max(clock[a], now - longest)


@njit(cache=True, nogil=True)
def expand(work, tables, aim, old, begin, at, end, new, count, heads, upper, final, space, tries):
    """Labels `begin` to `end` of a layer served one more target each; the first from team `at` on.

    Returns (next label to expand, its next team, labels in the new layer, upper). Stops early
    where the new layer is full, and after so many tries. A whole plan better than `upper` is
    written to `final` [3]: parent, target, team.
    """
    n, m = work.start.shape
    full = (1 << m) - 1
    most = 0
    for t in range(m):
        most = max(most, tables.first[t + 1])
    for i in range(begin, end):
        if count + most >= new.served.shape[0]:
            return i, at, count, upper
        if old.dead[i] or old.bound[i] >= upper:
            at = 0
            continue
        served = old.served[i]
        for t in range(m):
            if served >> t & 1 or tables.behind[t] & ~served:
                continue
            for c in range(max(tables.first[t], at), tables.first[t + 1]):
                tries -= 1
                if tries < 0:
                    return i, c, count, upper
                mask = tables.mask[c]
                when, way, fair = old.ready[i, t], 0.0, True
                for a in range(n):
                    if mask >> a & 1:
                        leg = work.start[a, t] if old.last[i, a] < 0 else (
                            work.between[work.classes[a], old.last[i, a], t])
                        when = max(when, old.clock[i, a] + leg)
                        way += work.effort[a] * leg
                        b = tables.twin[a]
                        if leg >= NEVER or (b >= 0 and old.last[i, a] < 0 and old.last[i, b] < 0
                                            and not mask >> b & 1):
                            fair = False
                            break
                if not fair or when > work.late[t] or (
                        when < old.now[i] and not aim.timeless) or when >= NEVER:
                    continue
                new.served[count] = served | 1 << t
                new.now[count] = when
                new.effort[count] = old.effort[i] + way
                new.parent[count], new.target[count], new.team[count] = i, t, c
                for a in range(n):
                    inside = mask >> a & 1
                    new.last[count, a] = t if inside else old.last[i, a]
                    new.clock[count, a] = when + work.service[t] if inside else old.clock[i, a]
                for k in range(m):
                    new.ready[count, k] = old.ready[i, k]
                for e in range(work.first_then[t], work.first_then[t + 1]):
                    k = work.then[e]
                    new.ready[count, k] = max(new.ready[count, k], when + work.service[t])
                bound = estimate(work, tables, aim, new.served[count], new.last[count],
                                 new.clock[count], new.ready[count], 0 if aim.timeless else when,
                                 new.effort[count], space)
                if bound >= upper:
                    continue
                if served | 1 << t == full:
                    cost = whole(work, aim, new.last[count], new.clock[count], new.effort[count])
                    if cost < upper:
                        upper = cost
                        final[0], final[1], final[2] = i, t, c
                    continue
                if not aim.timeless:
                    raise_clocks(work, new.served[count], new.last[count], new.clock[count],
                                 new.ready[count], when)
                new.bound[count] = max(bound, old.bound[i])
                count = admit(new, count, heads, aim)
        at = 0
    return end, 0, count, upper


@njit(cache=True, nogil=True)
def whole(work, aim, last, clock, way):
    """Cost of a whole schedule; infinity beyond the limit."""
    span = work.floor
    for a in range(clock.shape[0]):
        leg = work.idle_way[a] if last[a] < 0 else work.home[a, last[a]]
        if leg >= NEVER:
            return np.inf
        span = max(span, clock[a] + leg)
        way += work.effort[a] * leg
    if span > work.limit or span >= NEVER:
        return np.inf
    return aim.alpha * span + aim.beta * way
