"""A mission by the clock as arrays: what does not change, and the moment that planners are given.

Legend: R robots, M targets, S skills.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from moonteam.planners.seconds.base import MS, NEVER, Bools, Int64, Moment, enough
from moonteam.problem.mission import Mission, Target
from sim2grid.clock.errand import Errand
from sim2grid.clock.roads import Floats, Roads
from sim2grid.frame import Frame
from sim2grid.loop.asked import Body
from sim2grid.waypoints import SLOTS


@dataclass
class Task:
    """Targets, those brought by events at the end, and the team that is asked to serve them."""

    mission: Mission
    bodies: Sequence[Body]
    frame: Frame
    targets: list[Target] = field(default_factory=list)
    names: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.skills = sorted({s for r in self.mission.robots for s in r.skills}
                             | {s for t in self.mission.targets for s in t.needs()}
                             | {s for e in self.mission.events if e.target is not None
                                for s in e.target.needs()})
        self.has = np.array([[s in r.skills for s in self.skills] for r in self.mission.robots])
        self.kinds = [robot.kind for robot in self.mission.robots]
        self.homes = [None if r.home is None else self.place(r.home) for r in self.mission.robots]
        for target in self.mission.targets:
            self.add(target)

    def place(self, at: tuple[float, float]) -> Floats:
        """The point [2] m of a place in cells."""
        return self.frame.centre(np.array(at, float))

    def add(self, target: Target) -> None:
        """One more target."""
        self.targets.append(target)
        self.names.append(target.name or f"T{len(self.targets)}")

    @property
    def need(self) -> Int64:
        """[M, S] robots wanted of each skill."""
        return np.array([[t.needs().get(s, 0) for s in self.skills] for t in self.targets],
                        np.int64).reshape(len(self.targets), len(self.skills))

    @property
    def points(self) -> Floats:
        """[M, 2] m, the targets."""
        return np.array([self.place(t.at) for t in self.targets]).reshape(-1, 2)

    def after(self, target: int) -> list[int]:
        """Numbers of the targets that come before one."""
        return [self.names.index(name) for name in self.targets[target].after]

    def moment(self, roads: Roads, xy: Floats, speeds: Floats, errands: Sequence[Errand],
               present: Bools, solved: Bools, now: float) -> Moment:
        """The mission at second `now`, with robots at `xy` [R, 2] m as fast as `speeds` [R] m/s.

        Everybody who is in no service can be sent elsewhere. Beside the way a robot needs its
        `settle` seconds for each place.
        """
        robots, count = len(xy), len(self.targets)
        pace = np.array([body.speed for body in self.bodies]) / speeds
        settle = [body.settle for body in self.bodies]
        points = self.points
        at, free = self.frame.on_map(xy), np.zeros(robots, np.int64)
        under_way, ends = solved.copy(), np.zeros(count, np.int64)
        for i, errand in enumerate(errands):
            if errand.phase == "serving" and present[i]:
                left = max(0, round(MS * (errand.until - now)))
                free[i], at[i] = left, points[errand.choice]
                under_way[errand.choice], ends[errand.choice] = True, left
        start = np.full((robots, count), NEVER, np.int64)
        between = np.full((robots, count, count), NEVER, np.int64)
        home, home_now = np.zeros((robots, count), np.int64), np.zeros(robots, np.int64)
        for i, kind in enumerate(self.kinds):
            start[i] = _ms(pace[i] * roads.matrix(kind, at[i:i + 1], points)[0] + settle[i])
            between[i] = _ms(pace[i] * roads.matrix(kind, points, points) + settle[i])
            if (goal := self.homes[i]) is not None:
                home[i] = _ms(pace[i] * roads.matrix(kind, points, goal[None])[:, 0] + settle[i])
                home_now[i] = _ms(pace[i] * roads.matrix(kind, at[i:i + 1], goal[None])[:, 0]
                                  + settle[i])[0]
        for i, errand in enumerate(errands):
            if errand.phase == "there":
                start[i, errand.choice] = 0
        after = np.zeros((count, count), bool)
        for j in range(count):
            after[j, self.after(j)] = True
        return Moment(
            start=start, between=between, home=home, home_now=home_now,
            classes=np.arange(robots), has=self.has, need=self.need,
            either=np.array([t.either for t in self.targets], bool),
            service=np.array([round(MS * t.service) for t in self.targets], np.int64),
            after=after,
            appears=np.array([max(0, round(MS * (t.appears - now))) for t in self.targets],
                             np.int64),
            lapses=np.array([NEVER if t.lapses is None else round(MS * (t.lapses - now))
                             for t in self.targets], np.int64),
            free=free, present=present.copy(), solved=under_way, ends=ends,
            effort=np.ones(robots), limit=round(MS * (self.mission.max_seconds - now)))

    def spot(self, roads: Roads, robot: int, target: int, mates: Bools) -> Floats:
        """Where a robot stands at a target [2] m: in its middle, or in a quarter of its own.

        `mates` [R] are the other robots that may stand there with it. Who flies keeps to the
        middle, and so does who needs nobody's help and has none.
        """
        centre = self.place(self.targets[target].at)
        ground = np.array([not body.flies for body in self.bodies])
        if not ground[robot] or not (mates & ground).any():
            return centre
        rank = int((mates & ground)[:robot].sum())
        own = self.frame.cell_m * SLOTS
        places = [centre + own[(rank + k) % len(own)] for k in range(len(own))]
        kind = self.kinds[robot]
        return next((p for p in places if roads.passable(kind, p)), centre)

    def helpers(self, moment: Moment, target: int, robot: int) -> Bools:
        """[R] robots other than this one that may have to stand at a target with it."""
        if moment.either[target] or enough((robot,), target, moment):
            return np.zeros(len(self.bodies), bool)
        useful = (self.has & (moment.need[target] > 0)).any(1) & moment.present
        useful[robot] = False
        return useful


def _ms(seconds: npt.NDArray[np.float64]) -> Int64:
    """Whole milliseconds; NEVER where infinite."""
    finite = np.isfinite(seconds)
    return np.where(finite, np.rint(MS * np.where(finite, seconds, 0.0)), NEVER).astype(np.int64)
