"""A mission by the clock under way: choices of targets, ways, services, and what comes between.

A `TimedExecution` is the twin of `loop.execution.Execution`, driven by the same `drive.run`: it
says where each robot should go, is told how all of them moved, and puts the mission as a `Moment`
to whoever decides whenever something has happened: a service has ended, a target has appeared or
lapsed, a robot is lost, slowed, heard of again or behind its expectation, ground turns out closed,
a hidden target is found, a robot has come to where it was to look from.
In between nothing is decided. Arrival and loss follow from `loop.rules`.

Legend: R robots, M targets, T samples of a look.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from moonteam.planners.seconds.base import MS, NEVER, Moment, Service, enough
from moonteam.planners.seconds.keeper import HOME, WAIT
from moonteam.planners.unfolding.state import Order
from moonteam.planners.unfolding.world import View
from moonteam.problem.mission import Mission
from moonteam.problem.scenario import Scenario
from moonteam.robots.base import CONTROL_PERIOD
from sim2grid.clock import steer
from sim2grid.clock.errand import Errand
from sim2grid.clock.happenings import LATE_S, Happenings
from sim2grid.clock.roads import Floats, Roads
from sim2grid.clock.task import Task
from sim2grid.clock.unfold import LOOK, Scouting, Unfolding
from sim2grid.frame import Frame
from sim2grid.loop import rules as law
from sim2grid.loop.asked import Asked, Body
from sim2grid.loop.known import Known
from sim2grid.loop.logbook import Logbook, cell_of
from sim2grid.loop.power import Power
from sim2grid.loop.record import (
    GOING_ON,
    LOSSES,
    SETTING_OUT,
    Decision,
    FailureCause,
    Leg,
    LossCause,
    Record,
    ReplanCause,
    Solve,
)
from sim2grid.loop.rules import Rules

BEHIND, BEHIND_S = 1.5, 6.0
"""A robot is behind when it has taken so many times what was expected, and so many seconds more."""

WATCH_S = 10.0
"""Seconds after which a robot on its way must have come a part of what it can in that time."""

SAME_M = 0.3
"""m between two places to look from that are one."""

AROUND = np.array([(1, 0), (0, 1), (-1, 0), (0, -1), (1, 1), (-1, 1), (-1, -1), (1, -1)],
                  float)
"""Cells from a place that is closed at which a robot may look instead, times a ring."""

ASTRAY = 0.5
"""Cells from its place beyond which a robot is not at its service any more."""


SOON_S = 0.5
"""Seconds before a robot is where it is to look from at which it is asked where to look next."""

BEYOND_M = 3.0
"""m that its way leads on beyond, lest it slow down there."""


class Chooser(Protocol):
    """Who decides: `keeper.Keeper` with a planner or a policy, or where missions unfold
    `unfold.Scouting`, which is shown a `View` in place of a moment and may send to places.
    """

    name: str

    def reset(self, moment: Moment, seed: int = 0) -> None:
        """Starts a mission."""
        ...

    def act(self, moment: Any, /) -> Any:
        """[R] a target's number, HOME or WAIT, for every robot that is in no service."""
        ...

    def expected(self, moment: Moment) -> Sequence[Service] | None:
        """The services still to come, as they are planned; None where nothing is."""
        ...


