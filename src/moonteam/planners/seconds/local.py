"""Local search by the clock: plans for any moment of any size, better the longer it may search."""

from __future__ import annotations

import functools
import math
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from moonteam.planners.seconds import base
from moonteam.planners.seconds.base import NEVER, Int64, Moment, TimedPlan, makespan
from moonteam.planners.seconds.greedy import greedy
from moonteam.planners.seconds.leaving import sharing
from moonteam.planners.seconds.search import annealing
from moonteam.planners.seconds.search.goal import (
    Objective,
    answer,
    check,
    infeasible,
    lists,
    order_within,
    schedule,
    weights,
)
from moonteam.planners.seconds.search.work import Open, Work, compact, places

_BLOCK = 200  # moves between the first looks at the clock
_SLICE = 0.002  # s between later looks
_LAST = 4e-5  # s a target that it takes to write the plan down
_GREEDY = 5e-9  # s that the greedy plan takes, by targets squared and agents
_AGAIN, _SMALL = 300, 16  # moves a target after which small ones are hot again; up to how many
_RUN = 275  # moves by targets squared of one run, after which another begins anew
_APART = 7919  # between the seeds of runs
MIX = np.array([0.6, 0.65, 0.75, 0.95, 1.0, 0.5, 1.0, 0.0, 10.0, 0.0, 0.3, 1.0])
"""Chances of the moves, added up, and their measures, see `annealing.anneal`; found by trying."""


@dataclass
class Best:
    """The best list found."""

    cost: float  # without lateness
    late: float  # ms of lateness, 0 of a plan that keeps to all windows
    order: Int64  # [M]
    team: Int64  # [M, P]
    size: Int64  # [M]
    iterations: int
    curve: list[tuple[float, float]]  # seconds since the beginning, cost from then on
    seconds: float

    def lists(self) -> tuple[list[int], list[list[int]]]:
        """Targets and teams as `goal.schedule` takes them."""
        return lists(self.order, self.team, self.size)


def space_for(work: Work) -> tuple[annealing.Plan, annealing.Scratch]:
    """Empty arrays for a search."""
    agents, count = work.start.shape
    most = places(work)

    def ints(*shape: int) -> Int64:
        return np.zeros(shape, np.int64)

    plan = annealing.Plan(ints(count), ints(count), ints(count, most), ints(count), ints(count),
                          ints(count), np.zeros((count + 1, 3)))
    plan.sums[0, 0] = work.floor
    space = annealing.Scratch(ints(agents), ints(agents), ints(count), ints(agents),
                              ints(work.need.shape[1]), ints(count), ints(count, most),
                              ints(count), np.zeros(4))
    return plan, space


def steering(work: Work, alpha: float, beta: float) -> tuple[annealing.Goal, float]:
    """What the search is steered by, and its unit of cost: a leg and a service.

    The latest end alone is a plateau with steps: the fourth mean of all agents' ends leans the
    search towards plans whose other agents end early too, and effort towards short ways. Their
    weights were found by trying (DCMRTA's and HeteroMRTA's instances).
    """
    legs = work.between[work.between < NEVER]
    agents = len(work.free)
    unit = sum(float(some.mean()) for some in (legs, work.service) if some.size) + 1.0
    by_way = min(0.3, 2.0 / agents, max(0.1, 1.4 / agents))
    by_way *= alpha / max(float(work.effort.mean()), 1e-9)
    goal = annealing.Goal(alpha, beta + by_way, 0.4 * alpha, 100.0 * (alpha + beta))
    return goal, unit * (alpha + beta * float(work.effort.mean()))


def first_plan(opened: Open, plan: annealing.Plan, space: annealing.Scratch,
               goal: annealing.Goal, until: float) -> float:
    """Fills the plan with the better of two quick ones; returns its cost.

    The second takes a tenth of a second with 50 agents and 500 targets: only where there is time.
    """
    work, count = opened.work, len(opened.targets)

    def try_list(order: Int64) -> float:
        plan.order[:] = order
        plan.place[order] = np.arange(count)
        return annealing.decode(work, plan, space, goal, 0, count, np.inf, 0.0, 0.0, 0.0)

    far = np.argsort(-(np.median(work.start, axis=0) + work.service), kind="stable")
    order = order_within(work.first_before, work.before, far)
    cost = try_list(order)
    seconds = _GREEDY * count * count * len(opened.agents)
    if count > 0 and time.perf_counter() + seconds < until:
        team, size = plan.team.copy(), plan.size.copy()
        other, plan.team[:], plan.size[:] = greedy(opened)
        if try_list(other) > cost:
            plan.team[:], plan.size[:] = team, size
            try_list(order)
    annealing.settle(work, plan, space, 0)
    return float(space.result[0])


