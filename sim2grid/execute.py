"""The closed loop: planner, waypoints, physics, positions back to the grid, planner again.

An `Execution` is one mission as a state machine without an engine: it says where each robot
should go and is told how all of them moved. `run` drives any number of executions on one
backend. In `barrier` mode all robots decide together, as in training; in `async` mode each
decides when it arrives and the actions of the others stand.

Legend: B executions (worlds), R robots, M targets, T control steps of a chunk.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol

import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from moonteam.mission import Mission
from moonteam.planners.base import Planner, Snapshot
from moonteam.planners.simulate import STAY, moved
from moonteam.robots.base import CONTROL_PERIOD, Command
from moonteam.scenario import Cell, Scenario
from sim2grid.frames import Frame
from sim2grid.metrics import tilt
from sim2grid.record import Decision, Ending, FailureCause, Leg, Loss, LossCause, Record, Solve
from sim2grid.replan import contributors, unsolvable, with_target
from sim2grid.waypoints import waypoints

Mode = Literal["barrier", "async"]
NOBODY = 1 << 30
"""Bit of a skill that no robot has."""


@dataclass(frozen=True)
class Body:
    """What the executor needs to know of a simulated robot."""

    base: int  # index of its free joint in qpos
    speed: float  # m/s, the speed it travels at
    flies: bool = False


@dataclass(frozen=True)
class Rules:
    """When a robot has arrived, is late, has fallen or is stuck."""

    arrive_cells: float = 0.25  # distance to the waypoint, in cells
    arrive_speed: float = 0.5  # of the travelling speed, averaged over a chunk
    chunk_steps: int = 25  # control steps between two looks at the robots
    timeout_base_s: float = 8.0
    timeout_factor: float = 4.0  # times the time the way takes at travelling speed
    fall_tilt: float = float(np.radians(60.0))
    fall_s: float = 2.0
    stuck_progress: float = 0.25  # of a leg; a time-out with less counts towards stuck
    stuck_after: int = 2  # such time-outs in a row

    @property
    def chunk_s(self) -> float:
        """Seconds between two looks."""
        return self.chunk_steps * CONTROL_PERIOD


class Backend(Protocol):
    """What `run` needs of a physics backend; see moonteam.physics.backends."""

    log_every: int  # control steps between two samples of the log

    def reset(self, qpos: Any = None, batch: int = 1) -> Any:
        """`batch` worlds at the start; the state's `diverged` is [B] bool."""
        ...

    def advance(self, state: Any, commands: tuple[Command, ...],
                num_control_steps: int) -> tuple[Any, Any]:
        """Steps all worlds; the log holds qpos [B, T, nq], power and propellant_rate [B, T, R]."""
        ...


