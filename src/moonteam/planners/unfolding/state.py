"""Everything that is known of a mission under way; nothing here knows what will happen.

Legend: N robots, M targets that are known of, S skills; times in ms where nothing else is said.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import msgspec
import numpy as np

from moonteam.grid.macro.draw import places
from moonteam.planners.seconds.base import MS, NEVER, Int64, Moment, moment
from moonteam.planners.seconds.keeper import WAIT
from moonteam.planners.unfolding.ground import Ground
from moonteam.planners.unfolding.ways import Floats, Way
from moonteam.problem.timed import Place, Target, Timed

Order = int | Place
"""A known target's number, HOME, WAIT, or a place to go to and look."""

NO_LIMIT_S = 1e6
"""s after which a mission without a limit ends."""


@dataclass
class Body:
    """A robot: what it is about (`goal`), and where."""

    at: Place
    goal: Order = WAIT
    phase: str = "free"  # free, going, there, serving, lost
    way: Way | None = None
    until: int = 0  # ms, when its service ends
    travelled: float = 0.0  # s under way


@dataclass
class Outcome:
    """What came of a mission, in seconds."""

    success: bool = False
    reason: str = ""
    seconds: float = 0.0  # until everything was done, or it was over
    waited: float = 0.0  # mean over all targets, from when there was one to its service's start
    effort: float = 0.0  # of all robots, under way
    decisions: int = 0
    lost: int = 0
    worth: float = 0.0  # served, of targets that may lapse
    missed: float = 0.0  # not served
    solves: list[float] = field(default_factory=list)  # s of each
    seen: list[tuple[float, float]] = field(default_factory=list)  # s, share of the area seen

    @property
    def solved(self) -> int:
        """Targets."""
        return len(self.solves)


@dataclass
class State:
    """A mission as everybody knows it."""

    problem: Timed  # without its targets and what happens to its agents
    names: tuple[str, ...]  # [S] of skills
    now: int
    bodies: list[Body]  # [N]
    ground: Ground | None
    outcome: Outcome
    targets: list[Target] = field(default_factory=list)  # [M] as they came to be known of
    numbers: list[int] = field(default_factory=list)  # [M] by which `after` calls them
    known_at: list[int] = field(default_factory=list)  # [M]
    served_at: list[int] = field(default_factory=list)  # [M] when its service started, or -1
    ends: list[int] = field(default_factory=list)  # [M] when its service ends, or -1
    lapsed: set[int] = field(default_factory=set)  # targets that it had been worth to serve
    _known: Moment | None = None

    def copy(self) -> State:
        """Another, to go on elsewhere; its outcome is begun anew but for what is solved."""
        return State(
            self.problem, self.names, self.now, [replace(body) for body in self.bodies],
            None if self.ground is None else self.ground.copy(),
            Outcome(solves=[*self.outcome.solves]), [*self.targets], [*self.numbers],
            [*self.known_at], [*self.served_at], [*self.ends], {*self.lapsed}, self._known)

    @property
    def limit(self) -> int:
        """When it is over."""
        seconds = self.problem.max_seconds
        return round(MS * (NO_LIMIT_S if seconds is None else seconds))

    def add(self, number: int, target: Target) -> None:
        """A target comes to be known of."""
        self.targets.append(target)
        self.numbers.append(number)
        self.known_at.append(self.now)
        self.served_at.append(-1)
        self.ends.append(-1)

    def place(self, i: int) -> Place:
        """Where a robot is."""
        body = self.bodies[i]
        return body.at if body.way is None else body.way.at(self.now)

    @property
    def known(self) -> Moment:
        """The mission as if it began with what is known of now; made anew when that grows."""
        if self._known is None or len(self._known.solved) != len(self.targets):
            place = {number: j for j, number in enumerate(self.numbers)}
            targets = tuple(msgspec.structs.replace(t, after=tuple(place[k] for k in t.after))
                            for t in self.targets)
            self._known = moment(msgspec.structs.replace(self.problem, targets=targets), self.names)
        return self._known

    def moment(self, coming: int = 0) -> Moment:
        """The mission as planners by the clock take it, with so many targets to be known of."""
        known, agents = self.known, self.problem.agents
        here = np.array([self.place(i) for i in range(len(agents))], float)
        speeds = np.array([agent.speed for agent in agents])
        metric = self.problem.metric
        free = [body.until - self.now if body.phase == "serving" else 0 for body in self.bodies]
        home_now = [0 if agent.home is None else ms(
            distances(here[i:i + 1], np.array([agent.home], float), metric), agent.speed)[0, 0]
            for i, agent in enumerate(agents)]
        return replace(
            known, start=ms(distances(here, self._spots, metric), speeds[:, None]),
            home_now=np.array(home_now, np.int64),
            appears=np.maximum(known.appears - self.now, 0),
            lapses=np.where(known.lapses >= NEVER, NEVER, known.lapses - self.now),
            free=np.array(free, np.int64),
            present=np.array([body.phase != "lost" for body in self.bodies], bool),
            solved=np.array([served >= 0 or j in self.lapsed
                             for j, served in enumerate(self.served_at)], bool),
            ends=np.maximum(np.array(self.ends, np.int64) - self.now, 0),
            limit=max(self.limit - self.now, 0), coming=coming,
            middle=self.middle(self._spots) if coming else None,
            middle_now=self.middle(here) if coming else None)

    @property
    def _spots(self) -> Floats:
        """[M, 2] m."""
        return np.array([target.at for target in self.targets], float).reshape(-1, 2)

    def middle(self, spots: Floats) -> Int64 | None:
        """[A] ms from places [A, 2] to where targets may be, in the mean, for the fastest; None
        where that is not said.
        """
        area = None if self.problem.expects is None else self.problem.expects.area
        if area is None:
            return None
        spread = places(np.array(area[:2]), np.array(area[2:]))
        mean = distances(spots, spread, self.problem.metric).mean(1)
        return ms(mean, max(agent.speed for agent in self.problem.agents))


def ms(metres: Floats, speed: float | Floats) -> Int64:
    """Whole milliseconds of ways at so many metres a second."""
    return np.rint(MS * metres / speed).astype(np.int64)


def distances(a: Floats, b: Floats, metric: str) -> Floats:
    """[..., A, B] metres from places a [..., A, 2] to b [..., B, 2]."""
    shift = np.abs(a[..., :, None, :] - b[..., None, :, :])
    return shift.sum(-1) if metric == "manhattan" else np.hypot(shift[..., 0], shift[..., 1])
