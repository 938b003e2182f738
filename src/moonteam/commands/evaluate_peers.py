"""`moonteam evaluate peers`: our planners beside what others published on their instances."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import tyro

from moonteam import compilation, files, interrupts, loading, paths
from moonteam.commands.options import Limited, Many, Reported, Resumable, Seeded
from moonteam.errors import InputError
from moonteam.problem.timed import Timed

FILES = ("config.json", "rows.jsonl", "peers.json", "table.md", "rows.csv")
"""In --out."""


@dataclass(frozen=True)
class Args(Seeded, Limited, Resumable, Reported):
    """Plan others' instances and hold the makespans against the published ones, one by one.

    Means and paired differences have 95 % bootstrap intervals; beside them in how many problems
    a plan of ours is shorter, equal (to a hundredth) or longer. Makespans are in each set's own
    unit of time. Every plan of ours is judged by the rules before it counts.

    Without SETS, the bundled beginnings of three sets (docs/peers.md says where the rest is and
    how it is read). Options marked "again" may be given several times.

    Files in --out: peers.json, table.md and rows.csv; and rows.jsonl, to which each plan is added
    as it is made, so that --resume goes on.

    Examples:
      moonteam evaluate peers
      moonteam evaluate peers dcmrta.jsonl --planner lns --time-limit 1 --time-limit 10
      moonteam evaluate peers peers/mrta-benchmark --planner exact --json
      moonteam evaluate peers --planner lns --planner policy --policy mine.safetensors
    """

    sets: tyro.conf.Positional[tuple[str, ...]] = ()
    """Sets by the clock with published results (.jsonl), or names of bundled ones; the bundled
    ones if not given."""
    planner: Many[tuple[str, ...]] = ()
    """Planner by the clock (policy is one), or FILE.py:OBJECT; again for more. Default: exact on
    sets of at most 10 targets, and lns."""
    time_limit: Many[tuple[float, ...]] = ()
    """Seconds a problem that anytime planners may take; again for more. Default: theirs; lns: 1."""
    threads: int = 1
    """That lns by the clock searches with side by side."""
    policy: Many[tuple[str, ...]] = ()
    """For --planner policy: policy file (.safetensors) or the name of a bundled policy; again for
    more. Default: any_team."""
    decode: Many[tuple[str, ...]] = ()
    """For --planner policy: argmax, sample, best-of-K such as best-of-16; @T sets the temperature
    of drawing; again for more rows. Default: argmax."""


def bundled() -> tuple[str, ...]:
    """Names of the bundled beginnings of others' sets."""
    folder = paths.assets() / "testsets" / "peers"
    return tuple(f"peers/{path.stem}" for path in sorted(folder.glob("*.jsonl")))


def load(name: str, limit: int | None) -> list[Timed]:
    """A set by the clock with published results. Raises InputError."""
    found = loading.load_set(paths.find(name, "testsets", ".jsonl"))[:limit]
    problems = [one for one in found if isinstance(one, Timed)]
    if not problems:
        raise InputError(name, "is in steps; a set by the clock is needed")
    if not any(one.optimal and one.optimal.published for one in problems):
        raise InputError(name, "holds nothing published to compare with (optimal.published)")
    return problems


def run(args: Args) -> int:
    """Plans, compares, prints, saves; 0 whatever came out, 130 if interrupted."""
    if args.limit is not None and args.limit < 1:
        raise InputError("--limit", f"{args.limit} is not allowed; at least 1")
    compilation.enable_cache()
    from moonteam.commands.evaluate_grid import options_of
    from moonteam.evaluation import peers
    from moonteam.report import command, journal, provenance, tables

    sets = {Path(name).stem: load(name, args.limit) for name in args.sets or bundled()}
    asked = replace(options_of(args), planners=args.planner)
    rows = {name: peers.contenders(found, asked)
            for name, found in sets.items()}
    kept = journal.Kept.of(args.out, args.resume, command.figures(args), FILES)
    done, lacking = peers.run_all(sets, rows, args.seed, kept)
    document: dict = {
        "title": "beside others", "sets": [part["summary"] for part in done],
        "rows": [row for part in done for row in part["rows"]],
        "notes": [note for part in done for note in part["notes"]] + peers.NOTES,
        "meta": provenance.meta(command.line("evaluate peers", args), args.seed),
    } | ({"interrupted": lacking} if lacking else {})
    shown = peers.tables(document)
    if args.out:
        tables.save_plain(args.out, "peers", document, shown)
        files.write_text(args.out / "rows.csv", tables.plain_csv(peers.flat(document["rows"])))
    tables.print_plain(args, document, shown)
    if not lacking:
        return 0
    print(f"moonteam: interrupted; the report lacks {', '.join(lacking)}", file=sys.stderr)
    return interrupts.CODE
