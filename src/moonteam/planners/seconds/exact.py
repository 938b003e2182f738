"""The exact planner by the clock: certified optima of makespan, effort and their weighted sum.

The search is in `labels`; it starts from the plan that a short local search found, which is mostly
the best one already, so that what is left is to prove it.
"""

from __future__ import annotations

import functools
import math
import time
from dataclasses import dataclass

import numpy as np

from moonteam.errors import InputError
from moonteam.planners.seconds import base
from moonteam.planners.seconds.base import NEVER, TRIAL, Moment, TimedPlan, makespan
from moonteam.planners.seconds.leaving import leaving
from moonteam.planners.seconds.local import search
from moonteam.planners.seconds.search import labels, plain
from moonteam.planners.seconds.search.goal import (
    Objective,
    answer,
    check,
    infeasible,
    schedule,
    weights,
)
from moonteam.planners.seconds.search.work import Open, compact
from moonteam.problem.timed import Timed

MAX_TARGETS = 14
"""Open targets that the exact planner takes on: its tables grow as 2^M."""

_PLAIN_TARGETS, _PLAIN_IN_TIME = 12, 8  # that the search in steps gets, without and with a limit
_TRIES, _SLICE = 500, 0.02  # of a label and a team before a look at the clock; s then
_LISTED = 5e6  # teams that are tried a second as they are listed
_NO_LIMIT = 1 << 62
_FIRST_ITERATIONS = 60  # of local search, for each target
_EPS = 1e-6


@dataclass
class Found:
    """The best plan so far: its cost, and its targets and teams in order."""

    cost: float
    order: list[int]
    teams: list[list[int]]


@dataclass
class Layer:
    """Labels, how many, and the table by which they are found."""

    labels: labels.Labels
    heads: np.ndarray
    count: int = 0

    @classmethod
    def of(cls, size: int, agents: int, targets: int) -> Layer:
        """An empty layer of at most `size` labels."""
        whole, ints = lambda *shape: np.zeros(shape, np.int64), np.int64
        return cls(labels.Labels(
            whole(size), whole(size, agents), whole(size, agents), whole(size, targets),
            whole(size), np.zeros(size), np.zeros(size), whole(size), whole(size), whole(size),
            np.zeros(size, bool), whole(size)), np.full(2 * size, -1, ints))

    def grown(self) -> Layer:
        """The same with twice the room."""
        more = labels.Labels(*(np.concatenate([part, np.zeros_like(part)]) for part in self.labels))
        layer = Layer(more, np.full(2 * len(self.heads), -1, np.int64), self.count)
        labels.refile(more, self.count, layer.heads)
        return layer


