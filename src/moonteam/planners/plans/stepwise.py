"""A plan made by letting any Planner decide step by step on the grid's rules."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from moonteam.planners.base import Objective, Plan, Planner, Snapshot
from moonteam.planners.plans.routes import Certificate, infeasible, obstacles, plan_of_trace
from moonteam.planners.search.travel import travel_times
from moonteam.planners.simulate import Trace, holding, step


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
