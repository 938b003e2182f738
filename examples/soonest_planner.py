"""A planner by the clock of one's own: next is the target that some team can be at soonest.

moonteam plan sampling --planner examples/soonest_planner.py:SoonestPlanner
moonteam rollout sampling --planner examples/soonest_planner.py:SoonestPlanner
"""

from moonteam.planners.seconds.base import TimedPlan, effort, enough, makespan, timed_again


class SoonestPlanner:
    """See `moonteam.planners.seconds.base.TimedPlanner`; times are whole milliseconds."""

    name = "soonest"

    def plan(self, moment):
        """A whole plan of the `Moment`."""
        order, open_ = [], {j for j in range(len(moment.solved)) if not moment.solved[j]}
        free = {a: int(moment.free[a]) for a in range(len(moment.free)) if moment.present[a]}
        last = {}
        while open_:
            found = []
            for j in open_:
                there = {a: when + int(self.way(moment, a, last.get(a), j))
                         for a, when in free.items()}
                team = self.team(moment, j, sorted(there, key=there.get))
                if team and not any(moment.after[j, k] for k in open_):
                    found.append((max(there[a] for a in team), j, team))
            if not found:
                break
            when, j, team = min(found)
            open_.remove(j)
            order.append((j, team))
            for a in team:
                free[a], last[a] = when + int(moment.service[j]), j
        services = timed_again(moment, order)
        if services is None:
            return TimedPlan(self.name, "makespan", "infeasible", (), None, None, None, 0.0,
                             "the nearest first is too late for a target, or for home")
        return TimedPlan(self.name, "makespan", "feasible", services, makespan(moment, services),
                         effort(moment, services), None, 0.0)

    @staticmethod
    def way(moment, agent, last, target):
        """ms from where it will be to a target."""
        if last is None:
            return moment.start[agent, target]
        return moment.between[moment.classes[agent], last, target]

    @staticmethod
    def team(moment, target, agents):
        """The first that are enough, without those who are not needed."""
        for count in range(1, len(agents) + 1):
            if enough(agents[:count], target, moment):
                team = agents[:count]
                for agent in agents[:count]:
                    rest = [a for a in team if a != agent]
                    team = rest if enough(rest, target, moment) else team
                return tuple(team)
        return ()