class TimedExecution:
    """One mission under way. `finished` once `record.success` or `record.failure` is set."""

    def __init__(self, mission: Mission, scenario: Scenario, planner: Chooser,
                 bodies: Sequence[Body], frame: Frame, roads: Roads, *, seed: int = 0,
                 rules: Rules | None = None):
        self.asked = Asked(mission, scenario, planner, bodies, frame, seed,  # type: ignore[arg-type]
                           "clock", rules or Rules())
        self.known, self.book = Known(self.asked), Logbook(self.asked)
        self.task = Task(mission, bodies, frame)
        self.known.speeds = self.task.speeds
        self.roads = self._charted = roads
        self.planner = planner
        self.question: Moment | View | None = None
        self.finished = False
        self.errands: list[Errand] = []
        self.unfolding = Unfolding(self.task) if isinstance(planner, Scouting) else None
        self._happenings = Happenings(self)
        self._power = Power(self.asked, self.record.charges)
        self._due = True

    @property
    def record(self) -> Record:
        """What happened."""
        return self.book.record

    @property
    def solved(self) -> npt.NDArray[np.bool_]:
        """[M] targets whose services have ended."""
        return self.known.snapshot.solved

    @property
    def snapshot(self):
        """The grid as last decided on."""
        return self.known.snapshot

    @property
    def choosing(self) -> npt.NDArray[np.bool_]:
        """[R] robots that can be sent elsewhere: of the team, heard of and in no service."""
        serving = np.array([errand.phase == "serving" for errand in self.errands])
        return self.known.mask & ~serving & ~(self._happenings.silent_until > self.book.time)

    def moment(self) -> Moment:
        """The mission as it stands."""
        return self.task.as_it_stands(
            self.roads, self.known.xy, self.known.speeds, self.errands, self.known.mask,
            self.solved, self.book.time)

    def start(self, qpos: npt.ArrayLike) -> None:
        """Takes the robots' first pose, qpos [nq], and comes to the first decision."""
        pose = np.asarray(qpos, float)
        zeros = np.zeros((1, len(self.asked.bodies)))
        self.record.log([0.0], pose[None], zeros, zeros)
        self.known.start(self._positions(pose[None])[-1, :, :2])
        self.errands = [Errand.idle(xy, 0.0) for xy in self.known.xy]
        self.book.points = self.known.xy.copy()
        if self.unfolding is not None:
            self.unfolding.see(self.known.xy, self.known.xy, self.known.mask)
        self._happenings.apply()
        self.planner.reset(self.moment(), self.asked.seed)
        self._next()

    def commands(self) -> list[tuple[npt.NDArray, float, bool]]:
        """Waypoint [2] m, speed m/s and lost, for each robot, until the next look."""
        known, xy = self.known, self.known.xy
        going = np.array([e.phase == "going" for e in self.errands]) & known.mask
        places = np.array([e.place for e in self.errands])
        # What flies brakes for where it is sent, so it is sent to the end of each piece.
        ahead = np.where(self.asked.grounded, steer.AHEAD, np.inf)
        aims = np.array([steer.carrot(e.points, p, a) if e.phase == "going" else e.place
                         for e, p, a in zip(self.errands, xy, ahead.tolist(), strict=True)])
        points, holds = steer.mind(
            xy, aims, places, going, self.asked.grounded,
            np.array([body.footprint for body in self.asked.bodies]),
            lambda i, p: not bool(self.asked.frame.off_map(p, 0.0)) and self.roads.passable(
                self.task.kinds[i], p))
        near = law.near(self.asked.rules, self.asked.frame, xy, places)
        speeds = np.where(holds | (near & ~going), 0.0, known.speeds)
        for i, errand in enumerate(self.errands):
            if errand.phase == "serving" and (
                    self.task.targets[errand.choice].service >= self.asked.bodies[i].lands_for):
                speeds[i] = -1.0  # it comes down
        return [(np.where(holds[i], xy[i], points[i]), float(speeds[i]), not bool(known.mask[i]))
                for i in range(len(xy))]

    def observe(self, qpos: npt.NDArray, power: npt.NDArray, propellant: npt.NDArray,
                period: float = CONTROL_PERIOD) -> None:
        """Takes what happened since the last look: qpos [T, nq], power, propellant [T, R]."""
        book, known, seconds = self.book, self.known, period * len(qpos)
        times = book.time + period * np.arange(1, len(qpos) + 1)
        before = self.record.qpos[-1][-1:]
        book.time = float(times[-1])
        self.record.log(times, qpos, power, propellant)
        poses = self._positions(np.concatenate([before, qpos]))  # [T + 1, R, 7]
        for i, cause in enumerate(known.look(poses[1:], seconds).tolist()):
            if cause != law.PRESENT:
                self.lose(i, LOSSES[cause])
        for i in self._power.spend(known.mask, poses[-1, :, :2], power, propellant, seconds):
            self.lose(i, "battery")
        self._progress(poses[0, :, :2], poses[-1, :, :2], seconds)
        if self.unfolding is not None:
            self.unfolding.see(poses[0, :, :2], known.xy, known.mask)
        self._serve()
        self._happenings.apply()
        self._end_if_over()
        if not self.finished and self._due:
            self._next()

    def answer(self, choices: Sequence[Order] | npt.NDArray[np.int64]) -> None:
        """Takes a choice [R] for every robot and sends those that are free to follow it."""
        moment, self.question = self.question, None
        places = {i: order for i, order in enumerate(choices) if isinstance(order, tuple)}
        chosen = np.array([LOOK if i in places else int(order)  # type: ignore[arg-type]
                           for i, order in enumerate(choices)], np.int64)
        book, known = self.book, self.known
        if isinstance(moment, Moment) and not self.record.decisions:
            plan = self.planner.expected(moment) or ()
            self.record.expected |= {one.target: one.end / MS for one in plan}
        self.record.decisions.append(Decision(
            book.decision, book.time, known.snapshot.cells.copy(), chosen.astype(np.int32),
            self.solved.copy()))
        for i in np.flatnonzero(self.choosing).tolist():
            if i in places:
                self._look(i, np.array(places[i]))
            elif chosen[i] != self.errands[i].choice:
                self._choose(i, int(chosen[i]))
        book.decision += 1

    def diverged(self) -> None:
        """Ends the mission: the engine could not go on."""
        self._end("engine", "the physics diverged (not a number, or far too fast)")

    def interrupt(self) -> None:
        """Ends the mission where it stands."""
        if not self.finished:
            self._end("interrupted", "interrupted before the end")

    def ask(self, cause: ReplanCause | None = None) -> None:
        """A decision is due, for a cause that was not foreseen."""
        self._due = True
        if cause is not None:
            self.book.note(cause)

    def lose(self, robot: int, cause: LossCause) -> None:
        """A robot has left the team, and its coalition its service."""
        errand = self.errands[robot]
        self.known.drop(robot)
        self.book.lose(robot, cause)
        self.book.note_losses()
        if errand.phase == "serving":
            self._break(errand.choice)
        self.errands[robot] = Errand.idle(self.known.xy[robot], self.book.time)
        self.ask()

    def let_go(self, target: int) -> None:
        """A target has lapsed, if nobody serves it; where it has a worth the mission goes on."""
        meant = [i for i, errand in enumerate(self.errands) if errand.choice == target]
        if self.solved[target] or any(self.errands[i].phase == "serving" for i in meant):
            return
        if self.task.targets[target].worth:
            self._settle(target)
            self.record.lapsed.append(target)
            for i in meant:
                self._choose(i, WAIT)
        self.ask("lapsed")

    def again(self, robot: int) -> None:
        """Looks for the robot's way anew from where it is."""
        errand = self.errands[robot]
        if errand.phase == "going" and errand.look is not None:
            place, errand.look = errand.look, None
            self._look(robot, place)
        elif errand.phase == "going":
            self._send(robot, errand.choice, errand.place)

    def _positions(self, qpos: npt.NDArray) -> npt.NDArray:
        return qpos[:, self.asked.places].astype(float)

    def _next(self) -> None:
        """Settles the cells and asks for choices, or ends what can never be done."""
        self._due = False
        self.known.settle(self.book.decision)
        moment = self.moment()
        lacking = self._hopeless(moment)
        if self.roads is not self._charted and (lacking or self._cut_off()):
            self.roads = self._charted  # what was learned may be wrong
            moment = self.moment()
            lacking = self._hopeless(moment)
        if lacking:
            names = ", ".join(self.task.names[j] for j in lacking)
            gone = ", ".join(f"{self.asked.mission.robots[x.robot].name} ({x.cause})"
                             for x in self.record.losses)
            self._end("unsolvable", f"the robots that are left cannot solve {names}"
                      + (f"; lost: {gone}" if gone else ""))
        elif (~self.solved).any() or any(e.phase == "free" for e in self.errands):
            self.question = moment if self.unfolding is None else self.unfolding.view(
                moment, self.asked.frame.on_map(self.known.xy), self.known.speeds, self.errands,
                self.book.time, self._happenings.coming, self.record.lapsed)

    def _hopeless(self, moment: Moment) -> list[int]:
        """Open targets that have lapsed, or that nobody left can serve, and that have to be."""
        found = []
        for j in np.setdiff1d(np.flatnonzero(~moment.solved), moment.optional).tolist():
            able = np.flatnonzero(moment.present & (moment.start[:, j] < NEVER)).tolist()
            if moment.lapses[j] < 0 or not able or not enough(able, j, moment):
                found.append(j)
        return found

    def _away(self) -> list[int]:
        """Robots of the team that have a home and are not there."""
        return [i for i, errand in enumerate(self.errands) if self.known.mask[i]
                and self.task.homes[i] is not None and not errand.at_home]

    def _cut_off(self) -> list[int]:
        """Those of them that no way leads home."""
        found = []
        for i in self._away():
            goal, here = self.task.homes[i], self.asked.frame.on_map(self.known.xy[i])
            assert goal is not None
            if not np.isfinite(self.roads.matrix(
                    self.task.kinds[i], here[None], goal[None])[0, 0]):
                found.append(i)
        return found

    def _choose(self, robot: int, choice: int) -> None:
        """Sends a robot on a new errand."""
        home = self.task.homes[robot]
        if choice == WAIT or (choice == HOME and home is None):
            self.book.close(robot, "cut")
            self._note_end(robot)
            self.errands[robot] = Errand.idle(self.known.xy[robot], self.book.time)
            self.errands[robot].choice = choice
            return
        place = home if choice == HOME else self.task.spot(
            self.roads, robot, choice, self.known.mask, self.known.xy, self.errands)
        assert place is not None
        self._send(robot, choice, place)

    def _look(self, robot: int, place: Floats) -> None:
        """Sends a robot by where it is to look from, or as near to that as it can be.

        It need not stand still to see, so its way leads on beyond, where that is open.
        """
        errand, kind = self.errands[robot], self.task.kinds[robot]
        if errand.phase == "going" and errand.look is not None and (
                law.metres(errand.look - place) < SAME_M):
            return
        frame, here = self.asked.frame, self.asked.frame.on_map(self.known.xy[robot])
        gap = float(law.metres(place - here))
        beyond = place + (BEYOND_M / max(gap, SAME_M)) * (place - here)
        near = [frame.on_map(place + ring * frame.cell_m * AROUND) for ring in (1.0, 2.0)]
        for spots in (frame.on_map(np.stack([beyond, place])), *near):
            for spot in spots[np.isfinite(self.roads.matrix(kind, here[None], spots)[0])][:1]:
                self._send(robot, LOOK, spot)
                self.errands[robot].look = place
                return

    def _send(self, robot: int, choice: int, place: Floats) -> None:
        known, book, kind = self.known, self.book, self.task.kinds[robot]
        pace = self.asked.bodies[robot].speed / float(known.speeds[robot])
        here = self.asked.frame.on_map(known.xy[robot])
        book.close(robot, "cut")
        self._note_end(robot)
        if not np.isfinite(self.roads.matrix(kind, here[None], place[None])[0, 0]):
            self.errands[robot] = Errand.idle(known.xy[robot], book.time)
            return
        way = self.roads.way(kind, here, place)
        self.errands[robot] = Errand.to(choice, place, way, pace, book.time)
        self._open_leg(robot, first=True)

    def _open_leg(self, robot: int, first: bool) -> None:
        """Writes down the next straight piece of a robot's way."""
        errand, book, frame = self.errands[robot], self.book, self.asked.frame
        goal, xy = errand.points[1], self.known.xy[robot]
        expected = float(errand.legs[0])
        leg = Leg(robot, book.decision, SETTING_OUT if first else GOING_ON,
                  cell_of(frame.cell(xy)), cell_of(frame.cell(goal)), xy.copy(), goal.copy(),
                  book.time, errand.watched + WATCH_S, expected_s=expected)
        book.legs[robot] = leg
        book.points[robot] = errand.place
        self.record.legs.append(leg)

    def _note_end(self, robot: int) -> None:
        leg = self.book.legs[robot]
        if leg is not None and leg.end_cell is None:
            leg.end_cell = cell_of(self.asked.frame.cell(self.known.xy[robot]))

    def _progress(self, before: Floats, after: Floats, seconds: float) -> None:
        """Follows everybody on its way: pieces done, arrivals, delays; before, after [R, 2]."""
        known, rules = self.known, self.asked.rules
        known.xy = law.seen(after, known.xy)
        places = np.array([e.place for e in self.errands])
        there = (law.near(rules, self.asked.frame, known.xy, places)
                 & law.slow_enough(rules, after, before, known.speeds, seconds)
                 & (known.tilted_s == 0.0))
        for i, errand in enumerate(self.errands):
            if errand.phase != "going" or not known.mask[i]:
                continue
            done = errand.drive(known.xy[i])
            close = rules.arrive_cells * self.asked.frame.cell_m + SOON_S * known.speeds[i]
            if errand.look is not None and law.metres(known.xy[i] - errand.look) < close:
                self.ask()
            if there[i] and len(errand.points) <= 2:
                self.book.close(i, "arrived")
                self._note_end(i)
                known.stalls[i] = 0
                errand.phase = "there"
                if errand.choice == LOOK:
                    if (leg := self.book.legs[i]) is not None:
                        leg.end_cell = leg.goal_cell  # no cell was asked for
                    self.errands[i] = Errand.idle(known.xy[i], self.book.time)
                    self.ask()
            elif done:
                self.book.close(i, "arrived")
                if (leg := self.book.legs[i]) is not None:
                    leg.end_cell = leg.goal_cell  # a corner that it has turned
                self._open_leg(i, first=False)
            else:
                self._mind_time(i)

    def _mind_time(self, robot: int) -> None:
        """Says when a robot is behind, and looks for another way when it has run out of time."""
        errand, leg, now = self.errands[robot], self.book.legs[robot], self.book.time
        if not errand.behind and now - errand.since > BEHIND * errand.expected + BEHIND_S:
            errand.behind = True
            self.ask("behind")
        known, rules = self.known, self.asked.rules
        if leg is None or not law.late(np.float64(now), np.float64(errand.watched + WATCH_S)):
            return
        assert errand.mark is not None
        able = float(known.speeds[robot]) * min(WATCH_S, errand.left(errand.mark))
        came = float(law.metres(known.xy[robot] - errand.mark))
        errand.watched, errand.mark = now, known.xy[robot].copy()
        leg.limit_s = now + WATCH_S
        if came >= rules.stuck_progress * able:
            known.stalls[robot] = 0
            return
        self.book.close(robot, "timeout")
        self._note_end(robot)
        known.stalls[robot] += 1
        if known.stalls[robot] >= rules.stuck_after:
            self.lose(robot, "stuck")
            return
        cells = self.asked.frame.cell(known.xy)
        crowd = law.crowded(rules, self.asked.frame, known.xy, cells,
                            self.book.goals(cells), self.asked.grounded)
        if not crowd[robot] and self.asked.grounded[robot]:
            ahead = steer.carrot(errand.points, known.xy[robot], self.asked.frame.cell_m)
            self.learn(robot, ahead)
        self.again(robot)
        self.ask("timeout")

    def learn(self, robot: int, xy: Floats, told: bool = False) -> None:
        """Closes ground about xy [2] to a robot's kind, if all can still be solved.

        What it was `told` is true; what it found out itself may be wrong.
        """
        before, kind = self.roads, self.task.kinds[robot]
        self.roads = self.roads.close(kind, xy)
        if self._hopeless(self.moment()):
            self.roads = before
            return
        if told:
            self._charted = self._charted.close(kind, xy)
        self.ask("impassable")

    def _serve(self) -> None:
        """Starts services whose coalition is there, ends those whose time has come."""
        now, errands = self.book.time, self.errands
        for j in sorted({e.choice for e in errands if e.phase == "serving"}):
            team = [i for i, e in enumerate(errands) if e.phase == "serving" and e.choice == j]
            astray = [i for i in team if law.metres(self.known.xy[i] - errands[i].place)
                      > ASTRAY * self.asked.frame.cell_m]
            if astray:
                self._break(j)
                for i in astray if not self.solved[j] else ():
                    self._send(i, j, errands[i].place)
            elif now >= errands[team[0]].until - 1e-6:
                self._solve(j, team)
        open_ = [j for j in np.flatnonzero(~self.solved).tolist()
                 if not any(e.phase == "serving" and e.choice == j for e in errands)]
        for j in open_:
            team = [i for i, e in enumerate(errands) if e.phase == "there" and e.choice == j]
            target = self.task.targets[j]
            if not team or now < target.appears - 1e-6 or (
                    target.lapses is not None and now > target.lapses + 1e-6):
                continue
            if not enough(team, j, self.task) or not all(
                    self.solved[k] for k in self.task.after(j)):
                continue
            for i in team:
                errands[i].phase, errands[i].until = "serving", now + target.service
            if target.service == 0.0:
                self._solve(j, team)

    def _solve(self, target: int, team: list[int]) -> None:
        """A service has ended: its target is solved, its robots are free."""
        known, book = self.known, self.book
        self._settle(target)
        centre = self.task.place(self.task.targets[target].at)
        self.record.solves.append(Solve(
            target, book.decision, book.time, tuple(team),
            tuple(float(law.metres(known.xy[i] - centre)) for i in team)))
        for i in team:
            self.errands[i] = Errand.idle(known.xy[i], book.time)
        self.ask()

    def _settle(self, target: int) -> None:
        """From now on nobody has to serve it."""
        solved = self.solved.copy()
        solved[target] = True
        self.known.snapshot = replace(self.known.snapshot, solved=solved)

    def _break(self, target: int) -> None:
        """A service is broken off: who is left waits there again."""
        for errand in self.errands:
            if errand.phase == "serving" and errand.choice == target:
                errand.phase = "there"
        self.ask()
        lapses = self.task.targets[target].lapses
        if lapses is not None and self.book.time > lapses + LATE_S:
            self.let_go(target)

    def _end_if_over(self) -> None:
        """Ends the mission when everything is done, or its time is."""
        if self.finished:
            return
        away = self._away()
        done = self.solved.all() and not self._happenings.coming
        if done and not away:
            self._end(None, "")
        elif done and away == self._cut_off():
            if self.roads is not self._charted:
                self.ask()  # what was learned may be wrong
                return
            names = ", ".join(self.asked.mission.robots[i].name for i in away)
            self._end("unsolvable", f"no way leads {names} home")
        elif self.book.time >= self.asked.mission.max_seconds - 1e-6:
            names = [self.task.names[j] for j in np.flatnonzero(~self.solved)]
            coming = self._happenings.coming
            left = ", ".join(names + ([f"{coming} still to come"] if coming else []))
            self._end("max_seconds", (f"{left} not solved" if left else "not everybody is home")
                      + f" within {self.asked.mission.max_seconds:g} s")

    def _end(self, failure: FailureCause | None, detail: str) -> None:
        self.finished, self.question = True, None
        self.record.success, self.record.failure = failure is None, failure
        self.record.detail = detail
        self.book.cut(self.known)
