"""Figures of the reports, as PNG files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from moonteam import files

INK = "#1f2933"
BLUE, ORANGE, GREEN = "#2867b2", "#d9822b", "#3a8f5c"


def _axes(width: float, height: float, count: int):
    """A figure without a screen, and its axes side by side."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(1, count, squeeze=False)[0]


def bars(path: Path, document: dict, panels: Sequence[tuple[str, str, float]]) -> None:
    """One panel a figure, one dot with its 95 % interval a planner.

    Args:
      path: the PNG.
      document: an evaluation report.
      panels: (key of the summary row, title, factor on the value).

    Where rows say how much of the ground had been seen when (`seen`), one panel more shows that.
    """
    rows = document["summary"]
    panels = [one for one in panels if any(one[0] in row for row in rows)]
    looked = [row for row in rows if "seen" in row]
    count = len(panels) + bool(looked)
    figure, axes = _axes(1.6 + 3.1 * count, max(1.6 + 0.34 * len(rows), 3.2 * bool(looked)), count)
    if looked:
        _coverage(axes[-1], looked)
        axes = axes[:-1]
    places = np.arange(len(rows))[::-1]
    for axis, (key, title, factor) in zip(axes, panels, strict=True):
        for place, row in zip(places, rows, strict=True):
            value, (low, high) = row[key], row["intervals"][key]
            if not np.isfinite(value):
                continue
            axis.plot([factor * low, factor * high], [place, place], color=BLUE, lw=2.5,
                      solid_capstyle="butt", alpha=0.45)
            axis.plot(factor * value, place, "o", color=BLUE, ms=5)
            axis.annotate(f"{factor * value:.3g}", (factor * value, place), color=INK,
                          xytext=(0, 5), textcoords="offset points", ha="center", fontsize=8)
        if key.endswith("gap"):
            axis.axvline(0.0, color=INK, lw=0.8, zorder=0)
        axis.set_title(title, fontsize=10, loc="left", color=INK)
        axis.set_yticks(places, [r["planner"] for r in rows] if axis is axes[0] else [])
        axis.set_ylim(-0.6, len(rows) - 0.2)
        axis.margins(x=0.12)
        if key == "success":
            axis.set_xlim(min(0.9, *(r["intervals"][key][0] for r in rows)) - 0.02, 1.02)
        axis.grid(axis="x", alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    figure.suptitle(document["title"], fontsize=11, x=0.01, ha="left", color=INK)
    with files.replacing(path) as temporary:
        figure.savefig(temporary, dpi=150)


def _coverage(axis: Any, rows: Sequence[dict]) -> None:
    """Mean share of the ground that has been seen over mission seconds, a line a row."""
    for row in rows:
        axis.plot(row["seen"]["seconds"], row["seen"]["share"], lw=1.6, label=row["planner"])
    axis.set_title("share of the ground seen, over seconds", fontsize=10, loc="left", color=INK)
    axis.set_ylim(0.0, 1.02)
    axis.grid(alpha=0.25)
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(fontsize=7, frameon=False, loc="lower right")


LINES = {"exact(makespan)": ("#2867b2", "-", "o"), "exact(moves)": ("#2867b2", "--", "s"),
         "exact(weighted)": ("#2867b2", ":", "^"), "greedy(makespan)": ("#3a8f5c", "-", "o"),
         "exhaustive(makespan)": ("#8a8f98", "-", "x")}


def timing(path: Path, document: dict) -> None:
    """Median seconds against the number of targets, logarithmic, 10 to 90 % shaded."""
    figure, (axis,) = _axes(7.6, 5.0, 1)
    rows = document["rows"]
    policy = iter(("-", "--", ":"))
    for name in dict.fromkeys(row["planner"] for row in rows):
        part = [row for row in rows if row["planner"] == name]
        color, style, mark = LINES.get(name) or (ORANGE, next(policy, "-."), "d")
        places = [row["targets"] for row in part]
        axis.plot(places, [row["seconds"] for row in part], style, color=color, marker=mark,
                  ms=5, label=name)
        axis.fill_between(places, [row["p10"] for row in part], [row["p90"] for row in part],
                          color=color, alpha=0.10, lw=0)
    axis.set_yscale("log")
    axis.set_xticks(sorted({row["targets"] for row in rows}))
    axis.set_xlabel("targets")
    axis.set_ylabel("seconds a call (median, 10 to 90 %)")
    axis.grid(alpha=0.25, which="both")
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.suptitle(document["title"], fontsize=11, x=0.01, ha="left", color=INK)
    with files.replacing(path) as temporary:
        figure.savefig(temporary, dpi=150)


def preference(path: Path, document: dict) -> None:
    """Mean makespan against mean moves over the preference, a line for each planner.

    Without intervals: all points are means over the same scenarios, and differ far less than
    the scenarios do.
    """
    figure, (axis,) = _axes(6.4, 4.6, 1)
    rows = document["rows"]
    styles = {"policy": (ORANGE, "o"), "exact": (BLUE, "s")}
    for name in dict.fromkeys(row["planner"] for row in rows):
        color, mark = styles[name]
        part = [row for row in rows if row["planner"] == name]
        x, y = ([row[key] for row in part] for key in ("moves", "makespan"))
        axis.plot(x, y, "-", color=color, marker=mark, ms=5, lw=1.4, label=name)
        for row in (part[0], part[-1]):
            axis.annotate(f"{row['preference']:g}", (row["moves"], row["makespan"]), color=color,
                          xytext=(6, 6), textcoords="offset points", fontsize=9)
    axis.set_xlabel("mean moves of the team")
    axis.set_ylabel("mean makespan, steps")
    axis.grid(alpha=0.25)
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(fontsize=9, frameon=False)
    figure.suptitle(document["title"], fontsize=11, x=0.01, ha="left", color=INK)
    with files.replacing(path) as temporary:
        figure.savefig(temporary, dpi=150)
