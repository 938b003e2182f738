"""What happened in one execution: written by the executor, read by metrics and drawings.

Legend: R robots, M targets, T logged moments (the first is the start), nq as in MuJoCo.
Seconds are mission seconds. A decision's number, counted from 1, is of the last joint action that
was done by then, 0 before the first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt

from moonteam.problem.mission import Mission, Target
from moonteam.problem.scenario import Cell
from sim2grid.loop import rules
from sim2grid.loop.power import Charge

Ending = Literal["arrived", "timeout", "lost", "cut"]
LossCause = Literal["fallen", "stuck", "not_a_number", "off_the_map", "battery", "event"]
ReplanCause = Literal["timeout", "wrong_cell", "robot_lost", "new_target", "slowed", "silent",
                      "heard_again", "impassable", "behind", "appeared", "lapsed", "found"]
FailureCause = Literal["max_steps", "max_seconds", "unsolvable", "plan_over", "engine",
                       "interrupted"]

LOSSES: dict[int, LossCause] = {
    rules.FALLEN: "fallen", rules.STUCK: "stuck", rules.NOT_A_NUMBER: "not_a_number",
    rules.OFF_THE_MAP: "off_the_map"}
"""Why a robot left, by the numbers of `rules`."""

XY = npt.NDArray[np.float64]  # [2] m

SETTING_OUT, GOING_ON = 5, 4
"""Actions of legs by the clock: the first piece of a way, and the others."""


@dataclass
class Leg:
    """One robot's part of one decision, from the decision until it arrived or gave up."""

    robot: int
    decision: int
    action: int  # 0..4, as the planner asked; by the clock SETTING_OUT or GOING_ON
    from_cell: Cell
    goal_cell: Cell  # from_cell where it stays or the way is barred
    start_xy: XY  # where it truly stood
    waypoint: XY  # where it was sent
    start_s: float
    limit_s: float  # mission second at which it times out
    end_s: float | None = None
    ended: Ending | None = None
    end_cell: Cell | None = None
    expected_s: float | None = None  # by the clock, what the way takes at travelling speed

    @property
    def moving(self) -> bool:
        """Sent to another cell."""
        return self.goal_cell != self.from_cell


@dataclass(frozen=True)
class Decision:
    """One joint action and the grid as the planner saw it."""

    decision: int
    time_s: float
    cells: npt.NDArray[np.int32]  # [R, 2]
    actions: npt.NDArray[np.int32]  # [R]
    solved: npt.NDArray[np.bool_]  # [M so far]


@dataclass(frozen=True)
class Solve:
    """A target solved: by which robots, and how far each stood from the target's centre."""

    target: int
    decision: int
    time_s: float
    robots: tuple[int, ...]
    distance_m: tuple[float, ...]


@dataclass(frozen=True)
class Loss:
    """A robot that left the team."""

    robot: int
    cause: LossCause
    decision: int
    time_s: float


@dataclass
class Record:
    """One execution from start to end."""

    targets: list[Target] = field(default_factory=list)  # grows when an event brings one
    target_names: list[str] = field(default_factory=list)
    legs: list[Leg] = field(default_factory=list)
    decisions: list[Decision] = field(default_factory=list)
    solves: list[Solve] = field(default_factory=list)
    lapsed: list[int] = field(default_factory=list)  # targets of some worth that nobody served
    losses: list[Loss] = field(default_factory=list)
    replans: list[tuple[int, ReplanCause]] = field(default_factory=list)
    expected: dict[int, float] = field(default_factory=dict)  # target: s, by the first plan
    success: bool = False
    failure: FailureCause | None = None
    detail: str = ""  # why it failed, for a person
    times: list[npt.NDArray[np.float64]] = field(default_factory=list)  # chunks of [T]
    qpos: list[npt.NDArray[np.float32]] = field(default_factory=list)  # chunks of [T, nq]
    power: list[npt.NDArray[np.float32]] = field(default_factory=list)  # chunks of [T, R] W
    propellant: list[npt.NDArray[np.float32]] = field(default_factory=list)  # [T, R] kg/s
    charges: dict[int, Charge] = field(default_factory=dict)  # by robot, of those with a battery

    def log(self, times: npt.ArrayLike, qpos: npt.ArrayLike, power: npt.ArrayLike,
            propellant: npt.ArrayLike) -> None:
        """Appends a chunk: times [T], qpos [T, nq], power and propellant rate [T, R]."""
        self.times.append(np.asarray(times, np.float64))
        self.qpos.append(np.asarray(qpos, np.float32))
        self.power.append(np.asarray(power, np.float32))
        self.propellant.append(np.asarray(propellant, np.float32))

    def seconds(self) -> float:
        """Mission seconds so far."""
        return float(self.times[-1][-1]) if self.times else 0.0

    def solved_at(self, time_s: float) -> set[int]:
        """Targets solved by a mission second."""
        return {s.target for s in self.solves if s.time_s <= time_s + 1e-9}


def failed_words(record: Record, solved: npt.NDArray[np.bool_], limit: int | None = None) -> str:
    """Which targets [M] are open at the end of `limit` decisions, or of a plan."""
    names = ", ".join(record.target_names[j] for j in np.flatnonzero(~solved))
    over = "when the plan was over" if limit is None else f"within {limit} decisions"
    return f"{names} not solved {over}"


def unsolvable_words(record: Record, mission: Mission, targets: Sequence[int]) -> str:
    """Which targets can never be solved, and who is missing."""
    names = ", ".join(record.target_names[j] for j in targets)
    gone = ", ".join(f"{mission.robots[x.robot].name} ({x.cause})" for x in record.losses)
    return (f"the robots that are left cannot solve {names}"
            + (f"; lost: {gone}" if gone else ""))
