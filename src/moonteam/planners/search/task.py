"""The open part of a snapshot, and the objectives, as the planners' searches take them.

Legend: N agents, M open targets, K kinds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from moonteam.planners.base import BoolArray, IntArray, Objective, Snapshot, check_objective
from moonteam.planners.search.travel import Travel
from moonteam.planners.simulate import holding


@dataclass(frozen=True)
class Task:
    """What is still to do, with travel times in steps; contiguous arrays for Numba."""

    targets: IntArray  # [M] indices of the open targets among the snapshot's
    start: IntArray  # [N, M] steps from each agent to each target
    between: IntArray  # [K, M, M] steps between targets
    kinds: IntArray  # [N] index into `between`
    skills: IntArray  # [N] bit masks, 0 for lost agents
    need: IntArray  # [M] bit masks
    both: BoolArray  # [M] AND
    horizon: int  # steps left

    @classmethod
    def of(cls, snapshot: Snapshot, travel: Travel) -> Task:
        """The targets that are neither solved nor holding at this moment."""
        index = np.flatnonzero(~holding(snapshot)).astype(np.int32)
        return cls(
            targets=index,
            start=np.ascontiguousarray(travel.start[:, index], np.int32),
            between=np.ascontiguousarray(travel.between[:, index][:, :, index], np.int32),
            kinds=np.ascontiguousarray(travel.kinds, np.int32),
            skills=np.where(snapshot.agent_mask, snapshot.agent_skills, 0).astype(np.int32),
            need=snapshot.target_skills[index].astype(np.int32),
            both=np.ascontiguousarray(snapshot.target_and[index], np.bool_),
            horizon=snapshot.max_steps - snapshot.step)

    def named(self, routes: IntArray) -> list[list[int]]:
        """Routes [N, *] of open targets, padded by -1, as lists of the snapshot's targets."""
        return [[int(self.targets[t]) for t in route if t >= 0] for route in routes.tolist()]

    def part(self, keep: list[int]) -> Task:
        """The task with only these of its targets."""
        return Task(
            targets=self.targets[keep], start=np.ascontiguousarray(self.start[:, keep]),
            between=np.ascontiguousarray(self.between[:, keep][:, :, keep]), kinds=self.kinds,
            skills=self.skills, need=self.need[keep], both=self.both[keep],
            horizon=self.horizon)


def weights(objective: Objective, alpha: float, beta: float, agents: int,
            horizon: int) -> tuple[float, float]:
    """Weights of makespan and moves in the exact search.

    Among plans of least makespan the one of fewest moves is wanted: moves get a weight so
    small that all of them together weigh less than one step. Raises InputError.
    """
    check_objective(objective, alpha, beta)
    if objective == "makespan":
        return 1.0, 1.0 / (agents * max(horizon, 1) + 1)
    return (0.0, 1.0) if objective == "moves" else (alpha, beta)


def value_of(objective: Objective, alpha: float, beta: float, makespan: float,
             moves: float) -> float:
    """The objective's value of a plan; `alpha` and `beta` count only in the weighted one."""
    if objective == "weighted":
        return alpha * makespan + beta * moves
    return makespan if objective == "makespan" else moves
