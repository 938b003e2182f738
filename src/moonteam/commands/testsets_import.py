"""`moonteam testsets import`: instances that others publish, as a set by the clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from moonteam import files, outputs
from moonteam.commands.options import Forced, Limited, Printed
from moonteam.errors import InputError
from moonteam.problem import timed
from moonteam.problem.timed import Timed


@dataclass(frozen=True)
class Args(Limited, Forced, Printed):
    """Reads a folder of others' instances and writes a set that `evaluate` takes.

    Each problem keeps its own name as id, says where it comes from in `source`, and holds in
    `optimal.published` what was published of it, by method. The set is written whole or not at
    all. Formats: dcmrta, heteromrta, mrta-benchmark, another package's, or FILE.py:OBJECT;
    docs/peers.md says where the folders are.

    Examples:
      moonteam testsets import testSet_20A_50T_CONDET --format dcmrta --out dcmrta.jsonl
      moonteam testsets import RALTestSet --format heteromrta --out heteromrta.jsonl
      moonteam testsets import dataset_optimal_8t3r3s --format mrta-benchmark --out mrta.jsonl
    """

    folder: tyro.conf.Positional[Path]
    """The folder, as their repository has it."""
    format: str
    """How it is written: dcmrta, heteromrta, mrta-benchmark, or FILE.py:OBJECT."""
    out: Path
    """The set to write (.jsonl)."""


def run(args: Args) -> int:
    """Reads, writes and says what was read; returns 0."""
    from moonteam.problem.importers import IMPORTERS

    importer = IMPORTERS.get(args.format, "--format")
    if args.out.suffix != ".jsonl":
        raise InputError("--out", f"{args.out} is not allowed; a set ends in .jsonl")
    if args.limit is not None and args.limit < 1:
        raise InputError("--limit", f"{args.limit} is not allowed; at least 1")
    with outputs.file(args.out, args.force):
        found = importer.read(args.folder)[:args.limit]
        if not found:
            raise InputError(args.folder, f"holds no instance of {importer.name}")
        timed.save_set(args.out, found)
    said = describe(found)
    if args.json:
        print(files.dump_json({"set": str(args.out), **said}))
        return 0
    print(f"{args.out}: {said['problems']} problems, {span(said['agents'])} agents, "
          f"{span(said['targets'])} targets, {len(said['skills'])} skills; {said['optima']} optima")
    for name, row in said["published"].items():
        print(f"published, {name}: {row['problems']} problems, mean makespan {row['mean']:.3f}")
    return 0


def describe(found: Sequence[Timed]) -> dict:
    """What a set holds: sizes as [least, most], and the mean of each published column."""
    published: dict[str, list[float]] = {}
    for problem in found:
        for name, value in (problem.optimal.published if problem.optimal else {}).items():
            published.setdefault(name, []).append(value)
    agents, targets = ([len(getattr(problem, key)) for problem in found]
                       for key in ("agents", "targets"))
    return {
        "problems": len(found), "agents": [min(agents), max(agents)],
        "targets": [min(targets), max(targets)],
        "skills": sorted({skill for problem in found for skill in problem.skill_names}),
        "optima": sum(p.optimal is not None and p.optimal.makespan is not None for p in found),
        "published": {name: {"problems": len(values), "mean": sum(values) / len(values)}
                      for name, values in published.items()}}


def span(ends: Sequence[int]) -> str:
    """Such as 3, or 3 to 5."""
    least, most = ends
    return str(least) if least == most else f"{least} to {most}"
