"""Plans for large teams and many targets: insertion with regret, then large neighbourhoods.

Anytime: there is a plan after the first insertion, and it gets better with every iteration.
The search itself is in `search.neighbourhoods`, what steers it in `search.guides`.
"""

from __future__ import annotations

import math
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from threading import Event

import numpy as np

from moonteam.errors import InputError
from moonteam.planners.base import IntArray, Objective, Snapshot
from moonteam.planners.kind import PlannerKind, PlannerOptions
from moonteam.planners.plans.follow import Answer, RoutePlanner
from moonteam.planners.search import insertion, neighbourhoods
from moonteam.planners.search.bounds import HASTY, ROUNDS, lower_bounds
from moonteam.planners.search.guides import PLAIN, Floats
from moonteam.planners.search.insertion import Ways
from moonteam.planners.search.task import Task, value_of, weights
from moonteam.planners.search.teams import Teams, teams_of

MAX_AGENTS = 62
"""Coalitions are bit masks of 64 bits."""

_STEER = 0.05  # weight of moves while searching for makespan: it breaks ties on plateaus
_BLOCK = 250  # iterations between looks at the clock, at most
_FIRST, _SLICE = 5, 0.02  # the first so many; s that they then may take
_HURRY = 0.1  # s; with less the first plan is made in one way only, and bounds are looser
_LARGE = 60  # targets above which insertion looks at few anew each time


@dataclass
class Events:
    """A list of events: targets in order, each with its coalition."""

    order: IntArray  # [M]
    crew: IntArray  # [M] index into `teams`
    teams: Teams

    def copy(self) -> Events:
        """A list of its own."""
        return Events(self.order.copy(), self.crew.copy(), self.teams)

    def routes(self, agents: int) -> IntArray:
        """Each agent's targets in order [N, M], padded by -1."""
        out = np.full((agents, len(self.order)), -1, np.int32)
        masks = self.teams.masks[self.crew]
        for a in range(agents):
            mine = self.order[masks >> a & 1 == 1]
            out[a, :len(mine)] = mine
        return out


@dataclass(frozen=True)
class Weights:
    """What the search is steered by, and what the best is kept by."""

    alpha: float
    beta: float
    true_alpha: float
    true_beta: float

    @classmethod
    def of(cls, objective: Objective, alpha: float, beta: float, task: Task) -> Weights:
        """Weights for an objective; raises InputError if they are not allowed."""
        true = weights(objective, alpha, beta, len(task.start), task.horizon)
        steer = (1.0, _STEER) if objective == "makespan" else true
        return cls(*steer, *true)

    @property
    def unit(self) -> float:
        """What one step, or else one move, costs."""
        return max(self.alpha, self.beta)


def _ways(task: Task) -> Ways:
    return Ways(task.start, task.between, task.kinds)


def insert(task: Task, goal: Weights, teams: Teams, regret: bool) -> Events:
    """A list of events made by insertion, with regret or cheapest first."""
    count = len(task.targets)
    return Events(*insertion.inserted(
        _ways(task), teams, regret, goal.alpha, goal.beta, task.horizon,
        count if count <= _LARGE else insertion.SOME), teams)


def measure(task: Task, events: Events) -> tuple[int, int]:
    """(makespan, moves) of a list."""
    return insertion.measured(_ways(task), events.teams, events.order, events.crew)


def cost(task: Task, goal: Weights, events: Events) -> float:
    """Cost of a list in the true objective, steps past the horizon charged."""
    return insertion.price(*measure(task, events), goal.true_alpha, goal.true_beta, task.horizon)


def best_insertion(task: Task, goal: Weights, hurry: bool = False) -> Events:
    """The better of the two insertions; in a hurry that with regret."""
    teams = teams_of(task.start, task.skills, task.need, task.both)
    tries = [insert(task, goal, teams, regret) for regret in ((True,) if hurry else (True, False))]
    return min(tries, key=lambda events: cost(task, goal, events))


def improve(task: Task, goal: Weights, events: Events, seed: int, iterations: int | None,
            until: float | None, threads: int = 1, guide: Floats = PLAIN) -> Events:
    """The best list found from `events` on.

    Args:
      task: what is to be done.
      goal: the weights.
      events: where to begin.
      seed: of the random numbers.
      iterations: budget; with it alone the result depends on nothing but seed and threads.
      until: `time.perf_counter()` at which to stop.
      threads: searches side by side, each with the whole budget; the best counts.
      guide: what is taken out and how it is put back, see `neighbourhoods`.
    """
    stop = Event()
    if threads == 1:
        return _improved(task, goal, events, seed, iterations, until, guide, stop)
    with ThreadPoolExecutor(threads) as pool:
        try:
            found = list(pool.map(lambda k: _improved(
                task, goal, events, seed + k * _APART, iterations, until, guide, stop),
                range(threads)))
        finally:  # an interruption waits for none of them
            stop.set()
    return min(found, key=lambda one: cost(task, goal, one))


