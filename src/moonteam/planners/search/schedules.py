"""Exact search for joint schedules, compiled with Numba.

Legend: N agents, M open targets (at most 30 by the bit masks; tables grow as 2^M), K kinds,
B table bits. A set of targets is a bit mask. Times are steps; `UNREACHABLE` means no way.

The problem: every target needs a coalition of agents in its cell at the same time (any one
sharing agent for OR; agents that together have all skills for AND); minimise
alpha * makespan + beta * moves. A plan is fixed by three choices: which agents visit each
target, in which order each agent makes its visits, and nothing else, since waiting is free
and everybody walks at once.

How it is searched:
1. `suffix_table`: for each kind the shortest open path from every target through every set.
   With it, the shortest way of an agent through any set of targets is one look-up.
2. `cover_tables`: dynamic programme over the agents in turn and the set of needs still open.
   It knows who must visit what, but not that a coalition must meet at one time: so its values
   are lower bounds, and exact wherever no coalition is larger than one. It is done for
   makespan and for moves; the latter counts only agents' ways no longer than a cap on the
   makespan, which any plan better than the threshold must keep.
3. `search`: depth first over the agents' sets of targets under that bound. Where agents
   share targets, `sequence` chooses the order of the meetings and what each agent does
   between them, in order of meeting time, under the bound of every agent's shortest way
   through what it still has to visit.
4. `solve`: thresholds just above the lower bound, doubled until a plan is found below; the
   first found search that ends has proved its plan the best.

All loops are iterative: a self-recursive function under Numba's on-disk cache is not safe
when two processes share it.
"""

from __future__ import annotations

import numpy as np

from moonteam.compilation import njit
from moonteam.planners.search.travel import UNREACHABLE

OPTIMAL, FEASIBLE, NONE = 0, 1, 2
"""Outcome of `solve`: proved best; stopped early with a plan; no plan found."""

_EPS = 1e-9


@njit(cache=True, nogil=True)
def suffix_table(between):
    """Shortest open paths [K, 2^M, M]: from target i through the set V (i not in V), any end."""
    kinds, m = between.shape[0], between.shape[1]
    table = np.full((kinds, 1 << m, m), UNREACHABLE, np.int32)
    for k in range(kinds):
        for i in range(m):
            table[k, 0, i] = 0
        for v in range(1, 1 << m):
            for j in range(m):
                if v >> j & 1:
                    onward = table[k, v ^ (1 << j), j]
                    for i in range(m):
                        if not v >> i & 1:
                            length = between[k, i, j] + onward
                            if length < table[k, v, i]:
                                table[k, v, i] = length
    return table


@njit(cache=True, nogil=True)
def segment_table(between):
    """Shortest paths [K, 2^M, M, M] from target i through the set X to target j."""
    kinds, m = between.shape[0], between.shape[1]
    table = np.full((kinds, 1 << m, m, m), UNREACHABLE, np.int32)
    for k in range(kinds):
        table[k, 0] = between[k]
        for x in range(1, 1 << m):
            for f in range(m):
                if x >> f & 1:
                    rest = x ^ (1 << f)
                    for i in range(m):
                        if not x >> i & 1:
                            for j in range(m):
                                if not x >> j & 1:
                                    length = between[k, i, f] + table[k, rest, f, j]
                                    if length < table[k, x, i, j]:
                                        table[k, x, i, j] = length
    return table


@njit(cache=True, nogil=True)
def way_lengths(start, kinds, skills, need, suffix):
    """Shortest way [N, 2^M] of each agent through each set it may be asked to visit."""
    n, m = start.shape
    lengths = np.full((n, 1 << m), UNREACHABLE, np.int32)
    for a in range(n):
        useful = 0
        for t in range(m):
            if skills[a] & need[t] and start[a, t] < UNREACHABLE:
                useful |= 1 << t
        lengths[a, 0] = 0
        for v in range(1, 1 << m):
            if v & ~useful:
                continue
            for j in range(m):
                if v >> j & 1:
                    length = start[a, j] + suffix[kinds[a], v ^ (1 << j), j]
                    if length < lengths[a, v]:
                        lengths[a, v] = length
    return lengths


