"""Plots of the HTML pages, as SVG text on the pages' dark ground."""

from __future__ import annotations

import io
import math
import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from moonteam import files
from sim2grid.frame import tilt
from sim2grid.measure.story import Story
from sim2grid.show.picture import (
    BARRED,
    GREY,
    INK,
    NIGHT,
    OPEN,
    REPLAN,
    SOLVED,
    STATES,
    Color,
    Ground,
    hillshade,
    requirement,
    robot_color,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH = 9.6  # inches, of a plot as wide as the page
DIM = (70, 78, 96)
SERIES: tuple[Color, ...] = (
    (159, 180, 216), (222, 190, 140), (150, 200, 170), (205, 155, 185), (176, 176, 176))
"""Colours of what is compared: robots keep theirs to themselves."""
MOST_POINTS = 600  # of a line


def hexed(color: Color) -> str:
    """#rrggbb."""
    return "#{:02x}{:02x}{:02x}".format(*color)


def timeline(story: Story) -> str:
    """What each robot was doing when: moving, waiting, late, lost; targets solved, new plans."""
    names = [robot.name for robot in story.mission.robots]
    figure, (axis,) = _axes(WIDTH, 0.9 + 0.42 * len(names), 1)
    end = story.record.seconds()
    for i in range(len(names)):
        axis.barh(i, end, height=0.12, color=hexed(DIM), left=0.0)
    for leg in story.record.legs:
        if leg.moving and leg.end_s is not None:
            late = leg.ended == "timeout"
            axis.barh(leg.robot, leg.end_s - leg.start_s, left=leg.start_s, height=0.5,
                      color=hexed(STATES["late"] if late else robot_color(leg.robot)),
                      edgecolor=hexed(NIGHT), linewidth=0.8)
    for loss in story.record.losses:
        axis.barh(loss.robot, end - loss.time_s, left=loss.time_s, height=0.5,
                  color=hexed(NIGHT), edgecolor=hexed(GREY), hatch="////", linewidth=0.0)
        axis.plot(loss.time_s, loss.robot, "x", color=hexed(OPEN), ms=9, mew=2.5)
    for solve in story.record.solves:
        name = story.record.target_names[solve.target]
        axis.axvline(solve.time_s, color=hexed(SOLVED), lw=1.0, alpha=0.6, zorder=0)
        axis.plot([solve.time_s] * len(solve.robots), solve.robots, "s", color=hexed(SOLVED), ms=7)
        axis.annotate(name, (solve.time_s, 1.0), xycoords=("data", "axes fraction"), rotation=30,
                      ha="left", va="bottom", fontsize=8, color=hexed(SOLVED))
    for replan in story.replans:
        place = len(names) - 0.5 if replan.robot is None else replan.robot + 0.36
        axis.plot(replan.time_s, place, "D", color=hexed(REPLAN), ms=5, clip_on=False)
    axis.set_yticks(range(len(names)), names)
    for label, i in zip(axis.get_yticklabels(), range(len(names)), strict=True):
        label.set_color(hexed(robot_color(i)))
    axis.set_ylim(len(names) - 0.5, -0.5)
    axis.set_xlim(0.0, end * 1.01 + 0.01)
    axis.set_xlabel("mission time, s")
    return svg(figure)


def paths(story: Story, ground: Ground, barred: npt.NDArray[np.bool_] | None = None) -> Figure:
    """The map with every way: axes and a scale in metres, starts, planned and driven ways,
    targets by state, new plans.

    `barred` [H, W] are cells that some robot cannot enter.
    """
    from matplotlib.lines import Line2D
    from matplotlib.patches import Rectangle

    frame, record = story.frame, story.record
    half = np.array(frame.size) * frame.cell_m / 2
    side = 8.4 * half / half.max()
    figure, (axis,) = _axes(side[0] + 0.8, side[1] + 1.2, 1)
    _ground(axis, ground, half)
    for y, x in np.argwhere(barred) if barred is not None else ():
        axis.add_patch(Rectangle((x * frame.cell_m - half[0], y * frame.cell_m - half[1]),
                                 frame.cell_m, frame.cell_m, color=hexed(BARRED), alpha=0.45, lw=0))
    for leg in record.legs:
        axis.plot(*zip(leg.start_xy, leg.waypoint, strict=True), lw=6, alpha=0.3,
                  color=hexed(robot_color(leg.robot)))
    for i, path in enumerate(story.paths):
        color = hexed(robot_color(i))
        axis.plot(*path.T, color=color, lw=1.8)
        axis.plot(*path[0], "o", ms=9, mfc=hexed(NIGHT), mec=color, mew=2.0)
        known = path[np.isfinite(path).all(axis=1)]
        axis.plot(*known[-1], "o", ms=9, mfc=color, mec=hexed(NIGHT), mew=1.0)
    for j, target in enumerate(record.targets):
        color = hexed(SOLVED if any(s.target == j for s in record.solves) else OPEN)
        centre = frame.centre(np.array(target.at, float))
        axis.add_patch(Rectangle(centre - 0.46 * frame.cell_m, 0.92 * frame.cell_m,
                                 0.92 * frame.cell_m, fill=False, ec=color, lw=2.0))
        _named(axis, f"{record.target_names[j]} {requirement(target)}", centre, color)
    for replan in story.replans:
        if replan.xy is not None:
            axis.plot(*replan.xy, "D", color=hexed(REPLAN), mec=hexed(NIGHT), ms=7)
    _scale(axis, half)
    kinds = [Line2D([], [], color=hexed(INK), lw=6, alpha=0.3, label="planned"),
             Line2D([], [], color=hexed(INK), label="driven"),
             Line2D([], [], color=hexed(INK), marker="o", ls="", mfc=hexed(NIGHT), label="start")]
    team = [Line2D([], [], color=hexed(robot_color(i)), lw=3, label=robot.name)
            for i, robot in enumerate(story.mission.robots)]
    axis.legend(handles=team + kinds, ncols=6, loc="upper center", bbox_to_anchor=(0.5, -0.07),
                frameon=False, labelcolor=hexed(INK), fontsize=9)
    return figure


def _ground(axis: Axes, ground: Ground, half: npt.NDArray) -> None:
    """Hill shade under a map of `half` widths [2] m, with axes in metres."""
    reach = (np.array(ground.heights.shape[::-1]) - 1) * ground.spacing / 2
    axis.imshow(hillshade(ground), cmap="gray", vmin=0, vmax=255,
                origin="lower", extent=(-reach[0], reach[0], -reach[1], reach[1]))
    axis.set_xlim(-half[0], half[0])
    axis.set_ylim(-half[1], half[1])
    axis.set_aspect("equal")
    axis.grid(False)
    axis.set_xlabel("east, m")
    axis.set_ylabel("north, m", color=hexed(INK), fontsize=8)


def _named(axis: Axes, text: str, at: npt.NDArray, color: str) -> None:
    """A name under a target, or above it in the south, where there would be no room."""
    from matplotlib.patheffects import withStroke

    low, high = axis.get_ylim()
    below = at[1] - low > 0.08 * (high - low)
    axis.annotate(text, tuple(at), xytext=(0, -14 if below else 14), textcoords="offset points",
                  ha="center", va="top" if below else "bottom", fontsize=9, fontweight="bold",
                  color=color, path_effects=[withStroke(linewidth=2.5, foreground=hexed(NIGHT))])


def _scale(axis: Axes, half: npt.NDArray) -> None:
    """A bar of about a fifth of the map, in a length that is easily read."""
    wanted = 0.4 * float(half[0])
    power = 10.0 ** math.floor(math.log10(wanted))
    length = max(power * n for n in (1, 2, 5) if power * n <= wanted)
    x, y = 0.95 * half[0] - length, -0.95 * half[1]
    axis.plot([x, x + length], [y, y], color=hexed(INK), lw=4, solid_capstyle="butt")
    axis.annotate(f"{length:g} m", (x + length / 2, y), xytext=(0, 5), ha="center",
                  textcoords="offset points", fontsize=9, color=hexed(INK))


def save_png(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Writes a figure as PNG, whole or not at all."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    with files.replacing(path) as temporary:
        FigureCanvasAgg(figure).figure.savefig(temporary, format="png", dpi=120,
                                               facecolor=hexed(NIGHT))


def motion(story: Story, bases: Sequence[int]) -> str:
    """Speed, tilt and distance to the waypoint of each robot over time."""
    figure, axes = _axes(WIDTH, 5.2, 3, rows=True)
    rows = _thinned(len(story.times))
    times = story.times[rows]
    for i, base in enumerate(bases):
        color = hexed(robot_color(i))
        axes[0].plot(times, [story.speed(i, t) for t in times], color=color, lw=1.2,
                     label=story.mission.robots[i].name)
        axes[1].plot(times, np.degrees(tilt(story.qpos[rows, base + 3:base + 7])), color=color,
                     lw=1.2)
        goals = np.array([story.state(i, t)[1] for t in times])
        axes[2].plot(times, np.hypot(*(story.paths[i][rows] - goals).T), color=color, lw=1.2)
    for axis, title in zip(axes, ("speed, m/s", "tilt, degrees", "distance to the waypoint, m"),
                           strict=True):
        axis.set_title(title, loc="left", fontsize=9, color=hexed(INK))
        axis.set_ylim(bottom=0.0)
        axis.set_xlim(0.0, max(float(times[-1]), 0.01))
    axes[0].legend(ncols=8, loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False,
                   labelcolor=hexed(INK), fontsize=8)
    axes[2].set_xlabel("mission time, s")
    return svg(figure)


def intervals(names: Sequence[str], panels: Sequence[tuple[str, Sequence[Any]]]) -> str:
    """One panel a figure, one dot with its interval a name.

    Args:
      names: of the rows.
      panels: (title, (value, low, high) a row); None for no value.
    """
    figure, axes = _axes(WIDTH, 0.8 + 0.36 * len(names), len(panels))
    places = np.arange(len(names))[::-1]
    for axis, (title, values) in zip(axes, panels, strict=True):
        for place, value in zip(places, values, strict=True):
            if value is None or value[0] is None:
                continue
            mean, low, high = value
            if low is not None and high is not None:
                axis.plot([low, high], [place, place], color=hexed(SERIES[0]), lw=4,
                          alpha=0.45, solid_capstyle="butt")
            axis.plot(mean, place, "o", color=hexed(SERIES[0]), ms=6)
            axis.annotate(f"{mean:.3g}", (mean, place), xytext=(0, 6), ha="center",
                          textcoords="offset points", fontsize=8, color=hexed(INK))
        axis.set_title(title, loc="left", fontsize=9, color=hexed(INK))
        axis.set_yticks(places, names if axis is axes[0] else [])
        axis.set_ylim(-0.6, len(names) - 0.2)
        axis.margins(x=0.15)
        if title == "success":
            axis.set_xlim(min(axis.get_xlim()[0], 0.9), 1.03)
    return svg(figure)


def histograms(title: str, groups: Mapping[str, Sequence[float]]) -> str:
    """Shares of one figure's values, a row a group, on common bins."""
    kept = {name: np.asarray(values, float) for name, values in groups.items() if len(values)}
    if not kept:
        return ""
    figure, axes = _axes(WIDTH / 2, 0.7 + 0.62 * len(kept), len(kept), rows=True)
    every = np.concatenate(list(kept.values()))
    low, high = float(every.min()), float(every.max())
    bins = np.linspace(low, high if high > low else low + 1.0, 31).tolist()
    for axis, (name, values) in zip(axes, kept.items(), strict=True):
        axis.hist(values, bins=bins, color=hexed(SERIES[0]), alpha=0.85)
        axis.axvline(float(np.median(values)), color=hexed(INK), lw=1.2)
        axis.set_yticks([])
        axis.set_title(f"{name}: median {np.median(values):.3g}", loc="right", fontsize=8,
                       color=hexed(INK), pad=2)
    axes[-1].set_xlabel(title)
    return svg(figure)


def curves(columns: Sequence[tuple[str, dict[str, Sequence[tuple[float, Any]]],
                                   dict[str, Sequence[tuple[float, Any]]]]]) -> Figure:
    """Success above, seconds below, a column for each quantity that was varied.

    Each column: (what was varied, success, seconds); lines by name, their points
    (x, (value, low, high)), the second None where nothing was measured.
    """
    figure, axes = _axes(WIDTH * max(1.0, len(columns) / 4), 4.4, 2 * len(columns), grid_rows=2)
    most = len(columns)
    for k, (title, *both) in enumerate(columns):
        for axis, lines in zip((axes[k], axes[most + k]), both, strict=True):
            for i, (name, points) in enumerate(lines.items()):
                kept = [(x, v) for x, v in points if v is not None and v[0] is not None]
                if not kept:
                    continue
                x = [point[0] for point in kept]
                mean, low, high = np.array([point[1] for point in kept], float).T
                color = hexed(SERIES[i % len(SERIES)])
                axis.plot(x, mean, "o-", color=color, ms=4, lw=1.5, label=name)
                axis.fill_between(x, low, high, color=color, alpha=0.18, lw=0)
        axes[k].set_ylim(-0.03, 1.05)
        axes[most + k].set_ylim(bottom=0.0)
        axes[most + k].set_xlabel(title)
    for axis, label in ((axes[0], "success"), (axes[most], "mission seconds")):
        axis.set_ylabel(label, fontsize=8, color=hexed(INK))
    if len(columns[0][1]) > 1:
        axes[0].legend(frameon=False, labelcolor=hexed(INK), fontsize=8, loc="lower left")
    return figure


def _thinned(count: int) -> npt.NDArray[np.int64]:
    """At most MOST_POINTS rows out of `count`, first and last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, MOST_POINTS)).astype(int))


def _axes(width: float, height: float, count: int, rows: bool = False, grid_rows: int = 1
          ) -> tuple[Figure, list[Axes]]:
    """A figure without a screen on a dark ground, its axes side by side in `grid_rows` or,
    `rows`, stacked.
    """
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained", facecolor=hexed(NIGHT))
    FigureCanvasSVG(figure)
    shape = (count, 1) if rows else (grid_rows, count // grid_rows)
    grid = figure.subplots(*shape, squeeze=False, sharex=rows).ravel()
    for axis in grid:
        axis.set_facecolor(hexed(NIGHT))
        axis.tick_params(colors=hexed(STATES["waiting"]), labelsize=8)
        axis.xaxis.label.set_color(hexed(INK))
        axis.xaxis.label.set_fontsize(8)
        axis.grid(axis="x", color=hexed(DIM), alpha=0.5, lw=0.6)
        axis.set_axisbelow(True)
        for side, spine in axis.spines.items():
            spine.set_visible(side in ("left", "bottom"))
            spine.set_color(hexed(DIM))
    return figure, list(grid)


def svg(figure: Figure) -> str:
    """The figure as SVG text; the same figure gives the same text."""
    import matplotlib

    out = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "moonteam", "font.family": "DejaVu Sans"}):
        figure.savefig(out, format="svg", metadata={"Date": None}, facecolor=hexed(NIGHT))
    return out.getvalue()
