"""Where targets are hidden: what the plans for many futures agree on.

After the consensus function of Bent and Van Hentenryck (2004, "Scenario-based planning for
partially dynamic vehicle routing with stochastic customers", Operations Research 52). In each
future drawn, the hidden targets are put somewhere on unseen ground and planned for as if they were
known, but each after the place from which its part of the ground is looked at: so a plan goes
nowhere for what nobody can know yet, and yet has those who will be needed near, and looks first
where finding something late would cost most. What is done is how that plan begins whose first
moves most of the plans share. A policy that points at targets need not plan: what it points at in
each future is its first move, all futures in one call.

Legend: K futures, N robots, M columns of a moment: targets known of, and places to look from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from moonteam.planners.seconds.base import Int64, Moment, TimedPlanner, needs_of
from moonteam.planners.seconds.keeper import WAIT, first_moves
from moonteam.planners.unfolding.deciding.deciders import Choose
from moonteam.planners.unfolding.deciding.search import with_more
from moonteam.planners.unfolding.future import future
from moonteam.planners.unfolding.state import distances
from moonteam.planners.unfolding.world import View
from moonteam.problem.timed import Target


class Consensus:
    """Decides by plans for sampled futures; where nothing is hidden by the plan of what is known.

    Args:
      planner: whose plans they are.
      futures: K.
      seed: of the draws.
      choose: who says, in place of the planner, what everybody goes for first.
    """

    def __init__(self, planner: TimedPlanner, futures: int, seed: int = 0,
                 choose: Choose | None = None):
        self._planner, self._count, self._choose = planner, futures, choose
        self._rng = np.random.default_rng(seed)

    def choose(self, views: Sequence[View]) -> list[Int64]:
        """Of each view, [N] a column of its moment, WAIT, or of a plan HOME."""
        return [self._of(view) for view in views]

    def _of(self, view: View) -> Int64:
        moves = []
        if view.coming and view.looks:
            drawn = [with_hidden(view, future(view, self._rng).coming) for _ in range(self._count)]
            firsts = self._firsts(view, [moment for moment, _ in drawn])
            # Who is to serve what is hidden goes to where it will be found.
            moves = [np.where(first >= 0, seen_from[first], first)
                     for first, (_, seen_from) in zip(firsts, drawn, strict=True)
                     if first is not None]
        if moves:
            return agreed(np.array(moves))
        (first,) = self._firsts(view, [view.moment])
        return np.full(len(view.places), WAIT) if first is None else first

    def _firsts(self, view: View, moments: Sequence[Moment]) -> list[Int64 | None]:
        """Of each moment, [N] what everybody goes for first; None where there is no plan."""
        if self._choose is not None:
            return [*self._choose([replace(view, moment=one, looks=()) for one in moments])]
        return [first_moves(moment, self._planner.plan(moment)) for moment in moments]


def with_hidden(view: View, coming: Sequence[Target]) -> tuple[Moment, Int64]:
    """The moment with these targets too, each after the place to look from that sees it; and of
    each of its columns the one to go to, which is that place for them.
    """
    count, names = len(view.moment.solved), view.state.names
    spots = np.array([target.at for target in coming], float).reshape(-1, 2)
    points = np.concatenate([look.unseen for look in view.looks])
    part = np.repeat(np.arange(len(view.looks)), [len(look.unseen) for look in view.looks])
    sees = len(view.targets) + part[distances(spots, points, "straight").argmin(1)]
    asked, either = needs_of(coming, names)
    need = np.pad(asked, ((0, 0), (0, view.moment.need.shape[1] - len(names))))
    after = sees[:, None] == np.arange(count)
    return with_more(view, spots, need, either, after), np.append(np.arange(count), sees)


def agreed(moves: Int64) -> Int64:
    """[N] those of the joint moves [K, N] of which, robot by robot, most others have the same."""
    votes = (moves[:, None] == moves[None]).sum((1, 2))
    return moves[int(votes.argmax())]
