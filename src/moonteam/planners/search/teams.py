"""The minimal coalitions that can solve each target, compiled with Numba.

Legend: N agents, M targets, C coalitions of all targets, S most members of one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from moonteam.compilation import njit
from moonteam.planners.base import BoolArray, IntArray
from moonteam.planners.search.travel import UNREACHABLE

MOST_COALITIONS = 512
"""Coalitions considered for one target; beyond them only the first found are used."""


class Teams(NamedTuple):
    """The minimal coalitions of every target."""

    masks: IntArray  # [C] int64 of agents
    first: IntArray  # [M + 1] first of a target
    members: IntArray  # [C, S] agents, padded by -1
    having: IntArray  # coalitions by target and agent
    begin: IntArray  # [M N + 1] first in `having` of those of target t with agent a, at t N + a


@njit(cache=True, nogil=True)
def coalitions(start, skills, need, both):
    """The minimal coalitions of all targets, `Teams`."""
    n, m = start.shape
    masks = np.empty(m * MOST_COALITIONS, np.int64)
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
                masks[count] = np.int64(1) << able[i]
                count += 1
        else:
            count = _teams(skills, need[t], able[:number], team, masks, count)
        first[t + 1] = count
    return _indexed(masks[:count].copy(), first, n)


@njit(cache=True, nogil=True)
def _indexed(masks, first, n):
    """Coalitions with their members listed, and listed by member."""
    m, count = len(first) - 1, len(masks)
    most, total = 1, 0
    for c in range(count):
        size = 0
        for a in range(n):
            size += masks[c] >> a & 1
        most, total = max(most, size), total + size
    members = np.full((count, most), -1, np.int32)
    begin = np.zeros(m * n + 1, np.int32)
    for t in range(m):
        for c in range(first[t], first[t + 1]):
            size = 0
            for a in range(n):
                if masks[c] >> a & 1:
                    members[c, size] = a
                    begin[t * n + a + 1] += 1
                    size += 1
    for i in range(m * n):
        begin[i + 1] += begin[i]
    having, put = np.empty(total, np.int32), begin.copy()
    for t in range(m):
        for c in range(first[t], first[t + 1]):
            for a in members[c]:
                if a >= 0:
                    having[put[t * n + a]] = c
                    put[t * n + a] += 1
    return Teams(masks, first, members, having, begin)


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
            have, mask = 0, np.int64(0)
            for k in range(size + 1):
                have |= skills[able[team[k]]]
                mask |= np.int64(1) << able[team[k]]
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
def _sizes(start, skills, need, both):
    teams = coalitions(start, skills, need, both)
    return len(teams.masks), teams.members.shape[1], len(teams.having)


@njit(cache=True, nogil=True)
def _fill(start, skills, need, both, masks, first, members, having, begin):
    teams = coalitions(start, skills, need, both)
    masks[:], first[:], members[:] = teams.masks, teams.first, teams.members
    having[:], begin[:] = teams.having, teams.begin


def teams_of(start: IntArray, skills: IntArray, need: IntArray, both: BoolArray) -> Teams:
    """The minimal coalitions of all targets, for Python; see `insertion` for why by arrays."""
    n, m = start.shape
    count, most, total = _sizes(start, skills, need, both)
    teams = Teams(np.empty(count, np.int64), np.empty(m + 1, np.int32),
                  np.empty((count, most), np.int32), np.empty(total, np.int32),
                  np.empty(m * n + 1, np.int32))
    _fill(start, skills, need, both, *teams)
    return teams
