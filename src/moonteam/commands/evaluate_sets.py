"""`moonteam evaluate sets`: one policy over all bundled scenario sets, one row a set."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import msgspec
import tyro

from moonteam import compilation, paths
from moonteam.commands.options import Limited, Many, Reported, Seeded


@dataclass(frozen=True)
class Args(Seeded, Limited, Reported):
    """Play the bundled scenario sets with a policy, whatever their teams and targets.

    Columns: decided step by step (argmax with the deadlock watch) at preference 0 and at
    preference 1, and the best of K sampled rollouts at preference 0. Gaps are mean makespan and
    mean moves over the mean optimum, or over the best known values where optima are not proved.

    Files in --out: report.json, summary.csv, rows.csv and table.md.

    Examples:
      moonteam evaluate sets --policy any_team
      moonteam evaluate sets 3x5 3x7 5x20 --policy any_team --limit 50 --json
    """

    sets: tyro.conf.Positional[tuple[str, ...]] = ()
    """Bundled sets or files (.jsonl); all bundled ones if not given."""
    policy: Many[tuple[str, ...]] = ()
    """Policy file (.safetensors) or the name of a bundled policy; again for more. Default:
    any_team."""
    best_of: int = 16
    """K, sampled rollouts a scenario."""


def run(args: Args) -> int:
    """Evaluates, prints, saves; 0 whatever the policy achieved, 130 if interrupted."""
    compilation.enable_cache()
    from moonteam.report import command, provenance, tables

    found = [paths.find(name, "policies", ".safetensors") for name in args.policy or ("any_team",)]
    rows, left = [], [(name, path) for name in args.sets or _bundled() for path in found]
    try:
        while left:
            rows.append(_row(*left[0], args))
            del left[0]
    except KeyboardInterrupt:
        lacking = ", ".join(name for name, _ in left)
        print(f"moonteam: interrupted; the report lacks {lacking}", file=sys.stderr)
    document = {
        "title": "policies on sets", "summary": rows, "rows": [], "rows_are": "set",
        "notes": [f"argmax: with the deadlock watch; best-of-{args.best_of}: planning time is the "
                  "whole set's, played in batches, over its scenarios.",
                  "5x20 and 8x40 are held against the best known plans, the others against "
                  "certified optima. In brackets: 95 % bootstrap intervals."],
        "meta": provenance.meta(command.line("evaluate sets", args), args.seed)}
    columns = _columns(args.best_of)
    if args.out:
        tables.save(args.out, document, columns)
    tables.print_columns(args, document, columns, columns)
    return 130 if left else 0


def _bundled() -> list[str]:
    """Names of all bundled sets, small ones first."""
    index = msgspec.json.decode(paths.find("index", "testsets", ".json").read_bytes())
    return sorted(index, key=lambda name: (index[name]["targets"], index[name]["agents"]))


def _row(name: str, policy: Path, args: Args) -> dict:
    """One set: the figures of three ways to use the policy, side by side."""
    from moonteam.commands.evaluate_grid import load_set, options_of
    from moonteam.evaluation import grid
    from moonteam.evaluation.contenders import called, contenders

    asked = SimpleNamespace(planner=("policy",), objective=(), policy=(str(policy),),
                            time_limit=(), seed=args.seed)
    found = load_set(name, args.limit)
    label = Path(name).stem
    if len(args.policy) > 1:
        label += f", {called(policy)}"
    row: dict = {"planner": label, "scenarios": len(found), "intervals": {}}
    for suffix, wish, decode in (("", 0.0, "argmax"), ("_effort", 1.0, "argmax"),
                                 ("_best", 0.0, f"best-of-{args.best_of}")):
        asked.preference, asked.decode = (wish,), (decode,)
        rows = contenders(options_of(asked))
        got = grid.evaluate(found, rows, args.seed, name, "")["summary"][0]
        for key, value in got.items():
            if isinstance(value, float):
                row[key + suffix] = value
        row["intervals"] |= {key + suffix: pair for key, pair in got["intervals"].items()}
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
