"""Success and gaps of imitated and refined policies, drawn over labelled states."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from moonteam import files
from training.run.trainee import Row


def draw_curve(path: Path, runs: dict[str, list[Row]]) -> None:
    """Success and gaps over labelled states: every family of one run, or the mean of each of
    several runs; of rows without an evaluation nothing is shown.
    """
    from matplotlib import colormaps
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import PercentFormatter

    figure = Figure(figsize=(13, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 3)
    colours = colormaps["tab20"]([*range(0, 20, 2), *range(1, 20, 2)])
    keys = ("success", "makespan_gap", "moves_gap")
    for number, (name, every) in enumerate(runs.items()):
        rows = [row for row in every if "families" in row]
        states = [row["labelled"] / 1e6 for row in rows]
        for axis, key in zip(axes, keys, strict=True):
            table = np.array([[family[key] for family in row["families"]] for row in rows])
            if len(runs) > 1:
                axis.plot(states, table.mean(axis=1), color=colours[number % 20], label=name)
                continue
            for i, family in enumerate(rows[-1]["families"]):
                axis.plot(states, table[:, i], color=colours[i % 20], label=family["family"])
    for axis, title in zip(axes, ("success, argmax, preference 0", "makespan gap, preference 0",
                                  "moves gap, preference 1"), strict=True):
        axis.set_title(title)
        axis.set_xlabel("labelled states, millions")
        axis.grid(alpha=0.3)
        axis.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes[0].set_ylim(min(axes[0].get_ylim()[0], 0.9), 1.005)
    for axis in axes[1:]:
        axis.set_ylim(top=min(axis.get_ylim()[1], 0.5))  # the first looks dwarf the rest
    figure.legend(*axes[0].get_legend_handles_labels(), fontsize=7, ncols=4,
                  loc="outside lower center")
    with files.replacing(path) as temporary:
        figure.savefig(temporary, dpi=110)