class Execution:
    """One mission under way. `finished` once `record.success` or `record.failure` is set."""

    def __init__(self, mission: Mission, scenario: Scenario, planner: Planner,
                 bodies: Sequence[Body], frame: Frame, *, seed: int = 0,
                 mode: Mode = "barrier", rules: Rules | None = None):
        self.mission, self.planner, self.bodies, self.frame = mission, planner, bodies, frame
        self.seed, self.mode, self.rules = seed, mode, rules or Rules()
        self.snapshot = Snapshot.start(scenario)
        # In async mode one robot's move costs the others no decision of their own.
        self.limit = mission.max_steps * (len(bodies) if mode == "async" else 1)
        self.snapshot = replace(self.snapshot, solved=np.zeros_like(self.snapshot.solved),
                                max_steps=self.limit)
        self.record = Record(list(mission.targets),
                             [mission.target_name(j) for j in range(len(mission.targets))])
        self.legs: list[Leg | None] = [None] * len(bodies)
        self.finished = False
        self.time = 0.0
        self.decision = 0
        self._skill_bits = scenario.skill_bits
        self._events = sorted(mission.events, key=lambda event: event.at_decision)
        self._tilted_s = np.zeros(len(bodies))
        self._stalls = np.zeros(len(bodies), int)
        self._lost_since = False
        self._xy = np.zeros((len(bodies), 2))

    def start(self, qpos: npt.ArrayLike) -> None:
        """Takes the robots' first pose, qpos [nq], and makes the first decision."""
        pose = np.asarray(qpos, float)
        zeros = np.zeros((1, len(self.bodies)))
        self.record.log([0.0], pose[None], zeros, zeros)
        self._xy = self._positions(pose[None])[-1, :, :2]
        self.snapshot = replace(self.snapshot, cells=self.frame.cell(self._xy))
        self.planner.reset(self.snapshot, self.seed)
        self._decide()

    def commands(self) -> list[tuple[npt.NDArray, float, bool]]:
        """Waypoint [2] m, speed m/s and lost, for each robot, until the next look."""
        mask = self.snapshot.agent_mask
        goals = [leg.goal_cell if leg is not None and mask[i] else _cell(self.snapshot.cells[i])
                 for i, leg in enumerate(self.legs)]
        points = waypoints(self.frame, goals, [not body.flies for body in self.bodies])
        out = []
        for i, body in enumerate(self.bodies):
            leg = self.legs[i]
            if leg is not None and mask[i]:
                leg.waypoint = points[i] if leg.ended is None else leg.waypoint
            there = bool(np.hypot(*(points[i] - self._xy[i])) <= self._tolerance)
            hold = there and (leg is None or leg.ended is not None)
            out.append((points[i], 0.0 if hold else body.speed, not bool(mask[i])))
        return out

    def observe(self, qpos: npt.NDArray, power: npt.NDArray, propellant: npt.NDArray,
                period: float = CONTROL_PERIOD) -> None:
        """Takes what happened since the last look: qpos [T, nq], power, propellant [T, R].

        `period` is the time between two samples, s.
        """
        times = self.time + period * np.arange(1, len(qpos) + 1)
        before = self.record.qpos[-1][-1:]
        self.time = float(times[-1])
        self.record.log(times, qpos, power, propellant)
        poses = self._positions(np.concatenate([before, qpos]))  # [T + 1, R, 7]
        self._look_for_losses(poses[1:], period * len(qpos))
        if self.finished:
            return
        self._look_for_arrivals(poses, period * len(qpos))
        if self._ready():
            self._decide()

    def diverged(self) -> None:
        """Ends the mission: the engine could not go on."""
        self._end("engine", "the physics diverged (not a number, or far too fast)")

    def interrupt(self) -> None:
        """Ends the mission where it stands."""
        if not self.finished:
            self._end("interrupted", "interrupted before the end")

    @property
    def _tolerance(self) -> float:
        return self.rules.arrive_cells * self.frame.cell_m

    def _positions(self, qpos: npt.NDArray) -> npt.NDArray:
        """Free joints [T, R, 7] out of qpos [T, nq]."""
        return np.stack([qpos[:, b.base:b.base + 7] for b in self.bodies], axis=1).astype(float)

    def _look_for_losses(self, poses: npt.NDArray, seconds: float) -> None:
        """Marks robots that fell, left the map or are not a number; poses [T, R, 7]."""
        last = poses[-1]
        angle: npt.NDArray = tilt(poses[:, :, 3:7])  # [T, R]
        for i in np.flatnonzero(self.snapshot.agent_mask).tolist():
            if not np.isfinite(poses[:, i]).all():
                self._lose(i, "not_a_number")
                continue
            over = bool(np.min(angle[:, i]) > self.rules.fall_tilt)
            self._tilted_s[i] = self._tilted_s[i] + seconds if over else 0.0
            if self._tilted_s[i] >= self.rules.fall_s:
                self._lose(i, "fallen")
            elif self.frame.off_map(last[i, :2]):
                self._lose(i, "off_the_map")
        if self._lost_since:
            self._check_solvable()

    def _lose(self, robot: int, cause: LossCause) -> None:
        mask = self.snapshot.agent_mask.copy()
        mask[robot] = False
        self.snapshot = replace(self.snapshot, agent_mask=mask)
        self.record.losses.append(Loss(robot, cause, self.decision, self.time))
        self._close_leg(robot, "lost")
        self._lost_since = True

    def _look_for_arrivals(self, poses: npt.NDArray, seconds: float) -> None:
        """Ends the legs of robots that are there, or late; poses [T + 1, R, 7]."""
        moved = poses[-1, :, :2] - poses[0, :, :2]
        seen = np.isfinite(poses[-1, :, :2].sum(-1, keepdims=True))
        self._xy = np.where(seen, poses[-1, :, :2], self._xy)
        for i, leg in enumerate(self.legs):
            if leg is None or leg.ended is not None:
                continue
            near = np.hypot(*(self._xy[i] - leg.waypoint)) <= self._tolerance
            inside = self.frame.inside(self._xy[i], np.array(leg.goal_cell))
            slow = np.hypot(*moved[i]) <= self.rules.arrive_speed * self.bodies[i].speed * seconds
            if not leg.moving or (near and inside and slow and self._tilted_s[i] == 0.0):
                self._close_leg(i, "arrived")
                self._stalls[i] = 0
            elif self.time >= leg.limit_s - 1e-9:
                self._close_leg(i, "timeout")
                self._note_stall(i, leg)
        if self._lost_since and not self.finished:
            self._check_solvable()

    def _note_stall(self, robot: int, leg: Leg) -> None:
        """A time-out: with too little progress, twice in a row, the robot counts as stuck."""
        length = float(np.hypot(*(leg.waypoint - leg.start_xy)))
        left = float(np.hypot(*(leg.waypoint - self._xy[robot])))
        stalled = length - left < self.rules.stuck_progress * length
        self._stalls[robot] = self._stalls[robot] + 1 if stalled else 0
        if self._stalls[robot] >= self.rules.stuck_after:
            self._lose(robot, "stuck")

    def _close_leg(self, robot: int, ended: Ending) -> None:
        leg = self.legs[robot]
        if leg is not None and leg.ended is None:
            leg.ended, leg.end_s = ended, self.time

    def _ready(self) -> bool:
        """Whether it is time to decide."""
        live = np.flatnonzero(self.snapshot.agent_mask).tolist()
        ended = [leg.ended is not None for i in live if (leg := self.legs[i]) is not None]
        if self.mode == "barrier" or not ended:
            return all(ended)
        moving = [leg.ended is not None for i in live
                  if (leg := self.legs[i]) is not None and leg.moving]
        return any(moving) if moving else True

    def _decide(self) -> None:
        """Positions to cells, events, targets solved, end or the next joint action."""
        self.snapshot = replace(
            self.snapshot, cells=self.frame.settle(self._xy, self.snapshot.cells),
            step=self.decision)
        free = [i for i, leg in enumerate(self.legs) if leg is None or leg.ended is not None]
        self._note_deviations(free)
        self._apply_events()
        self._mark_solved()
        if self.snapshot.solved.all() and not any(e.target for e in self._events):
            self._end(None, "")
            return
        self._check_solvable()
        if not self.finished and self.decision >= self.limit:
            self._end("max_steps",
                      f"{self._open_names()} not solved within {self.limit} decisions")
        if self.finished:
            return
        actions = self._ask()
        self.record.decisions.append(Decision(
            self.decision, self.time, self.snapshot.cells.copy(), actions,
            self.snapshot.solved.copy()))
        goals = moved(self.snapshot, actions)
        for i in free:
            if self.snapshot.agent_mask[i]:
                self._send(i, int(actions[i]), goals[i])
        self.decision += 1

    def _ask(self) -> npt.NDArray[np.int32]:
        """The planner's joint action [R]; all stay while nothing is open, lost robots stay."""
        if self.snapshot.solved.all():
            return np.full(len(self.bodies), STAY, np.int32)
        actions = np.asarray(self.planner.act(self.snapshot), np.int32)
        return np.where(self.snapshot.agent_mask, actions, np.int32(STAY))

    def _send(self, robot: int, action: int, goal: npt.NDArray[np.int32]) -> None:
        """Starts a leg to the goal cell [2]: the robot's own where it stays or is barred."""
        centre = self.frame.centre(goal.astype(float))
        way = float(np.hypot(*(centre - self._xy[robot])))
        limit = (self.rules.timeout_base_s
                 + self.rules.timeout_factor * way / self.bodies[robot].speed)
        leg = Leg(robot, self.decision, action, _cell(self.snapshot.cells[robot]), _cell(goal),
                  self._xy[robot].copy(), centre, self.time, self.time + limit)
        self.legs[robot] = leg
        self.record.legs.append(leg)

    def _note_deviations(self, deciding: Sequence[int]) -> None:
        """Logs why the planner finds another grid than it foresaw."""
        for i in deciding:
            leg = self.legs[i]
            if leg is None or not self.snapshot.agent_mask[i]:
                continue
            leg.end_cell = _cell(self.snapshot.cells[i])
            if leg.ended == "timeout":
                self.record.replans.append((self.decision, "timeout"))
            elif leg.end_cell != leg.goal_cell:
                self.record.replans.append((self.decision, "wrong_cell"))
        if self._lost_since:
            self.record.replans.append((self.decision, "robot_lost"))
            self._lost_since = False

    def _apply_events(self) -> None:
        """What the mission file has in store for this decision."""
        names = [robot.name for robot in self.mission.robots]
        while self._events and self._events[0].at_decision <= self.decision:
            event = self._events.pop(0)
            if event.lost is not None and self.snapshot.agent_mask[names.index(event.lost)]:
                self._lose(names.index(event.lost), "event")
                self._lost_since = False
                self.record.replans.append((self.decision, "robot_lost"))
            if event.target is not None:
                self.record.targets.append(event.target)
                self.record.target_names.append(
                    event.target.name or f"T{len(self.record.targets)}")
                need = sum(self._skill_bits.get(s, NOBODY) for s in set(event.target.skills))
                self.snapshot = with_target(self.snapshot, event.target, need)
                self.record.replans.append((self.decision, "new_target"))

    def _mark_solved(self) -> None:
        """Targets whose needed robots stand in their cell at this decision."""
        solved = self.snapshot.solved.copy()
        for j in np.flatnonzero(~solved).tolist():
            cell = self.snapshot.target_cells[j]
            present = ((self.snapshot.cells == cell).all(-1)
                       & self.frame.inside(self._xy, np.broadcast_to(cell, self._xy.shape)))
            robots = contributors(self.snapshot, present, j)
            if robots:
                solved[j] = True
                centre = self.frame.centre(cell.astype(float))
                away = tuple(float(np.hypot(*(self._xy[i] - centre))) for i in robots)
                self.record.solves.append(
                    Solve(j, self.decision, self.time, tuple(robots), away))
        self.snapshot = replace(self.snapshot, solved=solved)

    def _check_solvable(self) -> None:
        if not self.finished and (targets := unsolvable(self.snapshot)):
            names = ", ".join(self.record.target_names[j] for j in targets)
            gone = ", ".join(f"{self.mission.robots[x.robot].name} ({x.cause})"
                             for x in self.record.losses)
            self._end("unsolvable", f"the robots that are left cannot solve {names}"
                      + (f"; lost: {gone}" if gone else ""))

    def _open_names(self) -> str:
        return ", ".join(self.record.target_names[j]
                         for j in np.flatnonzero(~self.snapshot.solved))

    def _end(self, failure: FailureCause | None, detail: str) -> None:
        self.finished = True
        self.record.success, self.record.failure = failure is None, failure
        self.record.detail = detail
        for i, leg in enumerate(self.legs):
            self._close_leg(i, "cut")
            if leg is not None and leg.end_cell is None:
                leg.end_cell = _cell(self.frame.settle(self._xy[i], self.snapshot.cells[i]))


