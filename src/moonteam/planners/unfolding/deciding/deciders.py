"""Who decides in a mission that unfolds: replanning at every event, and choosing over futures.

Legend: N robots, M targets known of, B missions.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, Protocol, cast

import numpy as np

from moonteam.grid.macro.sight import INSIDE
from moonteam.planners.seconds.base import MS, TimedPlanner
from moonteam.planners.seconds.keeper import HOME, Keeper, choices, first_moves, order_of
from moonteam.planners.unfolding.deciding.search import Pattern, with_looks, with_posts
from moonteam.planners.unfolding.future import future
from moonteam.planners.unfolding.state import Order
from moonteam.planners.unfolding.world import View, World

OPTIONS = 6
"""First moves that are tried at an event."""

NOT_DONE = 2.0
"""Times its limit that an imagined mission counts which does not end well."""

TIE = 0.01
"""Worth of a mission's whole limit where targets may lapse."""

Goal = Literal["makespan", "waiting"]
GOALS: tuple[Goal, ...] = ("makespan", "waiting")
"""What counts in an imagined mission: when it ends, or how long its targets wait."""

Choose = Callable[[list[View]], list[np.ndarray]]
"""Of missions at an event [B], what everybody goes for, [N] each."""


def by_time(seconds: Any, limit: float) -> Any:
    """What is left to time where worth counts: a tie is broken by it."""
    return TIE * seconds / limit


class Decider(Protocol):
    """Decides in one mission."""

    def act(self, view: View) -> list[Order]:
        """What each robot does now [N]; of those in service and lost it does not matter."""
        ...


class Replanning:
    """Plans what is known of anew at every event, and looks no further.

    A plan is kept until another is better, by `margin_ms`. Robots that it has nothing for go home,
    or look for hidden targets by the pattern; or, with `places`, places to look from are planned
    for as if they were targets. A policy may be shown places to wait at beside them (`posts`).
    """

    def __init__(self, planner: TimedPlanner, pattern: Pattern | None = None,
                 places: bool = False, margin_ms: int = 0, posts: bool = False):
        self._planner, self._pattern, self._places = planner, pattern, places
        self._posts = posts
        self._keeper = Keeper(planner, margin_ms)

    def act(self, view: View) -> list[Order]:
        """See `Decider`."""
        view = self.shown(view)
        if view.moment.solved.all():
            return self.settled(view, np.full(len(view.places), HOME))
        if view.looks:  # other places at every event: there is no plan to keep
            plan = self._planner.plan(view.moment)
            return self.settled(view, choices(view.moment, order_of(plan)))
        return self.settled(view, self._keeper.act(view.moment))

    def shown(self, view: View) -> View:
        """What is planned for: with the places to look from, where these count as targets, or to
        wait at.
        """
        shown = with_looks(view) if self._places else view
        return with_posts(shown) if self._posts else shown

    def settled(self, view: View, chosen: np.ndarray) -> list[Order]:
        """The choices [N], those who have none looking for what is hidden."""
        orders: list[Order] = [int(choice) for choice in chosen]
        for i, choice in enumerate(orders):
            if view.looks and isinstance(choice, int) and choice >= len(view.targets):
                look, reach = view.looks[choice - len(view.targets)], view.agents[i].sensor or 0.0
                orders[i] = look.from_afar(view.places[i], INSIDE * reach)
        pattern = self._pattern
        if pattern is None or not view.coming or (pattern.eyes and view.ground is None):
            return orders
        idle = [i for i in np.flatnonzero(view.moment.present & (chosen < 0)).tolist()
                if view.moment.free[i] == 0
                and not (pattern.eyes and view.agents[i].sensor is None)]
        for i, place in pattern.look(view, idle).items():
            orders[i] = place
        return orders


