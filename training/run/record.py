"""What a run leaves behind while it goes: metrics.jsonl, its curve, the progress line."""

from __future__ import annotations

import itertools
import json
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from moonteam import files
from moonteam.errors import InputError
from training.run.config import Config

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from rich.console import Console


class Metrics:
    """Appends one JSON object a chunk to `metrics.jsonl`, and its numbers to TensorBoard's events.

    `close` at the end.
    """

    def __init__(self, path: Path, resumed_updates: int, tensorboard: bool = False,
                 earlier: Path | None = None):
        """Keeps the lines of an earlier stretch up to `resumed_updates`, drops later ones.

        `earlier`: where that stretch is, if in another file.
        Raises InputError if TensorBoard is asked for and its writer is not installed.
        """
        writer = tensorboard_writer() if tensorboard else None
        self.path, self.events = path, None
        self.rows = [row for row in read(earlier or path)
                     if row["total_updates"] <= resumed_updates]
        files.write_text(path, "".join(files.dump_json(row) + "\n" for row in self.rows))
        if writer:
            done = self.rows[-1]["env_steps"] if self.rows else 0
            # What an earlier stretch wrote from here on is hidden: it is trained anew.
            self.events = writer(str(path.parent), purge_step=done + 1)

    def add(self, row: dict[str, Any]) -> None:
        """One more line, on disk at once."""
        self.rows.append(row)
        with self.path.open("a", encoding="utf-8") as out:
            out.write(files.dump_json(row) + "\n")
        if self.events:
            for name, value in scalars(row).items():
                self.events.add_scalar(name, value, row["env_steps"])
            self.events.flush()

    def close(self) -> None:
        """Nothing is added after this."""
        if self.events:
            self.events.close()


def tensorboard_writer() -> Any:
    """The class that writes TensorBoard's events. Raises InputError if it is not installed."""
    try:
        from tensorboardX import SummaryWriter
    except ImportError:
        raise InputError("--tensorboard", "needs tensorboardX, which is not installed: "
                         "pip install 'moonteam[tensorboard]'") from None
    return SummaryWriter


def scalars(row: dict[str, Any], prefix: str = "") -> dict[str, float]:
    """The numbers of a row by name; those of a held-out score as argmax/success and so on."""
    found: dict[str, float] = {}
    for key, value in row.items():
        if isinstance(value, dict):
            found |= scalars(value, f"{prefix}{key}/")
        elif isinstance(value, (int, float)):
            found[prefix + key] = value
    return found


def read(path: Path) -> list[dict[str, Any]]:
    """The rows of a metrics file; a half-written last line is left out."""
    rows = []
    for line in files.read_text(path).splitlines() if path.exists() else []:
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            break
    return rows


STANDING = 0.5
"""Success from which on a policy counts as one that can be lost."""
PATIENCE = 3
"""Evaluations in a row that must show the fall."""


def best(rows: list[dict[str, Any]]) -> dict[str, Any] | None:
    """The row of the best evaluation so far, by success of sampled actions; the last of equals."""
    looks = [row for row in rows if "sample" in row]
    return max(reversed(looks), key=lambda row: row["sample"]["success"], default=None)


def collapsed(rows: list[dict[str, Any]], scenarios: int) -> bool:
    """Whether a policy that could do something has lost it, and not for a moment.

    True when the best evaluation solved at least half of the scenarios, and each of the last
    three at most half as many as it, the fall being more than chance explains: four standard
    errors of the difference of two shares of `scenarios`. Sampled actions count, since argmax
    also fails by robots that wait for each other, which comes and goes while all is well. The
    phases are one: they set the same scenarios. A fresh optimiser and new rewards may cost a
    policy something at the start of a phase, which is why one low evaluation is not enough.
    """
    top = best(rows)
    if top is None or top["sample"]["success"] < STANDING:
        return False
    success = top["sample"]["success"]
    low = min(success / 2, success - 4 * math.sqrt(0.5 / scenarios))
    last = [row["sample"]["success"] for row in rows if "sample" in row][-PATIENCE:]
    return len(last) == PATIENCE and max(last) <= low


