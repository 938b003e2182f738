"""`moonteam train compare`: runs side by side."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from moonteam import files
from moonteam.commands.options import Reported, keeping
from moonteam.commands.options import parse as parse_words
from moonteam.errors import InputError
from training.run.compare import Kind, grouped, listed, notes, plain, read, shared, summary

FILES = ("compare.json", "table.md", "curves.png")
"""In --out."""


@dataclass(frozen=True)
class Args(Reported):
    """Put run folders of `moonteam train` side by side: those of small, laptop and pi_*, those
    of quick, paper_team and any_team, or those of imitate and refine; or unlike ones by what they
    have in common, success and gap to the optimum over minutes.

    Runs that differ only in their seed are one row: the mean over seeds, in brackets the lowest
    and the highest. A row is named by what its numbers differ in from the first of its preset,
    so give the baseline first.

    Files in --out: compare.json, table.md and curves.png.

    Examples:
      moonteam train compare runs/small-*
      moonteam train compare runs/small-* runs/no-memory-* --markdown --out runs/compared
      moonteam train compare runs/small-* runs/no-memory-* --label GRU --label feed-forward
      moonteam train compare runs/quick-0 runs/imitate-quick-0 runs/pi_5t-0 --out runs/compared
    """

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders, finished or not."""
    label: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Name of the first row; again for the second, and so on; all or none."""


def parse(words: list[str]) -> Args:
    """Arguments of `moonteam train compare`."""
    return parse_words(Args, "train compare", words)


def run(args: Args) -> int:
    """Reads, prints, saves; returns the exit code."""
    with keeping(args, FILES):
        return _compare(args)


def _compare(args: Args) -> int:
    from moonteam.report import command, provenance, tables
    from training.mappo.compared import MAPPO
    from training.mappo.macro.compared import MACRO
    from training.teacher.compared import TAUGHT

    if not args.runs:
        raise InputError("RUN", "no run folder is given; at least one is needed")
    found = shared([read(folder, (MAPPO, MACRO, TAUGHT)) for folder in args.runs])
    kind, groups = found[0].kind, grouped(found, args.label)
    meta = provenance.meta(command.line("train compare", args), 0)
    document = {
        "title": "training runs", "rows_are": "run",
        "summary": [summary(name, runs) for name, runs in groups.items()],
        "rows": [plain(name, run) for name, runs in groups.items() for run in runs],
        "notes": notes(groups),
        "meta": meta | {"seed": listed(sorted({run.seed for run in found}))}}
    shown = columns(kind)
    if args.out:
        files.write_json(args.out / "compare.json", document)
        files.write_text(args.out / "table.md", tables.markdown(document, shown) + "\n")
        kind.draw(args.out / "curves.png",
                  {name: [run.rows for run in runs] for name, runs in groups.items()})
    tables.print_columns(args, document, shown, shown)
    return 0


def columns(kind: Kind) -> tuple:
    """Of the printed table."""
    from moonteam.report.tables import Column

    shown = (("seeds", "seeds", 0), ("env_steps", "env steps", 0), *kind.columns,
             ("seconds", "training, s", 0))
    return tuple(Column(key, title, lambda value, digits=digits: f"{value:,.{digits}f}")
                 for key, title, digits in shown)
