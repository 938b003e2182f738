"""A mission on its ground as planners for missions that unfold are shown it, and who so decides.

What robots have seen of the ground, what is known and how much is still to come make a `View` of
the planners' world; its moment is the ground's own, with ways over slopes and about boulders. Where
planners think of places to look from, or of futures, they take ways for straight and level.

Legend: R robots, M targets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import msgspec
import numpy as np

from moonteam.planners.seconds.base import MS, Bools, Moment
from moonteam.planners.seconds.keeper import WAIT
from moonteam.planners.unfolding.deciding.deciders import Decider
from moonteam.planners.unfolding.ground import Ground
from moonteam.planners.unfolding.state import Body, Order, Outcome, State
from moonteam.planners.unfolding.world import View
from moonteam.problem import timed
from moonteam.problem.mission import Target
from sim2grid.clock.errand import Errand
from sim2grid.clock.roads import Floats
from sim2grid.clock.task import Task

LOOK = -3
"""Choice beside `keeper.WAIT` and `HOME`: a place to look from."""


class Scouting:
    """Who decides by what is shown of a mission that unfolds, in place of a `Keeper`."""

    def __init__(self, name: str, decider: Decider):
        self.name, self._decider = name, decider

    def reset(self, moment: Moment, seed: int = 0) -> None:
        """Starts a mission; each has its own."""
        del moment, seed

    def act(self, view: View) -> Sequence[Order]:
        """[R] a target's number, HOME, WAIT or a place, m."""
        return self._decider.act(view)

    def expected(self, moment: object) -> None:
        """No plan reaches beyond what comes."""
        del moment


class Unfolding:
    """What is shown of a mission under way, and what has been seen of its ground."""

    def __init__(self, task: Task):
        mission, self._task = task.mission, task
        self._sensors = [robot.sensor_m for robot in mission.robots]
        expects = mission.expects or timed.Prospect()
        wide, high = mission.map.size
        west, south, east, north = expects.area or (0.0, 0.0, wide - 1.0, high - 1.0)
        corners = [*task.place((west, south)).tolist(), *task.place((east, north)).tolist()]
        self._expects = msgspec.structs.replace(
            expects, area=(corners[0], corners[1], corners[2], corners[3]))
        self.ground = Ground.of(self._problem(task.starts, task.speeds))
        self._known_at: list[int] = []

    def see(self, before: Floats, after: Floats, present: Bools) -> None:
        """Takes the way that robots came, from and to [R, 2] m."""
        if self.ground is None:
            return
        for i, reach in enumerate(self._sensors):
            if reach is not None and present[i]:
                self.ground.see(np.stack([before[i], after[i]]), reach)

    def view(self, moment: Moment, at: Floats, speeds: Floats, errands: Sequence[Errand],
             now: float, coming: int, lapsed: Sequence[int] = ()) -> View:
        """What is known at second `now`, with robots at `at` [R, 2] m as fast as `speeds` [R], and
        targets that have `lapsed`, which counts as solved.
        """
        clock, served = round(MS * now), moment.solved.copy()
        served[list(lapsed)] = False
        problem = self._problem(at, speeds)
        targets = [self._target(j, target) for j, target in enumerate(self._task.targets)]
        self._known_at += [clock] * (len(targets) - len(self._known_at))
        state = State(
            problem, tuple(self._task.skills), clock,
            [_body(errand, place, bool(here)) for errand, place, here in zip(
                errands, at, moment.present, strict=True)],
            self.ground, Outcome(), targets, list(range(len(targets))), [*self._known_at],
            np.where(served, clock, -1).tolist(),
            np.where(served, clock + moment.ends, -1).tolist(), set(lapsed))
        if coming:
            moment = replace(moment, coming=coming, middle=state.middle(self._task.points),
                             middle_now=state.middle(at))
        return View(clock, moment, tuple(targets), at, problem.agents, self._expects, coming,
                    self.ground, state)

    def _problem(self, at: Floats, speeds: Floats) -> timed.Timed:
        """The team where it is, without targets."""
        homes = [None if home is None else _place(home) for home in self._task.homes]
        agents = tuple(
            timed.Agent(_place(here), robot.skills, float(speed), home, robot.kind, robot.sensor_m)
            for here, robot, speed, home in zip(at, self._task.mission.robots, speeds, homes,
                                                strict=True))
        return timed.Timed("seconds", agents, (), max_seconds=self._task.mission.max_seconds,
                           expects=self._expects)

    def _target(self, number: int, target: Target) -> timed.Target:
        """A target as problems by the clock have it, in metres."""
        return timed.Target(
            _place(self._task.place(target.at)), target.skills, "OR" if target.either else "AND",
            target.coalition, target.service, tuple(self._task.after(number)), target.appears,
            target.lapses, target.worth)


def _place(xy: Floats) -> timed.Place:
    return float(xy[0]), float(xy[1])


def _body(errand: Errand, at: Floats, present: bool) -> Body:
    """A robot as that world has it; where it is to look it is on its way to a place."""
    goal: Order = errand.choice
    if errand.look is not None:
        goal = _place(errand.look)
    phase = errand.phase if present else "lost"
    return Body(_place(at), goal if phase != "lost" else WAIT, phase,
                until=round(MS * errand.until))
