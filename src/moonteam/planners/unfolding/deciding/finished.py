"""How soon all can be done once everything is known: the exact search, of many missions in a call.

Legend: B problems, R missions, N robots, T targets, S skills; times are s in, whole ms inside.
"""

from __future__ import annotations

import numpy as np

from moonteam.compilation import njit
from moonteam.grid.macro.types import FAR, MacroProblem
from moonteam.planners.search import schedules
from moonteam.planners.search.travel import UNREACHABLE
from moonteam.planners.seconds.base import MS
from moonteam.planners.seconds.search.plain import MOST_SKILLS, NO_LIMIT


def fits(problems: MacroProblem) -> np.ndarray:
    """[B] bool, whether what is left, once it is known, is travel, services and minimal coalitions
    alone, which the search in steps solves (see `seconds.search.plain`). Of NumPy arrays.
    """
    p = problems
    asks = (p.after, p.home, p.home_now, p.need > 1, p.worth, p.lapses < FAR, p.looks,
            p.lost < FAR, p.appears > p.shown)
    few = p.has.shape[-1] <= MOST_SKILLS and p.sight is None
    return ~np.any([x.reshape(len(x), -1).any(axis=1) for x in asks], axis=0) & few


def ends(problems: MacroProblem, row: np.ndarray, ways: np.ndarray,
         open_: np.ndarray) -> np.ndarray:
    """[R] least s in which all that is open is served; infinity where it cannot be.

    Args:
      problems: [B] NumPy arrays that `fits` agrees to.
      row: [R] the problem of each mission.
      ways: [R, N, T] s until each robot can be at each target.
      open_: [R, T] bool, targets to be served.
    """
    bits = 1 << np.arange(problems.has.shape[-1], dtype=np.int32)
    has = ((problems.has & problems.agent_mask[..., None]) @ bits).astype(np.int32)
    need = ((problems.need > 0) @ bits).astype(np.int32)
    return _ends(row, ways, open_, problems.between, problems.service, has, need,
                 ~problems.either)


@njit(cache=True, nogil=True)
def _ms(seconds):
    """Whole ms of a way, as the search takes it."""
    return min(round(MS * seconds), UNREACHABLE)


@njit(cache=True, nogil=True)
def _ends(row, ways, open_, between, service, has, need, both):
    """`ends`, of skills as bit masks [B, N] and [B, T], both [B, T] an AND target."""
    found = np.zeros(row.shape[0])
    for r in range(row.shape[0]):
        b = row[r]
        some = np.flatnonzero(open_[r])
        n, m = ways.shape[1], some.shape[0]
        if m == 0:
            continue
        start, apart = np.empty((n, m), np.int32), np.empty((n, m, m), np.int32)
        kinds, count = np.empty(n, np.int32), 0
        for a in range(n):
            for j in range(m):
                stay = service[b, some[j]]
                start[a, j] = _ms(ways[r, a, some[j]] + stay)
                for i in range(m):
                    apart[count, i, j] = _ms(between[b, a, some[i], some[j]] + stay)
            kinds[a] = count
            for k in range(count):
                if (apart[k] == apart[count]).all():
                    kinds[a] = k
                    break
            if kinds[a] == count:
                count += 1
        outcome, span, _, _ = schedules.solve(
            start, apart[:count].copy(), kinds, has[b], need[b][some], both[b][some], 1.0, 0.0,
            UNREACHABLE - 1, 0.0, np.inf, NO_LIMIT, np.empty((n, m), np.int32))
        found[r] = span / MS if outcome == schedules.OPTIMAL else np.inf
    return found
