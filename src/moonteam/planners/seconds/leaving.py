"""Plans that leave out what need not be served: first as much worth as can be, then the objective.

Any planner by the clock serves all that is open or finds no plan; which targets to leave out is
chosen here, above it. Up to `EXACTLY` of them the choice is certified if the planner's plans are:
sets of targets are tried from the most worth down, but those that hold a pair which cannot both be
served. Beyond, or where a plan takes long, the worthiest are taken on one after the other.

Legend: M targets, O of them optional.
"""

from __future__ import annotations

import copy
import itertools
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from moonteam.planners.seconds.base import Moment, Service, TimedPlan, makespan

EXACTLY = 12
"""Targets of which all sets are looked at."""
_EQUAL = 1e-9

Plan = Callable[[Moment], TimedPlan]


def served(moment: Moment, services: tuple[Service, ...]) -> float:
    """What a plan's services count where targets may lapse; 0 where none may."""
    return 0.0 if moment.worth is None else float(
        sum(moment.worth[service.target] for service in services))


def better(moment: Moment, services: tuple[Service, ...], other: tuple[Service, ...],
           margin: int = 0) -> bool:
    """Whether a plan serves more than another, or as much and is over `margin` ms sooner."""
    more = served(moment, services) - served(moment, other)
    return more > _EQUAL or (more > -_EQUAL and makespan(moment, services)
                             < makespan(moment, other) - margin)


def leaving(plan: Plan, moment: Moment, exactly: bool = True) -> TimedPlan:
    """The plan of `plan` for the targets that it is best to serve: for all, where all have to be.

    Args:
      plan: serves all that is open, or says that this is infeasible.
      moment: some of whose targets may be left out.
      exactly: by looking at all sets of them; else the worthiest first.
    """
    began = time.perf_counter()
    optional = moment.optional
    if not len(optional):
        return plan(moment)
    found = plan(moment)
    if found.status == "infeasible":
        few = exactly and len(optional) <= EXACTLY
        found = (_best_set if few else _one_by_one)(plan, moment, optional, found)
    return replace(found, seconds=time.perf_counter() - began)


def sharing(planner: Any, moment: Moment) -> TimedPlan:
    """The same of a planner whose `plan_all` takes its `time_limit`: all its plans share that."""
    if not len(moment.optional):
        return planner.plan_all(moment)
    one = copy.copy(planner)
    if planner.time_limit is not None:
        one.time_limit = planner.time_limit / (2 + len(moment.optional))
    return leaving(one.plan_all, moment, exactly=False)


def _best_set(plan: Plan, moment: Moment, optional: np.ndarray, whole: TimedPlan) -> TimedPlan:
    """Of all sets the one of the most worth that can be served; of several, the soonest done."""
    assert moment.worth is not None
    count = len(optional)
    worth = moment.worth[optional]
    sets = np.arange(2**count - 1)  # of all of them there is no plan
    has = (sets[:, None] >> np.arange(count) & 1).astype(bool)  # [sets, O]
    tried: dict[int, TimedPlan] = {2**count - 1: whole}

    def of(number: int) -> TimedPlan:
        if number not in tried:
            left = [j for k, j in enumerate(optional.tolist()) if not number >> k & 1]
            tried[number] = plan(moment.without(np.array(left)))
        return tried[number]

    may = np.ones(len(sets), bool)
    for size in (1, 2) if count > 2 else ():
        for few in itertools.combinations(range(count), size):
            number = sum(1 << k for k in few)
            if may[number] and of(number).status == "infeasible":
                may &= ~has[:, few].all(1)
    best: TimedPlan | None = None
    total = (has * worth).sum(1)
    for number in np.lexsort((sets, -total)).tolist():
        if best is not None and total[number] < served(moment, best.services) - _EQUAL:
            break
        if may[number]:
            own = of(number)
            if own.status != "infeasible" and (best is None or better(
                    moment, own.services, best.services)):
                best = own
    return whole if best is None else best


def _one_by_one(plan: Plan, moment: Moment, optional: np.ndarray, whole: TimedPlan) -> TimedPlan:
    """Takes on the worthiest first, and each that a plan is found with."""
    assert moment.worth is not None
    left = optional.copy()
    best = plan(moment.without(left))
    for j in optional[np.argsort(-moment.worth[optional], kind="stable")].tolist():
        if best.status == "infeasible":
            return replace(best, reason=best.reason or whole.reason)
        own = plan(moment.without(left[left != j]))
        if own.status != "infeasible":
            best, left = own, left[left != j]
    return best if best.status == "infeasible" else replace(
        best, status="feasible", bound=None)
