"""What a run leaves behind while it goes: metrics.jsonl, its curve, the progress line."""

from __future__ import annotations

import itertools
import json
import sys
from pathlib import Path
from typing import Any

from moonteam import files
from training.config import Config


class Metrics:
    """Appends one JSON object a chunk to `metrics.jsonl`."""

    def __init__(self, path: Path, resumed_updates: int):
        """Keeps the lines of an earlier stretch up to `resumed_updates`, drops later ones."""
        self.path = path
        self.rows = [row for row in read(path) if row["total_updates"] <= resumed_updates]
        files.write_text(path, "".join(files.dump_json(row) + "\n" for row in self.rows))

    def add(self, row: dict[str, Any]) -> None:
        """One more line, on disk at once."""
        self.rows.append(row)
        with self.path.open("a", encoding="utf-8") as out:
            out.write(files.dump_json(row) + "\n")


def read(path: Path) -> list[dict[str, Any]]:
    """The rows of a metrics file; a half-written last line is left out."""
    rows = []
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else []:
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            break
    return rows


class Progress:
    """A live line on standard error when it is a terminal, else nothing."""

    def __init__(self, config: Config, done: int):
        """`done`: env steps already behind us."""
        self.bar, self.task = None, None
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

            total = sum(config.env_steps(phase) for _, phase in config.phases)
            self.bar = Progress(TextColumn("{task.description}"), BarColumn(),
                                TimeRemainingColumn(), TextColumn("{task.fields[line]}"),
                                console=Console(stderr=True))
            self.task = self.bar.add_task(config.name, total=total, completed=done,
                                          line="compiling")
            self.bar.start()
        self.score = ""

    def show(self, row: dict[str, Any]) -> None:
        """Brings the line up to date with a metrics row."""
        if "argmax" in row:
            held_out = row["argmax"]
            self.score = (f"held-out success {held_out['success']:.3f} makespan "
                          f"{held_out['makespan']:.1f} moves {held_out['moves']:.1f}")
        if self.bar is not None and self.task is not None:
            line = (f"{row['phase']} {row['env_steps']:,} env steps, {row['rate']:,.0f}/s, "
                    f"success {row['success']:.3f}  {self.score}")
            self.bar.update(self.task, completed=row["env_steps"], line=line)

    def stop(self) -> None:
        """Leaves the terminal as it was."""
        if self.bar is not None:
            self.bar.stop()


def draw_curve(path: Path, runs: dict[str, list[dict[str, Any]]]) -> None:
    """Success, makespan and moves over env steps; one line a run, held-out argmax in full."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 3)
    for axis, key in zip(axes, ("success", "makespan", "moves"), strict=True):
        for index, (name, rows) in enumerate(runs.items()):
            color = f"C{index}"
            scored = [row for row in rows if "argmax" in row]
            axis.plot([r["env_steps"] for r in rows], [r[key] for r in rows], color=color,
                      alpha=0.3, label=f"{name}, while training")
            for decode, style in (("argmax", "-"), ("sample", ":")):
                axis.plot([r["env_steps"] for r in scored], [r[decode][key] for r in scored],
                          style, color=color, label=f"{name}, held out, {decode}")
            switch = [r["env_steps"] for a, r in itertools.pairwise(rows)
                      if a["phase"] != r["phase"]]
            for x in switch:
                axis.axvline(x, color="0.7", linewidth=0.8)
        axis.set_xlabel("env steps")
        axis.set_title({"success": "success", "makespan": "makespan, steps",
                        "moves": "moves, whole team"}[key])
    axes[0].legend(fontsize=7)
    with files.replacing(path) as temporary:
        figure.savefig(temporary, dpi=120)
