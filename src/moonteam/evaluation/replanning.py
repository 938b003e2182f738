"""The paper's replanning experiment: five targets, and five more that appear under way.

A scenario has ten targets. The first five are shown; when one of them is solved, the next of
the other five takes its slot in the observation at that very step and can be solved from the
next step on. New targets are part of the scenario, so that every planner meets the same ones
in the same order (it meets them at other times, since it solves at other times). A planner
sees none of them before they appear. All ten must be solved within max_steps.

The exact planner that plans anew whenever a target appears is the row to compare with. It is
not a bound: nobody can know what will appear, and a planner may be lucky.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from moonteam.errors import InputError
from moonteam.evaluation import grid
from moonteam.evaluation import world as worlds
from moonteam.evaluation.contenders import Contender, Options, contenders
from moonteam.evaluation.metrics import Outcomes, Reference
from moonteam.planners.base import Snapshot
from moonteam.planners.exact import MAX_TARGETS, ExactPlanner
from moonteam.problem.scenario import Scenario
from moonteam.report.journal import NOTHING, Kept
from moonteam.report.progress import track

ORACLE = (("exact", "makespan"), ("exact", "moves"))
COLUMNS = tuple(column for column in grid.COLUMNS if column.key not in ("st_ratio", "tte_ratio"))
PAGE = tuple(column for column in COLUMNS if column.key != "decisions")
PANELS = (("makespan_gap", "T over exact(makespan), %", 100.0),
          ("moves_gap", "moves over exact(moves), %", 100.0),
          ("success", "success", 1.0))


def evaluate(scenarios: Sequence[Scenario], rows: Sequence[Contender], num_new: int, seed: int,
             title: str, command: str, kept: Kept = NOTHING) -> dict:
    """The report; rows of the exact planner are added where they are missing.

    Raises:
      InputError: a scenario with too few targets or one solved at the start, or a policy made
        for another size; nothing is run then.
    """
    for scenario in scenarios:
        if len(scenario.targets) <= num_new:
            raise InputError(scenario.id or "scenario", f"has {len(scenario.targets)} targets; "
                             f"more than {num_new} are needed, {num_new} of them appear later")
    world = worlds.build(scenarios, num_new)
    worlds.check_fresh(world, title)
    oracle = [contenders(Options(planners=[kind], objectives=[objective]))[0]
              for kind, objective in ORACLE]
    names = {o.name for o in oracle}
    ordered = [*oracle, *(row for row in rows if row.name not in names)]
    for contender in ordered:
        contender.check(world)
    found = grid.run_all(ordered, world, least=len(ORACLE), kept=kept)
    document = grid.document(world.family, found, _reference(found), seed, title, command)
    document |= grid.missing(found, ordered)
    document["notes"].insert(0, _hindsight(scenarios))
    shown = sorted({len(s.targets) - num_new for s in scenarios})
    document["notes"].insert(0, f"{' or '.join(map(str, shown))} targets at the start and "
                             f"{num_new} more, each in the slot of one just solved; success: all "
                             "within max_steps. mean T and mean moves are the raw figures, M_st "
                             "and M_tte the slack.")
    document["notes"] = [note for note in document["notes"] if note]
    return document


def _hindsight(scenarios: Sequence[Scenario]) -> str:
    """What is possible at best: all targets known, and open, from the first step.

    Any run of the experiment is a run of that easier problem, so its optimum is a bound.
    """
    planner = ExactPlanner("makespan")
    least = []
    for scenario in track(scenarios, "bound", len(scenarios)):
        if len(scenario.targets) > MAX_TARGETS:
            return ""
        moment = replace(Snapshot.start(scenario), max_steps=64 * scenario.max_steps)
        least.append(planner.plan(moment).makespan or 0)
    lost = sum(t > s.max_steps for t, s in zip(least, scenarios, strict=True))
    capped = [min(t, s.max_steps) for t, s in zip(least, scenarios, strict=True)]
    return (f"Bound for any planner (all targets known from the start): mean T "
            f"{np.mean(capped):.2f}; {lost} of {len(scenarios)} scenarios cannot be solved "
            "within max_steps by anybody.")


def _reference(found: Sequence[Outcomes]) -> Reference:
    """The oracle's own outcomes stand where the optimum would."""
    fast, thrifty = found[0], found[1]
    return Reference(fast.steps.astype(np.float64), thrifty.moves.astype(np.float64),
                     "the exact planner, planning anew whenever a target appears: its T for "
                     "makespan, its moves for moves (an oracle for what is shown, not a bound)")