@njit(cache=True, nogil=True)
def table_bits(start, skills, need, both, limit):
    """The needs that `cover_tables` tracks: (target [B], skills [B]) of each bit.

    One bit for every OR target and one for each skill of an AND target, as long as there are
    no more than `limit`; then an AND target keeps only the skill that fewest agents offer,
    which leaves the tables lower bounds.
    """
    n, m = start.shape
    targets = np.empty(8 * m, np.int32)
    wanted = np.empty(8 * m, np.int32)
    count = 0
    spare = limit - m
    for t in range(m):
        if not both[t]:
            targets[count], wanted[count] = t, need[t]
            count += 1
            continue
        extra = -1
        rarest, fewest = 0, n + 1
        for b in range(8):
            if need[t] >> b & 1:
                extra += 1
                holders = 0
                for a in range(n):
                    holders += (skills[a] >> b & 1) and start[a, t] < UNREACHABLE
                if holders < fewest:
                    rarest, fewest = 1 << b, holders
        if extra > spare:
            targets[count], wanted[count] = t, rarest
            count += 1
            continue
        spare -= extra
        for b in range(8):
            if need[t] >> b & 1:
                targets[count], wanted[count] = t, 1 << b
                count += 1
    return targets[:count].copy(), wanted[:count].copy()


@njit(cache=True, nogil=True)
def coverage(skills, m, bit_target, bit_skills):
    """Per agent: bits covered by visiting a set [N, 2^M]; targets useful for bits [N, 2^B]."""
    n, bits = skills.shape[0], bit_target.shape[0]
    covered = np.zeros((n, 1 << m), np.int32)
    useful = np.zeros((n, 1 << bits), np.int32)
    for a in range(n):
        for b in range(bits):
            if skills[a] & bit_skills[b]:
                covered[a, 1 << bit_target[b]] |= 1 << b
        for v in range(1, 1 << m):
            covered[a, v] = covered[a, v & (v - 1)] | covered[a, v & -v]
        for b in range(bits):
            if skills[a] & bit_skills[b]:
                useful[a, 1 << b] = 1 << bit_target[b]
        for u in range(1, 1 << bits):
            useful[a, u] = useful[a, u & (u - 1)] | useful[a, u & -u]
    return covered, useful


@njit(cache=True, nogil=True)
def cover_tables(lengths, covered, useful, cap, least_max, least_sum):
    """Fills lower bounds [N + 1, 2^B] of makespan and moves for agents a.. to cover bits u.

    Only ways of at most `cap` steps count. Row 0 is filled for the full set alone.
    """
    n = lengths.shape[0]
    full = useful.shape[1] - 1
    least_max[n, :] = UNREACHABLE
    least_sum[n, :] = UNREACHABLE
    least_max[n, 0] = 0
    least_sum[n, 0] = 0
    for a in range(n - 1, -1, -1):
        first = full if a == 0 else 0
        for u in range(first, full + 1):
            offer = useful[a, u]
            top, total = UNREACHABLE, UNREACHABLE
            v = offer
            while True:
                length = lengths[a, v]
                if length <= cap:
                    left = u & ~covered[a, v]
                    top = min(top, max(length, least_max[a + 1, left]))
                    total = min(total, length + least_sum[a + 1, left])
                if v == 0 or a == n - 1:
                    break
                v = (v - 1) & offer
            least_max[a, u] = top
            least_sum[a, u] = total


@njit(cache=True, nogil=True)
def _first_leg(start, segments, agent, kind, x, goal):
    """Shortest way from the agent's start through the set x to the target `goal`."""
    if x == 0:
        return start[agent, goal]
    best = UNREACHABLE
    for j in range(start.shape[1]):
        if x >> j & 1:
            best = min(best, start[agent, j] + segments[kind, x ^ (1 << j), j, goal])
    return best


@njit(cache=True, nogil=True)
def _member(sets, n, target, rank):
    """The agent of that rank among those that visit the target; -1 past the last."""
    for a in range(n):
        if sets[a] >> target & 1:
            if rank == 0:
                return a
            rank -= 1
    return -1


@njit(cache=True, nogil=True)
def _next_bit(mask, after):
    """The lowest bit of `mask` above `after`, or -1."""
    for b in range(after + 1, 31):
        if mask >> b & 1:
            return b
    return -1


