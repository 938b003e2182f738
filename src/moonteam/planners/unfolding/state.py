"""Everything that is known of a mission under way; nothing here knows what will happen.

Legend: N robots, M targets that are known of, K speeds, S skills; times in ms where nothing else is
said.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from moonteam.planners.seconds.base import MS, NEVER, Bools, Int64, Moment
from moonteam.planners.seconds.keeper import WAIT
from moonteam.planners.unfolding.ground import Ground
from moonteam.planners.unfolding.ways import Floats, Way
from moonteam.problem.timed import Place, Target, Timed

Order = int | Place
"""A known target's number, HOME, WAIT, or a place to go to and look."""

PARTS = 8
"""Along each side of the area in which targets may be, for the mean way there."""

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
    solved: int = 0
    waited: float = 0.0  # mean over all targets, from when there was one to its service's start
    effort: float = 0.0  # of all robots, under way
    decisions: int = 0
    lost: int = 0
    solves: list[float] = field(default_factory=list)  # s of each
    seen: list[tuple[float, float]] = field(default_factory=list)  # s, share of the area seen


@dataclass(frozen=True)
class Table:
    """What follows from which targets are known of; `Moment` says what each column is."""

    spots: Floats  # [M, 2] m
    between: Int64  # [K, M, M]
    home: Int64  # [N, M]
    need: Int64  # [M, S]
    either: Bools  # [M]
    service: Int64  # [M]
    after: Bools  # [M, M]
    appears: Int64  # [M] from the mission's start, as the next
    lapses: Int64  # [M]
    has: Bools  # [N, S]


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
    _table: Table | None = None

    def copy(self) -> State:
        """Another, to go on elsewhere; its outcome is begun anew but for what is solved."""
        return State(
            self.problem, self.names, self.now, [replace(body) for body in self.bodies],
            None if self.ground is None else self.ground.copy(),
            Outcome(solves=[*self.outcome.solves]), [*self.targets], [*self.numbers],
            [*self.known_at], [*self.served_at], [*self.ends], self._table)

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
    def table(self) -> Table:
        """See `Table`; made anew when a target comes to be known of."""
        if self._table is None or len(self._table.spots) != len(self.targets):
            self._table = self._tabled()
        return self._table

    def moment(self, coming: int = 0) -> Moment:
        """The mission as planners by the clock take it, with so many targets to be known of."""
        table, agents = self.table, self.problem.agents
        here = np.array([self.place(i) for i in range(len(agents))], float)
        speeds = np.array([agent.speed for agent in agents])
        metric = self.problem.metric
        free = [body.until - self.now if body.phase == "serving" else 0 for body in self.bodies]
        home_now = [0 if agent.home is None else _ms(
            distances(here[i:i + 1], np.array([agent.home], float), metric), agent.speed)[0, 0]
            for i, agent in enumerate(agents)]
        return Moment(
            start=_ms(distances(here, table.spots, metric), speeds[:, None]),
            between=table.between, home=table.home, home_now=np.array(home_now, np.int64),
            classes=np.unique(speeds, return_inverse=True)[1].astype(np.int64).reshape(-1),
            has=table.has, need=table.need, either=table.either, service=table.service,
            after=table.after, appears=np.maximum(table.appears - self.now, 0),
            lapses=np.where(table.lapses >= NEVER, NEVER, table.lapses - self.now),
            free=np.array(free, np.int64),
            present=np.array([body.phase != "lost" for body in self.bodies], bool),
            solved=np.array(self.served_at, np.int64) >= 0,
            ends=np.maximum(np.array(self.ends, np.int64) - self.now, 0),
            effort=np.ones(len(agents)), limit=max(self.limit - self.now, 0), coming=coming,
            middle=self._middle(table.spots) if coming else None,
            middle_now=self._middle(here) if coming else None)

    def _middle(self, spots: Floats) -> Int64 | None:
        """[A] ms from places [A, 2] to where targets may be, in the mean, for the fastest; None
        where that is not said.
        """
        area = None if self.problem.expects is None else self.problem.expects.area
        if area is None:
            return None
        share = (np.arange(PARTS) + 0.5) / PARTS
        low, high = np.array(area[:2]), np.array(area[2:])
        places = low + np.stack(np.meshgrid(share, share), -1).reshape(-1, 2) * (high - low)
        mean = distances(spots, places, self.problem.metric).mean(1)
        return _ms(mean, max(agent.speed for agent in self.problem.agents))

    def _tabled(self) -> Table:
        agents, targets, metric = self.problem.agents, self.targets, self.problem.metric
        count = len(targets)
        spots = np.array([t.at for t in targets], float).reshape(count, 2)
        apart = distances(spots, spots, metric)
        after = np.zeros((count, count), bool)
        for j, target in enumerate(targets):
            after[j, [self.numbers.index(k) for k in target.after]] = True
        homes = [np.zeros(count, np.int64) if agent.home is None else _ms(
            distances(spots, np.array([agent.home], float), metric), agent.speed)[:, 0]
            for agent in agents]
        needs = [target.needs() for target in targets]
        return Table(
            spots, np.array([_ms(apart, v) for v in sorted({a.speed for a in agents})]),
            np.array(homes, np.int64).reshape(len(agents), count),
            np.array([[need.get(s, 0) for s in self.names] for need in needs],
                     np.int64).reshape(count, len(self.names)),
            np.array([t.type == "OR" and not t.coalition for t in targets], bool),
            np.array([round(MS * t.service) for t in targets], np.int64), after,
            np.array([appears(t) for t in targets], np.int64),
            np.array([lapses(t) for t in targets], np.int64),
            np.array([[s in a.skills for s in self.names] for a in agents], bool))


def appears(target: Target) -> int:
    """ms before which its service does not start."""
    return math.ceil(MS * target.appears - 1e-6)


def lapses(target: Target) -> int:
    """ms after which its service does not start; NEVER where it does not lapse."""
    return NEVER if target.lapses is None else math.floor(MS * target.lapses + 1e-6)


def _ms(metres: Floats, speed: float | Floats) -> Int64:
    return np.rint(MS * metres / speed).astype(np.int64)


def distances(a: Floats, b: Floats, metric: str) -> Floats:
    """[A, B] metres from places a [A, 2] to b [B, 2]."""
    shift = np.abs(a[:, None, :] - b[None, :, :])
    return shift.sum(2) if metric == "manhattan" else np.hypot(shift[..., 0], shift[..., 1])
