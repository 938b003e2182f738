"""The objectives of plans by the clock, and plans made of lists of targets and teams."""

from __future__ import annotations

import time
from typing import Literal

import numpy as np

from moonteam.errors import InputError, not_one_of
from moonteam.planners.base import check_objective
from moonteam.planners.seconds.base import Int64, Moment, Service, TimedPlan, effort, makespan
from moonteam.planners.seconds.search.work import Open

Objective = Literal["makespan", "effort", "weighted"]


def weights(objective: Objective, alpha: float, beta: float) -> tuple[float, float]:
    """What a ms of makespan and a unit of effort weigh."""
    if objective == "makespan":
        return 1.0, 0.0
    return (0.0, 1.0) if objective == "effort" else (alpha, beta)


def check(objective: str, alpha: float, beta: float) -> Objective:
    """The objective, if it is one and its weights make sense. Raises InputError."""
    known: dict[str, Objective] = {"makespan": "makespan", "effort": "effort",
                                   "weighted": "weighted"}
    if objective not in known:
        raise InputError("--objective", not_one_of(objective, known))
    if objective == "weighted":
        check_objective(objective, alpha, beta)
    return known[objective]


def value(objective: Objective, alpha: float, beta: float, span: float, way: float) -> float:
    """The objective's value of a plan."""
    by_time, by_way = weights(objective, alpha, beta)
    return by_time * span + by_way * way


def schedule(opened: Open, order: list[int], teams: list[list[int]]) -> tuple[Service, ...]:
    """Services as early as can be, in order of start.

    Args:
      opened: what is to be done.
      order: open targets (rows of `work`) in the order in which they are put behind each other.
      teams: the team of each of them, rows of `work`, in the same order.
    """
    work = opened.work
    clock, last = work.free.tolist(), [-1] * len(work.free)
    ends: dict[int, int] = {}
    services = []
    names, targets, classes = opened.agents.tolist(), opened.targets.tolist(), work.classes.tolist()
    for t, team in zip(order, teams, strict=True):
        first, stop = work.first_before[t], work.first_before[t + 1]
        when = max([int(work.ready[t]), *(ends[int(b)] for b in work.before[first:stop])])
        for a in team:
            when = max(when, clock[a] + int(work.start[a, t] if last[a] < 0 else
                                            work.between[classes[a], last[a], t]))
        ends[t] = when + int(work.service[t])
        for a in team:
            clock[a], last[a] = ends[t], t
        services.append(Service(targets[t], tuple(sorted(names[a] for a in team)), when, ends[t]))
    return tuple(sorted(services, key=lambda one: (one.start, one.end)))


def answer(name: str, objective: Objective, now: Moment, services: tuple[Service, ...],
           bound: float | None, certified: bool, began: float) -> TimedPlan:
    """A plan with its makespan and effort."""
    return TimedPlan(
        name, objective, "optimal" if certified else "feasible", services,
        makespan(now, services), effort(now, services), bound, time.perf_counter() - began)


def infeasible(name: str, objective: Objective, reason: str, began: float) -> TimedPlan:
    """No plan, and why."""
    return TimedPlan(name, objective, "infeasible", (), None, None, None,
                     time.perf_counter() - began, reason)


def lists(order: Int64, team: Int64, size: Int64) -> tuple[list[int], list[list[int]]]:
    """An order [M], teams [M, P] and their sizes [M] by target, as `schedule` takes them."""
    teams = [team[t, :size[t]].tolist() for t in order.tolist()]
    return order.tolist(), teams


def order_within(work_first: Int64, before: Int64, liking: Int64) -> Int64:
    """An order [M] that keeps to "after"; among targets that may come next, as `liking` says."""
    count = len(liking)
    done = np.zeros(count, bool)
    out = []
    wanted = liking.tolist()
    while wanted:
        for t in wanted:
            if done[before[work_first[t]:work_first[t + 1]]].all():
                break
        else:
            raise ValueError("targets wait for each other")
        done[t] = True
        out.append(t)
        wanted.remove(t)
    return np.array(out, np.int64)
