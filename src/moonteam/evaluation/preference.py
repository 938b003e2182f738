"""One policy over its whole preference, time to effort, beside the exact planner's Pareto points.

At preference p the policy is asked for p, and the exact planner minimises
(1 - p) * makespan + p * moves, with a little of both at either end so that neither is wasted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from moonteam.evaluation import metrics
from moonteam.evaluation import world as worlds
from moonteam.evaluation.contenders import Planned
from moonteam.evaluation.metrics import Outcomes, Reference
from moonteam.evaluation.played import play
from moonteam.evaluation.world import World
from moonteam.planners.decode import Decode
from moonteam.planners.exact import MAX_TARGETS, ExactPlanner
from moonteam.planners.kind import PlannerOptions
from moonteam.policies.policy import Policy
from moonteam.problem.scenario import Scenario
from moonteam.report import provenance
from moonteam.report.intervals import Bootstrap

POLICY, EXACT = "policy", "exact"
KEYS = ("success", "makespan", "moves")
_LITTLE = 0.01


def evaluate(scenarios: Sequence[Scenario], policy: Policy, decode: Decode,
             preferences: Sequence[float], seed: int, title: str, command: str) -> dict:
    """The report as a JSON-able document: a row for each preference and planner."""
    world = worlds.build(scenarios)
    for moment in worlds.snapshots(world, world.start):
        policy.check(moment)
    bootstrap = Bootstrap(len(world), seed)
    unknown = np.full(len(world), np.nan)
    solvable = max(len(s.targets) for s in scenarios) <= MAX_TARGETS
    rows = []
    for p in preferences:
        found = [_policy(world, policy, decode, p, seed)]
        found += [_exact(world, p)] if solvable else []
        for outcome in found:
            row = metrics.summary(outcome, world.family, Reference(unknown, unknown), bootstrap)
            rows.append({"preference": p, "planner": row["planner"], "scenarios": len(world),
                         **{key: row[key] for key in KEYS},
                         "intervals": {key: row["intervals"][key] for key in KEYS},
                         "seconds": row["seconds"]})
    notes = [f"Means over {len(world)} scenarios, those that fail included with max_steps and the "
             f"moves they made; the policy decides by {decode.name}.",
             "exact: certified optimal plans for (1 - p) makespan + p moves, with "
             f"{_LITTLE:g} more of each at every p." if solvable else
             f"Exact points are left out: above {MAX_TARGETS} targets nothing is certified."]
    return {"title": title, "rows": rows, "notes": notes,
            "meta": provenance.meta(command, seed)}


def _policy(world: World, policy: Policy, decode: Decode, preference: float,
            seed: int) -> Outcomes:
    found = play(policy, world, decode, PlannerOptions(preference=preference, seed=seed),
                 f"preference {preference:g}")
    return Outcomes(POLICY, found.success, found.steps, found.moves, found.seconds,
                    found.compiling)


def _exact(world: World, preference: float) -> Outcomes:
    planner = ExactPlanner("weighted", 1.0 - preference + _LITTLE, preference + _LITTLE)
    return replace(Planned(planner, EXACT, "weighted").run(world), planner=EXACT)


def pivot(document: dict) -> tuple[list[str], list[list[str]]]:
    """Titles and rows of a table: a preference a row."""
    rows = document["rows"]
    names = list(dict.fromkeys(row["planner"] for row in rows))
    at = {(row["preference"], row["planner"]): row for row in rows}
    titles = ["preference", *(f"{name}: {what}" for name in names for what in
                              ("success", "mean T", "mean moves"))]
    table = [[f"{p:g}", *(text for name in names for text in _cells(at[p, name]))]
             for p in dict.fromkeys(row["preference"] for row in rows)]
    return titles, table


def _cells(row: dict) -> list[str]:
    """Success, mean T and mean moves, with their intervals."""
    found = []
    for key, digits in zip(KEYS, (3, 2, 2), strict=True):
        ends = ", ".join(f"{end:.{digits}f}" for end in row["intervals"][key])
        found.append(f"{row[key]:.{digits}f} [{ends}]")
    return found
