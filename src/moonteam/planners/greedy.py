"""The greedy planner: one insertion with regret, the yardstick that any search must beat."""

from __future__ import annotations

from moonteam.planners.kind import PlannerKind
from moonteam.planners.lns import InsertionPlanner


class GreedyPlanner(InsertionPlanner):
    """Targets are put into the team's routes one by one, never moved again.

    Of two lists the cheaper is taken: one made in order of regret (what a target loses if it
    misses its best coalition), one cheapest target first.
    """

    name = "greedy"


PLANNER = PlannerKind("greedy", lambda options: GreedyPlanner(*options.goal))