class OverFutures:
    """Chooses what does best over sampled futures, by playing them to their end.

    At every event so many futures are drawn of what is expected. What everybody could do first
    comes from the plan of what is known, and from a plan for each of the futures as if it were
    known; where that leads to a target which nobody knows of yet, its place is gone to. Up to
    `OPTIONS` of these are tried in every future, and go on by replanning. The least mean of what
    counts wins, if it is under that of replanning by more than its standard error: the best of
    several means of few futures flatters itself.

    Args:
      planner: by which is planned, in hindsight and when replanning.
      futures: how many are drawn.
      seed: of the draws.
      pattern: by which is looked for what is hidden.
      choose: who decides otherwise, and goes on, in place of replanning; see `play_together`.
      goal: what is to be least.
    """

    def __init__(self, planner: TimedPlanner, futures: int, seed: int = 0,
                 pattern: Pattern | None = None, choose: Choose | None = None,
                 goal: Goal = "makespan"):
        self._planner, self._count, self._pattern, self._goal = planner, futures, pattern, goal
        self._rng, self._choose = np.random.default_rng(seed), choose
        self._base = Replanning(planner, pattern)

    def act(self, view: View) -> list[Order]:
        """See `Decider`."""
        if self._choose is None or view.moment.solved.all():
            usual = self._base.act(view)
        else:
            usual = self._base.settled(view, self._choose([view])[0])
        if not view.coming and view.expects.loss is None and not view.expects.scatter:
            return usual
        drawn = [future(view, self._rng) for _ in range(self._count)]
        options = [usual]
        for one in drawn:
            option = self._hindsight(one.world(view))
            if option is not None and option not in options and len(options) < OPTIONS:
                options.append(option)
        if len(options) == 1:
            return usual
        worlds = [one.world(view) for _ in options for one in drawn]
        self._play(worlds, [option for option in options for _ in drawn])
        costs = np.array([self._cost(world) for world in worlds]).reshape(len(options), -1)
        gain = costs[0] - costs
        best = int(gain.mean(1).argmax())
        error = float(gain[best].std(ddof=1)) / math.sqrt(self._count)
        return options[best] if gain[best].mean() > error else usual

    def _hindsight(self, world: World) -> list[Order] | None:
        """What everybody does first where all that comes is known; None where there is no plan."""
        targets = len(world.state.targets)
        view = world.revealed().view()
        if view.moment.solved.all():
            return None
        chosen = first_moves(view.moment, self._planner.plan(view.moment))
        if chosen is None:
            return None
        return [view.targets[j].at if j >= targets else int(j) for j in chosen.tolist()]

    def _play(self, worlds: Sequence[World], first: Sequence[Sequence[Order]]) -> None:
        """Imagined missions to their ends, from what everybody does first."""
        for world, orders in zip(worlds, first, strict=True):
            world.step(orders)
        # What a pattern remembers of the mission is its own in each of them.
        goes_on = [Replanning(self._planner, copy.deepcopy(self._pattern)) for _ in worlds]
        if self._choose is not None:
            play_together(worlds, self._choose, goes_on, OPTIONS * self._count)
            return
        for world, decider in zip(worlds, goes_on, strict=True):
            play(world, decider)

    def _cost(self, world: World) -> float:
        """s of an imagined mission, from its start; or of waiting, a target."""
        out = world.outcome
        if out.success and (out.worth or out.missed):
            return out.missed + by_time(out.seconds, world.state.limit / MS)
        if out.success:
            return out.waited if self._goal == "waiting" else out.seconds
        return NOT_DONE * world.state.limit / MS


def play(world: World, decider: Decider) -> None:
    """Plays a mission to its end."""
    while not world.over:
        world.step(decider.act(world.view()))


def play_together(worlds: Sequence[World], choose: Choose, deciders: Sequence[Replanning],
                  size: int = 0) -> None:
    """Plays missions [B] side by side to their ends.

    Args:
      worlds: [B].
      choose: what everybody goes for, of several missions in one call, [N] each.
      deciders: [B], for who looks for what is hidden.
      size: missions of a call, filled up, lest it compile anew for every number; B if not given.
    """
    size = size or len(worlds)
    left = [k for k, world in enumerate(worlds) if not world.over]
    while left:
        views = {k: deciders[k].shown(worlds[k].view()) for k in left}
        asked = [k for k in left if not views[k].moment.solved.all()]
        given = [views[k] for k in asked]
        found = choose(given + given[:1] * (size - len(given))) if asked else []
        orders = {k: deciders[k].settled(views[k], chosen)
                  for k, chosen in zip(asked, found, strict=False)}
        for k in left:
            worlds[k].step(orders[k] if k in orders else deciders[k].act(views[k]))
        left = [k for k in left if not worlds[k].over]


def planned(planner: TimedPlanner, views: list[View]) -> list[np.ndarray]:
    """[B] of [N]: what the plans of a planner that takes many moments (`plans`) have everybody do
    first.
    """
    moments = [view.moment for view in views]
    plans = cast(Any, planner).plans(moments)
    return [choices(moment, order_of(plan)) for moment, plan in zip(moments, plans, strict=True)]
