"""Large-neighbourhood search: what is taken out of a plan, and how it is put back. For Numba.

Legend: N agents, M targets, S most members of a coalition, W ways to take out, B ways to put back,
G what is known of the search as a whole.

A `Guide` decides both, by chance: its weights say how likely each way is at this moment of the
search, how much is taken out, where that begins, what goes with it, and in which order all comes
back. `guides` tells where guides come from.
"""

from __future__ import annotations

import math
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np

from moonteam.compilation import LOOP, njit
from moonteam.planners.search.insertion import (
    SOME,
    Ways,
    best_place,
    empty,
    insert_all,
    measure,
    price,
    put,
)
from moonteam.planners.search.teams import Teams
from moonteam.planners.search.travel import UNREACHABLE

W, B, G = 4, 3, 4
SHAPES = {"ways": (W, G), "size": (W, 3), "seed": (W, 5), "near": (W, 9), "back": (B, G),
          "row": (6,), "place": (4, G), "heat": (2, G)}
"""Of a guide's weights, in the order in which they stand in its vector."""
_ENDS = tuple(accumulate(math.prod(shape) for shape in SHAPES.values()))
DRAWN = 3
"""Events that the one is chosen from at which taking out begins."""


class Guide(NamedTuple):
    """The weights of a policy over what the search does; rows of G are linear in `moment`."""

    ways: Any  # [W, G] logits of the ways to take out
    size: Any  # [W, 3] log of the most taken out with 40 targets; by log of targets / 40, by share
    seed: Any  # [W, 5] of an event: slack, detour, wait, time; logit of: it must be critical
    near: Any  # [W, 9] of an event: way from the seed, slack, time apart, no agent in common,
    #   detour, wait, members, luck, critical; those of the least sum are taken out
    back: Any  # [B, G] logits: with regret, cheapest first, in a row
    row: Any  # [6] of a target: coalitions, members, slack, detour, time, luck; the least first
    place: Any  # [4, G] weight of the chain through a place, logit of noise, log of how much, log
    #   of how much more a move weighs than in the cost
    heat: Any  # [2, G] log of the temperature, in steps (or moves), at the beginning and the end


class Look(NamedTuple):
    """The plan that is to be changed, by events, as its guide looks at it."""

    slack: Any  # [M] steps its chain is shorter than the longest
    detour: Any  # [M] steps that its members walk for it
    wait: Any  # [M] steps that its members wait at it
    at: Any  # [M] step at which it happens
    score: Any  # [M] to work in


@njit(cache=True, nogil=True)
def guide_of(vector):
    """A guide of its vector, the shapes one after the other."""
    return Guide(
        vector[:_ENDS[0]].reshape((W, G)), vector[_ENDS[0]:_ENDS[1]].reshape((W, 3)),
        vector[_ENDS[1]:_ENDS[2]].reshape((W, 5)), vector[_ENDS[2]:_ENDS[3]].reshape((W, 9)),
        vector[_ENDS[3]:_ENDS[4]].reshape((B, G)), vector[_ENDS[4]:_ENDS[5]],
        vector[_ENDS[5]:_ENDS[6]].reshape((4, G)), vector[_ENDS[6]:].reshape((2, G)))


@njit(cache=True, nogil=True)
def of_moment(agents, targets):
    """[G] what is known of the search: 1, share done less a half, logs of targets, by agents."""
    return np.array([1.0, -0.5, np.log(targets / 40.0), np.log(targets / (5.0 * agents))])


@njit(**LOOP)
def weigh(weights, moment):
    """A weighted sum of what is known."""
    total = 0.0
    for i in range(moment.shape[0]):
        total += weights[i] * moment[i]
    return total


@njit(**LOOP)
def drawn(logits, moment):
    """One of the rows of logits [*, G], by chance."""
    whole, top = 0.0, -np.inf
    for i in range(logits.shape[0]):
        top = max(top, weigh(logits[i], moment))
    for i in range(logits.shape[0]):
        whole += np.exp(weigh(logits[i], moment) - top)
    left = np.random.random() * whole
    for i in range(logits.shape[0]):
        left -= np.exp(weigh(logits[i], moment) - top)
        if left < 0.0:
            return i
    return logits.shape[0] - 1


@njit(**LOOP)
def size_of(teams, coalition):
    """Its members."""
    size = 0
    for s in range(teams.members.shape[1]):
        size += teams.members[coalition, s] >= 0
    return size


