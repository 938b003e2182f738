"""Plans by the clock as a picture: the ways over the ground, and who does what when.

Legend: R robots, M targets, P points of a way.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import msgspec
import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from moonteam import files
from moonteam.planners.plans.figure import COLOURS, INK, PAPER
from moonteam.planners.seconds.base import MS, Service

Floats = npt.NDArray[np.float64]
DRIVES, WAITS = 0.55, 0.12  # heights of bars


class Panel(msgspec.Struct, frozen=True):
    """One plan of the picture."""

    title: str
    ground: Floats  # [rows, columns] 0..1, south first
    box: tuple[float, float, float, float]  # west, east, south, north m
    targets: Floats  # [M, 2] m
    starts: Floats  # [R, 2] m
    ways: list[list[tuple[Floats, float, float]]]  # a robot: points [P, 2] m, leaves, arrives s
    services: tuple[Service, ...]
    makespan: float  # s


def draw_panels(path: str | Path, title: str, panels: Sequence[Panel], robots: Sequence[str],
                targets: Sequence[str]) -> None:
    """Draws one plan, or several side by side on one scale of time, as a PNG."""
    end = max(panel.makespan for panel in panels)
    figure = Figure(figsize=(5.6 * len(panels) + 0.6, 8.2), facecolor=PAPER, layout="constrained")
    with matplotlib.rc_context({"font.family": "DejaVu Sans"}):
        axes = figure.subplots(2, len(panels), squeeze=False,
                               gridspec_kw={"height_ratios": [5, 0.55 * len(robots) + 0.5]})
        for k, panel in enumerate(panels):
            _ways(axes[0, k], panel, targets)
            _bars(axes[1, k], panel, robots, targets, end)
        figure.suptitle(title, color=INK, fontsize=13, fontweight="bold", x=0.02, ha="left")
        with files.replacing(path) as temporary:
            figure.savefig(temporary, dpi=120, facecolor=PAPER)


def _ways(axes: Any, panel: Panel, targets: Sequence[str]) -> None:
    halo = [withStroke(linewidth=2.6, foreground="black")]
    axes.imshow(panel.ground, cmap="gray", vmin=-0.2, vmax=1.1, origin="lower", extent=panel.box)
    for i, ways in enumerate(panel.ways):
        colour = COLOURS[i % len(COLOURS)]
        for points, _, _ in ways:
            axes.plot(*points.T, "-", color=colour, linewidth=2.0, path_effects=halo)
        axes.plot(*panel.starts[i], "o", color=colour, markersize=9, markeredgecolor="white")
    for j, (x, y) in enumerate(panel.targets):
        axes.plot(x, y, "*", color="gold", markersize=14, markeredgecolor="black")
        axes.annotate(targets[j], (x, y), xytext=(7, 5), textcoords="offset points",
                      color="white", fontsize=9, path_effects=halo)
    axes.set_title(f"{panel.title}: {panel.makespan:.0f} s", fontsize=11, color=INK)
    axes.set_xlabel("east, m")
    axes.set_ylabel("north, m")


def _bars(axes: Any, panel: Panel, robots: Sequence[str], targets: Sequence[str], end: float
          ) -> None:
    for i, ways in enumerate(panel.ways):
        colour, row = COLOURS[i % len(COLOURS)], len(robots) - 1 - i
        mine = [one for one in panel.services if i in one.agents]
        for _, leaves, arrives in ways:
            axes.barh(row, arrives - leaves, DRIVES, left=leaves, color=colour)
        for (_, _, arrives), one in zip(ways, mine, strict=False):  # the way home serves nothing
            starts, ends = one.start / MS, one.end / MS
            axes.barh(row, starts - arrives, WAITS, left=arrives, color="0.6")
            axes.barh(row, ends - starts, DRIVES, left=starts, color=colour, alpha=0.45,
                      hatch="///")
            axes.plot(ends, row, "*", color="gold", markersize=11, markeredgecolor="black")
            axes.annotate(targets[one.target], (ends, row + 0.33), fontsize=7.5, color=INK,
                          ha="center")
    axes.set_xlim(0, 1.04 * end)
    axes.set_ylim(-0.5, len(robots) - 0.3)
    axes.set_yticks(range(len(robots)), list(reversed(robots)))
    axes.set_xlabel("mission seconds")
    axes.axvline(panel.makespan, color=INK, linestyle=":", linewidth=1.0)
