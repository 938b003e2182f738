"""Whole plans of planners that only decide, made by letting them decide on the grid's rules."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from moonteam.errors import InputError
from moonteam.planners.base import IntArray, Objective, Plan, Planner, Snapshot
from moonteam.planners.plans.routes import Certificate, infeasible, obstacles, plan_of_trace
from moonteam.planners.search.travel import travel_times
from moonteam.planners.simulate import STAY, Trace, holding, step


def plan_from_planner(planner: Planner, snapshot: Snapshot, objective: Objective = "makespan",
                      seed: int = 0) -> Plan:
    """The plan that a planner's own decisions amount to.

    Args:
      planner: asked once a step.
      snapshot: where it begins.
      objective: written into the plan; a policy has none of its own.
      seed: handed to the planner's `reset`.

    Returns:
      a plan of status feasible, or infeasible with the reason where targets stay unsolved;
      then it still holds the actions.
    """
    began = time.perf_counter()
    agents = len(snapshot.cells)
    hopeless = obstacles(snapshot, travel_times(snapshot))
    if hopeless:
        return infeasible(planner.name, objective, "; ".join(hopeless.values()),
                          time.perf_counter() - began, agents)
    now = replace(snapshot, solved=holding(snapshot))
    planner.reset(now, seed)
    cells, solved, actions = [now.cells], [now.solved], []
    while not now.solved.all() and now.step < now.max_steps:
        joint = np.asarray(planner.act(now), np.int32)
        now = step(now, joint)
        cells.append(now.cells)
        solved.append(now.solved)
        actions.append(joint)
    trace = Trace(np.array(cells), np.array(solved),
                  np.array(actions, np.int32).reshape(len(actions), agents))
    seconds = time.perf_counter() - began
    claim = Certificate(planner.name, objective, "feasible", None)
    plan = plan_of_trace(snapshot, trace, claim, seconds)
    if trace.complete:
        return plan
    left = ", ".join(str(t) for t in np.flatnonzero(~now.solved).tolist())
    return replace(plan, status="infeasible", reason=f"{planner.name} left targets {left} "
                   f"unsolved after {now.step - snapshot.step} steps")


class Stepwise:
    """A planner with `reset` and `act` alone, completed by the whole plan they amount to.

    Args:
      planner: somebody's own; what it answers is checked.
      name: where it has none.
      objective: written into its plans.
      seed: of its plans.
    """

    def __init__(self, planner: Planner, name: str, objective: Objective = "makespan",
                 seed: int = 0):
        self.planner, self.seed = planner, seed
        self.objective: Objective = objective
        self.name = str(getattr(planner, "name", name))
        self.most_targets: int | None = getattr(planner, "most_targets", None)

    def check(self, snapshot: Snapshot) -> None:
        """What the planner itself says of a mission, if it has a `check`."""
        own = getattr(self.planner, "check", None)
        if own is not None:
            own(snapshot)

    def reset(self, snapshot: Snapshot, seed: int = 0) -> None:
        """Starts a mission."""
        self.planner.reset(snapshot, seed)

    def act(self, snapshot: Snapshot) -> IntArray:
        """Joint action [N]. Raises InputError if the planner answers with anything else."""
        joint = np.asarray(self.planner.act(snapshot))
        whole = joint.dtype.kind in "iu" and joint.shape == (len(snapshot.cells),)
        if not whole or (joint < 0).any() or (joint > STAY).any():
            raise InputError(f"--planner {self.name}", f"act returned {joint.tolist()}; "
                             f"{len(snapshot.cells)} whole numbers of 0 to {STAY} are needed")
        return joint.astype(np.int32)

    def plan(self, snapshot: Snapshot) -> Plan:
        """The whole plan that its decisions make; infeasible if they fail."""
        return plan_from_planner(self, snapshot, self.objective, self.seed)