def _cell(cell: npt.NDArray[np.int32]) -> Cell:
    return int(cell[0]), int(cell[1])


def run(executions: Sequence[Execution], backend: Backend, qpos: npt.ArrayLike,
        progress: Callable[[], None] = lambda: None) -> None:
    """Drives executions, one a world of the backend, to their ends.

    `qpos` [nq] is the pose in which every world starts; `progress` is called at each look.
    Ctrl-C ends all of them where they stand and is raised again.
    """
    rules = executions[0].rules
    state = backend.reset(batch=len(executions))
    period = CONTROL_PERIOD * backend.log_every
    for execution in executions:
        execution.start(qpos)
    try:
        while not all(execution.finished for execution in executions):
            state, log = backend.advance(state, _stack(executions), rules.chunk_steps)
            poses, power = np.asarray(log.qpos), np.asarray(log.power)
            rate = np.asarray(log.propellant_rate)
            gone = np.asarray(state.diverged)
            for b, execution in enumerate(executions):
                if not execution.finished:
                    execution.observe(poses[b], power[b], rate[b], period)
                if gone[b] and not execution.finished:
                    execution.diverged()
            progress()
    except KeyboardInterrupt:
        for execution in executions:
            execution.interrupt()
        raise


def _stack(executions: Sequence[Execution]) -> tuple[Command, ...]:
    """One Command a robot, its arrays with leading axis B."""
    asked = [execution.commands() for execution in executions]
    return tuple(
        Command(xy=jnp.asarray(np.stack([row[i][0] for row in asked]), jnp.float32),
                speed=jnp.asarray([row[i][1] for row in asked], jnp.float32),
                lost=jnp.asarray([row[i][2] for row in asked]))
        for i in range(len(asked[0])))
