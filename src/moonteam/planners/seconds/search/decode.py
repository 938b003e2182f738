"""From a list of targets to a schedule: when each service starts, and who serves. For Numba.

A plan is a list of targets, each with its team; every agent serves its targets in the order of the
list, as early as it can, so no two can wait for each other for ever. A target whose team is empty
gets one on the way: those who are there first.

Legend: N agents, M targets, P places in a team.
"""

from __future__ import annotations

import numpy as np

from moonteam.compilation import LOOP, njit

MANY = 1 << 60
"""ms later than anything."""


@njit(**LOOP)
def choose(work, t, last, clock, when, near, noise, team, reach, want):
    """Fills `team` [P] with agents that are at target t early; returns how many, 0 if nobody can.

    Agents are taken by their time of arrival, their way counted `near` times more, and up to
    `noise` ms of luck. With `near` below 0, by their arrival alone, and then those are taken
    instead who are free last but still there in time: no sooner than `when` the target waits.
    """
    start, between, classes = work.start, work.between, work.classes
    first, able = work.first_able, work.able
    if not work.single:
        return gather(work, t, last, clock, when, near, noise, team, reach, want)
    size = 0
    at = np.uint64(t)  # without a sign no index is looked at for being negative
    for e in range(work.first_need[t], work.first_need[t + 1]):
        s = work.needed[e]
        low, wanted = size, work.need[t, s]
        for q in range(first[s], first[s + 1]):
            a = np.uint64(able[q])
            leg = start[a, at] if last[a] < 0 else (
                between[np.uint64(classes[a]), np.uint64(last[a]), at])
            there = clock[a] + leg
            if near > 0.0 or noise > 0.0:
                there += int(near * leg + noise * np.random.random())
            reach[a] = there
            k = size
            if k == low + wanted:
                if there >= reach[team[k - 1]]:
                    continue
                k -= 1
            else:
                size += 1
            while k > low and reach[team[k - 1]] > there:
                team[k] = team[k - 1]
                k -= 1
            team[k] = able[q]
        if size < low + wanted:
            return 0
        if wanted > 0:
            when = max(when, reach[team[size - 1]])
    if near < 0.0:
        low = 0
        for e in range(work.first_need[t], work.first_need[t + 1]):
            s = work.needed[e]
            low = fit(clock, when, team, low, low + work.need[t, s], reach, able, first[s],
                      first[s + 1])
    return size


@njit(**LOOP)
def fit(clock, when, team, low, high, reach, able, first, stop):
    """Fills places `low` to `high` of the team with those who are free last but there in time."""
    size = low
    for q in range(first, stop):
        a = able[q]
        if reach[a] > when:
            continue
        k = size
        if k == high:
            if clock[a] <= clock[team[k - 1]]:
                continue
            k -= 1
        else:
            size += 1
        while k > low and clock[team[k - 1]] < clock[a]:
            team[k] = team[k - 1]
            k -= 1
        team[k] = a
    return high


@njit(**LOOP)
def gather(work, t, last, clock, when, near, noise, team, reach, want):
    """As `choose`, for agents with several skills."""
    has, need, start, between, classes = (work.has, work.need, work.start, work.between,
                                          work.classes)  # looked up once: each look-up is counted
    either, kind = work.either[t], work.kind
    n, skills = has.shape
    for a in range(n):
        reach[a] = MANY
        for e in range(work.first_need[t], work.first_need[t + 1]):
            if has[a, work.needed[e]]:
                leg = start[a, t] if last[a] < 0 else between[classes[a], last[a], t]
                reach[a] = clock[a] + leg
                if noise > 0.0 or near > 0.0:
                    reach[a] += int(near * leg + noise * np.random.random())
                break
    for s in range(skills):
        want[s] = need[t, s]
    size = 0
    while True:
        best, pick = MANY, -1
        for a in range(n):
            if reach[a] < best:
                for e in range(work.first_need[t], work.first_need[t + 1]):
                    s = work.needed[e]
                    if has[a, s] and want[s] > 0:
                        best, pick = reach[a], a
                        break
        if pick < 0:
            return 0
        team[size] = pick
        size += 1
        when = max(when, best)
        reach[pick] = MANY
        left = False
        for e in range(work.first_need[t], work.first_need[t + 1]):
            s = work.needed[e]
            if has[pick, s]:
                want[s] -= 1
            left |= want[s] > 0
        if either or not left:
            break
    if size > 1 and work.first_need[t + 1] - work.first_need[t] > 1:
        size = spare(work, t, team, size)
    if near < 0.0:
        for k in range(size):
            a = team[k]
            for b in range(n):
                if kind[b] == kind[a] and reach[b] <= when and clock[b] > clock[team[k]]:
                    team[k] = b
            if team[k] != a:
                reach[team[k]] = MANY
    return size


@njit(**LOOP)
def spare(work, t, team, size):
    """Takes those out of the team who are not needed, the last to come first; returns its size."""
    for i in range(size - 1, -1, -1):
        if size > 1 and enough(work, t, team, size, i, -1):
            for j in range(i, size - 1):
                team[j] = team[j + 1]
            size -= 1
    return size


@njit(**LOOP)
def enough(work, t, team, size, without, instead):
    """Whether the team is what target t needs, place `without` taken by agent `instead` or none."""
    has, need, either = work.has, work.need, work.either[t]
    for s in range(has.shape[1]):
        if need[t, s] > 0:
            number = 0
            for i in range(size):
                a = instead if i == without else team[i]
                if a >= 0 and has[a, s]:
                    number += 1
            if either:
                if number > 0:
                    return True
            elif number < need[t, s]:
                return False
    return not either
