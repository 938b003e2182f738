"""How far runs of any kind are from the optimum, over minutes of training."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from moonteam import files
from training.run.trainee import Row

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis


TITLES = ("success, argmax", "makespan over the optimum, argmax")


def over_minutes(axes: Sequence[Axes], titles: Iterable[str]) -> None:
    """Dresses axes of the success, of the gap to the optimum and of others, over log minutes."""
    from matplotlib.ticker import FuncFormatter, PercentFormatter

    for axis, title in zip(axes, titles, strict=True):
        axis.set_title(title)
        axis.set_xlabel("minutes of training")
        axis.set_xscale("log")
        axis.grid(alpha=0.3, which="both")
        _logarithmic(axis.xaxis, "{x:g}")
    axes[0].yaxis.set_major_formatter(PercentFormatter(1.0))
    axes[1].set_yscale("log")
    # Where little changes, ticks lie closer than a percent.
    _logarithmic(axes[1].yaxis, FuncFormatter(lambda value, _: f"{100 * value:.3g}%"))


def _logarithmic(axis: Axis, form: Any) -> None:
    """Ticks at 1, 2 and 5 of each decade, written by `form`, and none between them."""
    from matplotlib.ticker import LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(form)
    axis.set_minor_formatter(NullFormatter())


def draw_gap(path: Path, groups: dict[str, list[list[Row]]]) -> None:
    """Success, and gap of the makespan to the optimum, over minutes, logarithmic.

    Args:
      path: PNG.
      groups: runs by name, one colour each; their rows hold seconds and gap, the success and the
        gap of an evaluation.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 2)
    for index, (name, runs) in enumerate(groups.items()):
        for number, rows in enumerate(runs):
            looks = [row for row in rows if row["seconds"] > 0]
            minutes = [row["seconds"] / 60 for row in looks]
            for i, axis in enumerate(axes):
                axis.plot(minutes, [row["gap"][i] for row in looks], ".-", color=f"C{index}",
                          alpha=1.0 if len(runs) == 1 else 0.6, label=None if number else name)
    over_minutes(axes, TITLES)
    figure.legend(*axes[0].get_legend_handles_labels(), fontsize=8, ncols=2,
                  loc="outside lower center")
    with files.replacing(path) as temporary:
        figure.savefig(temporary, dpi=120)