@njit(cache=True, nogil=True)
def sequence(start, kinds, suffix, segments, lengths, sets, n, shared, floor_max, floor_sum,
             alpha, beta, upper, cap, nodes, limit, legs):
    """The best order of meetings for fixed sets of targets, if better than `upper`.

    A leg is (meeting target, agent, set the agent visits on its way there). Meetings are
    taken in order of time. `floor_*` are lower bounds from elsewhere (agents not decided yet).
    Returns (value, makespan, moves, number of legs, nodes); the value is `upper` if nothing
    better was found. Fills `legs` [*, 3] with the best.
    """
    depth = 1
    for a in range(n):
        for t in range(start.shape[1]):
            depth += (shared & sets[a]) >> t & 1
    clock = np.zeros((depth, n), np.int32)
    walked = np.zeros((depth, n), np.int32)
    tail = np.zeros((depth, n), np.int32)
    last = np.full((depth, n), -1, np.int32)
    rest = np.zeros((depth, n), np.int32)
    left = np.zeros(depth, np.int32)
    now = np.zeros(depth, np.int32)
    rank = np.zeros(depth, np.int32)
    goal = np.full(depth, -1, np.int32)
    visit = np.full(depth, -1, np.int32)
    trail = np.zeros((depth, 3), np.int32)
    best, best_max, best_sum, count = upper, 0, 0, 0
    left[0] = shared
    for a in range(n):
        rest[0, a] = sets[a]
        tail[0, a] = lengths[a, sets[a]]
    goal[0] = _next_bit(shared, -1)
    visit[0] = rest[0, _member(sets, n, goal[0], 0)] & ~shared
    p = 0
    while p >= 0 and nodes < limit:
        if goal[p] < 0:
            p -= 1
            continue
        nodes += 1
        t, x = goal[p], visit[p]
        a = _member(sets, n, t, rank[p])
        if x != 0:
            visit[p] = (x - 1) & (rest[p, a] & ~shared)
        elif rank[p] == 0:
            goal[p] = _next_bit(left[p], t)
            if goal[p] >= 0:
                visit[p] = rest[p, _member(sets, n, goal[p], 0)] & ~shared
        else:
            goal[p] = -1
        if last[p, a] < 0:
            leg = _first_leg(start, segments, a, kinds[a], x, t)
        else:
            leg = segments[kinds[a], x, last[p, a], t]
        q = p + 1
        for b in range(n):
            clock[q, b], walked[q, b], tail[q, b] = clock[p, b], walked[p, b], tail[p, b]
            last[q, b], rest[q, b] = last[p, b], rest[p, b]
        clock[q, a] += leg
        walked[q, a] += leg
        last[q, a] = t
        rest[q, a] &= ~(x | 1 << t)
        tail[q, a] = suffix[kinds[a], rest[q, a], t]
        left[q], now[q], rank[q], goal[q] = left[p], now[p], rank[p] + 1, t
        partner = _member(sets, n, t, rank[q])
        if partner < 0:
            meeting = 0
            for b in range(n):
                if sets[b] >> t & 1:
                    meeting = max(meeting, clock[q, b])
            if meeting < now[p]:
                continue
            for b in range(n):
                if sets[b] >> t & 1:
                    clock[q, b] = meeting
            left[q] &= ~(1 << t)
            now[q] = meeting
        top, total = floor_max, floor_sum
        for b in range(n):
            top = max(top, clock[q, b] + tail[q, b])
            total += walked[q, b] + tail[q, b]
        if top > cap or alpha * top + beta * total >= best - _EPS:
            continue
        trail[p, 0], trail[p, 1], trail[p, 2] = t, a, x
        if partner < 0 and left[q] == 0:
            best, best_max, best_sum, count = alpha * top + beta * total, top, total, q
            legs[:q] = trail[:q]
            continue
        if partner < 0:
            rank[q] = 0
            goal[q] = _next_bit(left[q], -1)
            partner = _member(sets, n, goal[q], 0)
        visit[q] = rest[q, partner] & ~shared
        p = q
    return best, best_max, best_sum, count, nodes


