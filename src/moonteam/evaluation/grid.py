"""Planners and policies side by side on a set of scenarios."""

from __future__ import annotations

from collections.abc import Sequence

from moonteam import interrupts
from moonteam.cluster import Cluster
from moonteam.evaluation import apart, metrics, optima
from moonteam.evaluation import world as worlds
from moonteam.evaluation.contenders import Contender
from moonteam.evaluation.world import World
from moonteam.problem.scenario import Scenario
from moonteam.report import provenance, tables
from moonteam.report.intervals import RESAMPLES, Bootstrap
from moonteam.report.journal import NOTHING, Kept

PANELS = (("makespan_gap", "makespan over the optimum, %", 100.0),
          ("moves_gap", "moves over the optimum, %", 100.0),
          ("success", "success", 1.0))
AGAINST = tables.Column("against", "against", lambda value: f"{100 * value:+.2f} %")
COLUMNS = (*tables.GRID_COLUMNS, AGAINST, *tables.SECONDS)
PAGE = tuple(c for c in COLUMNS if c.key not in ("M_st", "M_tte", "decisions"))
"""Columns of the Markdown table, which must not be too wide; the others follow from them."""


def evaluate(scenarios: Sequence[Scenario], rows: Sequence[Contender], seed: int, title: str,
             command: str, kept: Kept = NOTHING, cluster: Cluster | None = None,
             against: str = "") -> dict:
    """The whole report as a JSON-able document, of work done here or on a cluster; `kept` holds
    what was done before. `against`: a planner that others of its objective and time limit are held
    against.

    Raises InputError before anything is run. Interrupted, it reports the rows that are done
    (see `run_all`).
    """
    world = worlds.build(scenarios)
    for contender in rows:
        contender.check(world)
    whole, kept = apart.done(cluster, rows, len(world), kept,
                             lambda row, size, kept: row.parts(world, size, kept))
    found = run_all(whole, world, kept=kept)
    reference = optima.reference(world.scenarios)
    return document(world.family, found, reference, seed, title, command,
                    against) | missing(found, rows)


def run_all(rows: Sequence[Contender], world: World, least: int = 1,
            kept: Kept = NOTHING) -> list[metrics.Outcomes]:
    """What each contender did; after Ctrl-C what those before it did, if at least `least`."""
    found = []
    try:
        for contender in rows:
            found.append(contender.run(world, kept))
            interrupts.hold()
    except KeyboardInterrupt:
        if len(found) < least:
            raise
    return found


def missing(found: Sequence[metrics.Outcomes], rows: Sequence[Contender]) -> dict:
    """Names of the rows that an interruption left out, as part of the document."""
    names = [row.name for row in rows[len(found):]]
    return {"interrupted": names} if names else {}


def document(family: metrics.Family, found: Sequence[metrics.Outcomes],
             reference: metrics.Reference, seed: int, title: str, command: str,
             against: str = "") -> dict:
    """Summary, rows, notes and provenance; `against` as in `evaluate`."""
    bootstrap = Bootstrap(len(family), seed)
    notes = [f"Measured against: {reference.source}.",
             f"In brackets: 95 % intervals over {len(family)} scenarios: of success by Wilson, "
             f"else bootstrap, {RESAMPLES} resamples.",
             *(f"{o.planner}: {o.note}" for o in found if o.note)]
    summary = [metrics.summary(o, family, reference, bootstrap) for o in found]
    if against:
        notes.append(f"Against {against}: mean makespan over that of {against} with the same "
                     "objective and time limit, the same scenarios resampled.")
        by_name = {o.planner: o for o in found}
        for row, one in zip(summary, found, strict=True):
            other = by_name.get(against + one.planner[one.planner.find("("):])
            metrics.hold_against(row, one, None if other is one else other, bootstrap)
    return {
        "title": title,
        "summary": summary,
        "rows": [row for o in found for row in metrics.rows(o, family, reference)],
        "notes": [note for note in notes if note],
        "meta": provenance.meta(command, seed),
    }
