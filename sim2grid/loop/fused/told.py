"""From the arrays of a fused run to records, as an `Execution` writes them: for reports and films.

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
from sim2grid.loop import rules
from sim2grid.loop.fused import state
from sim2grid.loop.fused.state import Outcome, Setup
from sim2grid.loop.record import (
    LOSSES,
    Decision,
    Ending,
    FailureCause,
    Leg,
    Loss,
    Record,
    Solve,
    failed_words,
    unsolvable_words,
)
from sim2grid.loop.replan import unsolvable

ENDINGS: tuple[Ending, ...] = ("cut", "arrived", "timeout", "lost")  # by state.GOING to LOST


def record_of(setup: Setup, outcome: Outcome, index: int, mission: Mission,
              scenario: Scenario) -> Record:
    """The record of one mission of a batch; `scenario` as given to `Fused.run`."""
    one: Any = jax.tree.map(lambda a: np.asarray(a[index]), outcome)
    return _Telling(setup, one, mission, scenario).record


class _Telling:
    """One mission's arrays, told as a record."""

    def __init__(self, setup: Setup, one: Outcome, mission: Mission, scenario: Scenario):
        self._setup, self._now, self._trace = setup, one.progress, one.trace
        self._mission = mission
        self._team = range(len(mission.robots))
        self._targets = len(mission.targets)
        self._snapshot = Snapshot.start(scenario)
        self._made = int(self._now.decision)
        looks = int(self._now.look)
        self._poses = np.concatenate([np.asarray(one.start)[None], one.trace.qpos[:looks]])
        self.record = Record(list(mission.targets),
                             [mission.target_name(j) for j in range(self._targets)])
        self._log(looks)
        self._decisions()
        self._losses()
        self._legs()
        self._solves()
        self._end()

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
        return (lost == rules.PRESENT) | (np.asarray(self._now.lost_at) > decision)

    def _decisions(self) -> None:
        trace = self._trace
        for d in range(self._made):
            self.record.decisions.append(Decision(
                d, float(trace.time_s[d]), np.asarray(trace.cells[d]),
                np.asarray(trace.actions[d]), np.asarray(trace.solved[d, :self._targets])))

    def _losses(self) -> None:
        """In the order in which the executor finds them: those stuck of a look come last."""
        now = self._now
        for i in self._team:
            if int(now.lost[i]) != rules.PRESENT:
                self.record.losses.append(Loss(
                    i, LOSSES[int(now.lost[i])], int(now.lost_at[i]), float(now.lost_s[i])))
        self.record.losses.sort(key=lambda loss: (loss.time_s, loss.cause == "stuck"))

    def _legs(self) -> None:
        """Legs, and what the planner found otherwise than foreseen when they had ended."""
        settled, last = int(self._now.settled), np.asarray(self._now.xy, float)
        final = self._setup.frame.settle(last, np.asarray(self._now.cells))
        for d in range(self._made):
            heard = d + 1 < settled  # the decision that came after was come to
            after = self._trace.cells[d + 1] if d + 1 < self._made else self._now.cells
            for i in np.flatnonzero(self._there(d)).tolist():
                stays = heard and bool(self._there(d + 1)[i])
                leg = self._leg(d, i, _cell(after[i] if stays else final[i]))
                self.record.legs.append(leg)
                if stays:
                    self._deviation(leg)
            if heard and any(loss.decision == d + 1 for loss in self.record.losses):
                self.record.replans.append((d + 1, "robot_lost"))

    def _leg(self, decision: int, robot: int, end_cell: Cell) -> Leg:
        trace, at = self._trace, (decision, robot)
        ended = ENDINGS[int(trace.ended[at])]
        end_s = self.record.seconds() if ended == "cut" else float(trace.end_s[at])
        return Leg(robot, decision, int(trace.actions[at]), _cell(trace.cells[at]),
                   _cell(trace.goals[at]), np.asarray(trace.start_xy[at], float),
                   np.asarray(trace.waypoint[at], float), float(trace.time_s[decision]),
                   float(trace.limit_s[at]), end_s, ended, end_cell)

    def _deviation(self, leg: Leg) -> None:
        replans, decision = self.record.replans, leg.decision + 1
        if leg.ended == "timeout":
            replans.append((decision, "timeout"))
            if self._trace.learned[leg.decision, leg.robot]:
                replans.append((decision, "impassable"))
        elif leg.end_cell != leg.goal_cell:
            replans.append((decision, "wrong_cell"))

    def _solves(self) -> None:
        now, frame, start = self._now, self._setup.frame, self._snapshot
        for j in range(self._targets):
            decision, seconds = int(now.solved_at[j]), float(now.solved_s[j])
            if decision < 0:
                continue
            xy, cell = self._xy(seconds), start.target_cells[j]
            cells = self._trace.cells[decision] if decision < self._made else now.cells
            here = rules.present(frame, xy, np.asarray(cells), cell[None])
            shares = rules.contributing(
                here & self._there(decision)[:, None], start.agent_skills,
                start.target_skills[[j]], start.target_and[[j]])
            robots = np.flatnonzero(shares[:, 0])
            away = rules.metres(xy[robots] - frame.centre(cell.astype(float))[None])
            self.record.solves.append(Solve(j, decision, seconds, tuple(robots.tolist()),
                                            tuple(away.tolist())))
        self.record.solves.sort(key=lambda solve: (solve.decision, solve.target))

    def _end(self) -> None:
        """Success, or why not, in the executor's words."""
        status, record = int(self._now.status), self.record
        solved = np.asarray(self._now.solved)[:self._targets]
        record.success = status == state.SUCCESS
        if not record.success:
            record.failure, record.detail = self._failure(status, solved)

    def _failure(self, status: int, solved: np.ndarray) -> tuple[FailureCause, str]:
        if status == state.MAX_STEPS:
            return "max_steps", failed_words(self.record, solved, self._setup.max_steps)
        if status == state.UNSOLVABLE:
            left = replace(self._snapshot, solved=solved, cells=np.asarray(self._now.cells),
                           agent_mask=np.asarray(self._now.mask))
            return "unsolvable", unsolvable_words(self.record, self._mission, unsolvable(left))
        if status == state.ENGINE:
            return "engine", "the physics diverged (not a number, or far too fast)"
        return "interrupted", "not over when its time was up"


def _cell(cell: Any) -> Cell:
    return int(cell[0]), int(cell[1])
