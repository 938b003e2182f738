"""The greedy planner by the clock: each time the target, with the team, that is done first."""

from __future__ import annotations

import time

import numpy as np

from moonteam.compilation import njit
from moonteam.planners.seconds.base import NEVER, Int64, Moment, TimedPlan, makespan
from moonteam.planners.seconds.leaving import leaving
from moonteam.planners.seconds.search.decode import choose
from moonteam.planners.seconds.search.goal import answer, infeasible, lists, schedule
from moonteam.planners.seconds.search.work import Open, compact, places


@njit(cache=True, nogil=True)
def first_done(work, order, team, size):
    """Fills `order` [M], `team` [M, P] and `size` [M] with the services in order of their ends."""
    n, m = work.start.shape
    clock, last = work.free.copy(), np.full(n, -1, np.int64)
    reach, want = np.empty(n, np.int64), np.empty(work.has.shape[1], np.int64)
    ready, waits = work.ready.copy(), np.empty(m, np.int64)
    ends, done = np.zeros(m, np.int64), np.zeros(m, np.bool_)
    for t in range(m):
        waits[t] = work.first_before[t + 1] - work.first_before[t]
        size[t] = 0
    for i in range(m):
        pick = -1
        for t in range(m):
            if done[t] or waits[t] > 0:
                continue
            if size[t] == 0:
                size[t] = choose(work, t, last, clock, 0, 0.0, 0.0, team[t], reach, want)
                when = ready[t]
                for k in range(size[t]):
                    a = team[t, k]
                    leg = work.start[a, t] if last[a] < 0 else (
                        work.between[work.classes[a], last[a], t])
                    when = max(when, clock[a] + leg)
                ends[t] = when + work.service[t]
            if pick < 0 or ends[t] < ends[pick]:
                pick = t
        order[i] = pick
        done[pick] = True
        for k in range(size[pick]):
            a = team[pick, k]
            clock[a], last[a] = ends[pick], pick
            for t in range(m):  # whoever counted on the agent looks for a team again
                for q in range(size[t]):
                    if not done[t] and team[t, q] == a:
                        size[t] = 0
        for e in range(work.first_then[pick], work.first_then[pick + 1]):
            t = work.then[e]
            waits[t] -= 1
            ready[t] = max(ready[t], ends[pick])


def greedy(opened: Open) -> tuple[Int64, Int64, Int64]:
    """Order [M], teams [M, P] and their sizes [M]."""
    count = len(opened.targets)
    order, size = np.zeros(count, np.int64), np.zeros(count, np.int64)
    team = np.zeros((count, places(opened.work)), np.int64)
    first_done(opened.work, order, team, size)
    return order, team, size


class GreedyPlanner:
    """Each time the target and the team whose service ends first; the floor for other planners."""

    name = "greedy"

    def plan(self, moment: Moment) -> TimedPlan:
        """A plan at once. Where targets lapse it may find none although there is one; those that
        need not be served are taken on by their worth.
        """
        return leaving(self.plan_all, moment, exactly=False)

    def plan_all(self, moment: Moment) -> TimedPlan:
        """A plan that serves all that is open."""
        began = time.perf_counter()
        opened = compact(moment)
        if opened.reason:
            return infeasible(self.name, "makespan", opened.reason, began)
        services = schedule(opened, *lists(*greedy(opened)))
        span = makespan(moment, services)
        late = [one.target for one in services if one.start > moment.lapses[one.target]]
        if late or span > moment.limit or span >= NEVER:
            what = f"targets {late} would have lapsed" if late else f"it would take {span} ms"
            return infeasible(self.name, "makespan", f"{what}; there may be another plan", began)
        return answer(self.name, "makespan", moment, services, None, False, began)