def load(opened: Open, plan: annealing.Plan, space: annealing.Scratch, goal: annealing.Goal,
         found: Best) -> float:
    """Fills the plan with a list that was found; returns its cost."""
    plan.order[:], plan.team[:], plan.size[:] = found.order, found.team, found.size
    plan.place[found.order] = np.arange(len(found.order))
    cost = annealing.decode(opened.work, plan, space, goal, 0, len(found.order), np.inf, 0.0, 0.0,
                            0.0)
    annealing.settle(opened.work, plan, space, 0)
    return float(cost)


def temperatures(count: int) -> tuple[float, float]:
    """In units, at the beginning and at the end; found by trying (DCMRTA and HeteroMRTA)."""
    if count <= _SMALL:
        return min(100.0 / count**2, 0.3), 0.01
    hot = min(2.0 / count, 100.0 / count**2)
    return hot, min(max(0.01, 25.0 / count**2), 0.5 * hot)


def search(opened: Open, alpha: float, beta: float, iterations: int | None = None,
           until: float = math.inf, seed: int = 0, threads: int = 1) -> Best:
    """The best list found in so many moves, or until `time.perf_counter()` says so.

    Each of the threads makes its own moves, so many or for so long, and the best of all counts.
    """
    if not len(opened.targets):  # such as between the last one and one that an event will bring
        none, cost = space_for(opened.work)[0], alpha * opened.work.floor
        return Best(cost, 0.0, none.order, none.team, none.size, 0, [(0.0, cost)], 0.0)
    stop = threading.Event()

    def one(number: int) -> Best:
        return _runs(opened, alpha, beta, iterations, until, seed + number * _APART**2, stop)

    if threads == 1:
        return one(0)
    with ThreadPoolExecutor(threads) as pool:
        try:
            found = list(pool.map(one, range(threads)))
        finally:
            stop.set()  # Ctrl-C does not wait for them
    return _merge(found, together=True)


def _runs(opened: Open, alpha: float, beta: float, iterations: int | None, until: float, seed: int,
          stop: threading.Event) -> Best:
    """Runs of a set length, each from the beginning; in what is left, one goes on from the best."""
    count = len(opened.targets)
    most = _RUN * count**2 if count > _SMALL else None
    moves = most if iterations is None else min(most or iterations, iterations)
    first = _run(opened, alpha, beta, moves, until, seed, stop)
    found = [first]
    if most is None:
        return first

    def left() -> tuple[float, int | None]:
        """How many more runs there is time for, and moves."""
        if stop.is_set():
            return 0.0, 0
        by_time = (until - time.perf_counter()) / max(first.seconds, 1e-9)
        if iterations is None:
            return by_time, None
        rest = iterations - sum(one.iterations for one in found)
        return min(by_time, rest / most), rest

    while left()[0] >= 2.0:
        found.append(_run(opened, alpha, beta, most, until, seed + _APART * len(found), stop))
    runs, moves = left()
    if runs > 0.0:
        found.append(_run(opened, alpha, beta, moves, until, seed + _APART * len(found), stop,
                          _merge(found)))
    return _merge(found)


def _merge(found: list[Best], together: bool = False) -> Best:
    """The best of several, with the moves and the curve of all, made one after the other or not."""
    best = min(found, key=lambda one: (one.late, one.cost))
    points: list[tuple[float, float]] = []
    since = 0.0
    for one in found:
        points += [(since + at, cost) for at, cost in one.curve]
        since += 0.0 if together else one.seconds
    curve: list[tuple[float, float]] = []
    for at, cost in sorted(points):
        if not curve or cost < curve[-1][1]:
            curve.append((at, cost))
    seconds = max(one.seconds for one in found) if together else since
    return replace(best, iterations=sum(one.iterations for one in found), curve=curve,
                   seconds=seconds)