class Progress:
    """Two live lines on standard error when it is a terminal, else nothing."""

    def __init__(self, config: Config, done: int, console: Console | None = None):
        """`done`: env steps already behind us; `console`: where to show it, if not there."""
        self.bar, self.task, self.score = None, None, ""
        if console is None and not sys.stderr.isatty():
            return
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        total = sum(config.env_steps(phase) for _, phase in config.phases)
        # The estimate must outlive a chunk, which takes minutes where the network is large.
        self.bar = Progress(TextColumn("{task.description}"), BarColumn(bar_width=10),
                            TimeRemainingColumn(), TextColumn("{task.fields[line]}"),
                            console=console or Console(stderr=True), speed_estimate_period=1800)
        self.task = self.bar.add_task(config.name, total=total, completed=done, line="compiling")
        self.bar.start()

    def show(self, row: dict[str, Any]) -> None:
        """Brings the lines up to date with a metrics row."""
        if self.bar is None or self.task is None:
            return
        if "argmax" in row:
            held_out = row["argmax"]
            self.score = (f"held out {held_out['success']:.3f} success, "
                          f"{held_out['makespan']:.1f} makespan, {held_out['moves']:.1f} moves")
        line = f"{row['phase']}, {row['env_steps']:,} env steps, {row['rate']:,.0f}/s"
        self.bar.update(self.task, completed=row["env_steps"],
                        line=f"{line}\n{self.score or 'held out: no evaluation yet'}")

    def stop(self) -> None:
        """Leaves the terminal as it was."""
        if self.bar is not None:
            self.bar.stop()


def draw_curve(path: Path, groups: dict[str, list[list[dict[str, Any]]]]) -> None:
    """Success, makespan and moves over env steps; one colour a group of runs (lists of rows).

    On held-out scenarios: argmax in full, the mean as far as all runs of the group have come,
    with each run as a thin line and a band from the lowest to the highest; sampled actions
    dotted. A run on its own also shows how it did while training.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 3.8), layout="constrained")
    FigureCanvasAgg(figure)
    titles = {"success": "success", "makespan": "makespan, steps", "moves": "moves, whole team"}
    runs = [rows for group in groups.values() for rows in group]
    switches = {r["env_steps"] for rows in runs for a, r in itertools.pairwise(rows)
                if a["phase"] != r["phase"]}
    axes = figure.subplots(1, 3)
    for axis, key in zip(axes, titles, strict=True):
        if len(runs) == 1:
            axis.plot([r["env_steps"] for r in runs[0]], [r[key] for r in runs[0]], color="C0",
                      alpha=0.3, label="while training")
        for index, (name, group) in enumerate(groups.items()):
            _draw_group(axis, key, name, group, f"C{index % 10}")
        for x in switches:
            axis.axvline(x, color="0.7", linewidth=0.8)
        axis.set_xlabel("env steps")
        axis.set_title(f"{titles[key]}, held out")
    figure.legend(*axes[0].get_legend_handles_labels(), fontsize=7, ncols=4,
                  loc="outside lower center")
    with files.replacing(path) as temporary:
        figure.savefig(temporary, dpi=120)


def _draw_group(axis: Axes, key: str, name: str, runs: list[list[dict[str, Any]]],
                colour: str) -> None:
    for decode, style in (("argmax", "-"), ("sample", ":")):
        curves = [{r["env_steps"]: r[decode][key] for r in rows if decode in r} for rows in runs]
        shared = sorted(set.intersection(*map(set, curves)))
        table = np.array([[curve[x] for x in shared] for curve in curves])  # [runs, points]
        axis.plot(shared, table.mean(axis=0), style, color=colour, label=f"{name}, {decode}")
        if decode == "argmax" and len(runs) > 1:
            axis.fill_between(shared, table.min(axis=0), table.max(axis=0), color=colour,
                              alpha=0.15, linewidth=0)
            for curve in curves:
                axis.plot(list(curve), list(curve.values()), color=colour, alpha=0.4,
                          linewidth=0.6)
