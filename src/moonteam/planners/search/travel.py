"""Travel times between agents and targets, and the steps that walk them; on the host.

Legend: N agents, M targets, K kinds, H rows, W columns. Cells are (x, y). On an open map the
travel time is the Manhattan distance; with cells blocked for some kinds it is the length of
the shortest way round. A blocked cell acts as the border does: nobody enters it, but an agent
that stands in one may leave.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from moonteam.compilation import njit
from moonteam.planners.base import BoolArray, IntArray, Snapshot
from moonteam.problem.rules import DISPLACEMENTS, STAY, UNREACHABLE

_DX, _DY = np.ascontiguousarray(DISPLACEMENTS.T)


@dataclass(frozen=True)
class Travel:
    """Travel times in steps; `UNREACHABLE` where there is no way."""

    start: IntArray  # [N, M] from each agent's cell to each target
    between: IntArray  # [K, M, M] from target to target, for each kind
    kinds: IntArray  # [N] index into `between`
    fields: IntArray | None  # [K, M, H, W] steps to target m from every cell; None: open map


@njit(cache=True, nogil=True)
def distance_field(passable: BoolArray, x: int, y: int, field: IntArray) -> None:
    """Fills `field` [H, W] with the steps from every cell to (x, y), by breadth-first search.

    A cell that is not passable gets its distance (an agent may stand there and leave) but
    leads nowhere.
    """
    height, width = passable.shape
    queue = np.empty((height * width, 2), np.int32)
    field[:, :] = UNREACHABLE
    field[y, x] = 0
    head, tail = 0, 0
    if passable[y, x]:
        queue[0, 0], queue[0, 1] = x, y
        tail = 1
    while head < tail:
        cx, cy = queue[head, 0], queue[head, 1]
        head += 1
        for action in range(4):
            nx, ny = cx + _DX[action], cy + _DY[action]
            if 0 <= nx < width and 0 <= ny < height and field[ny, nx] == UNREACHABLE:
                field[ny, nx] = field[cy, cx] + 1
                if passable[ny, nx]:
                    queue[tail, 0], queue[tail, 1] = nx, ny
                    tail += 1


@njit(cache=True, nogil=True)
def distance_fields(passable: BoolArray, cells: IntArray) -> IntArray:
    """Distance fields [K, M, H, W] to each of the target cells [M, 2], one per kind."""
    kinds, height, width = passable.shape
    fields = np.empty((kinds, cells.shape[0], height, width), np.int32)
    for k in range(kinds):
        for m in range(cells.shape[0]):
            distance_field(passable[k], cells[m, 0], cells[m, 1], fields[k, m])
    return fields


def travel_times(snapshot: Snapshot) -> Travel:
    """Travel times from every agent and between all targets (solved ones too)."""
    cells, targets = snapshot.cells, snapshot.target_cells
    if snapshot.passable is None:
        start = np.abs(cells[:, None] - targets[None]).sum(-1).astype(np.int32)
        between = np.abs(targets[:, None] - targets[None]).sum(-1).astype(np.int32)
        return Travel(start, between[None], np.zeros(len(cells), np.int32), None)
    fields = distance_fields(snapshot.passable, targets)
    kinds = snapshot.agent_kinds
    start = fields[kinds[:, None], np.arange(len(targets))[None],
                   cells[:, 1, None], cells[:, 0, None]]
    between = fields[:, :, targets[:, 1], targets[:, 0]].transpose(0, 2, 1)
    return Travel(start, np.ascontiguousarray(between), kinds, fields)


def walk(cell: npt.ArrayLike, goal: npt.ArrayLike, field: IntArray | None = None,
         passable: BoolArray | None = None) -> list[int]:
    """Actions along a shortest way from `cell` to `goal`, with as few turns as is easy.

    `field` [H, W] holds the steps to `goal` for this agent's kind and `passable` [H, W] the
    cells it may enter; both None on an open map. Raises ValueError if there is no way.
    """
    x, y = (int(v) for v in np.asarray(cell))
    gx, gy = (int(v) for v in np.asarray(goal))
    if field is None or passable is None:
        across = [3 if gx > x else 2] * abs(gx - x)
        along = [0 if gy > y else 1] * abs(gy - y)
        return across + along if len(across) >= len(along) else along + across
    if field[y, x] >= UNREACHABLE:
        raise ValueError(f"no way from {(x, y)} to {(gx, gy)}")
    actions: list[int] = []
    action = STAY
    while field[y, x] > 0:
        action = _downhill(field, passable, x, y, action)
        actions.append(action)
        x, y = x + int(_DX[action]), y + int(_DY[action])
    return actions


def _downhill(field: IntArray, passable: BoolArray, x: int, y: int, last: int) -> int:
    """An action one step nearer, the last one if it still is."""
    height, width = field.shape
    order = (last, 0, 1, 2, 3) if last != STAY else (0, 1, 2, 3)
    for action in order:
        nx, ny = x + int(_DX[action]), y + int(_DY[action])
        if (0 <= nx < width and 0 <= ny < height and passable[ny, nx]
                and field[ny, nx] == field[y, x] - 1):
            return action
    raise ValueError(f"the distance field has no way down from {(x, y)}")
