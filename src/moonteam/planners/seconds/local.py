"""Local search by the clock: plans for any moment of any size, better the longer it may search."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np

from moonteam.planners.seconds import annealing
from moonteam.planners.seconds.base import NEVER, Int64, Moment, TimedPlan, makespan
from moonteam.planners.seconds.goal import (
    Objective,
    answer,
    check,
    infeasible,
    lists,
    order_within,
    schedule,
    weights,
)
from moonteam.planners.seconds.greedy import greedy
from moonteam.planners.seconds.work import Open, Work, compact, places

_BLOCK = 200  # moves between the first looks at the clock
_SLICE = 0.002  # s between later looks
MIX = np.array([0.3, 0.4, 0.6, 0.9, 1.0, 0.5, 0.5, 500.0])


@dataclass
class Best:
    """The best list found."""

    cost: float  # without lateness
    late: float  # ms of lateness, 0 of a plan that keeps to all windows
    order: Int64  # [M]
    team: Int64  # [M, P]
    size: Int64  # [M]
    iterations: int
    curve: list[tuple[float, float]]

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
                          ints(count + 1, agents), np.full((count + 1, agents), -1, np.int64),
                          np.zeros((count + 1, 3)))
    plan.clock[0] = work.free
    plan.sums[0, 0] = work.floor
    space = annealing.Scratch(ints(agents), ints(agents), ints(count), ints(agents),
                              ints(work.need.shape[1]), ints(count), ints(count, most),
                              ints(count), np.zeros(4))
    return plan, space


def search(opened: Open, alpha: float, beta: float, iterations: int | None = None,
           until: float = math.inf, seed: int = 0) -> Best:
    """The best list found in so many moves, or until `time.perf_counter()` says so."""
    began = time.perf_counter()
    work = opened.work
    plan, space = space_for(work)
    liking = np.argsort(-(np.median(work.start, axis=0) + work.service), kind="stable")
    plan.order[:] = order_within(work.first_before, work.before, liking)
    plan.place[plan.order] = np.arange(len(liking))
    scale = alpha + beta
    goal = annealing.Goal(alpha, beta + 0.05 * alpha / 1.0, alpha, 100.0 * scale)
    now = annealing.decode(work, plan, space, goal, 0, np.inf, 0.0, 0.0)
    if len(liking):
        order, team, size = greedy(opened)
        other = plan._replace(order=order, team=team, size=size)
        other.place[order] = np.arange(len(order))
        cost = annealing.decode(work, other, space, goal, 0, np.inf, 0.0, 0.0)
        if cost < now:
            plan = other
        else:
            plan.place[plan.order] = np.arange(len(order))
        now = annealing.decode(work, plan, space, goal, 0, np.inf, 0.0, 0.0)
    annealing.settle(work, plan, space, 0)
    true = annealing.Goal(alpha, beta, 0.0, 100.0 * scale)
    best = np.array([alpha * space.result[1] + beta * space.result[2] + true.fine * space.result[3],
                     *space.result[1:]])
    order, team, size = plan.order.copy(), plan.team.copy(), plan.size.copy()
    curve = [(time.perf_counter() - began, float(best[0]))]
    done, block = 0, _BLOCK
    hot, cold = 200.0 * scale, 10.0 * scale
    while len(order) > 0 and (iterations is None or done < iterations):
        clock = time.perf_counter()
        shares = [done / iterations] if iterations else []
        if until < math.inf:
            shares.append((clock - began) / max(until - began, 1e-9))
        share = max(shares)
        if share >= 1.0:
            break
        step = block if iterations is None else min(block, iterations - done)
        warm = hot * (cold / hot) ** share
        was = best[0]
        now = annealing.anneal(work, plan, space, goal, true, now, warm, warm, step, seed + done,
                               MIX, order, team, size, best)
        done += step
        if best[0] < was:
            curve.append((time.perf_counter() - began, float(best[0])))
        spent = time.perf_counter() - clock
        if iterations is None:
            block = int(min(max(block * _SLICE / max(spent, 1e-6), 20), 4 * block))
    cost = alpha * best[1] + beta * best[2]
    return Best(cost, float(best[3]), order, team, size, done, curve)


class LocalSearchPlanner:
    """Plans by the clock for any number of agents and targets, better the longer it searches.

    Args:
      objective: makespan, effort or weighted.
      alpha: weight of the makespan, ms, in the weighted objective.
      beta: weight of the effort in the weighted objective.
      time_limit: seconds; None with a budget of iterations, by which alone a plan depends on
        nothing but the seed.
      seed: of the random numbers.
      iterations: moves tried; None: as many as the time allows.
    """

    name = "local"

    def __init__(self, objective: Objective = "makespan", alpha: float = 1.0, beta: float = 0.05,
                 time_limit: float | None = 1.0, seed: int = 0, iterations: int | None = None):
        self.objective: Objective = check(objective, alpha, beta)
        self.alpha, self.beta = alpha, beta
        self.time_limit = None if iterations is not None else time_limit
        self.iterations, self.seed = iterations, seed
        self.curve: list[tuple[float, float]] = []

    def plan(self, moment: Moment) -> TimedPlan:
        """The best plan found within the limit."""
        began = time.perf_counter()
        opened = compact(moment)
        if opened.reason:
            return infeasible(self.name, self.objective, opened.reason, began)
        alpha, beta = weights(self.objective, self.alpha, self.beta)
        until = math.inf if self.time_limit is None else began + self.time_limit
        best = search(opened, alpha, beta, self.iterations, until, self.seed)
        self.curve = best.curve
        services = schedule(opened, *best.lists())
        span = makespan(moment, services)
        if best.late > 0 or span > moment.limit or span >= NEVER:
            return infeasible(self.name, self.objective, "no plan was found that keeps to the "
                              "limit and the times at which targets lapse; there may be one", began)
        return answer(self.name, self.objective, moment, services, None, False, began)
