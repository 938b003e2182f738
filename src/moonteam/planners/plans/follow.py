"""Planners that plan the whole mission and follow the plan until the world differs from it."""

from __future__ import annotations

import functools
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

import numpy as np

from moonteam.planners import simulate
from moonteam.planners.base import IntArray, Objective, Plan, Snapshot
from moonteam.planners.plans.routes import Certificate, infeasible, obstacles, plan_of_routes
from moonteam.planners.search.task import Task, weights
from moonteam.planners.search.travel import travel_times
from moonteam.problem.scenario import Agent, Scenario, Target

TRIAL = Scenario(
    (2, 2), (Agent((0, 0), ("A",)), Agent((1, 0), ("B",))),
    (Target((1, 1), ("A", "B"), "AND"), Target((1, 0), ("A",), "OR")), blocked={"*": ((0, 1),)})
"""A mission that takes no time, for what is loaded or compiled at the first call."""


def same_moment(one: Snapshot, other: Snapshot) -> bool:
    """Whether two snapshots pose the same problem (the step count aside)."""
    fields = ("cells", "solved", "target_cells", "target_skills", "target_and", "agent_mask",
              "passable")
    return all(np.array_equal(getattr(one, f), getattr(other, f)) for f in fields)


@dataclass(frozen=True)
class Answer:
    """What a search says of a task.

    `routes` [N, *] are indices of open targets padded by -1, None if there is no plan within
    the horizon; `bound` is a lower bound of the objective, if one is known; `proved` that none is
    better (or that there is none).
    """

    routes: IntArray | None
    bound: float | None
    proved: bool


class Follower(ABC):
    """A Planner that looks ahead once and follows what it saw while all goes as foreseen."""

    def __init__(self) -> None:
        self._forget()

    def _forget(self) -> None:
        self.replans = 0
        self._actions: list[IntArray] = []
        self._expected: Snapshot | None = None

    @abstractmethod
    def _ahead(self, snapshot: Snapshot) -> IntArray:
        """The joint actions [T, N] to follow from this moment; none if there is no plan."""

    def _beyond(self, snapshot: Snapshot) -> IntArray:
        """Joint action [N] where those are at their end."""
        return np.full(len(snapshot.cells), simulate.STAY, np.int32)

    def reset(self, snapshot: Snapshot, seed: int = 0) -> None:
        """Starts a mission; planners without chance ignore the seed."""
        self._forget()

    def act(self, snapshot: Snapshot) -> IntArray:
        """Joint action [N]: the plan's next, or the first of a new plan."""
        if self._expected is None or not same_moment(snapshot, self._expected):
            self.replans += 1
            self._actions = list(self._ahead(snapshot))
        joint = self._actions.pop(0) if self._actions else self._beyond(snapshot)
        held = replace(snapshot, solved=simulate.holding(snapshot))
        self._expected = simulate.step(held, joint)
        return joint


class PlanFollower(Follower):
    """A Planner that follows whole plans.

    When the team cannot solve every target, or not in the steps left, `act` still works on
    those it can solve.
    """

    @abstractmethod
    def plan(self, snapshot: Snapshot) -> Plan:
        """A whole plan from this moment. Raises InputError if the planner cannot serve it."""

    def _ahead(self, snapshot: Snapshot) -> IntArray:
        return self._best_effort(snapshot).actions

    def _best_effort(self, snapshot: Snapshot) -> Plan:
        plan = self.plan(snapshot)
        if plan.status != "infeasible":
            return plan
        hopeless = list(obstacles(snapshot, travel_times(snapshot)))
        solved = snapshot.solved.copy()
        solved[hopeless] = True
        longer = max(snapshot.max_steps, snapshot.step + 1) * 64
        return self.plan(replace(snapshot, solved=solved, max_steps=longer))


class RoutePlanner(PlanFollower):
    """A Planner made of a search for routes.

    Args:
      objective: makespan (with few moves as the second wish), moves, or weighted.
      alpha: weight of the makespan in the weighted objective.
      beta: weight of the moves in the weighted objective.
    """

    name: str
    most_targets: int | None = None
    """Open targets that it takes on; None: any number."""
    time_limit: float | None = None
    """Seconds a plan, in which compiling at the first is not counted; None: no limit."""

    def __init__(self, objective: Objective = "makespan", alpha: float = 1.0, beta: float = 0.05):
        weights(objective, alpha, beta, 1, 1)
        self.objective: Objective = objective
        self.alpha, self.beta = alpha, beta
        super().__init__()

    @abstractmethod
    def _answer(self, task: Task, began: float) -> Answer:
        """Routes for a task that skills and ways allow; `began` is a `time.perf_counter()`."""

    @classmethod
    def _trial(cls) -> RoutePlanner | None:
        """One of its kind that is done with `TRIAL` at once; None where nothing is compiled."""
        return None

    def plan(self, snapshot: Snapshot) -> Plan:
        """A whole plan from this moment. Raises InputError if the planner cannot serve it."""
        if self.time_limit is not None:
            compiled(type(self))
        return self._plan(snapshot)

    def _plan(self, snapshot: Snapshot) -> Plan:
        began = time.perf_counter()
        agents = len(snapshot.cells)
        travel = travel_times(snapshot)
        hopeless = obstacles(snapshot, travel)
        if hopeless:
            return infeasible(self.name, self.objective, "; ".join(hopeless.values()),
                              time.perf_counter() - began, agents)
        task = Task.of(snapshot, travel)
        answer = self._answer(task, began) if len(task.targets) else Answer(
            np.full((agents, 0), -1, np.int32), 0.0, True)
        seconds = time.perf_counter() - began
        if answer.routes is None:
            found = "is" if answer.proved else "was found"
            reason = f"no plan {found} within the {task.horizon} steps left"
            return infeasible(self.name, self.objective, reason.replace("plan is", "plan"),
                              seconds, agents)
        claim = Certificate(self.name, self.objective,
                            "optimal" if answer.proved else "feasible", answer.bound)
        return plan_of_routes(snapshot, travel, task.named(answer.routes), claim, seconds)


@functools.cache
def compiled(kind: type[RoutePlanner]) -> None:
    """Has one of that kind plan, once a process: its first call compiles or loads what it needs."""
    trial = kind._trial()
    if trial is not None:
        trial._plan(Snapshot.start(TRIAL))