def _run(opened: Open, alpha: float, beta: float, iterations: int | None, until: float, seed: int,
         stop: threading.Event, begin: Best | None = None) -> Best:
    """One run, cooled down over its moves or its time; from a list it begins less hot."""
    began = time.perf_counter()
    work = opened.work
    plan, space = space_for(work)
    goal, unit = steering(work, alpha, beta)
    true = annealing.Goal(alpha, beta, 0.0, goal.fine)
    hot, cold = temperatures(len(plan.order))
    if begin is None:
        now = first_plan(opened, plan, space, goal, until)
    else:
        now = load(opened, plan, space, goal, begin)
        hot, cold = 0.6 * hot, 0.8 * cold
    result = space.result
    best = np.array([alpha * result[1] + beta * result[2] + true.fine * result[3], *result[1:]])
    order, team, size = plan.order.copy(), plan.team.copy(), plan.size.copy()
    curve = [(time.perf_counter() - began, float(best[0]))]
    done, block, rest = 0, _BLOCK, 0.0
    again = _AGAIN * len(plan.order) if len(plan.order) <= _SMALL else 0
    while not stop.is_set():
        clock = time.perf_counter()
        share = 0.0 if iterations is None else done / max(iterations, 1)
        if until < math.inf:
            share = max(share, (clock - began) / max(until - began, 1e-9))
        if share >= 1.0 or iterations == 0:
            break
        step = block if iterations is None else min(block, iterations - done)
        if again:  # small ones are cooled down over and over
            share = done % again / again
            step = min(step, again - done % again)
        warm = unit * hot * (cold / hot) ** share
        was = best[0]
        now, rest = annealing.anneal(work, plan, space, goal, true, now, rest, warm, step,
                                     seed + done, MIX, order, team, size, best)
        done += step
        if best[0] < was:
            curve.append((time.perf_counter() - began, float(best[0])))
        spent = time.perf_counter() - clock
        if until < math.inf:
            block = int(min(max(step * _SLICE / max(spent, 1e-6), 20), 4 * step + 20))
    cost = alpha * best[1] + beta * best[2]
    return Best(cost, float(best[3]), order, team, size, done, curve, time.perf_counter() - began)


class LocalSearchPlanner:
    """Plans by the clock for any number of agents and targets, better the longer it searches.

    Args:
      objective: makespan, effort or weighted.
      alpha: weight of the makespan, ms, in the weighted objective.
      beta: weight of the effort in the weighted objective.
      time_limit: seconds; None with a budget of iterations, by which alone a plan depends on
        nothing but the seed.
      seed: of the random numbers.
      iterations: moves tried by each thread; None: as many as the time allows.
      threads: that search side by side, each with random numbers of its own.
    """

    name = "local"

    def __init__(self, objective: Objective = "makespan", alpha: float = 1.0, beta: float = 0.05,
                 time_limit: float | None = 1.0, seed: int = 0, iterations: int | None = None,
                 threads: int = 1):
        self.objective: Objective = check(objective, alpha, beta)
        self.alpha, self.beta = alpha, beta
        self.time_limit = None if iterations is not None else time_limit
        self.iterations, self.seed, self.threads = iterations, seed, threads
        self.curve: list[tuple[float, float]] = []

    def plan(self, moment: Moment) -> TimedPlan:
        """The best plan found within the limit."""
        if self.time_limit is not None:
            compiled()
        return sharing(self, moment)

    def plan_all(self, moment: Moment) -> TimedPlan:
        """The best plan found that serves all that is open."""
        began = time.perf_counter()
        opened = compact(moment)
        if opened.reason:
            return infeasible(self.name, self.objective, opened.reason, began)
        alpha, beta = weights(self.objective, self.alpha, self.beta)
        until = math.inf if self.time_limit is None else (
            began + self.time_limit - _LAST * len(opened.targets))
        best = search(opened, alpha, beta, self.iterations, until, self.seed, self.threads)
        self.curve = best.curve
        services = schedule(opened, *best.lists())
        span = makespan(moment, services)
        if best.late > 0 or span > moment.limit or span >= NEVER:
            return infeasible(self.name, self.objective, "no plan was found that keeps to the "
                              "limit and the times at which targets lapse; there may be one", began)
        return answer(self.name, self.objective, moment, services, None, False, began)


@functools.cache
def compiled() -> None:
    """Compiles, or loads, what a search calls: once a process, which counts for no time limit."""
    LocalSearchPlanner(iterations=10).plan(base.moment(base.TRIAL))
