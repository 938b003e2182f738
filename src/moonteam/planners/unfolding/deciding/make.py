"""Who decides in one mission that unfolds, made from a planner and a few words."""

from __future__ import annotations

from typing import Literal

import numpy as np

from moonteam.errors import InputError
from moonteam.planners import macro
from moonteam.planners.seconds.base import TimedPlanner
from moonteam.planners.seconds.exact import ExactPlanner
from moonteam.planners.seconds.keeper import HOME
from moonteam.planners.seconds.policy import PolicyPlanner
from moonteam.planners.unfolding.deciding.ahead import LookingAhead
from moonteam.planners.unfolding.deciding.consensus import Consensus
from moonteam.planners.unfolding.deciding.deciders import (
    Choose,
    Decider,
    Goal,
    OverFutures,
    Replanning,
)
from moonteam.planners.unfolding.deciding.pointing import Pointing
from moonteam.planners.unfolding.deciding.search import Middle, NearestUnseen, Pattern, Sweep
from moonteam.planners.unfolding.state import Order
from moonteam.planners.unfolding.world import View

Search = Literal["nearest", "sweep", "places", "stay", "middle"]
"""How is looked for what is hidden; where nothing is, where who has nothing to do waits."""

PATTERNS = ("nearest", "sweep")
"""Those that say where to look next."""
PLACES = "places"
"""Places to look from are planned for as if they were targets."""
STAY, MIDDLE = "stay", "middle"
"""Where nothing is hidden: where it is, or where the next target is soonest reached in the mean."""
ALL_AT_ONCE = ("", STAY, MIDDLE)
"""By which a policy can look ahead in the macro world."""
MOST_FUTURES = 4096
NEAR_M = 1e-6
"""m at which a robot is where it was to look from; of bodies more."""


def check_search(search: str, hidden: bool) -> None:
    """Raises InputError for a way to search where nothing is hidden, or to wait where it is."""
    if hidden == (search in (STAY, MIDDLE)):
        ways = ("nearest, sweep, places", "stay, middle")
        raise InputError(f"--search {search}", "has no effect where "
                         + ("targets are hidden" if hidden else "no target is hidden")
                         + f"; {ways[not hidden]}")


def check_futures(count: int) -> None:
    """Raises InputError for a number of futures that is none."""
    if not 2 <= count <= MOST_FUTURES:
        raise InputError("--futures", f"{count} is not allowed; 2 to {MOST_FUTURES}")


class Choosing:
    """Decides by a choice of targets; who has none goes home, or looks for what is hidden."""

    def __init__(self, choose: Choose, replanning: Replanning):
        self._choose, self._rest = choose, replanning

    def act(self, view: View) -> list[Order]:
        """See `deciders.Decider`."""
        view = self._rest.shown(view)
        if view.moment.solved.all():
            return self._rest.settled(view, np.full(len(view.places), HOME))
        return self._rest.settled(view, self._choose([view])[0])


def pointing(planner: TimedPlanner) -> Choose | None:
    """A policy's likeliest choices of many moments in one call; None of other planners."""
    if isinstance(planner, PolicyPlanner) and planner.tries == 1 and planner.heat == 0.0:
        return Pointing(planner.policy, planner.preference).choose
    return None


def stands(planner: TimedPlanner) -> bool:
    """Whether it is a policy that may send who has nothing to do to a place to wait at."""
    return isinstance(planner, PolicyPlanner) and macro.spec_of(planner.policy).posts


def searching(search: str, near_m: float = NEAR_M) -> Pattern | None:
    """A fresh pattern, for it remembers its mission; None of `PLACES` and where none is."""
    made: dict[str, Pattern] = {
        "nearest": NearestUnseen(), "sweep": Sweep(near_m), MIDDLE: Middle()}
    return made.get(search)


def decider_of(planner: TimedPlanner, *, search: str = "", futures: int = 0,
               goal: Goal = "makespan", seed: int = 0, certain: bool = True,
               margin_ms: int = 0, near_m: float = NEAR_M) -> Decider:
    """Who decides in one mission.

    Args:
      planner: by the clock.
      search: a pattern's name, `PLACES`, or "" where nothing is hidden.
      futures: over how many; 0: it looks no further than what is known.
      goal: what is to be least over futures.
      seed: of the futures.
      certain: ways take what is expected, so that a policy can look ahead in the macro world.
      margin_ms: ms that a new plan has to gain over the one that is kept.
      near_m: m at which a robot is where it was to look from.
    """
    pattern, choose = searching(search, near_m), pointing(planner)
    replanning = Replanning(planner, pattern, search == PLACES, margin_ms, stands(planner))
    if futures and certain and isinstance(planner, PolicyPlanner) and search in ALL_AT_ONCE:
        return Choosing(LookingAhead(planner.policy, futures, goal, seed,
                                     planner.preference).choose, replanning)
    if futures and search == PLACES:
        return Choosing(Consensus(planner, futures, seed, choose).choose, replanning)
    if futures:
        return OverFutures(planner if choose is None else ExactPlanner(), futures, seed, pattern,
                           choose, goal)
    return replanning if choose is None else Choosing(choose, replanning)
