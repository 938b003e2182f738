"""What each scenario is measured against: certified optima, else the best value known."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from moonteam.evaluation.metrics import Reference
from moonteam.planners.base import Objective, Snapshot
from moonteam.planners.exact import MAX_TARGETS, ExactPlanner
from moonteam.problem.scenario import Scenario
from moonteam.report.progress import track

CERTIFIED = "certified optima of the file"
SOLVED = "optima solved here by the exact planner"
BEST = "best known values of the file (not proved optimal)"
NOTHING = "nothing (too large for the exact planner, or not solvable)"


def reference(scenarios: Sequence[Scenario]) -> Reference:
    """The optimum of both objectives, each on its own, and in words where they come from."""
    makespan, m_sources = _values(scenarios, "makespan")
    moves, v_sources = _values(scenarios, "moves")
    return Reference(makespan, moves, describe(m_sources, v_sources, len(scenarios)))


def describe(makespan: Counter[str], moves: Counter[str], count: int) -> str:
    """The sources in words, with how many scenarios each served where there are several."""
    def words(sources: Counter[str]) -> str:
        return "; ".join(name if n == count else f"{name} ({n} of {count})"
                         for name, n in sources.most_common())

    if makespan == moves:
        return words(makespan)
    return f"makespan: {words(makespan)}. moves: {words(moves)}"


def _values(scenarios: Sequence[Scenario], objective: Objective) -> tuple[np.ndarray, Counter[str]]:
    values = np.full(len(scenarios), np.nan)
    sources: Counter[str] = Counter()
    unknown = []
    for i, scenario in enumerate(scenarios):
        proved = getattr(scenario.optimal, objective, None)
        known = getattr(scenario.optimal, f"best_{objective}", None)
        if proved is not None:
            values[i] = proved
            sources[CERTIFIED] += 1
        elif len(scenario.targets) <= MAX_TARGETS:
            unknown.append(i)
        elif known is not None:
            values[i] = known
            sources[BEST] += 1
        else:
            sources[NOTHING] += 1
    planner = ExactPlanner(objective)
    for i in track(unknown, f"optimal {objective}", len(unknown)):
        plan = planner.plan(Snapshot.start(scenarios[i]))
        value = plan.makespan if objective == "makespan" else plan.moves
        certain = plan.status == "optimal" and value is not None
        values[i] = value if certain else np.nan
        sources[SOLVED if certain else NOTHING] += 1
    return values, sources
