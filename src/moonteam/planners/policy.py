"""A learned policy as a planner, whatever its network is and however it is decoded."""

from __future__ import annotations

from moonteam.planners.base import Planner
from moonteam.planners.best_of import BestOfPlanner
from moonteam.planners.kind import PlannerKind, PlannerOptions
from moonteam.planners.learned import LearnedPlanner
from moonteam.planners.pointing import PointingPlanner
from moonteam.policies.brain import PointerBrain


def planner_of(options: PlannerOptions) -> Planner:
    """The planner of the policy and decoding in the options. Raises InputError."""
    how, policy = options.decoding, options.loaded()
    if isinstance(policy.brain, PointerBrain):
        return PointingPlanner(policy, how, options)
    if how.rollouts > 1:
        return BestOfPlanner(policy, how.rollouts, options.objective, how.temperature,
                             alpha=options.alpha, beta=options.beta,
                             preference=options.preference, seed=options.seed)
    return LearnedPlanner(policy, "sample" if how.sample else "argmax", how.temperature,
                          how.sample or how.watch, options.preference, options.seed,
                          options.goal[0])


PLANNER = PlannerKind("policy", planner_of, wants_policy=True)
"""A learned policy, however it is decoded."""
