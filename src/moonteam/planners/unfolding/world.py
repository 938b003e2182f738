"""A mission by the clock under way, in which not everything is known: the planners' world.

A `World` holds all that will happen; whoever decides is shown a `View`, which holds what is known.
Between events nothing is decided; at an event (a target is solved, found, arrives or lapses, a
robot is lost, or has come to where it was to look from) every robot that is in no service may be
sent to a known target, home, or to any place.

Ways are straight, or along x and then along y; a robot that is sent elsewhere on its way turns
where it is. A target is served by all robots bound to it that are there, once they are enough,
everything before it is solved and its window is open. A robot is seen to be late only by when it
comes.

Legend: N robots, M targets that are known of, times in ms where nothing else is said.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from moonteam.planners.seconds.base import MS, NEVER, Moment, closes, enough, opens
from moonteam.planners.seconds.keeper import HOME, WAIT
from moonteam.planners.unfolding.ground import Ground, Look
from moonteam.planners.unfolding.state import Body, Order, Outcome, State
from moonteam.planners.unfolding.ways import Floats, Way
from moonteam.problem.timed import Agent, Place, Prospect, Target, Timed


@dataclass(frozen=True)
class View:
    """What is known at an event. `moment` has a column for every target known of, in that order."""

    now: int  # ms
    moment: Moment
    targets: tuple[Target, ...]  # [M]
    places: Floats  # [N, 2] m
    agents: tuple[Agent, ...]  # [N] without what nobody knows
    expects: Prospect
    coming: int  # targets that are still to be known of
    ground: Ground | None  # what has been seen of where targets may be hidden
    state: State
    looks: tuple[Look, ...] = ()  # places to look from, the last columns of `moment`

    @property
    def ended(self) -> int:
        """Targets whose services have ended."""
        return int((self.moment.solved & (self.moment.ends == 0)).sum()) - len(self.state.lapsed)

    @property
    def optional(self) -> bool:
        """Whether there are, or may come, targets that need not be served."""
        return self.expects.worth is not None or any(target.worth for target in self.targets)

    def imagine(self, coming: Sequence[Target], lost: Sequence[float | None],
                pace: np.ndarray | None = None) -> World:
        """A world that goes on from here with this future.

        Args:
          coming: targets still to be known of; seconds count from the mission's start.
          lost: [N] s at which each robot is lost, from the mission's start; None: never.
          pace: [N, M + targets coming] what ways take over what is expected; None: as expected.
        """
        return World.imagined(self.state, coming, lost, pace)


class World:
    """One mission under way; `over` once `outcome` says how it ended.

    Args:
      problem: with all that will happen.
    """

    def __init__(self, problem: Timed):
        agents = tuple(msgspec.structs.replace(a, lost=None, pace=()) for a in problem.agents)
        known = msgspec.structs.replace(problem, agents=agents, targets=())
        self.state = State(known, problem.skill_names, 0, [Body(a.at) for a in agents],
                           Ground.of(problem), Outcome())
        self._coming = list(enumerate(problem.targets))
        self._lost = [agent.lost for agent in problem.agents]
        self._pace = {k: [a.pace[k] if a.pace else 1.0 for a in problem.agents]
                      for k in range(len(problem.targets))}
        self._begin()

    @classmethod
    def imagined(cls, state: State, coming: Sequence[Target],
                 lost: Sequence[float | None], pace: np.ndarray | None = None) -> World:
        """See `View.imagine`."""
        world = cls.__new__(cls)
        world.state = state.copy()
        first = max(state.numbers, default=-1) + 1
        world._coming = [(first + k, target) for k, target in enumerate(coming)]
        world._lost = list(lost)
        numbers = [*state.numbers, *(k for k, _ in world._coming)]
        world._pace = {} if pace is None else dict(zip(numbers, pace.T.tolist(), strict=True))
        for body in world.state.bodies:  # how late anybody on its way will be is not known
            if body.way is not None:
                body.way = body.way.onwards(state.now)
        world._begin()
        return world

    def revealed(self) -> World:
        """The same with all that comes known of now, and nobody lost."""
        other = World.imagined(self.state, (), [None] * len(self._lost))
        other._know([(k, msgspec.structs.replace(t, hidden=False, following=0))
                     for k, t in self._coming])
        return other

    @property
    def outcome(self) -> Outcome:
        """How it ended; only part of it is filled before it is over."""
        return self.state.outcome

    def view(self) -> View:
        """What is known now."""
        state, coming = self.state, len(self._coming)
        places = np.array([state.place(i) for i in range(len(state.bodies))], float)
        return View(state.now, state.moment(coming), tuple(state.targets), places,
                    state.problem.agents, state.problem.expects or Prospect(), coming,
                    state.ground, state)

    def step(self, orders: Sequence[Order]) -> None:
        """Everybody in no service does as told [N]; then to the next event at which to decide."""
        self.outcome.decisions += 1
        for i, order in enumerate(orders):
            self._tell(i, order)
        self._due, began = False, self.state.now
        self._settle()
        while not self.over and not self._due:
            following = self._next()
            if following >= NEVER:
                # Who waited for others to be where they are now is asked once more.
                self._due = self.state.now > began and any(
                    body.phase == "free" for body in self.state.bodies)
                if not self._due:
                    self._end("nothing can happen any more")
            elif following > self.state.limit:
                self._advance(self.state.limit)
                self._end(f"not done within {self.state.limit / MS:g} s")
            else:
                self._advance(following)
                self._settle()

    def _begin(self) -> None:
        self.over, self._due = False, True
        if self.state.ground is not None and self.state.now == 0:
            for at, sensor in self._eyes():
                self.state.ground.see(np.array([at, at]), sensor)
            self.outcome.seen.append((0.0, self.state.ground.share))
        self._settle()

    # What is done.

    def _tell(self, i: int, order: Order) -> None:
        state, body = self.state, self.state.bodies[i]
        agent = state.problem.agents[i]
        if order == HOME and agent.home is None:
            order = WAIT
        same = order == body.goal and body.phase in ("going", "there")
        if same or body.phase in ("serving", "lost"):
            return
        here = state.place(i)
        self._stop(i, here)
        if order == WAIT:
            return
        goal, factor = self._aim(i, order)
        way = Way.of(here, goal, state.problem.metric, agent.speed, state.now, factor)
        body.goal, body.way = order, way
        body.phase = "going" if way.arrives > state.now else "there"

    def _aim(self, i: int, order: Order) -> tuple[Place, float]:
        """Where an order leads, and what the way there takes over what is expected."""
        if isinstance(order, tuple):
            return order, 1.0
        if order == HOME:
            home = self.state.problem.agents[i].home
            assert home is not None
            return home, 1.0
        pace = self._pace.get(self.state.numbers[order])
        return self.state.targets[order].at, 1.0 if pace is None else pace[i]

    def _stop(self, i: int, here: Place) -> None:
        body = self.state.bodies[i]
        if body.way is not None:
            body.travelled += (min(self.state.now, body.way.arrives) - body.way.since) / MS
        body.at, body.way, body.goal, body.phase = here, None, WAIT, "free"

    # What happens.

    def _next(self) -> int:
        """When the next event is; NEVER where there is none."""
        state, now = self.state, self.state.now
        found = [NEVER]
        for body, lost in zip(state.bodies, self._lost, strict=True):
            if body.phase == "going" and body.way is not None:
                found.append(body.way.arrives)
            elif body.phase == "serving":
                found.append(body.until)
            if body.phase != "lost" and lost is not None:
                found.append(max(now, math.ceil(MS * lost)))
        found += [max(now, opens(target)) for _, target in self._coming
                  if target.appears and not target.hidden and self._after_known(target)]
        for target, served in zip(state.targets, state.served_at, strict=True):
            if served < 0 and opens(target) > now:
                found.append(opens(target))
            if served < 0 and target.lapses is not None and not (
                    target.worth and closes(target) < now):
                found.append(max(now, closes(target) + 1))
        return min(*found, self._found_at(min(found)), NEVER)

    def _found_at(self, until: int) -> int:
        """When the next hidden target is seen, before `until`; NEVER if none is."""
        best = NEVER
        for body, agent in zip(self.state.bodies, self.state.problem.agents, strict=True):
            if agent.sensor is None or body.phase != "going" or body.way is None:
                continue
            for _, target in self._coming:
                if target.hidden:
                    best = min(best, body.way.within(target.at, agent.sensor, self.state.now,
                                                     min(best, until)))
        return best

    def _advance(self, now: int) -> None:
        """Time goes on; what is near a robot's way is seen."""
        state = self.state
        if state.ground is not None:
            for body, agent in zip(state.bodies, state.problem.agents, strict=True):
                if agent.sensor is not None and body.way is not None and body.phase == "going":
                    state.ground.see(body.way.between(state.now, now), agent.sensor)
            state.outcome.seen.append((now / MS, state.ground.share))
        state.now = now

    def _settle(self) -> None:
        """All that is due at this moment, until nothing more is."""
        while (self._lose() | self._end_services() | self._arrive() | self._find()
               | self._appear() | self._start_services() | self._lapse()):
            pass
        self._judge()

    def _lose(self) -> bool:
        some = False
        for i, (body, at) in enumerate(zip(self.state.bodies, self._lost, strict=True)):
            if body.phase == "lost" or at is None or math.ceil(MS * at) > self.state.now:
                continue
            served = body.goal if body.phase == "serving" else None
            self._stop(i, self.state.place(i))
            body.phase, some, self._due = "lost", True, True
            self.outcome.lost += 1
            if isinstance(served, int):
                self._break(served)
        return some

    def _break(self, j: int) -> None:
        """A service is broken off: who is left waits there again."""
        self.state.served_at[j] = self.state.ends[j] = -1
        for body in self.state.bodies:
            if body.phase == "serving" and body.goal == j:
                body.phase = "there"

    def _end_services(self) -> bool:
        done = {body.goal for body in self.state.bodies
                if body.phase == "serving" and body.until <= self.state.now}
        for body in self.state.bodies:
            if body.phase == "serving" and body.goal in done:
                body.phase, body.goal = "free", WAIT
        self.outcome.solves += [self.state.now / MS] * len(done)
        self._due |= bool(done)
        return bool(done)

    def _arrive(self) -> bool:
        some, expects = False, self.state.problem.expects
        for i, body in enumerate(self.state.bodies):
            if body.phase == "going" and body.way is not None and (
                    body.way.arrives <= self.state.now):
                goal = body.goal
                self._stop(i, body.way.end)
                body.goal, body.phase, some = goal, "there", True
                # Where ways scatter it is news when somebody comes.
                self._due |= isinstance(goal, tuple) or (
                    expects is not None and expects.scatter > 0)
        return some

    def _eyes(self) -> list[tuple[Place, float]]:
        """Where robots that see are, and how far."""
        state = self.state
        return [(state.place(i), agent.sensor) for i, agent in enumerate(state.problem.agents)
                if agent.sensor is not None and state.bodies[i].phase != "lost"]

    def _find(self) -> bool:
        """Hidden targets near robots that see are known of."""
        eyes = self._eyes()
        return self._know([(k, target) for k, target in self._coming if target.hidden and any(
            math.dist(at, target.at) <= sensor + 1e-3 for at, sensor in eyes)])

    def _appear(self) -> bool:
        count = len(self.outcome.solves)
        return self._know([
            (k, target) for k, target in self._coming
            if not target.hidden and target.following <= count
            and opens(target) <= self.state.now and self._after_known(target)])

    def _after_known(self, target: Target) -> bool:
        """Whether everything before it is known of: it is not known of earlier."""
        return all(k in self.state.numbers for k in target.after)

    def _know(self, found: list[tuple[int, Target]]) -> bool:
        self._coming = [one for one in self._coming if one[0] not in {k for k, _ in found}]
        for k, target in found:
            self.state.add(k, target)
            self._due = True
        return bool(found)

    def _start_services(self) -> bool:
        state, some = self.state, False
        for j, target in enumerate(state.targets):
            if state.served_at[j] >= 0 or not opens(target) <= state.now <= closes(target):
                continue
            team = [i for i, b in enumerate(state.bodies) if b.phase == "there" and b.goal == j]
            if not team or not enough(team, j, state.known) or not all(
                    0 <= state.ends[state.numbers.index(k)] <= state.now for k in target.after):
                continue
            state.served_at[j] = state.now
            state.ends[j] = state.now + round(MS * target.service)
            for i in team:
                state.bodies[i].phase, state.bodies[i].until = "serving", state.ends[j]
            some = True
        return some

    def _lapse(self) -> bool:
        """Targets that need not be served are over; who went or waited for them is free."""
        state = self.state
        over = {j for j, target in enumerate(state.targets) if target.worth and j not in (
            state.lapsed) and state.served_at[j] < 0 and state.now > closes(target)}
        state.lapsed |= over
        self._due |= bool(over)
        for i, body in enumerate(state.bodies):
            if body.goal in over and body.phase in ("going", "there"):
                self._stop(i, state.place(i))
        return bool(over)

    def _judge(self) -> None:
        """Ends what is done, or can never be."""
        state = self.state
        team = [i for i, body in enumerate(state.bodies) if body.phase != "lost"]
        if not self._coming and all(0 <= end <= state.now or j in state.lapsed
                                    for j, end in enumerate(state.ends)):
            homes = [(state.place(i), state.problem.agents[i].home) for i in team]
            if all(home is None or math.dist(at, home) < 1e-6 for at, home in homes):
                self._end("")
            return
        for j in [j for j, served in enumerate(state.served_at)
                  if served < 0 and not state.targets[j].worth]:
            if state.now > closes(state.targets[j]):
                self._end(f"target {state.numbers[j]} lapsed")
                return
            if not enough(team, j, state.known):
                self._end(f"the robots that are left cannot serve target {state.numbers[j]}")
                return

    def _end(self, reason: str) -> None:
        state, out = self.state, self.outcome
        self.over = True
        for i, body in enumerate(state.bodies):
            if body.phase != "lost":
                self._stop(i, state.place(i))
        out.success, out.reason, out.seconds = not reason, reason, state.now / MS
        waits = [(served if served >= 0 else min(state.now, closes(target)))
                 - (0 if target.hidden else max(known, opens(target)))
                 for served, known, target in zip(state.served_at, state.known_at, state.targets,
                                                  strict=True)]
        waits += [state.now for _, target in self._coming if target.hidden]
        worth = [target.worth for target in state.targets]
        out.worth = sum(own for own, served in zip(worth, state.served_at, strict=True)
                        if served >= 0)
        out.missed = sum(worth) - out.worth + sum(target.worth for _, target in self._coming)
        out.waited = float(np.mean(waits)) / MS if waits else 0.0
        out.effort = sum(body.travelled for body in state.bodies)
