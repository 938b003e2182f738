"""The planners that can drive an execution, by the names of the command line."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from moonteam.errors import InputError
from moonteam.planners import simulate
from moonteam.planners.base import IntArray, Objective, Planner, Snapshot
from moonteam.planners.learned import LearnedPlanner, Policy, plan_best_of
from moonteam.planners.plans.follow import same_moment

PLANNERS = ("policy", "exact", "greedy")


class BestOfPlanner:
    """Follows the best of K sampled rollouts of a policy; samples again when off that plan.

    Where none of them solves the mission it decides step by step instead.
    """

    name = "policy"

    def __init__(self, policy: Policy, rollouts: int, objective: Objective,
                 temperature: float = 1.0):
        self.policy, self.rollouts, self.temperature = policy, rollouts, temperature
        self.objective: Objective = objective
        self._stepwise = LearnedPlanner(policy)
        self._begin(0)

    def _begin(self, seed: int) -> None:
        self._seed = seed
        self._actions: list[IntArray] = []
        self._expected: Snapshot | None = None

    def reset(self, snapshot: Snapshot, seed: int = 0) -> None:
        """Starts a mission. Raises InputError if the policy cannot serve it."""
        self._stepwise.reset(snapshot, seed)
        self._begin(seed)

    def act(self, snapshot: Snapshot) -> IntArray:
        """Joint action [N]."""
        if self._expected is None or not same_moment(snapshot, self._expected):
            # From step 0, so that the compiled rollout has one length.
            plan = plan_best_of(self.policy, replace(snapshot, step=0), self.rollouts,
                                self._seed, self.objective, self.temperature)
            self._actions = list(plan.actions)
        joint = self._actions.pop(0) if self._actions else self._stepwise.act(snapshot)
        held = replace(snapshot, solved=simulate.holding(snapshot))
        self._expected = simulate.step(held, joint)
        return joint


def make_planner(name: str, *, policy: Path | None = None, objective: Objective = "makespan",
                 decode: str = "argmax") -> Planner:
    """`policy`, `exact` or `greedy`. Raises InputError for what cannot be.

    `policy` is the file of the planner `policy`; `decode` is argmax, sample or best-of-K.
    """
    return planner_maker(name, policy=policy, objective=objective, decode=decode)()


def planner_maker(name: str, *, policy: Path | None = None, objective: Objective = "makespan",
                  decode: str = "argmax") -> Callable[[], Planner]:
    """Makes any number of planners, each for a mission of its own; arguments as above."""
    if name == "exact":
        from moonteam.planners.exact import ExactPlanner

        return partial(ExactPlanner, objective)
    if name == "greedy":
        from moonteam.planners.greedy import GreedyPlanner

        return partial(GreedyPlanner, objective)
    if name != "policy" or policy is None:
        raise InputError("--planner", f"{name!r} is not one of {', '.join(PLANNERS)}")
    from moonteam.planners.decode import parse

    how = parse(decode)
    loaded = Policy.load(policy)
    if how.rollouts > 1:
        return partial(BestOfPlanner, loaded, how.rollouts, objective, how.temperature)
    return partial(LearnedPlanner, loaded, "sample" if how.sample else "argmax",
                   how.temperature, watch=how.sample or how.watch)


def check_planner(planner: Planner, snapshot: Snapshot) -> None:
    """Raises InputError if a planner cannot serve a mission.

    `snapshot` holds all its targets, those that events will bring too.
    """
    from moonteam.planners.exact import MAX_TARGETS, ExactPlanner

    policy = getattr(planner, "policy", None)
    if isinstance(policy, Policy):
        policy.check(snapshot)
    count = len(snapshot.target_cells)
    if isinstance(planner, ExactPlanner) and count > MAX_TARGETS:
        raise InputError("--planner exact", f"{count} targets, those of events counted; the exact "
                         f"planner takes up to {MAX_TARGETS}; use greedy")


def ask(planners: Sequence[Planner], snapshots: Sequence[Snapshot]) -> list[IntArray]:
    """The joint actions [N] of planners that are asked at the same time."""
    return [planner.act(snapshot) for planner, snapshot in zip(planners, snapshots, strict=True)]
