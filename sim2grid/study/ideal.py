"""The grid without physics, behind the same executor: every robot is at once where it was sent.

What an execution on it costs is what the mission would cost if the ground, the motors and the
clock did not matter: the yardstick of every other row of a table.

Legend: B worlds, R robots, D decisions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from sim2grid.frame import Frame
from sim2grid.loop.asked import Body, Route
from sim2grid.loop.record import Record
from sim2grid.measure.metrics import Report

Floats = npt.NDArray[np.float64]


class IdealState(NamedTuple):
    """Free joints of all robots, and the flag that an engine would set."""

    qpos: Floats  # [B, 7 R]
    diverged: npt.NDArray[np.bool_]  # [B] rows that stand still


class IdealLog(NamedTuple):
    """One sample, at the end of the look."""

    qpos: Floats  # [B, 1, 7 R]
    power: Floats  # [B, 1, R]
    propellant_rate: Floats  # [B, 1, R]


class IdealBackend:
    """A backend that puts every robot on its waypoint. One look is one sample."""

    name = "grid"

    def __init__(self, chunk_steps: int):
        self.log_every = chunk_steps

    def reset(self, qpos: Any = None, batch: int = 1) -> IdealState:
        """Worlds at qpos [B, 7 R]."""
        del batch
        places = np.array(qpos, float)
        return IdealState(places, np.zeros(len(places), bool))

    def advance(self, state: IdealState, commands: Sequence, num_control_steps: int
                ) -> tuple[IdealState, IdealLog]:
        """Puts the robots that are not lost where they were sent."""
        del num_control_steps
        qpos = state.qpos.copy()
        for i, command in enumerate(commands):
            going = ~np.asarray(command.lost) & ~state.diverged
            qpos[going, 7 * i:7 * i + 2] = np.asarray(command.xy)[going]
        nothing = np.zeros((len(qpos), 1, len(commands)))
        return state._replace(qpos=qpos), IdealLog(qpos[:, None], nothing, nothing)


def ideal_bodies(bodies: Sequence[Body]) -> tuple[Body, ...]:
    """The same robots as free joints side by side."""
    return tuple(replace(body, base=7 * i) for i, body in enumerate(bodies))


def ideal_start(frame: Frame, cells: Sequence[tuple[int, int]]) -> Floats:
    """[7 R] upright in the middle of their cells."""
    poses = np.zeros((len(cells), 7))
    poses[:, :2] = frame.centre(np.array(cells, float))
    poses[:, 3] = 1.0
    return poses.ravel()


def route_of(record: Record, starts: Sequence[tuple[int, int]]) -> Route:
    """The plan that an execution on the grid has walked."""
    end = {leg.robot: leg.end_cell or leg.goal_cell for leg in record.legs}
    last = [end.get(i, start) for i, start in enumerate(starts)]
    cells = [decision.cells for decision in record.decisions]
    actions = [decision.actions for decision in record.decisions]
    return Route(np.array([*cells, last], np.int32),
                 np.array(actions, np.int32).reshape(len(actions), len(starts)))


def nominal_times(record: Record, bodies: Sequence[Body], cell_m: float) -> Floats:
    """Mission seconds [D + 1] at which each decision, and the end, would come at best.

    All wait for the slowest of those that move, which crosses a cell at its travelling speed.
    """
    spent = np.zeros(len(record.decisions))
    for leg in record.legs:
        if leg.moving:
            spent[leg.decision] = max(spent[leg.decision], cell_m / bodies[leg.robot].speed)
    return np.concatenate([[0.0], np.cumsum(spent)])


def on_the_clock(report: Report, times: Floats) -> Report:
    """The report of an execution on the grid with nominal seconds in place of looks."""
    targets = tuple(
        t if t.decision is None else msgspec.structs.replace(
            t, time_s=round(float(times[t.decision]), 4)) for t in report.targets)
    return msgspec.structs.replace(report, seconds=round(float(times[-1]), 4), targets=targets)