@njit(cache=True, nogil=True)
def _shared(sets, n):
    """Targets that lie in two or more of the first n sets."""
    once, twice = 0, 0
    for a in range(n):
        twice |= once & sets[a]
        once |= sets[a]
    return twice


@njit(cache=True, nogil=True)
def search(start, kinds, skills, need, both, suffix, segments, lengths, covered, useful,
           least_max, least_sum, alpha, beta, upper, cap, nodes, limit, best_sets, best_legs):
    """Depth first over the agents' sets of targets, for plans better than `upper`.

    Returns (value, makespan, moves, number of legs, nodes); the value is `upper` if no plan
    is better. Fills `best_sets` [N] and `best_legs`.
    """
    n, m = start.shape
    full = useful.shape[1] - 1
    sets = np.zeros(n, np.int32)
    offer = np.zeros(n, np.int32)
    choice = np.full(n, -1, np.int32)
    bits = np.zeros(n + 1, np.int32)
    top = np.zeros(n + 1, np.int32)
    total = np.zeros(n + 1, np.int32)
    open_need = np.zeros((n + 1, m), np.int32)
    legs = np.zeros_like(best_legs)
    best, best_max, best_sum, best_count = upper, 0, 0, 0
    open_need[0] = need
    bits[0] = full
    for t in range(m):
        if skills[0] & need[t]:
            offer[0] |= 1 << t
    choice[0] = offer[0]
    a = 0
    while a >= 0 and nodes < limit:
        v = choice[a]
        if v < 0:
            a -= 1
            continue
        nodes += 1
        choice[a] = -1 if v == 0 or a == n - 1 else (v - 1) & offer[a]
        length = lengths[a, v]
        u = bits[a] & ~covered[a, v]
        high = max(top[a], length, least_max[a + 1, u])
        low_sum = total[a] + length + least_sum[a + 1, u]
        if high > cap or alpha * high + beta * low_sum >= best - _EPS:
            continue
        sets[a] = v
        unmet = 0
        for t in range(m):
            now = open_need[a, t]
            if v >> t & 1:
                now = now & ~skills[a] if both[t] else 0
            open_need[a + 1, t] = now
            unmet |= (now != 0) << t
        meet = _shared(sets, a + 1) & ~unmet
        if a == n - 1:
            if unmet:
                continue
            if meet == 0:
                best, best_max, best_sum = alpha * high + beta * low_sum, high, low_sum
                best_count = 0
                best_sets[:] = sets
                continue
            value, high, low_sum, count, nodes = sequence(
                start, kinds, suffix, segments, lengths, sets, n, meet, 0, 0,
                alpha, beta, best, cap, nodes, limit, legs)
            if value < best - _EPS:
                best, best_max, best_sum, best_count = value, high, low_sum, count
                best_sets[:] = sets
                best_legs[:count] = legs[:count]
            continue
        bits[a + 1] = u
        top[a + 1] = max(top[a], length)
        total[a + 1] = total[a] + length
        a += 1
        offer[a] = 0
        for t in range(m):
            if skills[a] & open_need[a, t]:
                offer[a] |= 1 << t
        choice[a] = offer[a]
    return best, best_max, best_sum, best_count, nodes


@njit(cache=True, nogil=True)
def _append_path(start, between, suffix, segments, agent, kind, at, x, goal, route, count):
    """Appends the targets of x to a route in the shortest order, then `goal` if there is one."""
    m = start.shape[1]
    while x:
        best, pick = UNREACHABLE * 4, -1
        for j in range(m):
            if x >> j & 1:
                onward = x ^ (1 << j)
                length = start[agent, j] if at < 0 else between[kind, at, j]
                length += suffix[kind, onward, j] if goal < 0 else segments[kind, onward, j, goal]
                if length < best:
                    best, pick = length, j
        route[count] = pick
        count += 1
        at = pick
        x ^= 1 << pick
    if goal >= 0:
        route[count] = goal
        count += 1
    return count


@njit(cache=True, nogil=True)
def write_routes(start, between, kinds, suffix, segments, sets, legs, count, routes):
    """Fills `routes` [N, M]: each agent's targets in order of visit, then -1."""
    routes[:, :] = -1
    for a in range(start.shape[0]):
        at, rest, length = -1, sets[a], 0
        for i in range(count):
            if legs[i, 1] == a:
                goal, x = legs[i, 0], legs[i, 2]
                length = _append_path(start, between, suffix, segments, a, kinds[a], at, x, goal,
                                      routes[a], length)
                rest &= ~(x | 1 << goal)
                at = goal
        _append_path(start, between, suffix, segments, a, kinds[a], at, rest, -1,
                     routes[a], length)


