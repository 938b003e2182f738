"""Makespans of a guide's held-out searches against those of the plain guide, over minutes."""

from __future__ import annotations

from pathlib import Path

from moonteam import files
from training.run.trainee import Row


def draw_curve(path: Path, rows: list[Row]) -> None:
    """A line a practice; below zero the learned guide is ahead."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import PercentFormatter

    figure = Figure(figsize=(9.5, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axis = figure.subplots()
    looks = [row for row in rows if "practices" in row]
    minutes = [row["seconds"] / 60 for row in looks]
    for i, practice in enumerate(looks[-1]["practices"] if looks else []):
        axis.plot(minutes, [row["practices"][i]["over_plain"] for row in looks],
                  label=practice["practice"])
    axis.axhline(0.0, color="0.5", linewidth=0.8)
    axis.set_xlabel("minutes of training")
    axis.set_title("makespan over the plain guide's in as much time")
    axis.yaxis.set_major_formatter(PercentFormatter(1.0))
    axis.grid(alpha=0.3)
    figure.legend(fontsize=7, loc="outside right upper")
    with files.replacing(path) as temporary:
        figure.savefig(temporary, dpi=110)
