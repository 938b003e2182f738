"""What is asked of an execution: mission, team, ground, rules, who decides. It does not change.

Legend: R robots, D decisions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from moonteam.planners.base import IntArray, Planner, Snapshot
from moonteam.problem.mission import Mission, Target
from moonteam.problem.scenario import Scenario
from moonteam.terrain.light import Sunlight
from sim2grid.frame import Frame
from sim2grid.loop.replan import with_target
from sim2grid.loop.rules import Rules

Mode = Literal["barrier", "async", "clock"]
NOBODY = 1 << 30
"""Bit of a skill that no robot has."""


@dataclass(frozen=True)
class Body:
    """What the executor needs to know of a simulated robot."""

    base: int  # index of its free joint in qpos
    speed: float  # m/s, the speed it travels at
    flies: bool = False
    fall_tilt: float = float(np.radians(60.0))  # rad, it has fallen when tilted further for long
    footprint: float = 0.3  # m, radius
    settle: float = 0.0  # s that setting out and coming to rest cost it
    lands_for: float = float("inf")  # s of service from which it comes down for it
    light: Sunlight | None = None  # on its ground; None: no sun is asked about


class Route(NamedTuple):
    """A plan to be walked through blindly."""

    cells: IntArray  # [D + 1, R, 2], entry 0 is the start
    actions: IntArray  # [D, R]


@dataclass(frozen=True)
class Asked:
    """One mission to be executed."""

    mission: Mission
    scenario: Scenario
    planner: Planner
    bodies: Sequence[Body]
    frame: Frame
    seed: int = 0
    mode: Mode = "barrier"
    rules: Rules = field(default_factory=Rules)
    route: Route | None = None  # walked through without asking the planner

    @property
    def pace(self) -> int:
        """Decisions that count as one: in async mode a robot's move costs the others none."""
        return len(self.bodies) if self.mode == "async" else 1

    @property
    def limit(self) -> int:
        """Decisions after which the mission has failed."""
        return self.mission.max_steps * self.pace

    @property
    def grounded(self) -> npt.NDArray[np.bool_]:
        """[R] False for a flyer."""
        return np.array([not body.flies for body in self.bodies])

    @property
    def places(self) -> npt.NDArray[np.int_]:
        """[R, 7] indices of the robots' free joints in qpos."""
        return np.array([np.arange(body.base, body.base + 7) for body in self.bodies])

    def snapshot(self) -> Snapshot:
        """The moment before the first decision, nothing looked at yet."""
        first = Snapshot.start(self.scenario)
        return replace(first, solved=np.zeros_like(first.solved), max_steps=self.limit)

    def with_targets(self, snapshot: Snapshot, targets: Sequence[Target]) -> Snapshot:
        """The snapshot with more targets, in the skill bits of the scenario."""
        bits = self.scenario.skill_bits
        for target in targets:
            need = sum(bits.get(skill, NOBODY) for skill in set(target.skills))
            snapshot = with_target(snapshot, target, need)
        return snapshot