@njit(cache=True, nogil=True)
def _meetings_possible(skills, need, both):
    """Whether some target may need agents to meet: an AND that some agent has only in part."""
    for t in range(need.shape[0]):
        for a in range(skills.shape[0]):
            part = skills[a] & need[t]
            if both[t] and part != 0 and part != need[t]:
                return True
    return False


@njit(cache=True, nogil=True)
def solve(start, between, kinds, skills, need, both, alpha, beta, horizon, lower, upper, limit,
          routes):
    """The plan of least alpha * makespan + beta * moves, makespan at most `horizon`.

    Args:
      start: [N, M] int32 steps from each agent to each open target.
      between: [K, M, M] int32 steps between targets, per kind.
      kinds: [N] int32 index into `between`.
      skills: [N] int32 bit masks.
      need: [M] int32 bit masks, non-zero, cut to the skills that matter.
      both: [M] bool, AND targets.
      alpha: weight of the makespan, >= 0.
      beta: weight of the moves, >= 0; one of the two is > 0.
      horizon: longest makespan allowed.
      lower: a lower bound already proved (0 if none).
      upper: only plans of lesser value are looked for (infinity if none is known).
      limit: most search nodes before it gives up.
      routes: [N, M] int32, filled with each agent's targets in order, then -1.

    Returns:
      (outcome, makespan, moves, lower bound of the value). With FEASIBLE the routes are those
      of the best plan found; with NONE there are none below `upper`, and unless the search was
      cut short (bound < upper and horizon not the reason) none exist.
    """
    n, m = start.shape
    suffix = suffix_table(between)
    if _meetings_possible(skills, need, both):
        segments = segment_table(between)
    else:
        segments = np.zeros((1, 1, 1, 1), np.int32)
    lengths = way_lengths(start, kinds, skills, need, suffix)
    bit_target, bit_skills = table_bits(start, skills, need, both, min(m + 3, max(m, 14)))
    covered, useful = coverage(skills, m, bit_target, bit_skills)
    least_max = np.empty((n + 1, useful.shape[1]), np.int32)
    least_sum = np.empty((n + 1, useful.shape[1]), np.int32)
    best_sets = np.zeros(n, np.int32)
    best_legs = np.zeros((n * m + 1, 3), np.int32)
    full = useful.shape[1] - 1
    cap = horizon
    cover_tables(lengths, covered, useful, cap, least_max, least_sum)
    loose_max, loose_sum = least_max[0, full], least_sum[0, full]
    if loose_max > horizon or loose_sum >= UNREACHABLE:
        return NONE, 0, 0, np.inf
    lower = max(lower, alpha * loose_max + beta * loose_sum)
    highest = min(upper, alpha * horizon + beta * n * horizon + 1.0)
    rise = alpha if alpha > 0 else beta
    nodes = 0
    while lower < highest - _EPS and nodes < limit:
        threshold = min(highest, lower + rise)
        wanted = horizon
        if alpha > 0:
            room = (threshold - beta * loose_sum) / alpha
            wanted = min(horizon, int(np.ceil(room - 1e-6)) - 1)
        if wanted != cap:
            cap = wanted
            cover_tables(lengths, covered, useful, cap, least_max, least_sum)
        value, top, total, count, nodes = search(
            start, kinds, skills, need, both, suffix, segments, lengths, covered, useful,
            least_max, least_sum, alpha, beta, threshold, cap, nodes, limit,
            best_sets, best_legs)
        if value < threshold - _EPS:
            write_routes(start, between, kinds, suffix, segments, best_sets, best_legs, count,
                         routes)
            if nodes < limit:
                return OPTIMAL, top, total, value
            return FEASIBLE, top, total, lower
        if nodes < limit:
            lower = threshold
            rise *= 2
    if nodes < limit and lower >= alpha * horizon + beta * n * horizon:
        lower = np.inf
    return NONE, 0, 0, lower
