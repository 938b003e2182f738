"""A policy that points at targets, as a planner of whole plans on the grid.

The policy is played out in the macro world (`planners.macro`), where a choice is held until its
target is solved; a try's routes become a plan as any search's do. In steps, a second of that
world is a step, for a step is a cell.

Legend: N agents, M open targets, S skills, K tries.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from moonteam.grid.macro.types import FAR, MacroProblem, plain
from moonteam.planners import macro
from moonteam.planners.base import IntArray, Snapshot
from moonteam.planners.best_of import cheapest, meaning, prices
from moonteam.planners.decode import Decode
from moonteam.planners.kind import PlannerOptions
from moonteam.planners.plans.follow import Answer, RoutePlanner
from moonteam.planners.plans.routes import actions_of, obstacles
from moonteam.planners.search.task import Task
from moonteam.planners.search.travel import UNREACHABLE, Travel, travel_times
from moonteam.policies.policy import Policy


def problem_of(task: Task) -> MacroProblem:
    """The task by the clock, NumPy arrays; without a limit, its horizon is the planner's affair."""
    targets = task.start.shape[1]
    length = max(int(np.bitwise_or.reduce(np.concatenate([task.skills, task.need, [1]]))), 1)
    bits = np.arange(length.bit_length())
    has = (task.skills[:, None] >> bits & 1).astype(bool)
    need = (task.need[:, None] >> bits & 1).astype(np.int32)
    start, between = (np.where(ways < UNREACHABLE, ways, FAR).astype(np.float32)
                      for ways in (task.start, task.between[task.kinds]))
    return plain(start, between, has, need, ~task.both, limit=np.float32(FAR),
                 agent_mask=task.skills > 0, target_mask=np.ones(targets, bool),
                 unit=macro.unit_of(start, has, need))


def _within(horizons: Sequence[int]) -> np.ndarray:
    """[B] s, of whole steps."""
    return np.asarray(horizons) + 0.5


def chosen(found: macro.Rollouts, horizons: Sequence[int],
           price: tuple[float, float]) -> tuple[IntArray, np.ndarray]:
    """[B] the try that counts of each task, by `best_of.cheapest`, and whether it is in time."""
    solved = found.solved & (found.seconds <= _within(horizons)[:, None])
    steps = np.where(found.solved, np.rint(found.seconds), FAR).astype(np.int64)
    best = cheapest(solved, steps, np.rint(found.effort).astype(np.int64), price)
    return best, np.take_along_axis(solved, best[:, None], axis=1)[:, 0]


class PointingPlanner(RoutePlanner):
    """The likeliest rollout of a pointing policy, or a drawn one, or the best of K drawn.

    Args:
      policy: of kind pointer. Raises InputError for another.
      decode: argmax and plain-argmax are one: here nobody circles.
      options: objective (by which the best of K counts; None: what the preference asks for),
        alpha and beta, preference and seed.
    """

    name = "policy"

    def __init__(self, policy: Policy, decode: Decode, options: PlannerOptions):
        macro.spec_of(policy)
        super().__init__(*(meaning(options) if decode.rollouts > 1 else options.goal))
        self.policy, self.decode = policy, decode
        self.preference, self.seed = options.preference, options.seed
        self.price = prices(options.objective, options.alpha, options.beta, options.preference)

    @property
    def heat(self) -> float:
        """At which choices are drawn; 0: never."""
        return self.decode.heat

    def check(self, snapshot: Snapshot) -> None:
        """Raises InputError if the policy cannot serve this mission."""
        self.policy.check(snapshot)

    def reset(self, snapshot: Snapshot, seed: int = 0) -> None:
        """Starts a mission; the seed is that of the draws."""
        self.policy.check(snapshot)
        super().reset(snapshot, seed)
        self.seed = seed

    def _answer(self, task: Task, began: float) -> Answer:
        found = self.rollouts([task])
        best, in_time = chosen(found, [task.horizon], self.price)
        routes = _routes(found, 0, best, task) if in_time[0] else None
        return Answer(routes, None, False)

    def rollouts(self, tasks: Sequence[Task],
                 tick: Callable[[int], object] = lambda episodes: None) -> macro.Rollouts:
        """K tries of every task; with less of the preference where that takes too many steps."""
        problems = macro.stacked([problem_of(task) for task in tasks])
        return macro.rollouts(
            self.policy, problems, tries=self.decode.rollouts, heat=self.heat,
            cooling=self.decode.cooling, seed=self.seed, preference=self.preference,
            within=_within([task.horizon for task in tasks]), tick=tick)

    def warm(self, tasks: Sequence[Task]) -> None:
        """Compiles what `rollouts` of such tasks needs."""
        macro.warm(self.policy, macro.stacked([problem_of(task) for task in tasks]),
                   self.decode.rollouts)


class Batch:
    """Moments of many missions, planned at once.

    A plan leaves out targets that nobody can solve, and goes on past the steps left.
    """

    def __init__(self, planner: PointingPlanner, moments: Sequence[Snapshot]):
        self.planner, self.moments = planner, moments
        self._travel = [travel_times(moment) for moment in moments]
        self._tasks = [_possible(m, t) for m, t in zip(moments, self._travel, strict=True)]
        self._open = [i for i, task in enumerate(self._tasks) if len(task.targets)]

    def warm(self) -> None:
        """Compiles what `actions` needs."""
        if self._open:
            self.planner.warm([self._tasks[i] for i in self._open])

    def actions(self, tick: Callable[[int], object] = lambda episodes: None) -> list[IntArray]:
        """Joint actions [T, N] of every moment."""
        out = [np.zeros((0, len(moment.cells)), np.int32) for moment in self.moments]
        if not self._open:
            return out
        tasks = [self._tasks[i] for i in self._open]
        found = self.planner.rollouts(tasks, tick)
        best, _ = chosen(found, [task.horizon for task in tasks], self.planner.price)
        for row, i in enumerate(self._open):
            routes = tasks[row].named(_routes(found, row, best, tasks[row]))
            out[i] = actions_of(self.moments[i], self._travel[i], routes)
        return out


def _possible(moment: Snapshot, travel: Travel) -> Task:
    """What is to be done, without what nobody can do."""
    task, hopeless = Task.of(moment, travel), obstacles(moment, travel)
    if not hopeless:
        return task
    return task.part([i for i, t in enumerate(task.targets.tolist()) if t not in hopeless])


def _routes(found: macro.Rollouts, row: int, best: IntArray, task: Task) -> IntArray:
    """[N, *] of the try that counts, without the padding's agents."""
    return found.routes(row, int(best[row]))[:len(task.skills)]
