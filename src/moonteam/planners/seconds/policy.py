"""A learned policy by the clock: who is free points at its next target, event by event.

The policy is played in the macro world to the end; what comes of it is timed again to the
millisecond, as every plan by the clock is. See `planners.macro` for the playing.

Legend: B moments, K tries of each, N agents, M targets.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from moonteam.planners import macro
from moonteam.planners.best_of import meaning, prices
from moonteam.planners.kind import PlannerOptions
from moonteam.planners.macro import Rollouts
from moonteam.planners.seconds.base import (
    MS,
    Moment,
    Service,
    TimedPlan,
    effort,
    enough,
    makespan,
    timed_again,
)
from moonteam.planners.seconds.leaving import served
from moonteam.planners.seconds.macro import problem_of
from moonteam.planners.seconds.search.goal import Objective
from moonteam.planners.seconds.search.work import compact
from moonteam.policies.policy import Policy

MOST_TIMED = 64
"""Of many tries only the best so many, as they were played, are timed again."""


class PolicyPlanner:
    """Plays a policy from a moment to its end; of several sampled tries the best counts.

    What is best is said by the objective; without one, by the preference. Raises InputError for a
    policy that does not point at targets.
    """

    name = "policy"
    wants_policy = True

    def __init__(self, options: PlannerOptions):
        decoding = options.decoding
        self.policy: Policy = options.loaded()
        macro.spec_of(self.policy)
        self.tries, self.seed = decoding.rollouts, options.seed
        self.heat, self.cooling = decoding.heat, decoding.cooling
        self.preference = options.preference
        word, *_ = meaning(options)
        self.objective: Objective = "effort" if word == "moves" else word
        self._prices = prices(options.objective, options.alpha, options.beta, options.preference)

    def plan(self, moment: Moment) -> TimedPlan:
        """The best of its tries; infeasible if none serves every target in time."""
        return self.plans([moment])[0]

    def plans(self, moments: Sequence[Moment]) -> list[TimedPlan]:
        """The same of many moments, all played in one call; each has its share of the time."""
        began = time.perf_counter()
        played = macro.rollouts(
            self.policy, macro.stacked([problem_of(moment) for moment in moments]),
            tries=self.tries, heat=self.heat, cooling=self.cooling, seed=self.seed,
            preference=self.preference)
        found = [self._best(moment, played, b) for b, moment in enumerate(moments)]
        share = (time.perf_counter() - began) / max(len(moments), 1)
        return [self._plan(moment, services, share)
                for moment, services in zip(moments, found, strict=True)]

    def _best(self, now: Moment, played: Rollouts, row: int) -> tuple[Service, ...] | None:
        cost = self._prices[0] * played.seconds[row] + self._prices[1] * played.effort[row]
        cost = np.where(played.solved[row], cost, np.inf)
        left = np.zeros(len(cost)) if now.worth is None else np.isnan(
            played.start[row][:, now.optional]) @ now.worth[now.optional]
        best, least = None, (np.inf, np.inf)
        for k in np.lexsort((cost, left))[:MOST_TIMED].tolist():
            services = None if cost[k] == np.inf else _timed(now, played, row, k)
            if services is not None and (price := self._price(now, services)) < least:
                best, least = services, price
        return best

    def _price(self, now: Moment, services: tuple[Service, ...]) -> tuple[float, float]:
        """What is left out, and what the rest costs."""
        return -served(now, services), (
            self._prices[0] * makespan(now, services)
            + self._prices[1] * effort(now, services)) / MS

    def _plan(self, now: Moment, services: tuple[Service, ...] | None, seconds: float
              ) -> TimedPlan:
        if services is None:
            reason = compact(now).reason or (
                f"none of {self.tries} sampled tries served every target in time"
                if self.tries > 1 else "the policy did not serve every target in time")
            return TimedPlan(self.name, self.objective, "infeasible", (), None, None, None, seconds,
                             reason)
        return TimedPlan(self.name, self.objective, "feasible", services, makespan(now, services),
                         effort(now, services), None, seconds)


def _timed(now: Moment, played: Rollouts, row: int, k: int) -> tuple[Service, ...] | None:
    """One try, to the millisecond; without the agents of a coalition that does without them."""
    targets = len(now.solved)
    start, end = played.start[row, k, :targets], played.end[row, k, :targets]
    sent = played.order[row, k, :len(now.present), :targets]
    done = np.flatnonzero(np.isfinite(start) & ~now.solved)
    # Of services that start together without a length, what comes before, then who set out first.
    by_time = np.lexsort((sent.max(0)[done], macro.depth(now.after)[done], end[done],
                          start[done]))
    order = [(j, tuple(np.flatnonzero(sent[:, j] >= 0).tolist()))
             for j in done[by_time].tolist()]
    whole = timed_again(now, order)
    fewer = [(j, _needed(team, j, now, sent[:, j])) for j, team in order]
    if fewer == order:
        return whole
    leaner = timed_again(now, fewer)
    if whole is None or leaner is None:
        return whole or leaner
    return leaner if makespan(now, leaner) <= makespan(now, whole) else whole


def _needed(team: tuple[int, ...], target: int, now: Moment, sent: np.ndarray
            ) -> tuple[int, ...]:
    """The team without those that it can do without, who set out first first."""
    left = list(team)
    for agent in sorted(team, key=lambda a: (sent[a], a)):
        rest = [a for a in left if a != agent]
        if rest and enough(rest, target, now):
            left = rest
    return tuple(left)