@njit(**LOOP)
def mean_way(ways):
    """Steps between two targets in the mean, of those that have a way."""
    total, count = 0, 0
    for k in range(ways.between.shape[0]):
        for i in range(ways.between.shape[1]):
            for j in range(ways.between.shape[2]):
                if ways.between[k, i, j] < UNREACHABLE:
                    total += ways.between[k, i, j]
                    count += 1
    return max(1.0, total / max(1, count))


@njit(**LOOP)
def look_at(ways, teams, line, makespan, look):
    """Fills what a guide sees of a whole plan that is measured."""
    size = teams.members.shape[1]
    order, crew, head, tail, onward, _, space = line
    last = space[0]
    last[:] = -1
    for i in range(order.shape[0]):
        t, detour, wait = order[i], 0, 0
        for s in range(size):
            a = teams.members[crew[i], s]
            if a < 0:
                break
            before, after, kind = last[a], onward[i, s], ways.kinds[a]
            if before < 0:
                way, free = ways.start[a, t], 0
            else:
                way, free = ways.between[kind, order[before], t], head[before]
            detour += way
            if after >= 0:
                detour += ways.between[kind, t, order[after]]
                detour -= (ways.start[a, order[after]] if before < 0
                           else ways.between[kind, order[before], order[after]])
            wait += head[i] - free - way
            last[a] = i
        look.slack[i] = makespan - head[i] - tail[i]
        look.detour[i], look.wait[i], look.at[i] = detour, wait, head[i]


