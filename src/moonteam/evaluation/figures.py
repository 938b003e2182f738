"""Figures of the reports, as PNG files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

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
    """
    rows = document["summary"]
    width = 1.6 + 3.1 * len(panels)
    figure, axes = _axes(width, 1.6 + 0.34 * len(rows), len(panels))
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
