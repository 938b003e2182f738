"""A policy that looks ahead: it plays what a plan says, and what else it could do, in many futures.

Where targets follow on others or arrive by a clock, or a robot may be lost, what is to come can be
drawn, and the policy can go on in each of these futures by its likeliest choices,
thousands of them in one call of the macro world: until nothing more may come to pass, for from
there on the plan is all that is needed, in a future as in the mission. That is one step of policy
iteration, at the moment itself. What is tried there is the plan of what is known, and what the
policy draws.

Legend: B missions, K tries of a mission, F futures, N robots, T targets, the
open and then the coming ones, padded.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

import jax
import numpy as np
from jax import Array

from moonteam.grid.macro import world
from moonteam.grid.macro.types import MacroProblem, MacroState
from moonteam.planners import macro
from moonteam.planners.seconds.base import MS, Moment
from moonteam.planners.seconds.exact import ExactPlanner
from moonteam.planners.seconds.keeper import WAIT, first_moves
from moonteam.planners.seconds.local import LocalSearchPlanner
from moonteam.planners.seconds.search.labels import MAX_AGENTS
from moonteam.planners.unfolding.deciding.deciders import Goal, by_time
from moonteam.planners.unfolding.deciding.imagined import imagined
from moonteam.planners.unfolding.deciding.pointing import Pointing, begun, moments, said
from moonteam.planners.unfolding.deciding.rollouts import rolled_out
from moonteam.planners.unfolding.deciding.search import posts, without_posts
from moonteam.planners.unfolding.future import future, may_lose
from moonteam.planners.unfolding.world import View
from moonteam.policies.pointer import PointerSpec
from moonteam.policies.policy import Policy

HEAT = 2.0
"""Temperature at which the other tries are drawn."""
TRIES = 16
"""Joint choices drawn at a moment, the likeliest first; equal ones are one."""
EXACTLY = 10
"""Targets up to which the plan of what is known is exact."""
MOVES = 300
"""Of local search for each of more."""
FIRST = 16
"""Futures in which all tries are played; then twice as many, and so on, with those still in it."""
SURE = 2.0
"""Standard errors behind the best at which a try drops out."""
FEWEST = 4
"""T at least: programs for fewer would be compiled in vain."""


@dataclass(frozen=True)
class _Asked:
    """A moment at which there is something to choose."""

    view: View
    open_: np.ndarray  # targets that can still be gone for
    bound: np.ndarray  # [N] int32, place in `open_` of who waits there for others; -1: free
    tries: np.ndarray  # [K, N] int32, places in `open_`; T and above: waits; the usual one first
    rng: np.random.Generator


class LookingAhead:
    """What is planned of what is known, unless something else is better in the mean over futures.

    Where waiting counts, for which nobody plans, the policy's likeliest choice takes its place.

    The plan's first moves and joint choices drawn from the policy are raced: all are played in a
    few futures that they share, who is clearly behind the best drops out, and the others go on with
    as many futures again. What gains most over the plan is done, if it gains more than its standard
    error. Draws depend on the moment and the seed alone, not on what other missions are played
    beside it; so do plans, which are exact or of a set number of moves.

    Args:
      policy: of kind pointer.
      futures: F, the most that are drawn at a moment; one where nothing is to come. 0: it does not
        look ahead, and until a plan is all that is needed does what the policy finds likeliest.
      goal: what counts in a future: its makespan, or how long targets wait for their services.
      seed: of the draws.
      preference: 0 time .. 1 effort, of the policy.

    Raises InputError for a policy that does not point at targets.
    """

    def __init__(self, policy: Policy, futures: int, goal: Goal = "makespan", seed: int = 0,
                 preference: float = 0.0):
        self._spec, self._params = macro.spec_of(policy), policy.params
        self._futures, self._goal, self._seed = futures, goal, seed
        self._preference = np.float32(preference)
        self._pointing = Pointing(policy, preference)

    def choose(self, views: Sequence[View]) -> list[np.ndarray]:
        """[B] of [N] int64: a target's number, WAIT, or of a plan HOME."""
        # Who plays side by side fills calls up with the first view.
        once = {id(view): view for view in views}
        plans = {key: of_the_known(without_posts(view)) for key, view in once.items()}
        best = {key: plan for key, plan in plans.items()
                if plan is not None and sure(once[key]) and self._goal == "makespan"}
        rest = {key: view for key, view in once.items() if key not in best}
        if rest and not self._futures:
            pointed = zip(views, self._pointing.choose(views), strict=True)
            best = {id(view): choice for view, choice in pointed} | best
        elif rest:
            asked = self._ask(list(rest.values()), len(views), [plans[key] for key in rest])
            best |= dict(zip(rest, self._best(asked), strict=True))
        return [best[id(view)] for view in views]

    def _ask(self, views: list[View], size: int,
             plans: list[np.ndarray | None]) -> list[_Asked]:
        """What could be done at each moment [B], its plan [N] too; calls are filled up to `size`.

        First stands what is done unless another is better: the plan, which is for the makespan, or
        what the policy finds likeliest.
        """
        filled = views + views[:1] * (size - len(views))
        problems, bound = moments(filled)
        targets = problems.service.shape[1]
        rngs = [self._rng(view) for view in views]
        seeds = np.zeros(size, np.uint32)
        seeds[:len(views)] = [rng.integers(2**32) for rng in rngs]
        drawn = np.asarray(_drawn(self._spec, self._params, problems, bound, seeds,
                                  self._preference))
        found = []
        for view, own, tries, rng, plan in zip(views, bound, drawn, rngs, plans, strict=False):
            count = len(view.places)
            open_ = np.flatnonzero(~view.moment.solved)
            place = np.full(targets + 1, targets, np.int32)  # of padding and waiting: past the last
            place[open_] = np.arange(len(open_))
            held = own[:count]
            tries = tries[:, :count]
            if plan is not None:
                free = (held < 0) & (view.moment.free == 0) & view.moment.present & (plan >= 0)
                # Whom the plan has nothing for waits where the policy says.
                first = np.where((held >= 0) | (~free & np.isin(tries[0], posts(view))), tries[0],
                                 np.where(free, plan, targets))
                tries = np.insert(tries, 0 if self._goal == "makespan" else 1, first, axis=0)
            different = np.unique(tries, axis=0, return_index=True)[1]
            found.append(_Asked(view, open_, np.where(held >= 0, place[held], -1).astype(np.int32),
                                place[tries[np.sort(different)]], rng))
        return found

    def _rng(self, view: View) -> np.random.Generator:
        where = np.rint(MS * view.places).astype(np.int64).reshape(-1)
        return np.random.default_rng([self._seed, view.now, *np.abs(where).tolist()])

    def _best(self, asked: list[_Asked]) -> list[np.ndarray]:
        """[B] of [N]."""
        chosen = [0] * len(asked)
        left = {b: np.arange(len(one.tries)) for b, one in enumerate(asked) if len(one.tries) > 1}
        costs: dict[int, np.ndarray] = {b: np.zeros((len(k), 0)) for b, k in left.items()}
        played, count = 0, min(FIRST, self._futures)
        while left:
            for b, own in self._costs(asked, left, count).items():
                costs[b] = np.concatenate([costs[b], own], axis=1)
            played += count
            for b in list(left):
                best, stays = raced(costs[b], bool(left[b][0] == 0))
                chosen[b] = int(left[b][best])
                left[b], costs[b] = left[b][stays], costs[b][stays]
                sure = costs[b].shape[1] == 1
                if sure or len(left[b]) == 1 or played >= self._futures:
                    del left[b]
            count = min(played, self._futures - played)
        found = []
        for one, k in zip(asked, chosen, strict=True):
            place = np.where(one.bound >= 0, one.bound, one.tries[k])
            some_ = place < len(one.open_)
            found.append(np.where(some_, one.open_[np.where(some_, place, 0)], WAIT)
                         if len(one.open_) else np.full(len(place), WAIT))
        return found

    def _costs(self, asked: list[_Asked], left: dict[int, np.ndarray],
               count: int) -> dict[int, np.ndarray]:
        """[tries, F] s, of the tries `left` of each mission, in futures that they share.

        So many as `count`, but one where nothing is drawn.
        """
        alike: dict[tuple[int, ...], list[int]] = {}
        for b in left:
            coming = asked[b].view.coming
            size = max(FEWEST, macro.padded(len(asked[b].open_) + coming))
            team = asked[b].view.moment.has.shape
            some = count if coming or may_lose(asked[b].view) else 1
            alike.setdefault((size, some, *team), []).append(b)
        found = {}
        for (size, some, *_), missions in alike.items():
            problems, rows, firsts, bounds = [], [], [], []
            for b in missions:
                one = asked[b]
                base = len(problems) * some
                problems.append(imagined(one.view, [future(one.view, one.rng)
                                                    for _ in range(some)], size))
                tries = one.tries[left[b]]
                rows.append(np.tile(base + np.arange(some), len(tries)))
                firsts.append(np.repeat(np.where(tries < len(one.open_), tries, size), some, 0))
                bounds.append(np.tile(one.bound, (len(tries) * some, 1)))
            whole: MacroProblem = jax.tree.map(lambda *x: np.concatenate(x), *problems)
            row, first, bound = (np.concatenate(x) for x in (rows, firsts, bounds))
            done = rolled_out(self._spec, self._params, whole, row, first, bound,
                              self._preference, self._goal == "makespan")
            ends = np.cumsum([len(row) for row in rows])[:-1]
            for b, *own in zip(missions, *(np.split(x, ends) for x in done), strict=True):
                found[b] = self._cost(asked[b], *own).reshape(-1, some)
        return found

    def _cost(self, asked: _Asked, span: np.ndarray, served: np.ndarray,
              missed: np.ndarray) -> np.ndarray:
        """[rollouts] what counts, of a mission's makespans, its services' starts [., T] and the
        worth of what was not served.
        """
        if asked.view.optional:
            return missed + by_time(span, asked.view.state.limit / MS)
        if self._goal == "makespan":
            return span
        first, targets = len(asked.open_), np.flatnonzero(asked.open_ < len(asked.view.targets))
        return served[:, [*targets, *range(first, first + asked.view.coming)]].sum(1)


