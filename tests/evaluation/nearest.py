"""A planner by the clock of a user's own, which the tests name as FILE.py:OBJECT."""

import numpy as np

from moonteam.planners.seconds import base


class Nearest:
    """One target after another, each by the agents that are there first."""

    name = "nearest"

    def __init__(self, objective="makespan", time_limit=None):
        self.objective = objective

    def plan(self, now):
        free, where, ends, services = now.free.copy(), {}, dict(enumerate(now.ends)), []
        left = {int(j) for j in np.flatnonzero(~now.solved)}
        while left:
            j = min(k for k in left if not left & set(np.flatnonzero(now.after[k]).tolist()))
            left.remove(j)
            there = {a: int(free[a]) + int(
                now.start[a, j] if a not in where else now.between[now.classes[a], where[a], j])
                for a in np.flatnonzero(now.present).tolist()}
            team = []
            for a in sorted(there, key=lambda a: there[a]):
                if not base.enough(team, j, now):
                    team.append(a)
            for a in list(team):
                if base.enough([b for b in team if b != a], j, now):
                    team.remove(a)
            start = max([there[a] for a in team] + [int(now.appears[j])]
                        + [int(ends[k]) for k in np.flatnonzero(now.after[j])])
            ends[j] = start + int(now.service[j])
            for a in team:
                free[a], where[a] = ends[j], j
            services.append(base.Service(j, tuple(team), start, int(ends[j])))
        return self.told(now, tuple(sorted(services, key=lambda one: one.start)))

    def told(self, now, services):
        return base.TimedPlan(self.name, self.objective, "feasible", services,
                              base.makespan(now, services), base.effort(now, services), None, 0.0)


class Boaster(Nearest):
    """Serves everything a second too early, and says that this is optimal."""

    def told(self, now, services):
        early = tuple(base.Service(s.target, s.agents, s.start - 1000, s.end - 1000)
                      for s in services)
        return base.TimedPlan("boaster", self.objective, "optimal", early, 1, 1.0, None, 0.0)


class Quitter(Nearest):
    """Plans two problems and is then interrupted."""

    most_targets = 8
    left = 3  # with the first call

    def plan(self, now):
        type(self).left -= 1
        if type(self).left < 0:
            raise KeyboardInterrupt
        return super().plan(now)


class Declines(Nearest):
    """Never has a plan."""

    def plan(self, now):
        return base.TimedPlan("declines", self.objective, "infeasible", (), None, None, None, 0.0,
                              "it does not want to")


NOT_A_PLANNER = 3


def makes_nothing():
    """No planner comes of it."""
    return object()
