"""`moonteam train compare`: MAPPO runs side by side, those that differ only in the seed as one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import tyro

from moonteam import files
from moonteam.commands.options import Reported
from moonteam.commands.options import parse as parse_words
from moonteam.errors import InputError
from training.run import record

KEYS = ("success", "makespan", "moves")
DECODES = ("argmax", "sample")


@dataclass(frozen=True)
class Args(Reported):
    """Put run folders of `moonteam train` (presets small, laptop and pi_*) side by side.

    Runs that differ only in their seed are one row: the mean over seeds, in brackets the lowest
    and the highest. A row is named by what its numbers differ in from the first of its preset,
    so give the baseline first.

    Files in --out: compare.json, table.md and curves.png.

    Examples:
      moonteam train compare runs/small-*
      moonteam train compare runs/small-* runs/no-memory-* --markdown --out runs/compared
      moonteam train compare runs/small-* runs/no-memory-* --label GRU --label feed-forward
    """

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders, finished or not."""
    label: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Name of the first row; again for the second, and so on; all or none."""


class Score(msgspec.Struct, frozen=True):
    """Held-out figures; see `training.mappo.held_out.Score`."""

    success: float
    makespan: float
    moves: float


class Row(msgspec.Struct, frozen=True):
    """What is used of a line of metrics.jsonl; the three figures are those while training."""

    phase: str
    env_steps: int
    seconds: float
    success: float
    makespan: float
    moves: float
    argmax: Score | None = None
    sample: Score | None = None


class Final(msgspec.Struct, frozen=True):
    """What is used of report.json; of an unfinished run, its last evaluation."""

    env_steps: int
    seconds: float
    scenarios: int
    argmax: Score
    sample: Score
    device: str | None = None
    commit: str | None = None


@dataclass(frozen=True)
class Trained:
    """One run folder."""

    folder: Path
    config: dict[str, Any]  # flat: "refinement.weights.AR"
    rows: list[dict[str, Any]]
    final: Final
    finished: bool

    @property
    def seed(self) -> int:
        """Of everything random in it."""
        return self.config["seed"]


def parse(words: list[str]) -> Args:
    """Arguments of `moonteam train compare`."""
    return parse_words(Args, "train compare", words)


def run(args: Args) -> int:
    """Reads, prints, saves; returns the exit code."""
    from moonteam.report import command, provenance, tables

    if not args.runs:
        raise InputError("RUN", "no run folder is given; at least one is needed")
    groups = grouped([read(folder) for folder in args.runs], args.label)
    seeds = sorted({run.seed for runs in groups.values() for run in runs})
    document = {
        "title": "training runs", "rows_are": "run",
        "summary": [summary(name, runs) for name, runs in groups.items()],
        "rows": [_plain(name, run) for name, runs in groups.items() for run in runs],
        "notes": notes(groups),
        "meta": provenance.meta(command.line("train compare", args), 0) | {"seed": _listed(seeds)}}
    if args.out:
        files.write_json(args.out / "compare.json", document)
        files.write_text(args.out / "table.md", tables.markdown(document, columns()) + "\n")
        record.draw_curve(args.out / "curves.png",
                          {name: [run.rows for run in runs] for name, runs in groups.items()})
    tables.print_columns(args, document, columns(), columns())
    return 0


def read(folder: Path) -> Trained:
    """A run folder. Raises InputError if it holds no MAPPO run, or one without an evaluation."""
    config = files.read_json(folder / "config.json", dict[str, Any])
    if not isinstance(config.get("name"), str) or not isinstance(config.get("seed"), int):
        raise InputError(folder, "is no run of the presets small, laptop or pi_*; only those "
                         "are compared")
    metrics = folder / "metrics.jsonl"
    rows = record.read(metrics)
    checked = files.convert(rows, list[Row], metrics)
    ended = folder / "report.json"
    if ended.exists():
        return Trained(folder, flat(config), rows, files.read_json(ended, Final), True)
    for row in reversed(checked):
        if row.argmax and row.sample:
            final = Final(row.env_steps, row.seconds, config.get("eval_scenarios", 0),
                          row.argmax, row.sample)
            return Trained(folder, flat(config), rows, final, False)
    raise InputError(metrics, "holds no evaluation on held-out scenarios yet")


def flat(config: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """One level, keys joined by dots, as the options of `moonteam train` are called."""
    pairs: dict[str, Any] = {}
    for key, value in config.items():
        pairs |= (flat(value, f"{prefix}{key}.") if isinstance(value, dict)
                  else {prefix + key: value})
    return pairs


def grouped(runs: list[Trained], labels: tuple[str, ...] = ()) -> dict[str, list[Trained]]:
    """Runs that differ only in their seed, under one name, in the order given.

    Raises InputError if a group holds a seed twice or the labels are not one a group.
    """
    groups: dict[str, list[Trained]] = {}
    for run in runs:
        same = groups.setdefault(files.dump_json(sorted(_seedless(run).items())), [])
        for other in same:
            if other.seed == run.seed:
                raise InputError(run.folder, f"is the same run as {other.folder}, seed {run.seed} "
                                 "included; each is to be given once")
        same.append(run)
    found = list(groups.values())
    if labels and len(set(labels)) != len(found):
        raise InputError("--label", f"{len(found)} different names are needed, for "
                         + "; ".join(_names(found)))
    return dict(zip(labels or _names(found), found, strict=True))


def _seedless(run: Trained) -> dict[str, Any]:
    return {key: value for key, value in run.config.items() if key != "seed"}


def _names(groups: list[list[Trained]]) -> list[str]:
    """The preset, and what differs from the first group of that preset."""
    first: dict[str, dict[str, Any]] = {}
    names = []
    for runs in groups:
        config = _seedless(runs[0])
        base = first.setdefault(config["name"], config)
        odd = [key for key in base | config if base.get(key) != config.get(key)]
        names.append(", ".join([config["name"], *(f"{k}={config.get(k)}" for k in odd)]))
    return names


def summary(name: str, runs: list[Trained]) -> dict[str, Any]:
    """Means over the seeds, with lowest and highest as `intervals`; a row of the table."""
    values = {"env_steps": [run.final.env_steps for run in runs],
              "seconds": [run.final.seconds for run in runs]}
    for decode in DECODES:
        for key in KEYS:
            values[f"{decode}_{key}"] = [getattr(getattr(r.final, decode), key) for r in runs]
    row: dict[str, Any] = {"planner": name, "seeds": len(runs)}
    row |= {key: sum(found) / len(found) for key, found in values.items()}
    row["intervals"] = {key: (min(found), max(found)) for key, found in values.items()
                        if len(runs) > 1 and not (key == "env_steps" and len(set(found)) == 1)}
    return row


def notes(groups: dict[str, list[Trained]]) -> list[str]:
    """What the table does not say: seeds, scenarios, unfinished runs, where they were trained."""
    runs = [run for group in groups.values() for run in group]
    done = [run for run in runs if run.finished]
    lines = ["Held-out figures; failures count with max_steps and their real moves. In brackets: "
             "lowest and highest over seeds.",
             "Seeds: " + "; ".join(f"{name}: {_listed(sorted(run.seed for run in group))}"
                                   for name, group in groups.items()) + "."]
    if done:
        scenarios = sorted({run.final.scenarios for run in done})
        commits = sorted({run.final.commit or "unknown" for run in done})
        devices = sorted({run.final.device or "unknown" for run in done})
        lines.append(f"On {_listed(scenarios)} scenarios at the end of training; trained at commit "
                     f"{_listed(commits)} on {_listed(devices)}.")
    lines += [f"{run.folder} is not finished: its last evaluation, on {run.final.scenarios} "
              f"scenarios after {run.final.env_steps:,} env steps."
              for run in runs if not run.finished]
    return lines


def _listed(values: list[Any]) -> str:
    whole = len(values) > 2 and all(isinstance(value, int) for value in values)
    if whole and values == list(range(values[0], values[0] + len(values))):
        return f"{values[0]} to {values[-1]}"
    return ", ".join(map(str, values))


def _plain(name: str, run: Trained) -> dict[str, Any]:
    return {"group": name, "folder": run.folder, "seed": run.seed, "finished": run.finished,
            **msgspec.structs.asdict(run.final)}


def columns() -> tuple:
    """Of the printed table."""
    from moonteam.report.tables import Column

    def fixed(digits: int):
        return lambda value: f"{value:,.{digits}f}"

    return (
        Column("seeds", "seeds", fixed(0)),
        Column("env_steps", "env steps", fixed(0)),
        Column("argmax_success", "success, argmax", fixed(3)),
        Column("sample_success", "success, sampled", fixed(3)),
        Column("argmax_makespan", "mean T, argmax", fixed(2)),
        Column("sample_makespan", "mean T, sampled", fixed(2)),
        Column("argmax_moves", "mean moves, argmax", fixed(2)),
        Column("sample_moves", "mean moves, sampled", fixed(2)),
        Column("seconds", "training, s", fixed(0)))