def sure(view: View) -> bool:
    """Whether nothing may come to pass that is not known."""
    return not view.coming and not may_lose(view)


def of_the_known(moment: Moment) -> np.ndarray | None:
    """[N] what a plan of all that is known has everybody do first; None where none is found."""
    count, agents = int((~moment.solved).sum()), len(moment.present)
    planner = ExactPlanner() if count <= EXACTLY and agents <= MAX_AGENTS else (
        LocalSearchPlanner(iterations=MOVES * count))
    return first_moves(moment, planner.plan(moment))


def raced(costs: np.ndarray, usual: bool) -> tuple[int, np.ndarray]:
    """Which try is done, of costs [K, F] that share their futures, and which [K] bool go on.

    The first, if it is what is `usual`, is kept until another is clearly better: the best of
    several means flatters itself.
    """
    root = math.sqrt(costs.shape[1])
    best = int(costs.mean(1).argmin())
    behind = costs - costs[best]
    if costs.shape[1] == 1:  # nothing is left to luck
        return best, behind[:, 0] <= 0.0
    stays = behind.mean(1) <= SURE * behind.std(1, ddof=1) / root
    if usual and behind[0].mean() <= behind[0].std(ddof=1) / root:
        best = 0
    return best, stays


@partial(jax.jit, static_argnames="spec")
def _drawn(spec: PointerSpec, params: Any, problems: MacroProblem, bound: Array, seeds: Array,
           preference: Array) -> Array:
    """[B, K, N] int32 joint choices, the likeliest first; see `pointing`."""
    states = begun(problems, bound)
    logits = said(spec, params, states, preference)

    def tried(state: MacroState, logits: Array, seed: Array) -> Array:
        noise = HEAT * jax.random.gumbel(jax.random.key(seed), (TRIES, *logits.shape))
        return jax.vmap(lambda own: world.choose(state, logits, own)[0])(noise.at[0].set(0.0))

    return cast(Array, jax.vmap(tried)(states, logits, seeds))