class ExactPlanner:
    """Optimal plans by the clock for up to 14 open targets.

    Args:
      objective: makespan, effort or weighted.
      alpha: weight of the makespan, ms, in the weighted objective.
      beta: weight of the effort in the weighted objective.
      time_limit: seconds after which the best plan so far is returned, with its bound and the
        status feasible; None to search to the end.
    """

    name = "exact"
    most_targets = MAX_TARGETS

    def __init__(self, objective: Objective = "makespan", alpha: float = 1.0, beta: float = 0.05,
                 time_limit: float | None = None):
        self.objective: Objective = check(objective, alpha, beta)
        self.alpha, self.beta = alpha, beta
        self.time_limit = time_limit

    def plan(self, moment: Moment) -> TimedPlan:
        """The best plan, of what it is best to serve. Raises InputError for too many targets or
        agents.
        """
        return leaving(self.plan_all, moment)

    def plan_all(self, moment: Moment) -> TimedPlan:
        """The best plan that serves all that is open."""
        if self.time_limit is not None:
            compiled()
        began = time.perf_counter()
        opened = compact(moment)
        agents, count = opened.work.start.shape
        if count > MAX_TARGETS:
            raise InputError("--planner exact", f"{count} targets are open; the exact planner "
                             f"takes up to {MAX_TARGETS}; use lns")
        if opened.reason:
            return infeasible(self.name, self.objective, opened.reason, began)
        if not count:
            return self._empty(moment, began)
        if agents > labels.MAX_AGENTS:
            raise InputError("--planner exact", f"{agents} agents; the exact planner takes up to "
                             f"{labels.MAX_AGENTS}; use lns")
        until = math.inf if self.time_limit is None else began + self.time_limit
        found = self._plain(opened)
        if found is not None:
            bound, done = found.cost, True
        else:
            found = self._first(opened, until)
            bound, done = self._improve(opened, found, until)
        if found.order:
            services = schedule(opened, found.order, found.teams)
            return answer(self.name, self.objective, moment, services,
                          self._said(found.cost if done else min(bound, found.cost)), done, began)
        return infeasible(self.name, self.objective, self._why(opened, done), began)

    def _empty(self, moment: Moment, began: float) -> TimedPlan:
        """The plan where nothing is open."""
        plan = answer(self.name, self.objective, moment, (), None, True, began)
        if makespan(moment, ()) > moment.limit or makespan(moment, ()) >= NEVER:
            return infeasible(self.name, self.objective, "nobody has anything left to do, yet not "
                              "everybody can be home within the limit", began)
        alpha, beta = weights(self.objective, self.alpha, self.beta)
        cost = alpha * (plan.makespan or 0) + beta * (plan.effort or 0.0)
        return TimedPlan(plan.planner, plan.objective, "optimal", (), plan.makespan, plan.effort,
                         cost, plan.seconds)

    def _plain(self, opened: Open) -> Found | None:
        """What the search in steps finds, where it serves and ends in time."""
        alpha, beta = weights(self.objective, self.alpha, self.beta)
        most = _PLAIN_TARGETS if self.time_limit is None else _PLAIN_IN_TIME
        if len(opened.targets) > most or not plain.fits(opened.work, alpha, beta):
            return None
        best = plain.solve(opened.work, alpha, beta)
        return None if best is None else Found(*best)

    def _first(self, opened: Open, until: float) -> Found:
        """What a short local search finds."""
        alpha, beta = weights(self.objective, self.alpha, self.beta)
        count = len(opened.targets)
        best = search(opened, alpha, beta, iterations=_FIRST_ITERATIONS * count, until=until)
        if best.late > 0:
            return Found(math.inf, [], [])
        return Found(best.cost, *best.lists())

    def _improve(self, opened: Open, found: Found, until: float) -> tuple[float, bool]:
        """Searches for better plans than the one found; (lower bound, whether it is proved)."""
        work = opened.work
        agents, count = work.start.shape
        alpha, beta = weights(self.objective, self.alpha, self.beta)
        timeless = alpha == 0.0 and bool((work.late >= NEVER - work.service).all())
        aim = labels.Aim(alpha, beta, timeless)
        left = until - time.perf_counter()
        mask, first, listed = labels.teams(
            work, beta == 0.0, _NO_LIMIT if left == math.inf else int(max(left, 0.0) * _LISTED))
        if not listed:
            return 0.0, False
        tables = labels.prepare(work, beta == 0.0, mask, first)
        space = np.zeros((3, max(agents, count)), np.int64)
        layer = Layer.of(8, agents, count)
        root, layer.count = layer.labels, 1
        root.last[0], root.clock[0], root.ready[0] = -1, work.free, work.ready
        root.bound[0] = labels.estimate(work, tables, aim, 0, root.last[0], root.clock[0],
                                        root.ready[0], 0, 0.0, space)
        trail: list[labels.Labels] = []
        final, tries = np.full(3, -1, np.int64), _NO_LIMIT if until == math.inf else _TRIES
        for _ in range(count):
            new = Layer.of(max(256, 2 * len(tables.mask), 2 * layer.count), agents, count)
            at, team = 0, 0
            while at < layer.count:
                clock = time.perf_counter()
                if clock > until:
                    return self._open_bound(layer, at, new, found), False
                at, team, new.count, upper = labels.expand(
                    work, tables, aim, layer.labels, at, team, layer.count, new.labels, new.count,
                    new.heads, found.cost - _EPS, final, space, tries)
                if until < math.inf:
                    share = _SLICE / max(time.perf_counter() - clock, 1e-6)
                    tries = int(max(1, tries * min(share, 4.0)))
                if upper < found.cost - _EPS:
                    found.cost = upper
                    found.order, found.teams = _trace([*trail, layer.labels], final, tables.mask)
                if new.count + len(tables.mask) >= len(new.labels.served):
                    new = new.grown()
            trail.append(layer.labels)
            layer = new
        return found.cost, True

    def _open_bound(self, layer: Layer, at: int, new: Layer, found: Found) -> float:
        """The least bound of the labels that are not expanded yet."""
        left = [found.cost]
        for part, first in ((layer, at), (new, 0)):
            alive = ~part.labels.dead[first:part.count]
            left += part.labels.bound[first:part.count][alive].tolist()
        return min(left)

    def _said(self, bound: float) -> float:
        return math.ceil(bound - _EPS) if self.objective == "makespan" else bound

    def _why(self, opened: Open, done: bool) -> str:
        if not done:
            return f"no plan was found in {self.time_limit:g} s; there may be one"
        work = opened.work
        reasons = []
        if (work.late < NEVER - work.service).any():
            reasons.append("the times at which targets lapse" if work.limit >= NEVER else
                           f"the limit of {work.limit} ms or the times at which targets lapse")
        return "no plan keeps to " + (" and ".join(reasons) or "the ways that there are")


def _trace(trail: list[labels.Labels], final: np.ndarray,
           masks: np.ndarray) -> tuple[list[int], list[list[int]]]:
    """Targets and teams that lead to a whole plan, from the layers gone through."""
    parent, target, team = (int(x) for x in final)
    order, teams = [target], [team]
    for layer in reversed(trail[1:]):
        order.append(int(layer.target[parent]))
        teams.append(int(layer.team[parent]))
        parent = int(layer.parent[parent])
    members = [[a for a in range(labels.MAX_AGENTS) if int(masks[c]) >> a & 1] for c in teams]
    return order[::-1], members[::-1]


@functools.cache
def compiled() -> None:
    """Compiles, or loads, what a search calls: once a process, which counts for no time limit."""
    plain = Timed("seconds", TRIAL.agents[:1], TRIAL.targets[1:2])  # the search in steps serves it
    for trial in (TRIAL, plain):
        ExactPlanner().plan(base.moment(trial))
    Layer.of(1, 1, 1).grown()
