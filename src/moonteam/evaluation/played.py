"""A policy on a whole set of scenarios, however its network decides; judged by the environment.

A policy that decides step by step is rolled out in the environment itself (`rollouts`); of one
that points at targets the plans are played there, as those of any planner. Legend: S scenarios,
T steps, N agents.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from moonteam.evaluation import rollouts
from moonteam.evaluation import world as worlds
from moonteam.evaluation.world import World
from moonteam.planners import best_of
from moonteam.planners.base import BoolArray, Snapshot
from moonteam.planners.decode import Decode
from moonteam.planners.kind import PlannerOptions
from moonteam.planners.pointing import Batch, PointingPlanner
from moonteam.policies.brain import PointerBrain
from moonteam.policies.policy import Policy
from moonteam.report.progress import bar

IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Played:
    """What the try that counts did, of every scenario: [S]."""

    success: npt.NDArray[np.bool_]
    steps: IntArray  # T_max where it failed
    moves: IntArray
    rescues: IntArray  # decisions that the deadlock watch had drawn
    seconds: float  # without compiling
    compiling: float


def play(policy: Policy, world: World, decode: Decode, options: PlannerOptions, title: str,
         alone: bool = False) -> Played:
    """Plays every scenario; of best-of-K the best by the options' prices counts.

    Args:
      policy: plays; `world` must be of a size that it takes.
      world: the scenarios.
      decode: how decisions are read from its probabilities.
      options: objective, weights, preference and seed.
      title: for the progress bar.
      alone: one scenario after the other, as a single mission would be planned.
    """
    if isinstance(policy.brain, PointerBrain):
        return _Pointing(PointingPlanner(policy, decode, options), title, alone).play(world)
    prices = best_of.prices(options.objective, options.alpha, options.beta, options.preference)
    tries = rollouts.run(policy, world, decode, options.preference, options.seed, title, prices,
                         alone)
    choice = rollouts.best(tries, prices)
    success, steps, moves, rescues = (rollouts.picked(v, choice) for v in (
        tries.success, tries.steps, tries.moves, tries.rescues))
    return Played(success, steps, moves, rescues, tries.seconds, tries.compiling)


class _Pointing:
    """Plans of a pointing policy for all scenarios at once, made anew where a target appears."""

    def __init__(self, planner: PointingPlanner, title: str, alone: bool):
        self._planner, self._title, self._alone = planner, title, alone
        self._seconds = self._compiling = 0.0

    def play(self, world: World) -> Played:
        """Every scenario as far as it goes."""
        walk = worlds.play_plans(world, self._plan)
        return Played(*worlds.tally(world, walk), np.zeros(len(world), np.int64), self._seconds,
                      self._compiling)

    def _plan(self, moments: list[Snapshot], over: BoolArray, round_: int) -> list[npt.ArrayLike]:
        plans: list[npt.ArrayLike] = [np.zeros((0, len(m.cells)), np.int32) for m in moments]
        going = np.flatnonzero(~over).tolist()
        title = self._title if round_ == 0 else f"{self._title} {round_ + 1}"
        ended = 0
        with bar(title, len(going) * self._planner.decode.rollouts) as update:

            def tick(episodes: int) -> None:
                nonlocal ended
                ended += episodes
                update(ended, "")

            for part in [[i] for i in going] if self._alone else [going]:
                made = self._planned([moments[i] for i in part], tick)
                for i, plan in zip(part, made, strict=True):
                    plans[i] = plan
        return plans

    def _planned(self, moments: list[Snapshot],
                 tick: Callable[[int], object]) -> list[npt.NDArray[np.int32]]:
        """Joint actions of each moment; keeps the time, compiling apart."""
        began = time.perf_counter()
        batch = Batch(self._planner, moments)
        ready = time.perf_counter()
        batch.warm()
        warm = time.perf_counter()
        plans = batch.actions(tick)
        self._seconds += time.perf_counter() - warm + ready - began
        self._compiling += warm - ready
        return plans
