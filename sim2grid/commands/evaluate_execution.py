"""`moonteam evaluate execution`: hundreds of missions in physics, and what came of them."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from moonteam import files
from moonteam.cluster import Cluster, cluster
from moonteam.commands.options import Apart, Missions, Planning, Reported, Resumable
from moonteam.report import command, journal
from moonteam.report.command import Aside
from moonteam.report.journal import Journal
from moonteam.report.progress import say

if TYPE_CHECKING:
    from sim2grid.study.evaluation import Evaluation, Row

PRESETS = ("mare", "highland", "crater_rim", "polar", "flat")

FILES = ("config.json", "rows.jsonl", "report.json", "report.html", "rows.csv", "table.md")
"""In --out."""


@dataclass(frozen=True)
class Args(Planning, Missions, Apart, Resumable, Reported):
    """Execute random missions in physics and compare what they cost with the grid's promise.

    Each mission has one robot of each of our own kinds with random skills, random targets
    and, if asked for, random events; all missions of a site stand on the same ground. A row of
    the table is a loop with a planner and a mode: closed (the planner decides again at each
    step, from where the robots really are), open (the grid plan walked through blindly, all
    robots in lockstep), oracle (closed with the exact planner) and grid (no physics).
    Exit code 0 whatever the missions came to, 130 if interrupted, with what is done saved.

    Files in --out: report.html (one page), report.json, rows.csv, table.md, and rows.jsonl, to
    which each mission is added as it ends, so that --resume can go on. The same options give the
    same report.

    Examples:
      moonteam evaluate execution --site mare highland --count 100 --out runs/execution
      moonteam evaluate execution --planner exact --loop closed open grid --mode barrier async
      moonteam evaluate execution --site flat --count 8 --lose 1 --out runs/lose --resume
      moonteam evaluate execution --backend native mjx --count 10 --out runs/backends
      moonteam evaluate execution --count 20 --new-targets 5 --slow 0.5 --silent 0.5 --json
      moonteam evaluate execution --count 500 --on ray://head:10001 --out runs/many
    """

    site: tuple[Literal["mare", "highland", "crater_rim", "polar", "flat"], ...] = ("mare",)
    """Presets of the ground, one group of missions each."""
    count: int = 20
    """Missions a site."""
    loop: tuple[Literal["closed", "open", "oracle", "grid"], ...] = ("closed",)
    """Which baselines stand in the table."""
    mode: tuple[Literal["barrier", "async", "clock"], ...] = ("barrier",)
    """barrier: all robots decide together; async: each when it arrives (closed, oracle); clock: a
    decision is a target, planned in seconds and driven at any angle (closed; exact in place of
    policies that do not point at targets)."""
    planner: tuple[str, ...] = ("policy",)
    """Who decides: registered planners (policy, auto, exact, greedy, lns, cpsat, exhaustive,
    another package's), or
    FILE.py:OBJECT."""
    cell: float = 1.0
    """Metres a side of a cell."""
    lose: float = 0.0
    """Chance for each mission that one robot is lost, at a random decision in mid-mission."""
    slow: float = 0.0
    """Chance for each mission that one robot is slowed to 0.3 to 0.7 of its speed."""
    silent: float = 0.0
    """Chance for each mission that one robot is silent for 5 to 14 decisions."""
    new_targets: int = 0
    """New targets that appear in mid-mission, each at a random decision."""
    impassable: int = 0
    """Cells on the way of a robot on the ground that turn out closed to its kind."""
    backend: tuple[Literal["native", "mjx", "fused"], ...] = ("native",)
    """Physics engines: C MuJoCo, MJX for accelerators, or the whole loop on MJX as one program
    (closed loop, barrier, a policy's likeliest actions, no events); or several."""
    width: int = 25
    """Worlds that the engine advances together."""
    threads: Aside[int] = 0
    """CPU threads of the native engine, 0 for all; the report is the same. With --on each piece
    has one."""


def run(args: Args) -> int:
    """Evaluates, prints, saves."""
    _check(args)
    with cluster(args.on, at_once=True) as workers:
        return _run(args, workers)


def _run(args: Args, workers: Cluster | None) -> int:
    from moonteam.compilation import call_at_once, enable_cache

    enable_cache()
    call_at_once()
    from moonteam.report import provenance
    from sim2grid.study.evaluation import Row
    from sim2grid.study.summary import document

    evaluation = _evaluation(args)
    evaluation.cluster = workers
    if args.out:
        held = Journal[Row](args.out, args.resume, _options(args), Row, FILES)
        evaluation.rows |= {(row.contender, row.number): row for row in held.entries}
        evaluation.keep = held.add
    begun, interrupted = time.perf_counter(), False
    try:
        evaluation.run()
    except KeyboardInterrupt:
        interrupted = True
    rows = evaluation.sorted_rows()
    report = document(rows, evaluation.entries, evaluation.contenders, _options(args),
                      provenance.meta(command.line("evaluate execution", args), args.seed),
                      args.seed)
    if interrupted:
        report["interrupted"] = True
    if args.out:
        _save(args.out, report, rows)
    _print(args, report)
    say(f"moonteam: {len(rows)} missions in the report; {time.perf_counter() - begun:.0f} s")
    return journal.interrupted(args.out) if interrupted else 0


def _check(args: Args) -> None:
    """Raises InputError for options out of range."""
    journal.check(args, (
        ("count", 1, 100_000), ("targets", 1, 64), ("side", 4, 128), ("max_steps", 1, 100_000),
        ("seed", 0, 2**31), ("site_seed", 0, 2**31), ("width", 1, 4096), ("threads", 0, 1024),
        ("new_targets", 0, 64), ("impassable", 0, 64), ("cell", 0.25, 10), ("lose", 0, 1),
        ("slow", 0, 1), ("silent", 0, 1)), choices=("site", "loop", "mode", "planner", "backend"))


def _evaluation(args: Args) -> Evaluation:
    from sim2grid.study.evaluation import Contender, Evaluation, contenders
    from sim2grid.study.fleet import Rates, Recipe

    rates = Rates(args.lose, args.slow, args.silent, args.new_targets, args.impassable)
    recipes = [Recipe(site, args.site_seed, args.seed, args.targets, args.side, args.cell,
                      args.max_steps, rates) for site in args.site]
    who = [Contender.of(name, args.planner_options()) for name in args.planner]
    return Evaluation(recipes, args.count, contenders(args.loop, args.mode, who, args.backend),
                      args.seed, args.width, args.threads)


def _options(args: Args) -> dict[str, Any]:
    """What the rows depend on; the same in a run and in what resumes it."""
    options = command.figures(args)
    rates = {name: options.pop(name)
             for name in ("lose", "slow", "silent", "new_targets", "impassable")}
    return options | {"rates": rates}


def _save(out: Path, report: dict[str, Any], rows: list[Row]) -> None:
    from moonteam.report.tables import plain_csv, plain_markdown
    from sim2grid.study.evaluation_page import evaluation_page
    from sim2grid.study.summary import csv_rows, tables

    files.write_json(out / "report.json", report)
    files.write_text(out / "report.html", evaluation_page(report, str(out / "report.json")))
    files.write_text(out / "table.md", plain_markdown(report, tables(report)) + "\n")
    if rows:
        files.write_text(out / "rows.csv", plain_csv(csv_rows(rows)))


def _print(args: Args, report: dict[str, Any]) -> None:
    from moonteam.report.tables import plain_markdown, show_plain
    from sim2grid.study.summary import tables

    if args.json:
        print(files.dump_json(report))
    elif args.markdown:
        print(plain_markdown(report, tables(report)))
    else:
        (titles, rows), *more = tables(report)
        heads = ["\n".join([row[0], " ".join(word for word in row[1:4] if word != "-")])
                 for row in rows]
        turned = [[title, *(row[k] for row in rows)] for k, title in enumerate(titles) if k > 3]
        show_plain(report, [(["", *heads], turned), *more])
