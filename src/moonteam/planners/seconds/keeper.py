"""From a planner by the clock to choices: a plan is kept until another is better by enough.

Robots that have set out may be sent elsewhere at any event, so the plan must not flutter: what is
left of the old one is timed again from where everybody really is, and a new plan has to beat it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from moonteam.planners.seconds.base import (
    Moment,
    Service,
    TimedPlan,
    TimedPlanner,
    timed_again,
)
from moonteam.planners.seconds.leaving import better

WAIT, HOME = -1, -2
"""Choices beside the number of a target."""

MARGIN_MS = 1500
"""ms that a new plan has to gain: less is noise of where robots happen to be."""


class Keeper:
    """Decides for the whole team at each event; see `moonteam.planners.seconds`."""

    def __init__(self, planner: TimedPlanner, margin_ms: int = MARGIN_MS):
        self.name = planner.name
        self.plan: TimedPlan | None = None
        self.first: TimedPlan | None = None  # of the mission, before anything went otherwise
        self._planner, self._margin = planner, margin_ms
        self._order: list[tuple[int, tuple[int, ...]]] = []

    def reset(self, moment: Moment, seed: int = 0) -> None:
        """Starts a mission."""
        del moment, seed
        self._order, self.plan, self.first = [], None, None

    def act(self, moment: Moment) -> npt.NDArray[np.int64]:
        """[R] what each robot goes for now: a target's number, HOME or WAIT."""
        kept = timed_again(moment, self._order)
        self.plan = self._planner.plan(moment)
        self.first = self.first or self.plan
        if self.plan.status != "infeasible" and (
                kept is None or better(moment, self.plan.services, kept, self._margin)):
            self._order = order_of(self.plan)
        elif kept is None:
            self._order = []
        return choices(moment, self._order)

    def expected(self, moment: Moment) -> tuple[Service, ...] | None:
        """The plan that is kept, as it would go from this moment."""
        return timed_again(moment, self._order)


def order_of(plan: TimedPlan) -> list[tuple[int, tuple[int, ...]]]:
    """Its targets with their teams, in order of start."""
    return [(one.target, one.agents) for one in plan.services]


def first_moves(moment: Moment, plan: TimedPlan) -> npt.NDArray[np.int64] | None:
    """[R] what a plan has everybody do first, see `choices`; None where it is none."""
    return None if plan.status == "infeasible" else choices(moment, order_of(plan))


def choices(moment: Moment, order: Sequence[tuple[int, tuple[int, ...]]]
            ) -> npt.NDArray[np.int64]:
    """[R] each robot's first open target in the order; HOME where it has none left."""
    found = np.full(len(moment.present), HOME, np.int64)
    for target, team in reversed(order):
        if not moment.solved[target]:
            found[list(team)] = target
    return np.where(moment.present, found, WAIT)
