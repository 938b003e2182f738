"""Local search with a learned guide: what is taken out of a plan, and how it is put back."""

from __future__ import annotations

import os

from moonteam.planners.base import Objective
from moonteam.planners.kind import PlannerKind, PlannerOptions
from moonteam.planners.lns import LnsPlanner
from moonteam.planners.search import guides


class GuidedPlanner(LnsPlanner):
    """Insertion with regret, then large-neighbourhood search as its guide has it.

    Guides learn to make plans short: of other objectives than the makespan the plain one takes
    care, and the planner is `LnsPlanner`.

    Args:
      objective, alpha, beta, iterations, time_limit, seed, threads: as of `LnsPlanner`.
      guide: a file that `moonteam train guide` made, or the name of a bundled guide.

    Raises InputError for a file that holds no guide.
    """

    name = "guided"

    def __init__(self, objective: Objective = "makespan", alpha: float = 1.0, beta: float = 0.05,
                 iterations: int | None = None, time_limit: float | None = None, seed: int = 0,
                 threads: int = 1, guide: str | os.PathLike[str] = guides.BUNDLED):
        super().__init__(objective, alpha, beta, iterations, time_limit, seed, threads)
        learned = guides.load(guide)
        self.guide = learned if self.objective == "makespan" else guides.PLAIN


def _planner(options: PlannerOptions) -> GuidedPlanner:
    return GuidedPlanner(*options.goal, time_limit=options.time_limit, seed=options.seed,
                         threads=options.threads)


PLANNER = PlannerKind("guided", _planner, anytime=True, parallel=True)
