"""Physics back to the grid: the moment a planner sees, and whether the rest can be solved.

Legend: R robots, M targets, K kinds.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import msgspec
import numpy as np
import numpy.typing as npt

from moonteam.planners import simulate
from moonteam.planners.base import Planner, Snapshot
from moonteam.planners.search.travel import UNREACHABLE, travel_times
from moonteam.problem.mission import Mission, Target
from moonteam.problem.scenario import Scenario
from sim2grid.loop import rules

BoolArray = npt.NDArray[np.bool_]


def grid_problem(mission: Mission, passable: dict[str, BoolArray]) -> Scenario:
    """The mission as a scenario whose `blocked` holds what each kind cannot cross.

    `passable` maps a kind to [H, W] bool, indexed [y, x], True where it can go.
    """
    kinds = {robot.kind for robot in mission.robots}
    blocked = {kind: tuple((int(x), int(y)) for y, x in np.argwhere(~passable[kind]))
               for kind in sorted(kinds) if not passable[kind].all()}
    return msgspec.structs.replace(mission.scenario(), blocked=blocked or None)


def grid_trace(scenario: Scenario, planner: Planner, seed: int = 0) -> simulate.Trace:
    """The mission on the grid alone, closed loop with the same planner."""
    snapshot = Snapshot.start(scenario)
    planner.reset(snapshot, seed)

    def decisions() -> Iterator[npt.NDArray[np.int32]]:
        now = snapshot
        while True:
            actions = planner.act(now)
            yield actions
            now = simulate.step(now, actions)

    return simulate.replay(snapshot, decisions())


def with_target(snapshot: Snapshot, target: Target, need: int) -> Snapshot:
    """The snapshot with one more, unsolved target; `need` is its skill bitmask."""
    both = target.type == "AND" and len(set(target.skills)) > 1
    return replace(
        snapshot,
        target_cells=np.concatenate([snapshot.target_cells, np.array([target.cell], np.int32)]),
        target_skills=np.append(snapshot.target_skills, np.int32(need)),
        target_and=np.append(snapshot.target_and, both),
        solved=np.append(snapshot.solved, False))


def without_cell(snapshot: Snapshot, kind: int, cell: npt.NDArray[np.int32]) -> Snapshot:
    """The snapshot in which a kind (index into `passable`) cannot enter a cell [2]."""
    kinds = int(snapshot.agent_kinds.max()) + 1
    open_map = np.ones((kinds, snapshot.size[1], snapshot.size[0]), bool)
    passable = (open_map if snapshot.passable is None else snapshot.passable).copy()
    passable[kind, cell[1], cell[0]] = False
    return replace(snapshot, passable=passable)


def unsolvable(snapshot: Snapshot) -> list[int]:
    """Open targets that the robots still in the team can never solve."""
    reach = travel_times(snapshot).start < UNREACHABLE  # [R, M]
    return np.flatnonzero(rules.unsolvable(
        reach, snapshot.agent_mask, snapshot.agent_skills, snapshot.target_skills,
        snapshot.target_and, snapshot.solved)).tolist()
