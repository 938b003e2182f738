"""What planners by the clock are given, and what they give back.

Times are whole milliseconds (of the scenario's own unit), so that searches add without error and
"optimal to the millisecond" means something. Legend: N agents, M targets, K travel classes (agents
that get everywhere in the same time), S skills.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol

import numpy as np
import numpy.typing as npt

from moonteam.problem.timed import Agent, Target, Timed, distance

Int64 = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]

MS = 1000
"""Milliseconds of a second."""

NEVER = 1 << 40
"""ms that stand for "no way" and "no limit"; a thousand still add up in int64."""

TRIAL = Timed("seconds", (Agent((0.0, 0.0), ("A",)), Agent((1.0, 0.0), ("B",), 2.0, (0.0, 0.0))), (
    Target((3.0, 0.0), ("A", "B"), service=1.0), Target((0.0, 3.0), ("A",)),
    Target((0.0, 4.0), ("A",), after=(0,))))
"""A problem that takes no time, for what is loaded or compiled at the first call."""


@dataclass(frozen=True)
class Moment:
    """A moment of a mission by the clock: now is 0.

    A target is solved, under way (its coalition, busy until `free`, has started its service, which
    ends at `ends`), or open. Only open ones are planned.
    """

    start: Int64  # [N, M] ms from where each agent is, or will be when it is free, to each target
    between: Int64  # [K, M, M] ms from target to target
    home: Int64  # [N, M] ms from each target to the agent's home; 0 where it has none
    home_now: Int64  # [N] ms from where the agent is, or will be, to its home; 0 where none
    classes: Int64  # [N] index into `between`
    has: Bools  # [N, S] skills of each agent
    need: Int64  # [M, S] agents wanted of each skill
    either: Bools  # [M] OR: one agent with any of the skills that are needed
    service: Int64  # [M] ms
    after: Bools  # [M, M] after[j, k]: j starts when k has ended
    appears: Int64  # [M] ms before which j does not start
    lapses: Int64  # [M] ms after which j does not start; NEVER where it does not lapse
    free: Int64  # [N] ms at which each agent can set out
    present: Bools  # [N] in the team
    solved: Bools  # [M] solved or under way
    ends: Int64  # [M] ms at which the service of a target under way ends; 0 of others
    effort: npt.NDArray[np.float64]  # [N] what a ms of travel costs each agent
    limit: int = NEVER  # ms in which everything must be done
    coming: int = 0  # targets that are still to be known of
    middle: Int64 | None = None  # [M] ms from each target to where they may come, in the mean
    middle_now: Int64 | None = None  # [N] the same from where each agent is
    worth: npt.NDArray[np.float64] | None = None
    """[M] what each target counts that need not be served; 0 of those that do. None: all do."""

    @property
    def optional(self) -> Int64:
        """Open targets that need not be served."""
        if self.worth is None:
            return np.zeros(0, np.int64)
        return np.flatnonzero(~self.solved & (self.worth > 0))

    def without(self, targets: Int64) -> Moment:
        """The same, these targets neither open nor ever to be served."""
        solved, ends = self.solved.copy(), self.ends.copy()
        solved[targets], ends[targets] = True, 0
        return replace(self, solved=solved, ends=ends)

    @property
    def plain(self) -> bool:
        """Whether it is the paper's case: travel and minimal coalitions alone."""
        open_ = ~self.solved
        return not (self.service[open_].any() or self.after[open_].any()
                    or self.appears[open_].any() or (self.lapses[open_] < NEVER).any()
                    or self.home.any() or (self.need[open_] > 1).any() or self.free.any())


@dataclass(frozen=True)
class Service:
    """One target of a plan: who serves it, from when to when, ms."""

    target: int
    agents: tuple[int, ...]
    start: int
    end: int


@dataclass(frozen=True)
class TimedPlan:
    """A plan by the clock, its services in order of start.

    `status`: optimal (certified in `objective`), feasible (the best found; `bound` is a lower
    bound of the objective, where one is known) or infeasible (`reason` says why; no services).
    """

    planner: str
    objective: Literal["makespan", "effort", "weighted"]
    status: Literal["optimal", "feasible", "infeasible"]
    services: tuple[Service, ...]
    makespan: int | None  # ms until all is served and everybody with a home is there
    effort: float | None  # the team's weighted ms of travel, ways home included
    bound: float | None
    seconds: float  # that planning took
    reason: str = ""

    def route(self, agent: int) -> list[Service]:
        """The services that one agent takes part in, in order."""
        return in_order(self.services, agent)