def searched(task: Task, goal: Weights, events: Events, seed: int, places: int,
             guide: Floats) -> Events:
    """As `improve`, until so many places were tried: that takes as long with any guide."""
    now, best = events.copy(), events.copy()
    if len(task.targets) > 1:
        neighbourhoods.improved(
            guide, _ways(task), now.teams, now.order, now.crew, goal.alpha, goal.beta,
            goal.true_alpha, goal.true_beta, task.horizon, goal.unit, places, float(places), 0.0,
            1.0, seed, best.order, best.crew)
    return best


_APART = 1_000_003  # between the seeds of searches side by side


def _improved(task: Task, goal: Weights, events: Events, seed: int, iterations: int | None,
              until: float | None, guide: Floats, stop: Event) -> Events:
    """`improve` in this thread, until somebody sets `stop`."""
    now, best, ways = events.copy(), events.copy(), _ways(task)
    began, done, room = time.perf_counter(), 0, _BLOCK if until is None else _FIRST
    each = 0.0  # s an iteration

    def share(done: int, clock: float) -> float:
        """Of the whole search."""
        by_count = 0.0 if iterations is None else done / iterations
        by_clock = 0.0 if until is None else (clock - began) / max(until - began, 1e-9)
        return min(max(by_count, by_clock), 1.0)

    while len(task.targets) > 1 and iterations != 0 and not stop.is_set():
        clock = time.perf_counter()
        if (before := share(done, clock)) >= 1.0:
            break
        block = room if iterations is None else min(room, iterations - done)
        neighbourhoods.improved(
            guide, ways, now.teams, now.order, now.crew, goal.alpha, goal.beta, goal.true_alpha,
            goal.true_beta, task.horizon, goal.unit, block, math.inf, before,
            share(done + block, clock + block * each), seed + done, best.order, best.crew)
        done += block
        if until is not None:
            clock, each = time.perf_counter(), (time.perf_counter() - began) / done
            room = int(min(_BLOCK, 4 * block, _SLICE / each, (until - clock) / each)) + 1
    return best


class InsertionPlanner(RoutePlanner):
    """What the greedy and the large-neighbourhood planner share: insertion alone."""

    name = "insertion"

    def _answer(self, task: Task, began: float) -> Answer:
        agents = len(task.start)
        if agents > MAX_AGENTS:
            raise InputError(f"--planner {self.name}",
                             f"{agents} agents; at most {MAX_AGENTS} are allowed")
        hurry = self.time_limit is not None and self.time_limit < _HURRY
        low_makespan, low_moves = lower_bounds(task, rounds=HASTY if hurry else ROUNDS)
        bound = value_of(self.objective, self.alpha, self.beta, low_makespan, low_moves)
        if low_makespan > task.horizon:
            return Answer(None, bound, True)
        goal = Weights.of(self.objective, self.alpha, self.beta, task)
        events = self._improved(task, goal, best_insertion(task, goal, hurry), began)
        if measure(task, events)[0] > task.horizon:
            return Answer(None, bound, False)
        return Answer(events.routes(agents), bound, False)

    def _improved(self, task: Task, goal: Weights, events: Events, began: float) -> Events:
        return events


class LnsPlanner(InsertionPlanner):
    """Insertion with regret, then large-neighbourhood search; to 50 agents and 500 targets.

    Args:
      objective: makespan, moves or weighted.
      alpha: weight of the makespan in the weighted objective.
      beta: weight of the moves in the weighted objective.
      iterations: budget; None: 2000 unless there is a time limit.
      time_limit: seconds; with it the result depends on the machine's speed.
      seed: of the random numbers.
      threads: searches side by side, each with the whole budget.
    """

    name = "lns"
    guide: Floats = PLAIN
    """What is taken out and how it is put back, see `search.neighbourhoods`."""

    def __init__(self, objective: Objective = "makespan", alpha: float = 1.0, beta: float = 0.05,
                 iterations: int | None = None, time_limit: float | None = None, seed: int = 0,
                 threads: int = 1):
        super().__init__(objective, alpha, beta)
        self.iterations = 2000 if iterations is None and time_limit is None else iterations
        self.time_limit, self.seed, self.threads = time_limit, seed, threads

    @classmethod
    def _trial(cls) -> LnsPlanner:
        return cls(iterations=1, time_limit=60.0)

    def reset(self, snapshot: Snapshot, seed: int = 0) -> None:
        """Starts a mission; the seed is that of the search."""
        super().reset(snapshot, seed)
        self.seed = seed

    def _improved(self, task: Task, goal: Weights, events: Events, began: float) -> Events:
        until = None if self.time_limit is None else began + self.time_limit
        return improve(task, goal, events, self.seed, self.iterations, until, self.threads,
                       self.guide)


def _planner(options: PlannerOptions) -> LnsPlanner:
    return LnsPlanner(*options.goal, time_limit=options.time_limit, seed=options.seed,
                      threads=options.threads)


PLANNER = PlannerKind("lns", _planner, anytime=True, parallel=True)
