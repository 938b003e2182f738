"""The closed loop: planner, waypoints, physics, positions back to the grid, planner again.

An `Execution` is one mission as a state machine without engine and without planner: it says
where each robot should go, is told how all of them moved, and puts the grid as it finds it to
the planner as a `question`. `drive.run` drives any number of executions on one backend. In
`barrier` mode all robots decide together, as in training; in `async` mode each decides when it
arrives and the actions of the others stand.

With a `route` the loop is open: the cells of a plan are walked through decision by decision,
all robots together, whatever they find; nobody is asked.

It holds three things: what is asked (`asked`), what is known (`known`), what is written down
(`book`). What happens follows from `rules` and `sim2grid.waypoints`.

Legend: R robots, M targets, D decisions, T samples of a look.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from moonteam.planners.base import IntArray, Planner, Snapshot
from moonteam.planners.registry import check_planner
from moonteam.planners.simulate import STAY, moved
from moonteam.problem.mission import Mission
from moonteam.problem.scenario import Scenario
from moonteam.robots.base import CONTROL_PERIOD
from sim2grid.frame import Frame
from sim2grid.loop import rules as law
from sim2grid.loop.asked import Asked, Body, Mode, Route
from sim2grid.loop.events import Events
from sim2grid.loop.known import Known
from sim2grid.loop.logbook import Logbook, cell_of
from sim2grid.loop.power import Power
from sim2grid.loop.record import (
    LOSSES,
    Decision,
    FailureCause,
    LossCause,
    Record,
    Solve,
    failed_words,
    unsolvable_words,
)
from sim2grid.loop.rules import Rules
from sim2grid.waypoints import yielding


class Execution:
    """One mission under way. `finished` once `record.success` or `record.failure` is set.

    While `question` is set it waits for `answer`. Raises InputError for a planner that cannot
    serve the mission with all its events.
    """

    def __init__(self, mission: Mission, scenario: Scenario, planner: Planner,
                 bodies: Sequence[Body], frame: Frame, *, seed: int = 0,
                 mode: Mode = "barrier", rules: Rules | None = None,
                 route: Route | None = None):
        self.asked = Asked(mission, scenario, planner, bodies, frame, seed, mode,
                           rules or Rules(), route)
        self.known = Known(self.asked)
        self.book = Logbook(self.asked)
        self.question: Snapshot | None = None
        self.finished = False
        self._events = Events(self.asked)
        self._power = Power(self.asked, self.record.charges)
        self._free = np.zeros(len(bodies), bool)  # robots that the question is about
        if route is None:
            late = [e.target for e in mission.events if e.target is not None]
            check_planner(planner, self.asked.with_targets(Snapshot.start(scenario), late))

    @property
    def record(self) -> Record:
        """What happened."""
        return self.book.record

    @property
    def planner(self) -> Planner:
        """Who answers the questions."""
        return self.asked.planner

    @property
    def snapshot(self) -> Snapshot:
        """The grid as last decided on."""
        return self.known.snapshot

    def start(self, qpos: npt.ArrayLike) -> None:
        """Takes the robots' first pose, qpos [nq], and comes to the first decision."""
        pose = np.asarray(qpos, float)
        zeros = np.zeros((1, len(self.asked.bodies)))
        self.record.log([0.0], pose[None], zeros, zeros)
        self.known.start(self._positions(pose[None])[-1, :, :2])
        if self.asked.route is None:
            self.planner.reset(self._believed(), self.asked.seed)
        self._decide()

    def commands(self) -> list[tuple[npt.NDArray, float, bool]]:
        """Waypoint [2] m, speed m/s and lost, for each robot, until the next look."""
        known, points = self.known, self.book.points
        hold = law.near(self.asked.rules, self.asked.frame, points, known.xy) & ~self.book.going()
        speeds = np.where(hold, 0.0, known.speeds)
        return [(points[i], float(speeds[i]), not bool(known.mask[i])) for i in range(len(points))]

    def observe(self, qpos: npt.NDArray, power: npt.NDArray, propellant: npt.NDArray,
                period: float = CONTROL_PERIOD) -> None:
        """Takes what happened since the last look: qpos [T, nq], power, propellant [T, R].

        `period` is the time between two samples, s.
        """
        times = self.book.time + period * np.arange(1, len(qpos) + 1)
        before = self.record.qpos[-1][-1:]
        self.book.time = float(times[-1])
        self.record.log(times, qpos, power, propellant)
        poses = self._positions(np.concatenate([before, qpos]))  # [T + 1, R, 7]
        lost = len(self.record.losses)
        self._look_for_losses(poses[1:], period * len(qpos), power, propellant)
        if self.finished:
            return
        self._look_for_arrivals(poses, period * len(qpos))
        if self._ready():
            self._decide()
        elif not self.finished and len(self.record.losses) > lost:
            self.book.lay_out(self.known)

    def answer(self, actions: npt.ArrayLike) -> None:
        """Takes the planner's joint action [R] for `question` and sends the robots."""
        self.question = None
        mask = self.known.mask
        joint = np.where(mask, np.asarray(actions, np.int32), np.int32(STAY))
        self._act(joint, self._without_swaps(moved(self.snapshot, joint)))

    def diverged(self) -> None:
        """Ends the mission: the engine could not go on."""
        self._end("engine", "the physics diverged (not a number, or far too fast)")

    def interrupt(self) -> None:
        """Ends the mission where it stands."""
        if not self.finished:
            self._end("interrupted", "interrupted before the end")

    def _positions(self, qpos: npt.NDArray) -> npt.NDArray:
        """Free joints [T, R, 7] out of qpos [T, nq]."""
        return qpos[:, self.asked.places].astype(float)

    def _places(self) -> tuple[npt.NDArray, IntArray]:
        """Positions and cells [R, 2] by which targets are solved."""
        return self.known.xy, self.snapshot.cells

    def _look_for_losses(self, poses: npt.NDArray, seconds: float, power: npt.NDArray,
                         propellant: npt.NDArray) -> None:
        """Marks robots that fell, left the map, are not a number or out of power.

        poses [T, R, 7], power and propellant [T, R].
        """
        for i, cause in enumerate(self.known.look(poses, seconds).tolist()):
            if cause != law.PRESENT:
                self._lose(i, LOSSES[cause])
        for i in self._power.spend(self.known.mask, poses[-1, :, :2], power, propellant, seconds):
            self._lose(i, "battery")
        if self.book.loss_unnoted:
            self._check_solvable()

    def _lose(self, robot: int, cause: LossCause) -> None:
        self.known.drop(robot)
        self.book.lose(robot, cause)

    def _look_for_arrivals(self, poses: npt.NDArray, seconds: float) -> None:
        """Ends the legs of robots that are there, or late; poses [T + 1, R, 7]."""
        rules, known, book = self.asked.rules, self.known, self.book
        before, after = poses[0, :, :2], poses[-1, :, :2]
        known.xy = law.seen(after, known.xy)
        going, moving = book.going(), book.moving()
        there = law.arrived(
            rules, self.asked.frame, known.xy, book.points, book.goals(self.snapshot.cells),
            law.slow_enough(rules, after, before, known.speeds, seconds), known.tilted_s)
        came = going & (~moving | there)
        limits = book.each(lambda leg: leg.limit_s, np.zeros(len(going)))
        late = going & ~came & law.late(book.time, limits)
        known.stalls = law.stalls(
            rules, known.stalls, late, came & moving, known.xy,
            book.each(lambda leg: leg.start_xy, known.xy), book.points)
        stuck = law.stuck(rules, late, known.stalls)
        for i in np.flatnonzero(came | late).tolist():
            book.close(i, "arrived" if came[i] else "timeout")
            if stuck[i]:
                self._lose(i, "stuck")
        if book.loss_unnoted and not self.finished:
            self._check_solvable()

    def _ready(self) -> bool:
        """Whether it is time to decide. A silent robot is not waited for once it stands."""
        if self.finished:
            return False
        known, going = self.known, self.book.going()
        heard = known.mask & ~known.silent(self.book.decision)
        if self.asked.mode == "barrier":
            return not bool((known.mask & going).any())
        moving = (heard | (known.mask & going)) & self.book.moving()
        return not moving.any() or bool((moving & ~going).any())

    def _decide(self) -> None:
        """Positions to cells, events, targets solved, end or the next question."""
        known, book = self.known, self.book
        known.settle(book.decision)
        ended = book.ended()
        self._note_deviations(ended)
        self._events.apply(known, book)
        self._mark_solved()
        if self.snapshot.solved.all() and not self._events.bring_targets:
            self._end(None, "")
            return
        self._check_solvable()
        self._check_steps()
        if self.finished:
            return
        self._free[:] = False
        self._free[ended] = True
        self._free &= known.mask & ~known.silent(book.decision)
        if (route := self.asked.route) is not None:
            self._act(route.actions[book.decision], route.cells[book.decision + 1])
        elif self.snapshot.solved.all():
            self._act(np.full(len(self._free), STAY, np.int32), self.snapshot.cells)
        else:
            self.question = self._believed()

    def _believed(self) -> Snapshot:
        goals = self.book.goals(self.snapshot.cells)
        return self.known.believed(goals, self.book.decision)

    def _without_swaps(self, goals: IntArray) -> IntArray:
        """Goal cells [R, 2] where nobody changes places head-on: one of the two waits."""
        cells, mask = self.snapshot.cells, self.known.mask
        book = self.book
        theirs = (mask & ~self._free)[:, None]  # who goes on with its leg
        bound = np.where(mask[:, None], np.where(theirs, book.goals(goals), goals), cells)
        away = theirs & book.going()[:, None]
        where = np.where(away, book.each(lambda leg: leg.from_cell, cells), cells)
        waits = yielding(bound, where, self._free, self.asked.grounded)
        return np.where(waits[:, None], cells, goals)

    def _act(self, actions: IntArray, goals: IntArray) -> None:
        """Sends the robots that are free to their goal cells [R, 2]."""
        book, now = self.book, self.snapshot
        self.record.decisions.append(Decision(
            book.decision, book.time, now.cells.copy(), actions, now.solved.copy()))
        for i in np.flatnonzero(self._free).tolist():
            book.send(i, int(actions[i]), goals[i], self.known)
        book.lay_out(self.known)
        book.decision += 1

    def _note_deviations(self, ended: Sequence[int]) -> None:
        """Closes the books on legs that ended, and learns from those that timed out."""
        known, book, cells = self.known, self.book, self.snapshot.cells
        crowded = law.crowded(self.asked.rules, self.asked.frame, known.xy, cells,
                              book.goals(cells), self.asked.grounded)
        for i in ended:
            leg = book.legs[i]
            if leg is None or leg.end_cell is not None or not known.mask[i]:
                continue
            leg.end_cell = cell_of(cells[i])
            astray = leg.end_cell != leg.goal_cell
            if leg.ended == "timeout":
                book.note("timeout")
                learns = astray and leg.moving and not crowded[i] and self.asked.route is None
                if learns and known.learn(i, np.array(leg.goal_cell)):
                    book.note("impassable")
            elif astray:
                book.note("wrong_cell")
        book.note_losses()

    def _mark_solved(self) -> None:
        """Targets whose needed robots stand in their cell at this decision."""
        xy, cells = self._places()
        shares = self.known.solve(xy, cells)
        for j in np.flatnonzero(shares.any(0)).tolist():
            robots = np.flatnonzero(shares[:, j])
            centre = self.asked.frame.centre(self.snapshot.target_cells[j].astype(float))
            away = law.metres(xy[robots] - centre[None])
            self.record.solves.append(Solve(
                j, self.book.decision, self.book.time, tuple(robots.tolist()),
                tuple(away.tolist())))

    def _check_solvable(self) -> None:
        """Ends the mission if what is open can never be solved."""
        if not self.finished and (targets := self.known.unsolvable()):
            self._end("unsolvable", unsolvable_words(self.record, self.asked.mission, targets))

    def _check_steps(self) -> None:
        """Ends the mission when its decisions, or those of its plan, are spent."""
        route, decision = self.asked.route, self.book.decision
        if self.finished:
            return
        if route is not None and decision >= len(route.actions):
            self._end("plan_over", failed_words(self.record, self.snapshot.solved))
        elif decision >= self.asked.limit:
            self._end("max_steps", failed_words(self.record, self.snapshot.solved,
                                                self.asked.limit))

    def _end(self, failure: FailureCause | None, detail: str) -> None:
        self.finished = True
        self.record.success, self.record.failure = failure is None, failure
        self.record.detail = detail
        self.book.cut(self.known)
