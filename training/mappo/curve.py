"""Success, makespan and moves of MAPPO runs, drawn over env steps."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from moonteam import files
from training.run.trainee import Row

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_curve(path: Path, groups: dict[str, list[list[Row]]]) -> None:
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


def _draw_group(axis: Axes, key: str, name: str, runs: list[list[Row]],
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
