"""Success and gap of macro-MAPPO runs, drawn over minutes of training."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from moonteam import files
from training.run.curve import TITLES, over_minutes
from training.run.trainee import Row


def draw_curve(path: Path, groups: dict[str, list[list[Row]]]) -> None:
    """Success and gap to the optimum on held-out problems; one colour a group of runs.

    Of one run every family; of several groups the mean over families, each run a thin line.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 3)
    runs = [rows for group in groups.values() for rows in group]
    for index, (name, group) in enumerate(groups.items()):
        for number, rows in enumerate(group):
            looks = [row for row in rows if "families" in row and row["seconds"] > 0]
            minutes = [row["seconds"] / 60 for row in looks]
            for axis, key in zip(axes[:2], ("success", "makespan_gap"), strict=True):
                table = np.array([[f[key] for f in row["families"]] for row in looks])
                if len(runs) == 1:
                    for i, family in enumerate(looks[-1]["families"]):
                        axis.plot(minutes, table[:, i], color=f"C{i}", label=family["family"])
                else:
                    axis.plot(minutes, table.mean(axis=1), color=f"C{index}",
                              alpha=1.0 if len(group) == 1 else 0.6,
                              label=name if number == 0 else None)
            made = [row for row in rows if "entropy" in row]
            axes[2].plot([row["seconds"] / 60 for row in made], [row["entropy"] for row in made],
                         color=f"C{index}" if len(runs) > 1 else "0.3")
    worth = any("worth_served" in f for row in runs[0] for f in row.get("families", ()))
    gap = "hindsight's worth over what is served, argmax" if worth else TITLES[1]
    over_minutes(axes, (TITLES[0], gap, "entropy of a choice"))
    axes[0].set_ylim(min(axes[0].get_ylim()[0], 0.98), 1.001)
    figure.legend(*axes[0].get_legend_handles_labels(), fontsize=7, ncols=4,
                  loc="outside lower center")
    with files.replacing(path) as temporary:
        figure.savefig(temporary, dpi=120)
