"""`moonteam evaluate sets`: policies and planners over all bundled scenario sets, a row a set."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import tyro

from moonteam import compilation, interrupts, paths
from moonteam.commands.options import Limited, Many, Reported, Resumable, Seeded
from moonteam.errors import InputError
from moonteam.planners import registry
from moonteam.planners.kind import DEFAULT_POLICY
from moonteam.report.journal import Kept

POLICY = "policy"
Who = tuple[str, Path | None]
"""A planner, and the policy file where it is the policy."""

FILES = ("config.json", "rows.jsonl", "report.json", "summary.csv", "rows.csv", "table.md")
"""In --out."""


@dataclass(frozen=True)
class Args(Seeded, Limited, Resumable, Reported):
    """Play the bundled scenario sets with a policy or planner, whatever their teams and targets.

    Columns of a policy: decided step by step (argmax with the deadlock watch) at preference 0 and
    at preference 1, and the best of K sampled rollouts at preference 0. Of a planner: least
    makespan, and under preference 1 fewest moves. Gaps are mean makespan and mean moves over the
    mean optimum, or over the best known values where optima are not proved.

    Files in --out: report.json, summary.csv, rows.csv and table.md; and rows.jsonl, to which each
    plan is added as it is made (a policy's batch as a whole), so that --resume goes on.

    Examples:
      moonteam evaluate sets --policy any_team
      moonteam evaluate sets 3x5 3x7 5x20 --policy any_team --limit 50 --json
      moonteam evaluate sets 3x5 8x40 --planner policy --planner lns --time-limit 0.1 --limit 50
    """

    sets: tyro.conf.Positional[tuple[str, ...]] = ()
    """Bundled sets or files (.jsonl); all bundled ones if not given."""
    planner: Many[tuple[str, ...]] = ()
    """policy, auto, exact, greedy, lns, guided, exhaustive, cpsat, routing, another package's, or
    FILE.py:OBJECT; again for more. Default: policy."""
    policy: Many[tuple[str, ...]] = ()
    """Policy file (.safetensors) or the name of a bundled policy; again for more. Default:
    any_team."""
    best_of: int = 16
    """K, sampled rollouts a scenario."""
    time_limit: float | None = None
    """Seconds a scenario that anytime planners (exact, lns, guided, cpsat, ...) may take. Default:
    theirs."""


def run(args: Args) -> int:
    """Evaluates, prints, saves; 0 whatever the policy achieved, 130 if interrupted."""
    compilation.enable_cache()
    from moonteam.report import command, journal, provenance, tables

    found = _who(args)
    sets = args.sets or _bundled()
    _check(found, sets)
    kept = journal.Kept.of(args.out, args.resume, command.figures(args), FILES)
    rows, left = [], [(name, who) for name in sets for who in found]
    try:
        while left:
            rows.append(_row(*left[0], args, len(found) > 1, kept))
            del left[0]
            interrupts.hold()
    except KeyboardInterrupt:
        lacking = ", ".join(name for name, _ in left)
        print(f"moonteam: interrupted; the report lacks {lacking}", file=sys.stderr)
    document = {
        "title": "policies and planners on sets", "summary": rows, "rows": [], "rows_are": "set",
        "notes": ["argmax: with the deadlock watch, of networks that decide step by step; best-of-"
                  f"{args.best_of}: planning time is the whole set's, played in batches, over its "
                  "scenarios.",
                  "5x20 and 8x40 are held against the best known plans, the others against "
                  "certified optima. In brackets: 95 % intervals, of success by Wilson, else "
                  "bootstrap."],
        "meta": provenance.meta(command.line("evaluate sets", args), args.seed)}
    columns = _columns(args.best_of)
    if args.out:
        tables.save(args.out, document, columns)
    tables.print_columns(args, document, columns, columns)
    return interrupts.CODE if left else 0


def _bundled() -> list[str]:
    """Names of the bundled sets that are in no folder, small ones first: all are in steps."""
    index = msgspec.json.decode(paths.find("index", "testsets", ".json").read_bytes())
    return sorted((name for name in index if "/" not in name),
                  key=lambda name: (index[name]["targets"], index[name]["agents"]))


def _who(args: Args) -> list[Who]:
    """Every policy file where the policy is asked for, and the other planners.

    Raises InputError for what there is not.
    """
    found: list[Who] = []
    for name in args.planner or (POLICY,):
        if registry.find(name).name != POLICY:
            found.append((name, None))
            continue
        found += [(name, paths.find(file, "policies", ".safetensors"))
                  for file in args.policy or (DEFAULT_POLICY,)]
    if args.policy and not any(file for _, file in found):
        raise InputError("--policy", f"has no effect without --planner {POLICY}")
    return found


def _check(found: list[Who], sets: Sequence[str]) -> None:
    """Raises InputError, before any is played, for a set that a planner cannot take."""
    from moonteam.commands.evaluate_grid import load_set

    for planner in dict.fromkeys(name for name, _ in found):
        most = registry.find(planner).most_targets
        for name in sets if most is not None else ():
            largest = max(len(one.targets) for one in load_set(name, None))
            if most is not None and largest > most:
                raise InputError(f"--planner {planner}", f"takes up to {most} targets; {name} has "
                                 f"{largest}; name the sets to play")


def _row(name: str, who: Who, args: Args, several: bool, kept: Kept) -> dict:
    """One set: the figures of three ways to use a policy, or two to use a planner."""
    from moonteam.commands.evaluate_grid import load_set, options_of
    from moonteam.evaluation import grid
    from moonteam.evaluation.contenders import called, contenders

    planner, policy = who
    asked = SimpleNamespace(
        planner=(planner,), objective=(), policy=(), preference=(), decode=(), seed=args.seed,
        time_limit=() if args.time_limit is None else (args.time_limit,))
    ways: dict[str, dict[str, Any]] = {"": {"objective": ("makespan",)},
                                       "_effort": {"objective": ("moves",)}}
    if policy is not None:
        asked.policy, asked.time_limit = (str(policy),), ()
        ways = {"": {"preference": (0.0,), "decode": ("argmax",)},
                "_effort": {"preference": (1.0,), "decode": ("argmax",)},
                "_best": {"preference": (0.0,), "decode": (f"best-of-{args.best_of}",)}}
    found = load_set(name, args.limit)
    label = Path(name).stem
    if several:
        label += f", {called(policy) if policy is not None else registry.shown(planner)}"
    row: dict = {"planner": label, "scenarios": len(found), "intervals": {}}
    got: dict = {}
    for suffix, way in ways.items():
        rows = contenders(options_of(SimpleNamespace(**vars(asked) | way)))
        document = grid.evaluate(found, rows, args.seed, name, "",
                                 kept.within(name, label, suffix))
        got = document["summary"][0]
        row |= {key + suffix: got[key] for key in got if isinstance(got[key], float)}
        row["intervals"] |= {key + suffix: pair for key, pair in got["intervals"].items()}
    if policy is None:  # a planner has no best of K
        row |= {f"{key}_best": None for key in got if isinstance(got[key], float)}
        row["intervals"] |= {f"{key}_best": (None, None) for key in got["intervals"]}
    return row


def _columns(best_of: int) -> tuple:
    from moonteam.report.tables import Column, duration, percent

    def plain(value: float) -> str:
        return f"{value:.3f}"

    return (
        Column("success", "success", plain),
        Column("st_ratio", "M_st ratio", plain),
        Column("makespan_gap", "makespan gap", percent),
        Column("seconds", "planning a scenario", duration),
        Column("success_effort", "success, preference 1", plain),
        Column("tte_ratio_effort", "M_tte ratio, preference 1", plain),
        Column("moves_gap_effort", "moves gap, preference 1", percent),
        Column("success_best", f"success, best-of-{best_of}", plain),
        Column("makespan_gap_best", f"makespan gap, best-of-{best_of}", percent),
        Column("seconds_best", f"planning, best-of-{best_of}", duration))