class TimedPlanner(Protocol):
    """Plans a moment to its end."""

    name: str

    def plan(self, moment: Moment) -> TimedPlan:
        """A whole plan. Raises InputError for a moment that it cannot take."""
        ...


def opens(target: Target) -> int:
    """ms before which its service does not start."""
    return math.ceil(MS * target.appears - 1e-6)


def closes(target: Target) -> int:
    """ms after which its service does not start; NEVER where it does not lapse."""
    return NEVER if target.lapses is None else math.floor(MS * target.lapses + 1e-6)


def worth_of(targets: Sequence[Any]) -> npt.NDArray[np.float64] | None:
    """[M] see `Moment.worth`; of a scenario's targets or a mission's."""
    worth = np.array([target.worth for target in targets], float)
    return worth if worth.any() else None


def moment(timed: Timed, skills: Sequence[str] | None = None) -> Moment:
    """A scenario's first moment: every way by its metric and each agent's speed.

    `skills` are the columns [S] of `has` and `need`; the scenario's own if not given.
    """
    names = timed.skill_names if skills is None else skills
    agents, targets = timed.agents, timed.targets
    count = len(targets)
    speeds = sorted({agent.speed for agent in agents})

    def ms(a: tuple[float, float], b: tuple[float, float], speed: float) -> int:
        return round(MS * distance(a, b, timed.metric) / speed)

    need, either = needs_of(targets, names)
    after = np.zeros((len(targets), len(targets)), bool)
    for j, target in enumerate(targets):
        after[j, list(target.after)] = True
    return Moment(
        start=np.array([[ms(a.at, t.at, a.speed) for t in targets] for a in agents], np.int64),
        between=np.array([[[ms(t.at, u.at, v) for u in targets] for t in targets]
                          for v in speeds], np.int64).reshape(len(speeds), count, count),
        home=np.array([[0 if a.home is None else ms(t.at, a.home, a.speed) for t in targets]
                       for a in agents], np.int64),
        home_now=np.array([0 if a.home is None else ms(a.at, a.home, a.speed) for a in agents],
                          np.int64),
        classes=np.array([speeds.index(a.speed) for a in agents], np.int64),
        has=np.array([[s in a.skills for s in names] for a in agents], bool),
        need=need, either=either,
        service=np.array([round(MS * t.service) for t in targets], np.int64),
        after=after,
        appears=np.array([opens(t) for t in targets], np.int64),
        lapses=np.array([closes(t) for t in targets], np.int64),
        free=np.zeros(len(agents), np.int64),
        present=np.ones(len(agents), bool),
        solved=np.zeros(len(targets), bool),
        ends=np.zeros(len(targets), np.int64),
        effort=np.ones(len(agents)),
        limit=NEVER if timed.max_seconds is None else round(MS * timed.max_seconds),
        worth=worth_of(targets))


def needs_of(targets: Sequence[Target], names: Sequence[str]) -> tuple[Int64, Bools]:
    """[M, S] how many of each skill targets need, and [M] whether anybody with one will do."""
    asked = [target.needs() for target in targets]
    need = np.array([[one.get(name, 0) for name in names] for one in asked], np.int64)
    return need.reshape(len(targets), len(names)), np.array(
        [target.type == "OR" and not target.coalition for target in targets], bool)


class Needs(Protocol):
    """Who has and what needs which skills, as in `Moment`."""

    @property
    def has(self) -> Bools:
        """[N, S]."""
        ...

    @property
    def need(self) -> Int64:
        """[M, S]."""
        ...

    @property
    def either(self) -> Bools:
        """[M]."""
        ...


def enough(team: tuple[int, ...] | list[int], target: int, now: Needs) -> bool:
    """Whether these agents together are what the target needs."""
    number = now.has[list(team)].sum(0)
    need = now.need[target]
    if now.either[target]:
        return bool((number[need > 0] > 0).any())
    return bool((number >= need).all())


