"""Median time of the exact planner on one core, by number of targets and objective."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from moonteam.grid.scenarios import generate
from moonteam.planners.base import Objective, Snapshot
from moonteam.planners.batch import solve_batch
from moonteam.planners.exact import ExactPlanner
from moonteam.report import clock
from moonteam.report.progress import track

OBJECTIVES: tuple[Objective, ...] = ("moves", "makespan", "weighted")


def _search(objective: Objective) -> Any:
    """Solves one instance: least cost and routes, without writing out the joint actions."""
    def call(moment: Snapshot) -> Any:
        return solve_batch(
            moment.cells[None], moment.agent_skills[None], moment.target_cells[None],
            moment.target_skills[None], moment.target_and[None], objective=objective,
            steps_left=moment.max_steps, threads=1)

    return call


def measure(targets: Sequence[int], count: int, budget: float, seed: int) -> list[dict]:
    """Rows of medians: `search` finds the optimum, `plan` also writes and replays the actions."""
    rows = []
    for size in track(list(targets), "exact planner", len(targets)):
        moments = [Snapshot.start(generate(np.random.default_rng([seed, size, i]),
                                           num_targets=size)) for i in range(count)]
        for objective in OBJECTIVES:
            for what, call in (("search", _search(objective)),
                               ("plan", ExactPlanner(objective).plan)):
                times = clock.measure(call, moments, budget)
                rows.append({"targets": size, "objective": objective, "what": what,
                             **times.document()})
    return rows