@njit(**LOOP)
def choose_removed(guide, moment, teams, ways, order, crew, look, stride, removed):
    """Marks the events to take out in `removed` [M]; returns how many. `stride`: steps of a
    mean way.
    """
    m = order.shape[0]
    removed[:] = False
    way = drawn(guide.ways, moment)
    most = np.exp(guide.size[way, 0] + guide.size[way, 1] * moment[2]
                  + guide.size[way, 2] * moment[1])
    most = max(2.0, min(most, (2 * m) // 3))
    wanted = min(m, 1 + int(most * np.random.random()))
    lean = guide.seed[way]
    seed, highest = 0, -np.inf
    critical = np.random.random() * (1.0 + np.exp(-lean[4])) < 1.0
    for _ in range(DRAWN):
        i = np.random.randint(m)
        tries = 0
        while critical and look.slack[i] > 0 and tries < 2 * m:
            i = np.random.randint(m)
            tries += 1
        value = (lean[0] * look.slack[i] + lean[1] * look.detour[i] + lean[2] * look.wait[i]
                 + lean[3] * look.at[i]) / stride + np.random.random()
        if value > highest:
            seed, highest = i, value
    mate = -1
    for s in range(teams.members.shape[1]):
        a = teams.members[crew[seed], s]
        if a < 0:
            break
        if mate < 0 or np.random.random() < 0.5:
            mate = a
    near, score = guide.near[way], look.score
    for i in range(m):
        apart = ways.between[0, order[seed], order[i]] * (0.5 + np.random.random())
        steps = (near[0] * apart + near[1] * look.slack[i]
                 + near[2] * abs(look.at[i] - look.at[seed]) + near[4] * look.detour[i]
                 + near[5] * look.wait[i])
        apart_from_mate = 1 - (teams.masks[crew[i]] >> mate & 1)
        score[i] = (steps / stride + near[3] * apart_from_mate
                    + near[6] * size_of(teams, crew[i]) + near[7] * np.random.random()
                    + near[8] * (look.slack[i] <= 0))
    score[seed] = -np.inf
    for _ in range(wanted):
        nearest = np.argmin(score)
        removed[nearest], score[nearest] = True, np.inf
    return wanted


@njit(**LOOP)
def take_out(guide, teams, order, crew, look, stride, removed, line, missing, key):
    """Fills `line` with the events that stay, and returns how many; the targets of the others go
    into `missing`, and into `key` when each is to come back, the least first.
    """
    row, length, out = guide.row, 0, 0
    for i in range(order.shape[0]):
        if not removed[i]:
            line.order[length], line.crew[length] = order[i], crew[i]
            length += 1
            continue
        t = order[i]
        choices = teams.first[t + 1] - teams.first[t]
        key[out] = ((row[2] * look.slack[i] + row[3] * look.detour[i] + row[4] * look.at[i])
                    / stride + row[5] * np.random.random() + row[0] * np.log(choices)
                    + row[1] * size_of(teams, crew[i]))
        missing[out] = t
        out += 1
    return length


@njit(**LOOP)
def insert_row(missing, key, ways, teams, line, length, alpha, beta, horizon, hold, noise):
    """`insert_all` in the order of `key`, the least first: each is looked at but once."""
    makespan, moves = measure(ways, teams, line, length)
    tried = length
    for _ in range(missing.shape[0]):
        i = np.argmin(key)
        key[i] = np.inf
        _, _, place, coalition = best_place(
            missing[i], ways, teams, line, length, makespan, moves, alpha, beta, horizon, hold,
            noise)
        put(line, length, place, missing[i], coalition)
        length += 1
        makespan, moves = measure(ways, teams, line, length)
        tried += 2 * length
    return length, makespan, moves, tried


@njit(cache=True, nogil=True)
def improve(guide, ways, teams, order, crew, alpha, beta, true_alpha, true_beta, horizon,
            unit, iterations, most, share, stop, seed, best_order, best_crew):
    """Large-neighbourhood search with annealed acceptance.

    Args:
      guide: what to do.
      ways, teams: travel times and coalitions.
      order, crew: [M] int32 the current list of events; changed in place.
      alpha, beta: weights that steer the search.
      true_alpha, true_beta: weights of the objective, by which the best is kept.
      horizon: longest makespan wanted.
      unit: what one step, or else one move, costs.
      iterations: how often to take out and put back, at most.
      most: places to try at most, which are what takes time; infinity for any number.
      share, stop: of the whole search that is done before, and after, these iterations.
      seed: of the random numbers.
      best_order, best_crew: [M] int32 the best list; read and overwritten.

    Returns:
      cost of the best list in the true objective.
    """
    np.random.seed(seed)
    n, m = ways.start.shape
    line, removed = empty(ways, teams), np.zeros(m, np.bool_)
    look = Look(np.zeros(m), np.zeros(m), np.zeros(m), np.zeros(m), np.zeros(m))
    moment = of_moment(n, m)
    stride = mean_way(ways)
    line.order[:], line.crew[:] = best_order, best_crew
    makespan, moves = measure(ways, teams, line, m)
    best = price(makespan, moves, true_alpha, true_beta, horizon)
    line.order[:], line.crew[:] = order, crew
    makespan, moves = measure(ways, teams, line, m)
    now = price(makespan, moves, alpha, beta, horizon)
    look_at(ways, teams, line, makespan, look)
    missing, key = np.empty(m, np.int32), np.empty(m)
    hot, cold = weigh(guide.heat[0], moment), weigh(guide.heat[1], moment)
    spent = 0
    for step in range(iterations):
        part = max(step / iterations, spent / most)
        if part >= 1.0:
            break
        done = share + (stop - share) * part
        moment[1] = done - 0.5
        warmth = unit * np.exp((1.0 - done) * hot + done * cold)
        count = choose_removed(guide, moment, teams, ways, order, crew, look, stride, removed)
        length = take_out(guide, teams, order, crew, look, stride, removed, line, missing, key)
        hold = alpha * max(0.0, weigh(guide.place[0], moment))
        noise = 0.0
        if np.random.random() * (1.0 + np.exp(-weigh(guide.place[1], moment))) < 1.0:
            noise = warmth * np.exp(weigh(guide.place[2], moment))
        light = beta * np.exp(weigh(guide.place[3], moment))
        back = drawn(guide.back, moment)
        if back == 2:
            length, makespan, moves, tried = insert_row(
                missing[:count], key[:count], ways, teams, line, length, alpha, light,
                horizon, hold, noise)
        else:
            length, makespan, moves, tried = insert_all(
                missing[:count], back == 0, ways, teams, line, length, alpha, light, horizon, hold,
                noise, SOME)
        spent += tried + 2 * m  # choosing and looking take time too
        cost = price(makespan, moves, alpha, beta, horizon)
        true_cost = price(makespan, moves, true_alpha, true_beta, horizon)
        if true_cost < best - 1e-9:
            best = true_cost
            best_order[:], best_crew[:] = line.order, line.crew
        if cost < now - warmth * np.log(1.0 - np.random.random()):
            now = cost
            order[:], crew[:] = line.order, line.crew
            look_at(ways, teams, line, makespan, look)
    return best


@njit(cache=True, nogil=True)
def _improved(vector, start, between, kinds, masks, first, members, having, begin, order, crew,
              alpha, beta, true_alpha, true_beta, horizon, unit, iterations, most, share, stop,
              seed, best_order, best_crew):
    return improve(guide_of(vector), Ways(start, between, kinds),
                   Teams(masks, first, members, having, begin), order, crew, alpha, beta,
                   true_alpha, true_beta, horizon, unit, iterations, most, share, stop, seed,
                   best_order, best_crew)


def improved(vector: Any, ways: Ways, teams: Teams, *rest) -> float:
    """`improve` with the guide of a vector, from Python: plain arrays, see `insertion`."""
    return _improved(vector, *ways, *teams, *rest)
