"""The grid's rules, each stated once, as pure functions of arrays, NumPy's or JAX's.

The environment (`grid`), its host twin (`planners.simulate`), the networks' features and the
execution in physics all call them. Legend: N agents, M targets, K kinds of robots, W columns
(x), H rows (y); cells are int32 (x, y), skills bit masks, [...] any leading axes.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from moonteam.problem.scenario import ACTIONS

NUM_ACTIONS = len(ACTIONS)
STAY = ACTIONS.index("stay")

DISPLACEMENTS = np.array([(0, 1), (0, -1), (-1, 0), (1, 0), (0, 0)], np.int32)
"""Cells (x, y) that each action adds: up, down, left, right, stay."""

UNREACHABLE = 1 << 20
"""Steps that stand for "no way": more than any way has, and a dozen still add up in int32."""


def centre(cells: Any, size: Any, cell_m: float) -> Any:
    """Points [..., 2] m of places in cells [..., 2], [0, 0] the centre of the lower left one.

    The origin is the middle of the map, which is `size` (W, H) cells of `cell_m` m.
    """
    xp = cells.__array_namespace__()
    # Spelled out to the shape of the cells: ranks are never promoted silently.
    return (cells + 0.5 - xp.broadcast_to(xp.asarray(size), cells.shape) / 2) * cell_m


def enterable(cells: Any, kinds: Any, size: Any, passable: Any) -> Any:
    """[..., N] bool: the cells [..., N, 2] are on the map and open to that agent's kind.

    `kinds` [N] are indices into `passable` [K, H, W] bool, which is None on an open map; `size`
    is (W, H).
    """
    xp = cells.__array_namespace__()
    on_map = (cells >= 0).all(-1) & (cells[..., 0] < size[0]) & (cells[..., 1] < size[1])
    if passable is None:
        return on_map
    inside = xp.where(on_map[..., None], cells, 0)
    return on_map & passable[kinds, inside[..., 1], inside[..., 0]]


def moved(cells: Any, goal: Any, in_team: Any, kinds: Any, size: Any, passable: Any) -> Any:
    """[N, 2] cells of agents that try to get from `cells` to `goal`.

    The border and closed cells turn them back, and who is not `in_team` [N] does not move.
    Whoever stands in a closed cell may leave it. The rest as in `enterable`.
    """
    ok = enterable(goal, kinds, size, passable) & in_team
    return cells.__array_namespace__().where(ok[..., None], goal, cells)


def met(present: Any, need: Any, both: Any) -> Any:
    """[..., M] bool: the skills `present` [..., M] at targets meet what they `need` [M].

    OR (`both` [M] False): one of the skills will do; AND: all of them.
    """
    have = present & need
    return have.__array_namespace__().where(both, have == need, have != 0)