def problems(now: Moment, services: tuple[Service, ...]) -> list[str]:
    """What is wrong with a plan, one line each: the judge that knows nothing of how it was made.

    Every open target is served once, by enough agents of the team, each of whom has had the time
    to come; after what comes before it, within its window and the limit.
    """
    said: list[str] = []
    served = sorted(service.target for service in services)
    open_ = np.flatnonzero(~now.solved).tolist()
    left = set(now.optional.tolist()) - set(served)
    if served != [j for j in open_ if j not in left]:
        said.append(f"serves {served}, open are {open_}")
    ends = {j: int(now.ends[j]) for j in np.flatnonzero(now.solved).tolist()}
    ends |= {service.target: service.end for service in services}
    where: dict[int, Service] = {}
    for one in sorted(services, key=lambda service: (service.start, service.end)):
        j = one.target
        if not all(now.present[a] for a in one.agents) or not enough(one.agents, j, now):
            said.append(f"target {j}: agents {one.agents} are not enough")
        if one.end != one.start + now.service[j]:
            said.append(f"target {j}: {one.start} to {one.end} is not its service")
        if not now.appears[j] <= one.start <= now.lapses[j]:
            said.append(f"target {j}: starts at {one.start}, outside its window")
        said += [f"target {j}: starts before {k} has ended" for k in np.flatnonzero(now.after[j])
                 if ends.get(int(k), NEVER) > one.start]
        for a in one.agents:
            last = where.get(a)
            there = now.free[a] + now.start[a, j] if last is None else (
                last.end + now.between[now.classes[a], last.target, j])
            if there > one.start:
                said.append(f"target {j}: agent {a} is there at {there}, not at {one.start}")
            where[a] = one
    if makespan(now, services) > now.limit:
        said.append("takes longer than the limit")
    return said


def makespan(now: Moment, services: tuple[Service, ...]) -> int:
    """ms until all services have ended and every agent with a home is there.

    An agent of the team that serves nothing any more goes straight home.
    """
    ends = [int(now.ends.max(initial=0))] + [service.end for service in services]
    for a in np.flatnonzero(now.present).tolist():
        mine = in_order(services, a)
        ends.append(int(now.free[a] + now.home_now[a]) if not mine
                    else mine[-1].end + int(now.home[a, mine[-1].target]))
    return max(ends)


def in_order(services: Iterable[Service], agent: int) -> list[Service]:
    """The services of one agent as it does them; one of no length before what starts with it."""
    return sorted((one for one in services if agent in one.agents),
                  key=lambda one: (one.start, one.end))


def effort(now: Moment, services: tuple[Service, ...]) -> float:
    """Weighted ms of travel of the team, ways home included."""
    total = 0.0
    for a in np.flatnonzero(now.present).tolist():
        mine = in_order(services, a)
        way = int(now.home_now[a]) if not mine else int(
            now.start[a, mine[0].target] + now.home[a, mine[-1].target])
        way += sum(int(now.between[now.classes[a], one.target, two.target])
                   for one, two in itertools.pairwise(mine))
        total += float(now.effort[a]) * way
    return total


def timed_again(moment: Moment, order: Sequence[tuple[int, tuple[int, ...]]]
                ) -> tuple[Service, ...] | None:
    """The services of an order, each as soon as its team can be there; None where that is no plan.

    Targets that are solved are left out; what has to be served and is not in it makes it no plan.
    """
    at: dict[int, int] = {}
    free = moment.free.copy()
    ends = {int(j): int(moment.ends[j]) for j in np.flatnonzero(moment.solved)}
    services: list[Service] = []
    for j, team in order:
        if moment.solved[j]:
            continue
        if not all(moment.present[a] for a in team) or not enough(team, j, moment):
            return None
        start = int(moment.appears[j])
        for k in np.flatnonzero(moment.after[j]).tolist():
            start = max(start, ends.get(k, NEVER))
        for a in team:
            way = (moment.start[a, j] if a not in at
                   else moment.between[moment.classes[a], at[a], j])
            start = max(start, int(free[a] + way))
        if start > moment.lapses[j] or start >= NEVER:
            return None
        end = start + int(moment.service[j])
        services.append(Service(j, team, start, end))
        ends[j] = end
        for a in team:
            at[a], free[a] = j, end
    missing = np.setdiff1d(np.flatnonzero(~moment.solved), moment.optional)
    if not ends.keys() >= set(missing.tolist()):
        return None
    done = tuple(sorted(services, key=lambda one: (one.start, one.end)))
    return done if makespan(moment, done) <= moment.limit else None
