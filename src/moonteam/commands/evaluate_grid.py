"""`moonteam evaluate grid`: planners and policies side by side on a set of scenarios."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from moonteam import compilation, interrupts, loading, paths
from moonteam.cluster import Cluster, cluster
from moonteam.commands.options import Apart, Drawn, Limited, Many, Reported, Resumable
from moonteam.errors import InputError
from moonteam.problem.scenario import Scenario
from moonteam.problem.timed import Timed
from moonteam.report.journal import Kept

FILES = ("config.json", "rows.jsonl", "report.json", "summary.csv", "rows.csv", "table.md",
         "gaps.png")
"""In --out."""
PICTURE = "gaps.png"


@dataclass(frozen=True)
class Args(Drawn, Limited, Apart, Resumable, Reported):
    """Play a set of scenarios with any number of planners and compare them with the optimum.

    One row a planner and objective, or a policy and decoding: success, slack metrics and
    their ratios, true gaps in makespan and moves, planning time, with bootstrap intervals.
    Every plan is played in the grid environment; what it says counts, not the planner's
    promise. Failures count with T = max_steps and the moves they made. Options marked "again"
    may be given several times.

    Of a set by the clock (its objects say "clock": "seconds"), makespan and effort are in its
    own unit of time, and planners are those by the clock: auto, exact, greedy, lns, cpsat,
    routing, exhaustive, and policy with a network that points at targets.

    Files in --out: report.json, summary.csv, rows.csv, table.md and gaps.png; and rows.jsonl, to
    which each plan is added as it is made (a policy's batch as a whole), so that --resume goes on.

    Examples:
      moonteam evaluate grid 3x5 --planner exact --planner greedy --limit 200
      moonteam evaluate grid set.jsonl --planner exact --objective makespan --objective moves
      moonteam evaluate grid peers/mrta-benchmark --planner exact --planner greedy
      moonteam evaluate grid 8x40 --planner lns --time-limit 0.01 --time-limit 0.1 --limit 20
      moonteam evaluate grid 5x20 --planner lns --planner guided --time-limit 0.01 --against lns
      moonteam evaluate grid --count 500 --targets 3 --side 8 --max-steps 48 --planner policy
      --policy small --decode argmax --decode best-of-16
      moonteam evaluate grid 8x40 --planner lns --planner cpsat --on ray
    """

    set: tyro.conf.Positional[str | None] = None
    """Scenario set (.jsonl), scenario (.json), or the name of a bundled set; without it,
    --count scenarios are drawn from --seed."""
    planner: Many[tuple[str, ...]] = ()
    """auto, exact, greedy, lns, guided, exhaustive, cpsat, routing, policy, another package's, or
    FILE.py:OBJECT; again for more rows. Default: exact."""
    objective: Many[tuple[str, ...]] = ()
    """makespan, moves (by the clock: effort) or weighted; again for more rows. Default: makespan,
    and for best-of-K what the preference asks for."""
    policy: Many[tuple[str, ...]] = ()
    """Policy file (.safetensors) or the name of a bundled policy; again for more. Default:
    any_team."""
    preference: Many[tuple[float, ...]] = ()
    """0 (time) to 1 (effort), for policies that take one; again for more rows."""
    decode: Many[tuple[str, ...]] = ()
    """argmax, plain-argmax (without the deadlock watch), sample, best-of-K such as best-of-16;
    @T sets the temperature of drawing (sample@0.25); again for more rows.
    Default: argmax."""
    alone: bool = False
    """Policies play one scenario at a time, not in batches: the planning time of a mission."""
    alpha: float = 1.0
    """Weight of the makespan in the objective weighted."""
    beta: float = 0.05
    """Weight of the moves in the objective weighted."""
    time_limit: Many[tuple[float, ...]] = ()
    """Seconds a scenario that anytime planners (exact, lns, guided, cpsat, ...) may take; again for
    more rows. Default: theirs."""
    against: str = ""
    """A planner among the rows, such as lns: every other row of its objective and time limit is
    held against it too, scenario by scenario, by mean makespan. In steps only."""
    threads: int = 1
    """That lns, guided and auto search with side by side."""


def load_any(name: str, limit: int | None) -> list[Scenario] | list[Timed]:
    """The scenarios of a file or bundled set, in steps or by the clock.

    Raises InputError naming file and line.
    """
    if limit is not None and limit < 1:
        raise InputError("--limit", f"{limit} is not allowed; at least 1")
    suffix = ".json" if name.endswith(".json") else ".jsonl"
    return loading.load_set(paths.find(name, "testsets", suffix))[:limit]


def load_set(name: str, limit: int | None) -> list[Scenario]:
    """The same, in steps only. Raises InputError for a set by the clock too."""
    found = load_any(name, limit)
    steps = [one for one in found if isinstance(one, Scenario)]
    if not steps:
        raise InputError(name, "is by the clock; only scenarios in steps can be used here")
    return steps


def _scenarios(args: Args) -> tuple[list[Scenario] | list[Timed], str]:
    """The scenarios and a title."""
    if args.set is not None:
        found = load_any(args.set, args.limit)
        return found, f"{Path(args.set).stem}: {len(found)} scenarios"
    from moonteam.evaluation.draw import Draw

    found = Draw(args.count, args.seed, args.agents, args.targets, args.side,
                 args.max_steps).scenarios("drawn")[:args.limit]
    return found, (f"{args.agents} agents, {args.targets} targets on {args.side}x{args.side}: "
                   f"{len(found)} scenarios")


def options_of(args: Any) -> Any:
    """What the options shared by `evaluate grid` and `replanning` ask for, with its files found."""
    from moonteam.evaluation.contenders import Options

    return Options(
        planners=args.planner or ("exact",), objectives=getattr(args, "objective", ()),
        policies=[paths.find(p, "policies", ".safetensors") for p in args.policy],
        preferences=getattr(args, "preference", ()), decodes=args.decode or ("argmax",),
        alpha=getattr(args, "alpha", 1.0), beta=getattr(args, "beta", 0.05),
        time_limits=args.time_limit, seed=args.seed, alone=getattr(args, "alone", False),
        threads=getattr(args, "threads", 1))


def save(args: Any, document: dict, form: Any, picture: str) -> None:
    """Writes the files of the document into --out, if it is given; see `deliver`."""
    from moonteam.evaluation import figures
    from moonteam.report import tables

    if args.out:
        tables.save(args.out, document, form.PAGE)
        figures.bars(args.out / picture, document, form.PANELS)


def deliver(args: Any, document: dict, form: Any, picture: str) -> int:
    """Saves and prints a report as the options wish; returns the exit code.

    `form` is the module that made it, with its COLUMNS, PAGE and PANELS; an interrupted report
    says on standard error what it lacks.
    """
    from moonteam.report import tables

    save(args, document, form, picture)
    tables.print_columns(args, document, form.PAGE, form.COLUMNS)
    if "interrupted" not in document:
        return 0
    left = ", ".join(document["interrupted"])
    more = "; --resume goes on" if args.out else ""
    print(f"moonteam: interrupted; the report lacks {left}{more}", file=sys.stderr)
    return interrupts.CODE


def run(args: Args) -> int:
    """Evaluates, prints, saves; 0 whatever the planners achieved, 130 if interrupted."""
    from moonteam.report import command

    document, form = judged(args, *_scenarios(args), command.line("evaluate grid", args))
    return deliver(args, document, form, PICTURE)


def judged(args: Args, found: Sequence[Scenario | Timed], title: str, line: str,
           made: str = "") -> tuple[dict, Any]:
    """The report on scenarios in steps or by the clock, and the module that says its form.

    `line` is what makes it again; `made` tells scenarios that are in no file from others.
    """
    compilation.enable_cache()
    from moonteam.report import command, journal

    with cluster(args.on) as workers:
        options = options_of(args)
        asked = command.figures(args) | ({"made": made} if made else {})
        kept = journal.Kept.of(args.out, args.resume, asked, FILES)
        return _judged(found, options, args.seed, title, line, kept, workers, args.against)


def _judged(found: Sequence[Scenario | Timed], options: Any, seed: int, title: str, line: str,
            kept: Kept, workers: Cluster | None, against: str) -> tuple[dict, Any]:
    from moonteam.evaluation import contenders, grid, timed

    clocked = [one for one in found if isinstance(one, Timed)]
    if against and (clocked or against not in options.planners):
        raise InputError("--against", "is for scenarios in steps" if clocked else
                         f"{against} is none of the planners: {', '.join(options.planners)}")
    if clocked:
        return timed.evaluate(clocked, timed.contenders(options), seed, title, line, kept,
                              workers), timed
    steps = [one for one in found if isinstance(one, Scenario)]
    return grid.evaluate(steps, contenders.contenders(options), seed, title, line, kept,
                         workers, against), grid
