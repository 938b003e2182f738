"""From a list of targets to a schedule: when each service starts, and who serves. For Numba.

A plan is a list of targets, each with its team; every agent serves its targets in the order of the
list, as early as it can, so no two can wait for each other for ever. A target whose team is empty
gets one on the way: those who are there first.

Legend: N agents, M targets, P places in a team.
"""

from __future__ import annotations

import numpy as np
from numba import njit

MANY = 1 << 60
"""ms later than anything."""


@njit(cache=True, nogil=True)
def choose(work, t, last, clock, near, noise, team, reach, want):
    """Fills `team` [P] with agents that are at target t early; returns how many, 0 if nobody can.

    Agents are taken by their time of arrival, their way counted `near` times more, and up to
    `noise` ms of luck.
    """
    has, need, start, between, classes = (work.has, work.need, work.start, work.between,
                                          work.classes)  # looked up once: each look-up is counted
    either = work.either[t]
    n, skills = has.shape
    for a in range(n):
        reach[a] = MANY
        for s in range(skills):
            if has[a, s] and need[t, s] > 0:
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
                useful = False
                for s in range(skills):
                    if has[a, s] and want[s] > 0:
                        useful = True
                        break
                if useful:
                    best, pick = reach[a], a
        if pick < 0:
            return 0
        team[size] = pick
        size += 1
        reach[pick] = MANY
        left = False
        for s in range(skills):
            if has[pick, s]:
                want[s] -= 1
            left |= want[s] > 0
        if either:
            return size
        if not left:
            return spare(work, t, team, size) if size > 1 and skills > 1 else size


@njit(cache=True, nogil=True)
def spare(work, t, team, size):
    """Takes those out of the team who are not needed, the last to come first; returns its size."""
    for i in range(size - 1, -1, -1):
        if size > 1 and enough(work, t, team, size, i, -1):
            for j in range(i, size - 1):
                team[j] = team[j + 1]
            size -= 1
    return size


@njit(cache=True, nogil=True)
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
