"""`moonteam evaluate execution`: hundreds of missions in physics, and what came of them."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from moonteam import files
from moonteam.cluster import Cluster, cluster
from moonteam.commands.options import (
    Apart,
    Elevation,
    Missions,
    Planning,
    Reported,
    Resumable,
    check_soil,
)
from moonteam.errors import InputError
from moonteam.problem.mission import SoilName
from moonteam.report import command, journal
from moonteam.report.command import Aside
from moonteam.report.journal import Journal
from moonteam.report.progress import say

if TYPE_CHECKING:
    from moonteam.problem.mission import Mission
    from sim2grid.study.evaluation import Evaluation
    from sim2grid.study.fleet import Given, Recipe

DRAWN = ("team", "site", "sites", "count", "cell", "lose", "slow", "silent", "new_targets",
         "impassable", "unfold", "site_seed", "targets", "side", "max_steps", "ground", "soil",
         "fields",
         *(field.name for field in fields(Elevation)))
"""Options of random missions, which a mission that is given answers itself."""

FILES = ("config.json", "rows.jsonl", "report.json", "report.html", "rows.csv", "table.md")
"""In --out."""


@dataclass(frozen=True)
class Args(Elevation, Planning, Missions, Apart, Resumable, Reported):
    """Execute missions in physics and compare what they cost with the grid's promise.

    Missions are those of --mission, or random: one robot of each of our own kinds, or the --team,
    random skills where that says none, random targets and, if asked for, random events, all of a
    site on the same ground, which may be that of a --dem, or with --sites on many grounds at once.
    A row of the table is a loop with a planner and a mode: closed (the planner decides again at
    each step, from where the robots really are), open (the grid plan walked through blindly, all
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
      moonteam evaluate execution --mission outpost my_mission.yaml --planner exact policy
      moonteam evaluate execution --team scout.py:SCOUT:A,rover.py:ROVER:AB --planner my.py:Planner
      moonteam evaluate execution --dem moon.tif --units degrees --centre -89.4 222 --side 24
      moonteam evaluate execution --site highland --sites 64 --count 256 --width 256
      moonteam evaluate execution --mode clock --unfold hidden --planner exact --search sweep
      moonteam evaluate execution --count 500 --on ray://head:10001 --out runs/many
    """

    mission: tuple[str, ...] = ()
    """Mission files or names of bundled missions, each executed once, in place of random ones."""
    team: str = ""
    """The robots of random missions, KIND or KIND:SKILLS, with commas, such as
    scout.py:SCOUT:A,rover.py:ROVER:drill+camera. Kinds are registered or FILE.py:OBJECT; skills
    that are left out are drawn."""
    site: tuple[Literal["mare", "highland", "crater_rim", "polar", "flat"], ...] = ("mare",)
    """Presets of the ground, one group of missions each; without --dem."""
    ground: Literal["rigid", "regolith"] = "rigid"
    """Whether the ground carries everything, or wheels and feet sink in and slip."""
    soil: SoilName = "nominal"
    """Of regolith."""
    fields: Literal["measured", "rigid"] = "measured"
    """What plans believe of regolith: how each kind was measured on that soil, or as on rigid
    ground. The missions are the same."""
    sites: int = 1
    """Sites of each preset, with seeds from --site-seed on, which its missions go round; the engine
    has a different ground in each world."""
    count: int = 20
    """Missions of each preset, or of the --dem."""
    loop: tuple[Literal["closed", "open", "oracle", "grid"], ...] = ("closed",)
    """Which baselines stand in the table."""
    mode: tuple[Literal["barrier", "async", "clock"], ...] = ("barrier",)
    """barrier: all robots decide together; async: each when it arrives (closed, oracle); clock: a
    decision is a target, planned in seconds and driven at any angle (closed; exact in place of
    policies that do not point at targets)."""
    planner: tuple[str, ...] = ("policy",)
    """Who decides: registered planners (policy, auto, exact, greedy, lns, guided, cpsat, routing,
    exhaustive, another package's), or FILE.py:OBJECT, which decides in steps or by the
    clock, as it can."""
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
    unfold: Literal["following", "arrivals", "lapsing", "hidden", "losses"] | None = None
    """Missions by the clock in which not everything is known (--mode clock): five more targets,
    each when one is solved, or by the clock, 10 s apart in the mean, or so that they lapse after 15
    to 40 s and are worth 1 to 5; all targets hidden until a robot is within 6 m; or in one mission
    of three a robot is lost within 40 s."""
    search: tuple[Literal["nearest", "sweep", "places", "stay", "middle"], ...] = ()
    """Where targets are hidden: nearest, to the nearest ground not seen yet; sweep, up and down a
    strip each; places, to look from, planned for as if they were targets (lns, policy); default:
    nearest. Where they come: stay (default), or middle, where who has nothing to do goes to where
    the next target is soonest reached in the mean. A row each."""
    futures: tuple[int, ...] = ()
    """Where missions unfold: every row again, decided over so many sampled futures."""
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
    begun = time.perf_counter()
    report, rows = carry_out(args)
    _print(args, report)
    say(f"moonteam: {len(rows)} missions in the report; {time.perf_counter() - begun:.0f} s")
    return journal.interrupted(args.out) if "interrupted" in report else 0


def carry_out(args: Args, made: Sequence[Mission] = ()
              ) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """The report, and its rows as rows.csv has them; in --out too, where that is given.

    `made` are the missions of --mission where they are no files. Raises InputError before anything
    is written. An interrupted report has the key `interrupted`.
    """
    _check(args)
    with cluster(args.on, at_once=True) as workers:
        return _carry_out(args, made, workers)


def _carry_out(args: Args, made: Sequence[Mission], workers: Cluster | None
               ) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    from moonteam.compilation import call_at_once, enable_cache

    enable_cache()
    call_at_once()
    from moonteam.report import provenance
    from sim2grid.study.evaluation import Row
    from sim2grid.study.summary import document, flat_rows

    given = _given(args, made) if args.mission else []
    evaluation, options = _evaluation(args, given), _options(args)
    evaluation.cluster = workers
    evaluation.prepare()  # refuses what cannot be run before anything is written
    if args.out:
        asked = options | ({"made": [one.text for one in given]} if made else {})
        held = Journal[Row](args.out, args.resume, asked, Row, FILES)
        evaluation.rows |= {(row.contender, row.number): row for row in held.entries}
        evaluation.keep = held.add
    interrupted = False
    try:
        evaluation.run()
    except KeyboardInterrupt:
        interrupted = True
    rows = evaluation.sorted_rows()
    line = "moonteam.evaluate" if made else command.line("evaluate execution", args)
    report = document(rows, evaluation.entries, evaluation.contenders, options,
                      provenance.meta(line, args.seed), args.seed)
    if interrupted:
        report["interrupted"] = True
    flat = flat_rows(rows)
    if args.out:
        _save(args.out, report, flat)
    return report, flat


def _check(args: Args) -> None:
    """Raises InputError for options out of range."""
    journal.check(args, (
        ("count", 1, 100_000), ("sites", 1, 4096), ("targets", 1, 64), ("side", 4, 128),
        ("max_steps", 1, 100_000), ("seed", 0, 2**31), ("site_seed", 0, 2**31),
        ("width", 1, 4096), ("threads", 0, 1024),
        ("new_targets", 0, 64), ("impassable", 0, 64), ("cell", 0.25, 10), ("lose", 0, 1),
        ("slow", 0, 1), ("silent", 0, 1)), choices=("site", "loop", "mode", "planner", "backend"))
    by_clock = {*args.mode} == {"clock"} and {*args.loop} == {"closed"}
    for option, given in (("--search", args.search), ("--futures", args.futures)):
        if given and not by_clock:
            raise InputError(option, "is for missions by the clock that unfold; --mode clock "
                             "--loop closed alone executes them")
    if args.unfold is not None:
        if not by_clock:
            raise InputError("--unfold", "its missions are by the clock; --mode clock --loop "
                             "closed alone executes them")
        for name in ("lose", "slow", "silent", "new_targets", "impassable"):
            if getattr(args, name):
                raise InputError(command.flag(name), "comes at decisions; --unfold says by the "
                                 "clock what happens")


def _evaluation(args: Args, given: list[Given]) -> Evaluation:
    from sim2grid.study.evaluation import Evaluation, contenders, deciders, unfolded

    recipes = given or _recipes(args)
    # The plans of these loops are made in steps, whatever the modes of the others.
    modes = args.mode if not {"open", "grid"} & {*args.loop} else (*args.mode, "barrier")
    who = [deciders(name, args.planner_options(), modes) for name in args.planner]
    rows = contenders(args.loop, args.mode, [steps for steps, _ in who if steps], args.backend,
                      [timed for _, timed in who if timed])
    rows = unfolded(rows, args.search, args.futures)
    if not rows:
        raise InputError("--planner", f"nobody of {', '.join(args.planner)} decides in these modes "
                         "and loops")
    return Evaluation(recipes, 1 if args.mission else args.count, rows, args.seed, args.width,
                      args.threads)


def _recipes(args: Args) -> list[Recipe]:
    """Random missions, a recipe for each ground. Raises InputError."""
    from moonteam.problem.mission import Site
    from sim2grid.study.fleet import TEAM, Rates, Recipe, parse_team

    if args.dem is None:
        for name in args.model_options():
            raise InputError(command.flag(name), "is for an elevation model; give --dem too")
    if args.dem is not None and args.sites > 1:
        raise InputError("--sites", "is for presets; a --dem has one ground")
    if args.dem is not None and args.site != Args().site:
        raise InputError("--site", "give presets or an elevation model, not both; it has --dem")
    team, skills = parse_team(args.team) if args.team else (TEAM, ())
    rates = Rates(args.lose, args.slow, args.silent, args.new_targets, args.impassable)
    check_soil(args)
    its: dict[str, Any] = {"seed": args.site_seed, "ground": args.ground, "soil": args.soil,
                           "fields": args.fields}
    grounds = [(site, Site(preset=site, **its)) for site in args.site]
    if args.dem is not None:
        grounds = [(args.dem.stem, Site(
            dem=os.fspath(args.dem.resolve()), centre=args.centre, units=args.units,
            rotation=args.rotation, pixel=args.pixel, band=args.band, scale=args.scale,
            detrend=args.detrend, detail=args.detail, **its))]
    # The exact planner, whose plans say which missions can be, takes 6 robots.
    return [Recipe(name, args.site_seed, args.seed, args.targets, args.side, args.cell,
                   args.max_steps, rates, team, "exact" if len(team) <= 6 else "greedy", skills,
                   ground, args.sites, args.unfold) for name, ground in grounds]


def _given(args: Args, made: Sequence[Mission]) -> list[Given]:
    """The missions that were given. Raises InputError for what cannot go with them."""
    from sim2grid.clock.prepare import by_the_clock
    from sim2grid.study.fleet import Given

    usual = Args()
    for name in DRAWN:
        if getattr(args, name) != getattr(usual, name):
            raise InputError(command.flag(name), "is for random missions; those of --mission say "
                             "it themselves")
    given = [Given.of(mission) for mission in made] or [Given(name) for name in args.mission]
    if len(set(given)) < len(given):
        raise InputError("--mission", "give each once")
    for one in given:
        mission = one.mission()
        if "clock" in args.mode:
            by_the_clock(mission, one.name)
        if mission.clock == "seconds" and ({*args.mode} != {"clock"} or {*args.loop} != {"closed"}):
            raise InputError(one.name, "is by the clock, which --mode clock --loop closed alone "
                             "executes", "clock")
    return given


def _options(args: Args) -> dict[str, Any]:
    """What the rows depend on; the same in a run and in what resumes it."""
    options = command.figures(args)
    if args.dem is not None:
        options["dem"] = os.fspath(args.dem)
    if args.mission:
        options["count"] = 1  # of each
    for name in ("sites", "unfold", "search", "futures"):  # reports of before had none of them
        if getattr(args, name) == getattr(Args(), name):
            options.pop(name, None)
    rates = {name: options.pop(name)
             for name in ("lose", "slow", "silent", "new_targets", "impassable")}
    return options | {"rates": rates}


def _save(out: Path, report: dict[str, Any], rows: list[dict[str, Any]]) -> None:
    from moonteam.report.tables import plain_csv, plain_markdown
    from sim2grid.study.evaluation_page import evaluation_page
    from sim2grid.study.summary import tables

    files.write_json(out / "report.json", report)
    files.write_text(out / "report.html", evaluation_page(report, str(out / "report.json")))
    files.write_text(out / "table.md", plain_markdown(report, tables(report)) + "\n")
    if rows:
        files.write_text(out / "rows.csv", plain_csv(rows))


def _print(args: Args, report: dict[str, Any]) -> None:
    from moonteam.report.tables import plain_markdown, show_plain
    from sim2grid.study.summary import tables

    if args.json:
        print(files.dump_json(report))
    elif args.markdown:
        print(plain_markdown(report, tables(report)))
    else:
        show_plain(report, tables(report))
