"""Run folders side by side, those that differ only in the seed as one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from moonteam import files
from moonteam.errors import InputError
from training.run import metrics
from training.run.curve import draw_gap
from training.run.trainee import Row


class Line(msgspec.Struct, frozen=True, kw_only=True):
    """What is used of every line of metrics.jsonl; kinds add to it."""

    phase: str
    env_steps: int
    seconds: float


class Final(msgspec.Struct, frozen=True, kw_only=True):
    """What is used of every report.json; of an unfinished run, its last evaluation."""

    env_steps: int
    seconds: float
    scenarios: int
    device: str | None = None
    commit: str | None = None


@dataclass(frozen=True)
class Kind:
    """How runs of one kind are told, read and shown."""

    name_key: str
    """Key of config.json that holds the preset; only this kind has it."""
    line: type[Line]
    final: type[Final]
    ended: Callable[[dict[str, Any], Any], Any]
    """Config and a line with an evaluation -> what a report would say; None without one."""
    figures: Callable[[Any], dict[str, float]]
    """Of a `final`, those of the table."""
    columns: tuple[tuple[str, str, int], ...]
    """Of the table: figure, title, digits."""
    note: str
    """How failures count."""
    draw: Callable[[Path, dict[str, list[list[Row]]]], None]
    """Curves of groups of runs."""
    gap: Callable[[Row], tuple[float, float] | None]
    """Of a line: success and gap of the makespan to the optimum, argmax, held out; None where it
    holds no evaluation or the optimum is not known."""


@dataclass(frozen=True)
class Trained:
    """One run folder."""

    folder: Path
    kind: Kind
    preset: str  # that it was started from
    config: dict[str, Any]  # flat: "refinement.weights.AR"
    rows: list[Row]
    final: Final
    finished: bool

    @property
    def seed(self) -> int:
        """Of everything random in it."""
        return self.config["seed"]


def read(folder: Path, kinds: tuple[Kind, ...]) -> Trained:
    """A run folder. Raises InputError if it holds no run, or one without an evaluation."""
    config = files.read_json(folder / "config.json", dict[str, Any])
    kind = next((k for k in kinds if isinstance(config.get(k.name_key), str)), None)
    if kind is None or not isinstance(config.get("seed"), int):
        raise InputError(folder, "is no run of the presets small, laptop, pi_*, quick, paper_team "
                         "or any_team, nor one of imitate or refine as they are written now")
    path, ended = folder / "metrics.jsonl", folder / "report.json"
    rows = metrics.read(path)
    checked = files.convert(rows, list[kind.line], path)
    preset = config[kind.name_key]
    if ended.exists():
        final = files.read_json(ended, kind.final)
        return Trained(folder, kind, preset, flat(config), rows, final, True)
    for line in reversed(checked):
        if final := kind.ended(config, line):
            return Trained(folder, kind, preset, flat(config), rows, final, False)
    raise InputError(path, "holds no evaluation on held-out scenarios yet")


def shared(runs: list[Trained]) -> list[Trained]:
    """The runs as of one kind: their own, or what unlike kinds have in common.

    Raises InputError where a run lacks that: its problems have no known optimum.
    """
    if all(run.kind is runs[0].kind for run in runs):
        return runs
    for run in runs:
        if not any(run.kind.gap(row) for row in run.rows):
            raise InputError(run.folder, f"preset {run.preset} is judged by other figures than "
                             "those beside it, and its gap to the optimum is not in its "
                             "metrics.jsonl; compare them apart")
    return [replace(run, kind=COMMON, final=_last_gap(run), rows=[
        {"seconds": row["seconds"], "gap": found} for row in run.rows
        if (found := run.kind.gap(row))]) for run in runs]


class GapFinal(Final, frozen=True, kw_only=True):
    """What all kinds have in common."""

    success: float
    makespan_gap: float


def _last_gap(run: Trained) -> GapFinal:
    """At the last evaluation, of a finished run too: some judge the end on other scenarios."""
    row, found = next((row, found) for row in reversed(run.rows) if (found := run.kind.gap(row)))
    final = run.final
    return GapFinal(env_steps=row["env_steps"], seconds=row["seconds"], device=final.device,
                    scenarios=run.config.get("eval_scenarios", final.scenarios),
                    commit=final.commit, success=found[0], makespan_gap=found[1])


COMMON = Kind(
    "", Line, GapFinal, lambda config, line: None,
    lambda final: {"success": final.success, "makespan_gap": final.makespan_gap},
    columns=(("success", "success, argmax", 3), ("makespan_gap", "makespan over the optimum", 3)),
    note="at the last evaluation of each run, on its own problems; failures count with the limit",
    draw=draw_gap, gap=lambda row: row["gap"])
"""Of runs that are judged differently."""


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
        base = first.setdefault(runs[0].preset, config)
        odd = [key for key in base | config if base.get(key) != config.get(key)]
        names.append(", ".join([runs[0].preset, *(f"{k}={config.get(k)}" for k in odd)]))
    return names


def summary(name: str, runs: list[Trained]) -> dict[str, Any]:
    """Means over the seeds, with lowest and highest as `intervals`; a row of the table."""
    each = [{"env_steps": r.final.env_steps, "seconds": r.final.seconds}
            | r.kind.figures(r.final) for r in runs]
    values = {key: [found[key] for found in each] for key in each[0]}
    row: dict[str, Any] = {"planner": name, "seeds": len(runs)}
    row |= {key: sum(found) / len(found) for key, found in values.items()}
    row["intervals"] = {key: (min(found), max(found)) for key, found in values.items()
                        if len(runs) > 1 and not (key == "env_steps" and len(set(found)) == 1)}
    return row


def notes(groups: dict[str, list[Trained]]) -> list[str]:
    """What the table does not say: seeds, scenarios, unfinished runs, where they were trained."""
    runs = [run for group in groups.values() for run in group]
    done = [run for run in runs if run.finished]
    lines = [f"Held-out figures; {runs[0].kind.note}. In brackets: lowest and highest over seeds.",
             "Seeds: " + "; ".join(f"{name}: {listed(sorted(run.seed for run in group))}"
                                   for name, group in groups.items()) + "."]
    if done:
        scenarios = sorted({run.final.scenarios for run in done})
        commits = sorted({run.final.commit or "unknown" for run in done})
        devices = sorted({run.final.device or "unknown" for run in done})
        lines.append(f"On {listed(scenarios)} scenarios at the end of training; trained at commit "
                     f"{listed(commits)} on {listed(devices)}.")
    lines += [f"{run.folder} is not finished: its last evaluation, on {run.final.scenarios} "
              f"scenarios after {run.final.env_steps:,} env steps."
              for run in runs if not run.finished]
    return lines


def listed(values: list[Any]) -> str:
    """Numbers in a row as a range."""
    whole = len(values) > 2 and all(isinstance(value, int) for value in values)
    if whole and values == list(range(values[0], values[0] + len(values))):
        return f"{values[0]} to {values[-1]}"
    return ", ".join(map(str, values))


def plain(name: str, run: Trained) -> dict[str, Any]:
    """One run of a group as a row of the document."""
    return {"group": name, "folder": run.folder, "seed": run.seed, "finished": run.finished,
            **msgspec.structs.asdict(run.final)}
