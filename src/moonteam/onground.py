"""A mission by the clock on its ground, as the arrays that planners are given.

Both wings meet here as numbers alone: seconds of every way, skills, windows. `sim2grid` asks for
moments of missions under way, `moonteam plan` for the first one.

Legend: R robots, M targets, S skills. Points are [2] m, the site's centre at the origin.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import numpy.typing as npt

from moonteam.planners.seconds.base import MS, NEVER, Bools, Int64, Moment, worth_of
from moonteam.problem.mission import Mission, Place, Target
from moonteam.problem.rules import centre

Floats = npt.NDArray[np.float64]


class Travel(Protocol):
    """What is asked of the ground, such as `terrain.travel.Roads`."""

    def matrix(self, kind: str, starts: Floats, to: Floats) -> Floats:
        """Seconds [S, T] from starts [S, 2] m `to` [T, 2] m; infinite where no way is."""
        ...


class OnGround:
    """A mission's targets, those brought by events at the end, and its team.

    Args:
      mission: whose kinds go by their names.
      speeds: [R] m/s at which `Travel` has each robot's kind on the level.
      settle: [R] s that setting out and coming to rest cost each robot beside the way.
    """

    def __init__(self, mission: Mission, speeds: Sequence[float], settle: Sequence[float]):
        self.mission, self.targets, self.names = mission, [], []
        self._speeds, self._settle = np.array(speeds, float), np.array(settle, float)
        wanted = [e.target for e in mission.events if e.target is not None]
        self.skills = sorted({s for r in mission.robots for s in r.skills}
                             | {s for t in (*mission.targets, *wanted) for s in t.needs()})
        self.has = np.array([[s in r.skills for s in self.skills] for r in mission.robots])
        self.kinds = [robot.kind for robot in mission.robots]
        self.homes = [None if r.home is None else self.place(r.home) for r in mission.robots]
        for target in mission.targets:
            self.add(target)

    targets: list[Target]
    names: list[str]

    def place(self, at: Place) -> Floats:
        """The point [2] m of a place in cells."""
        return centre(np.array(at, float), self.mission.map.size, self.mission.map.cell_m)

    def add(self, target: Target) -> None:
        """One more target."""
        self.targets.append(target)
        self.names.append(target.name or f"T{len(self.targets)}")

    @property
    def starts(self) -> Floats:
        """[R, 2] m, where the robots stand at the start."""
        return np.array([self.place(robot.start) for robot in self.mission.robots])

    @property
    def speeds(self) -> Floats:
        """[R] m/s: of the kind, or what the mission says where that is less."""
        said = [np.inf if r.speed is None else r.speed for r in self.mission.robots]
        return np.minimum(self._speeds, said)

    @property
    def need(self) -> Int64:
        """[M, S] robots wanted of each skill."""
        return np.array([[t.needs().get(s, 0) for s in self.skills] for t in self.targets],
                        np.int64).reshape(len(self.targets), len(self.skills))

    @property
    def either(self) -> Bools:
        """[M] one robot with any of the skills that are needed."""
        return np.array([target.either for target in self.targets], bool)

    @property
    def points(self) -> Floats:
        """[M, 2] m, the targets."""
        return np.array([self.place(t.at) for t in self.targets]).reshape(-1, 2)

    def after(self, target: int) -> list[int]:
        """Numbers of the targets that come before one."""
        return [self.names.index(name) for name in self.targets[target].after]

    def first(self, travel: Travel) -> Moment:
        """The mission's first moment."""
        robots, count = len(self.kinds), len(self.targets)
        return self.moment(travel, self.starts, self.speeds, np.ones(robots, bool),
                           np.zeros(count, bool), np.zeros(robots), np.zeros(count), 0.0)

    def moment(self, travel: Travel, at: Floats, speeds: Floats, present: Bools, solved: Bools,
               free: Floats, ends: Floats, now: float) -> Moment:
        """The mission at second `now`.

        Args:
          travel: the ground as it is known.
          at: [R, 2] m from where each robot sets out when it is free.
          speeds: [R] m/s, on the level.
          present: [R] in the team.
          solved: [M] solved or in service.
          free: [R] s from now after which each can set out.
          ends: [M] s from now at which services under way end; 0 of other targets.
          now: mission second.
        """
        robots, count, points = len(at), len(self.targets), self.points
        pace = self._speeds / speeds
        start = np.full((robots, count), NEVER, np.int64)
        between = np.full((robots, count, count), NEVER, np.int64)
        home, home_now = np.zeros((robots, count), np.int64), np.zeros(robots, np.int64)
        for i, kind in enumerate(self.kinds):
            here, settle = at[i:i + 1], self._settle[i]
            start[i] = ms(pace[i] * travel.matrix(kind, here, points)[0] + settle)
            between[i] = ms(pace[i] * travel.matrix(kind, points, points) + settle)
            if (goal := self.homes[i]) is not None:
                there = goal[None]
                home[i] = ms(pace[i] * travel.matrix(kind, points, there)[:, 0] + settle)
                home_now[i] = ms(pace[i] * travel.matrix(kind, here, there)[0] + settle)[0]
                if home_now[i] >= NEVER:  # closed meanwhile: no plan has to lead there
                    home[i], home_now[i] = 0, 0
        after = np.zeros((count, count), bool)
        for j in range(count):
            after[j, self.after(j)] = True
        its = self.targets
        return Moment(
            start=start, between=between, home=home, home_now=home_now,
            classes=np.arange(robots), has=self.has, need=self.need, either=self.either,
            service=ms(np.array([t.service for t in its], float)), after=after,
            appears=ms(np.array([max(0.0, t.appears - now) for t in its])),
            lapses=ms(np.array([np.inf if t.lapses is None else t.lapses - now for t in its])),
            free=ms(free), present=present.copy(), solved=solved.copy(), ends=ms(ends),
            effort=np.ones(robots), limit=round(MS * (self.mission.max_seconds - now)),
            worth=worth_of(its))


def ms(seconds: Floats) -> Int64:
    """Whole milliseconds; NEVER where infinite."""
    finite = np.isfinite(seconds)
    return np.where(finite, np.rint(MS * np.where(finite, seconds, 0.0)), NEVER).astype(np.int64)
