"""From the arrays of a fused run to records, as `execute` writes them: for reports and films.

Legend: R robots, M targets, D decisions, T looks.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import numpy as np

from moonteam.planners.base import Snapshot
from moonteam.problem.mission import Mission
from moonteam.problem.scenario import Cell, Scenario
from sim2grid.loop import fused
from sim2grid.loop.record import Decision, Ending, FailureCause, Leg, Loss, LossCause, Record, Solve
from sim2grid.loop.replan import contributors

FAILURES: dict[int, tuple[FailureCause, str]] = {
    fused.UNDER_WAY: ("interrupted", "not over when its time was up"),
    fused.MAX_STEPS: ("max_steps", "not solved within its decisions"),
    fused.UNSOLVABLE: ("unsolvable", "the robots that are left cannot solve what is open"),
    fused.ENGINE: ("engine", "the physics diverged (not a number, or far too fast)"),
}
ENDINGS: tuple[Ending, ...] = ("cut", "arrived", "timeout", "lost")  # by fused.GOING to LOST
LOSSES: dict[int, LossCause] = {
    fused.FALLEN: "fallen", fused.STUCK: "stuck", fused.NOT_A_NUMBER: "not_a_number",
    fused.OFF_THE_MAP: "off_the_map"}


def record_of(setup: fused.Setup, outcome: fused.Outcome, index: int, mission: Mission,
              scenario: Scenario) -> Record:
    """The record of one mission of a batch; `scenario` as given to `Fused.run`."""
    one: Any = jax.tree.map(lambda a: np.asarray(a[index]), outcome)
    return _Telling(setup, one, mission, scenario).record


class _Telling:
    """One mission's arrays, told as a record."""

    def __init__(self, setup: fused.Setup, one: fused.Outcome, mission: Mission,
                 scenario: Scenario):
        self._setup, self._now, self._trace = setup, one.progress, one.trace
        self._team = range(len(mission.robots))
        self._snapshot = Snapshot.start(scenario)
        self._made = int(self._now.decision)
        looks = int(self._now.look)
        self._poses = np.concatenate([np.asarray(one.start)[None], one.trace.qpos[:looks]])
        self.record = Record(list(mission.targets),
                             [mission.target_name(j) for j in range(len(mission.targets))])
        self._log(looks)
        self._decisions(len(mission.targets))
        self._legs()
        self._losses()
        self._solves(len(mission.targets))
        status = int(self._now.status)
        self.record.success = status == fused.SUCCESS
        if not self.record.success:
            self.record.failure, self.record.detail = FAILURES[status]

    def _log(self, looks: int) -> None:
        nothing = np.zeros((1, len(self._team)))
        self.record.log([0.0], self._poses[:1], nothing, nothing)
        if looks:
            self.record.log(self._setup.rules.chunk_s * np.arange(1, looks + 1), self._poses[1:],
                            self._trace.power[:looks], self._trace.propellant[:looks])

    def _xy(self, seconds: float) -> np.ndarray:
        """Where the robots were at a look, [R, 2] m."""
        pose = self._poses[round(seconds / self._setup.rules.chunk_s)]
        return np.stack([pose[b:b + 2] for b in self._setup.bases]).astype(float)

    def _there(self, decision: int) -> np.ndarray:
        """Which robots were in the team at a decision, [R] bool."""
        lost = np.asarray(self._now.lost)
        return (lost == fused.PRESENT) | (np.asarray(self._now.lost_at) > decision)

    def _decisions(self, targets: int) -> None:
        trace = self._trace
        for d in range(self._made):
            self.record.decisions.append(Decision(
                d, float(trace.time_s[d]), np.asarray(trace.cells[d]),
                np.asarray(trace.actions[d]), np.asarray(trace.solved[d, :targets])))

    def _legs(self) -> None:
        trace, last = self._trace, self._poses[-1]
        ends = np.stack([last[b:b + 2] for b in self._setup.bases]).astype(float)
        for d in range(self._made):
            after = (trace.cells[d + 1] if d + 1 < self._made
                     else self._setup.frame.settle(ends, np.asarray(trace.cells[d])))
            for i in self._team:
                if self._there(d)[i]:
                    self.record.legs.append(self._leg(d, i, _cell(after[i])))
                    self._deviation(d + 1, self.record.legs[-1])

    def _leg(self, decision: int, robot: int, end_cell: Cell) -> Leg:
        trace, at = self._trace, (decision, robot)
        ended = ENDINGS[int(trace.ended[at])]
        end_s = self.record.seconds() if ended == "cut" else float(trace.end_s[at])
        return Leg(robot, decision, int(trace.actions[at]), _cell(trace.cells[at]),
                   _cell(trace.goals[at]), np.asarray(trace.start_xy[at], float),
                   np.asarray(trace.waypoint[at], float), float(trace.time_s[decision]),
                   float(trace.limit_s[at]), end_s, ended, end_cell)

    def _deviation(self, decision: int, leg: Leg) -> None:
        if leg.ended == "timeout":
            self.record.replans.append((decision, "timeout"))
        elif leg.ended == "arrived" and leg.end_cell != leg.goal_cell:
            self.record.replans.append((decision, "wrong_cell"))

    def _losses(self) -> None:
        now = self._now
        for i in self._team:
            if int(now.lost[i]) != fused.PRESENT:
                at = int(now.lost_at[i])
                self.record.losses.append(
                    Loss(i, LOSSES[int(now.lost[i])], at, float(now.lost_s[i])))
                self.record.replans.append((at, "robot_lost"))
        self.record.losses.sort(key=lambda loss: loss.time_s)
        self.record.replans.sort(key=lambda replan: replan[0])

    def _solves(self, targets: int) -> None:
        now, frame = self._now, self._setup.frame
        for j in range(targets):
            decision, seconds = int(now.solved_at[j]), float(now.solved_s[j])
            if decision < 0:
                continue
            xy, cell = self._xy(seconds), self._snapshot.target_cells[j]
            team = replace(self._snapshot, agent_mask=self._there(decision))
            robots = contributors(team, frame.inside(xy, np.broadcast_to(cell, xy.shape)), j)
            away = np.hypot(*(xy - frame.centre(cell.astype(float))).T)
            self.record.solves.append(Solve(j, decision, seconds, tuple(robots),
                                            tuple(float(away[i]) for i in robots)))
        self.record.solves.sort(key=lambda solve: (solve.decision, solve.target))


def _cell(cell: Any) -> Cell:
    return int(cell[0]), int(cell[1])
