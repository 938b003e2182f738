"""The closed loop: planner, waypoints, physics, positions back to the grid, planner again.

An `Execution` is one mission as a state machine without engine and without planner: it says
where each robot should go, is told how all of them moved, and puts the grid as it finds it to
the planner as a `question`. `drive.run` drives any number of executions on one backend. In
`barrier` mode all robots decide together, as in training; in `async` mode each decides when it
arrives and the actions of the others stand.

With a `route` the loop is open: the cells of a plan are walked through decision by decision,
all robots together, whatever they find; nobody is asked.

Legend: R robots, M targets, D decisions, T control steps of a chunk.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from moonteam.planners.base import IntArray, Planner, Snapshot
from moonteam.planners.simulate import STAY, moved
from moonteam.problem.mission import Event, Mission, Target
from moonteam.problem.scenario import Cell, Scenario
from moonteam.robots.base import CONTROL_PERIOD
from sim2grid.frame import Frame, tilt
from sim2grid.loop.brains import check_planner
from sim2grid.loop.record import (
    Decision,
    Ending,
    FailureCause,
    Leg,
    Loss,
    LossCause,
    Record,
    ReplanCause,
    Solve,
)
from sim2grid.loop.replan import contributors, unsolvable, with_target, without_cell
from sim2grid.waypoints import crowds, waypoints, yielding

Mode = Literal["barrier", "async"]
NOBODY = 1 << 30
"""Bit of a skill that no robot has."""


@dataclass(frozen=True)
class Body:
    """What the executor needs to know of a simulated robot."""

    base: int  # index of its free joint in qpos
    speed: float  # m/s, the speed it travels at
    flies: bool = False


class Route(NamedTuple):
    """A plan to be walked through blindly."""

    cells: IntArray  # [D + 1, R, 2], entry 0 is the start
    actions: IntArray  # [D, R]


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
    # Such time-outs in a row. Two are not enough: legs that hook on a rock in one direction have
    # come free at the third try, for by then the ground has been closed or they stand otherwise.
    stuck_after: int = 3
    crowd_cells: float = 1.2  # a robot that near, not the ground, is why another was late

    @property
    def chunk_s(self) -> float:
        """Seconds between two looks."""
        return self.chunk_steps * CONTROL_PERIOD


class Execution:
    """One mission under way. `finished` once `record.success` or `record.failure` is set.

    While `question` is set it waits for `answer`. Raises InputError for a planner that cannot
    serve the mission with all its events.
    """

    def __init__(self, mission: Mission, scenario: Scenario, planner: Planner,
                 bodies: Sequence[Body], frame: Frame, *, seed: int = 0,
                 mode: Mode = "barrier", rules: Rules | None = None,
                 route: Route | None = None):
        self.mission, self.planner, self.bodies, self.frame = mission, planner, bodies, frame
        self.seed, self.mode, self.rules = seed, mode, rules or Rules()
        self.route = route
        self.question: Snapshot | None = None
        self.snapshot = Snapshot.start(scenario)
        self._skill_bits = scenario.skill_bits
        if route is None:
            late = [e.target for e in mission.events if e.target is not None]
            check_planner(planner, self._with_targets(self.snapshot, late))
        # In async mode one robot's move costs the others no decision of their own.
        self._pace = len(bodies) if mode == "async" else 1
        self.limit = mission.max_steps * self._pace
        self.snapshot = replace(self.snapshot, solved=np.zeros_like(self.snapshot.solved),
                                max_steps=self.limit)
        self.record = Record(list(mission.targets),
                             [mission.target_name(j) for j in range(len(mission.targets))])
        self.legs: list[Leg | None] = [None] * len(bodies)
        self.finished = False
        self.time = 0.0
        self.decision = 0
        self._events = sorted(mission.events, key=lambda event: event.at_decision)
        self._tilted_s = np.zeros(len(bodies))
        self._stalls = np.zeros(len(bodies), int)
        self._lost_since = False
        self._xy = np.zeros((len(bodies), 2))
        self._speeds = np.array([body.speed for body in bodies])
        self._silent_until = np.zeros(len(bodies), int)  # decision from which it is heard again
        self._free: list[int] = []  # robots that the question is about
        self._charted = self.snapshot.passable  # without what was learned on the way
        self._places = np.array([np.arange(b.base, b.base + 7) for b in bodies])
        self._points: npt.NDArray | None = None  # waypoints, None: to be laid out again
        self._goals: list[Cell] = []  # as last laid out
        self._laid = np.zeros((len(bodies), 2))
        self._grounded = [not body.flies for body in bodies]

    def start(self, qpos: npt.ArrayLike) -> None:
        """Takes the robots' first pose, qpos [nq], and comes to the first decision."""
        pose = np.asarray(qpos, float)
        zeros = np.zeros((1, len(self.bodies)))
        self.record.log([0.0], pose[None], zeros, zeros)
        self._xy = self._positions(pose[None])[-1, :, :2]
        self.snapshot = replace(self.snapshot, cells=self.frame.cell(self._xy))
        if self.route is None:
            self.planner.reset(self._seen(), self.seed)
        self._decide()

    def commands(self) -> list[tuple[npt.NDArray, float, bool]]:
        """Waypoint [2] m, speed m/s and lost, for each robot, until the next look."""
        mask = self.snapshot.agent_mask
        if self._points is None:
            self._points = self._lay_out()
        there = np.hypot(*(self._points - self._xy).T) <= self._tolerance
        out = []
        for i, leg in enumerate(self.legs):
            hold = bool(there[i]) and (leg is None or leg.ended is not None)
            out.append((self._points[i], 0.0 if hold else float(self._speeds[i]),
                        not bool(mask[i])))
        return out

    def _lay_out(self) -> npt.NDArray:
        """Waypoints [R, 2] m of all robots; a lost one keeps its place."""
        mask = self.snapshot.agent_mask
        goals = [leg.goal_cell if leg is not None and mask[i] else _cell(self.snapshot.cells[i])
                 for i, leg in enumerate(self.legs)]
        points = waypoints(self.frame, goals, self._grounded, self._xy)
        shared, before = crowds(goals, self._grounded), crowds(self._goals, self._grounded)
        alone = [[i] for i, leg in enumerate(self.legs) if leg is not None and not leg.moving
                 and not any(i in group for group in shared)]
        for group in [group for group in shared if group in before] + alone:
            if self._goals and all(self._goals[i] == goals[i] for i in group):
                points[group] = self._laid[group]  # who stays need not change places
        self._goals, self._laid = goals, points
        for i, leg in enumerate(self.legs):
            if leg is not None and leg.ended is None and mask[i]:
                leg.waypoint = points[i]
        return points

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
        return qpos[:, self._places].astype(float)

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
        self._points = None

    def _look_for_arrivals(self, poses: npt.NDArray, seconds: float) -> None:
        """Ends the legs of robots that are there, or late; poses [T + 1, R, 7]."""
        seen = np.isfinite(poses[-1, :, :2].sum(-1, keepdims=True))
        self._xy = np.where(seen, poses[-1, :, :2], self._xy)
        moved_m = np.hypot(*(poses[-1, :, :2] - poses[0, :, :2]).T)
        slow = moved_m <= self.rules.arrive_speed * self._speeds * seconds
        for i, leg in enumerate(self.legs):
            if leg is None or leg.ended is not None:
                continue
            if not leg.moving or (slow[i] and self._tilted_s[i] == 0.0 and self._there(i, leg)):
                self._close_leg(i, "arrived")
                self._stalls[i] = 0 if leg.moving else self._stalls[i]
            elif self.time >= leg.limit_s - 1e-9:
                self._close_leg(i, "timeout")
                self._note_stall(i, leg)
        if self._lost_since and not self.finished:
            self._check_solvable()

    def _there(self, robot: int, leg: Leg) -> bool:
        """Near the waypoint, and inside the goal cell."""
        xy = self._xy[robot]
        return bool(np.hypot(*(xy - leg.waypoint)) <= self._tolerance
                    and self.frame.inside(xy, np.array(leg.goal_cell)))

    def _note_stall(self, robot: int, leg: Leg) -> None:
        """A time-out: with too little progress, `stuck_after` in a row, the robot is stuck."""
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
        """Whether it is time to decide. A silent robot is not waited for once it stands."""
        heard = self.snapshot.agent_mask & (self._silent_until <= self.decision)
        legs = [leg for i, leg in enumerate(self.legs) if leg is not None and (
            heard[i] or (self.snapshot.agent_mask[i] and leg.ended is None))]
        ended = [leg.ended is not None for leg in legs]
        if self.mode == "barrier" or not ended:
            return all(ended)
        moving = [leg.ended is not None for leg in legs if leg.moving]
        return any(moving) if moving else True

    def _decide(self) -> None:
        """Positions to cells, events, targets solved, end or the next question."""
        self.snapshot = replace(
            self.snapshot, cells=self.frame.settle(self._xy, self.snapshot.cells),
            step=self.decision)
        ended = [i for i, leg in enumerate(self.legs) if leg is None or leg.ended is not None]
        self._note_deviations(ended)
        self._apply_events()
        self._mark_solved()
        if self.snapshot.solved.all() and not any(e.target for e in self._events):
            self._end(None, "")
            return
        self._check_solvable()
        if not self.finished:
            self._check_steps()
        if self.finished:
            return
        self._free = [i for i in ended if self.snapshot.agent_mask[i]
                      and self._silent_until[i] <= self.decision]
        if self.route is not None:
            self._act(self.route.actions[self.decision], self.route.cells[self.decision + 1])
        elif self.snapshot.solved.all():
            stay = np.full(len(self.bodies), STAY, np.int32)
            self._act(stay, self.snapshot.cells)
        else:
            self.question = self._seen()

    def answer(self, actions: npt.ArrayLike) -> None:
        """Takes the planner's joint action [R] for `question` and sends the robots."""
        self.question = None
        joint = np.where(self.snapshot.agent_mask, np.asarray(actions, np.int32), np.int32(STAY))
        goals = moved(self.snapshot, joint)
        self._act(joint, self._without_swaps(goals))

    def _without_swaps(self, goals: IntArray) -> IntArray:
        """Goal cells [R, 2] where nobody changes places head-on: one of the two waits."""
        where, bound = list(map(_cell, self.snapshot.cells)), list(map(_cell, goals))
        for i, leg in enumerate(self.legs):
            if not self.snapshot.agent_mask[i]:
                bound[i] = where[i]
            elif i not in self._free and leg is not None:
                bound[i] = leg.goal_cell
                where[i] = leg.from_cell if leg.ended is None else where[i]
        waits = yielding(bound, where, self._free, self._grounded)
        goals = goals.copy()
        goals[waits] = self.snapshot.cells[waits]
        return goals

    def _act(self, actions: IntArray, goals: IntArray) -> None:
        """Sends the robots that are free to their goal cells [R, 2]."""
        self.record.decisions.append(Decision(
            self.decision, self.time, self.snapshot.cells.copy(), actions,
            self.snapshot.solved.copy()))
        for i in self._free:
            self._send(i, int(actions[i]), goals[i])
        self._points = None
        self.decision += 1

    def _check_steps(self) -> None:
        """Ends the mission when its decisions, or those of its plan, are spent."""
        if self.route is not None and self.decision >= len(self.route.actions):
            self._end("plan_over", f"{self._open_names()} not solved when the plan was over")
        elif self.decision >= self.limit:
            self._end("max_steps",
                      f"{self._open_names()} not solved within {self.limit} decisions")

    def _seen(self) -> Snapshot:
        """The moment as the planner sees it.

        A silent robot is believed to be where it was last sent. In async mode, where each
        robot's decisions count, the clock is that of the team.
        """
        cells = self.snapshot.cells.copy()
        for i in np.flatnonzero(self._silent_until > self.decision).tolist():
            leg = self.legs[i]
            cells[i] = cells[i] if leg is None else leg.goal_cell
        return replace(self.snapshot, cells=cells, step=self.decision // self._pace,
                       max_steps=self.mission.max_steps)

    def _send(self, robot: int, action: int, goal: npt.NDArray[np.int32]) -> None:
        """Starts a leg to the goal cell [2]: the robot's own where it stays or is barred."""
        centre = self.frame.centre(goal.astype(float))
        way = float(np.hypot(*(centre - self._xy[robot])))
        limit = (self.rules.timeout_base_s
                 + self.rules.timeout_factor * way / float(self._speeds[robot]))
        leg = Leg(robot, self.decision, action, _cell(self.snapshot.cells[robot]), _cell(goal),
                  self._xy[robot].copy(), centre, self.time, self.time + limit)
        self.legs[robot] = leg
        self.record.legs.append(leg)

    def _note(self, cause: ReplanCause) -> None:
        """Logs why the planner finds another grid than it foresaw."""
        if self.route is None:
            self.record.replans.append((self.decision, cause))

    def _note_deviations(self, ended: Sequence[int]) -> None:
        """Closes the books on legs that ended, and learns from those that timed out."""
        for i in ended:
            leg = self.legs[i]
            if leg is None or leg.end_cell is not None or not self.snapshot.agent_mask[i]:
                continue
            leg.end_cell = _cell(self.snapshot.cells[i])
            if leg.ended == "timeout":
                self._note("timeout")
                if leg.end_cell != leg.goal_cell and leg.moving and not self._crowded(i, leg):
                    self._learn(i, np.array(leg.goal_cell))
            elif leg.end_cell != leg.goal_cell:
                self._note("wrong_cell")
        if self._lost_since:
            self._note("robot_lost")
            self._lost_since = False

    def _crowded(self, robot: int, leg: Leg) -> bool:
        """Whether another robot stood so near, or in the goal, that it may have been in the way."""
        if self.bodies[robot].flies:
            return False
        reach = self.rules.crowd_cells * self.frame.cell_m
        for k, body in enumerate(self.bodies):
            near = np.hypot(*(self._xy[k] - self._xy[robot])) <= reach
            if k != robot and not body.flies and (
                    near or _cell(self.snapshot.cells[k]) == leg.goal_cell):
                return True
        return False

    def _learn(self, robot: int, cell: npt.NDArray[np.int32]) -> None:
        """Ground that a robot could not cross is closed to its kind, if all can still be solved."""
        kind = int(self.snapshot.agent_kinds[robot])
        known = self.snapshot.passable
        if self.route is not None or (known is not None and not known[kind, cell[1], cell[0]]):
            return
        closed = without_cell(self.snapshot, kind, cell)
        if not unsolvable(closed):
            self.snapshot = closed
            self._note("impassable")

    def _apply_events(self) -> None:
        """What the mission has in store for this decision."""
        for i in np.flatnonzero((self._silent_until == self.decision) & (self._silent_until > 0)):
            if self.snapshot.agent_mask[i]:
                self._note("heard_again")
        while self._events and self._events[0].at_decision <= self.decision:
            self._apply(self._events.pop(0))

    def _apply(self, event: Event) -> None:
        names = [robot.name for robot in self.mission.robots]
        if event.lost is not None and self.snapshot.agent_mask[names.index(event.lost)]:
            self._lose(names.index(event.lost), "event")
            self._lost_since = False
            self._note("robot_lost")
        if event.target is not None:
            self.record.targets.append(event.target)
            self.record.target_names.append(event.target.name or f"T{len(self.record.targets)}")
            self.snapshot = self._with_targets(self.snapshot, [event.target])
            self._note("new_target")
        if event.slow is not None:
            self._slow(names.index(event.slow.robot), event.slow.factor)
        if event.silent is not None:
            until = self.decision + event.silent.decisions
            self._silent_until[names.index(event.silent.robot)] = until
            self._note("silent")
        if event.impassable is not None:
            kinds = [robot.kind for robot in self.mission.robots]
            if event.impassable.kind in kinds:
                self._learn(kinds.index(event.impassable.kind), np.array(event.impassable.at))

    def _slow(self, robot: int, factor: float) -> None:
        """From now on a robot travels at a factor of its speed, and is given the time for it."""
        before = float(self._speeds[robot])
        self._speeds[robot] = factor * self.bodies[robot].speed
        leg = self.legs[robot]
        if leg is not None and leg.ended is None:
            leg.limit_s = self.time + (leg.limit_s - self.time) * before / self._speeds[robot]
        self._note("slowed")

    def _with_targets(self, snapshot: Snapshot, targets: Sequence[Target]) -> Snapshot:
        for target in targets:
            need = sum(self._skill_bits.get(skill, NOBODY) for skill in set(target.skills))
            snapshot = with_target(snapshot, target, need)
        return snapshot

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
        """Ends the mission if what is open can never be solved; what was learned may be wrong."""
        if self.finished or not (targets := unsolvable(self.snapshot)):
            return
        self.snapshot = replace(self.snapshot, passable=self._charted)
        if targets := unsolvable(self.snapshot):
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
