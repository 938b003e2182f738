"""Planners that plan the whole mission and follow the plan until the world differs from it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace

import numpy as np

from moonteam.planners import simulate
from moonteam.planners.base import IntArray, Plan, Snapshot
from moonteam.planners.routes import obstacles
from moonteam.planners.travel import travel_times


def same_moment(one: Snapshot, other: Snapshot) -> bool:
    """Whether two snapshots pose the same problem (the step count aside)."""
    fields = ("cells", "solved", "target_cells", "target_skills", "target_and", "agent_mask")
    return all(np.array_equal(getattr(one, f), getattr(other, f)) for f in fields)


class Follower(ABC):
    """A Planner made of a `plan`: asked once, followed while everything goes as foreseen.

    When the team cannot solve every target, or not in the steps left, it still works on those
    it can solve.
    """

    name: str

    def __init__(self) -> None:
        self._actions: list[IntArray] = []
        self._expected: Snapshot | None = None
        self.replans = 0

    @abstractmethod
    def plan(self, snapshot: Snapshot) -> Plan:
        """A whole plan from this moment."""

    def reset(self, snapshot: Snapshot, seed: int = 0) -> None:
        """Starts a mission; nothing here is random, so the seed has no effect."""
        self._actions = []
        self._expected = None
        self.replans = 0

    def act(self, snapshot: Snapshot) -> IntArray:
        """Joint action [N]: the plan's next, or the first of a new plan."""
        if self._expected is None or not same_moment(snapshot, self._expected):
            self.replans += 1
            self._actions = list(self._best_effort(snapshot).actions)
        if self._actions:
            joint = self._actions.pop(0)
        else:
            joint = np.full(len(snapshot.cells), simulate.STAY, np.int32)
        held = replace(snapshot, solved=simulate.holding(snapshot))
        self._expected = simulate.step(held, joint)
        return joint

    def _best_effort(self, snapshot: Snapshot) -> Plan:
        plan = self.plan(snapshot)
        if plan.status != "infeasible":
            return plan
        hopeless = list(obstacles(snapshot, travel_times(snapshot)))
        solved = snapshot.solved.copy()
        solved[hopeless] = True
        longer = max(snapshot.max_steps, snapshot.step + 1) * 64
        return self.plan(replace(snapshot, solved=solved, max_steps=longer))
