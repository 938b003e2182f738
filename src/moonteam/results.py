"""What the calls of `moonteam.api` give back: rows for tables, pictures for notebooks."""

from __future__ import annotations

import html
import importlib
import json
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from moonteam import files
from moonteam.errors import InputError
from moonteam.report.markup import data_uri, table

if TYPE_CHECKING:
    from sim2grid.loop.record import Record
    from sim2grid.measure.metrics import Report, RobotReport, TargetReport

Row = dict[str, Any]
"""Flat: numbers, words, yes and no, None."""

LARGEST_VIDEO = 20_000_000
"""Bytes up to which a video is put into a notebook."""


def flat(row: dict[str, Any]) -> Row:
    """The row with what is nested under names with dots: gap.0, intervals.success.1."""
    out: Row = {}
    for key, value in row.items():
        if isinstance(value, (list, tuple)):
            value = {str(i): inner for i, inner in enumerate(value)}
        if isinstance(value, dict):
            out |= {f"{key}.{name}": inner for name, inner in flat(value).items()}
        else:
            out[key] = value
    return out


def frame(rows: Sequence[Row]) -> Any:
    """The rows as a pandas.DataFrame. Raises InputError where pandas is not installed."""
    try:
        return importlib.import_module("pandas").DataFrame(list(rows))
    except ModuleNotFoundError as error:
        if error.name != "pandas":
            raise
        raise InputError("to_pandas", "pandas is not installed; pip install pandas, or take "
                         "rows as they are") from None


class Evaluation(dict):
    """Planners side by side: the document of `moonteam evaluate grid --json`, or of `evaluate
    execution --json`, a dict.

    Args:
      document: the document.
      rows: its rows where they are flat otherwise than under names with dots.
    """

    def __init__(self, document: dict[str, Any], rows: Sequence[Row] | None = None):
        super().__init__(document)
        self._rows = rows

    @property
    def rows(self) -> list[Row]:
        """One a planner and scenario; of executions one a contender and mission, as rows.csv."""
        return [flat(row) for row in self["rows"]] if self._rows is None else list(self._rows)

    @property
    def summary(self) -> list[Row]:
        """One a planner, of executions one a site and contender; intervals.KEY.0 and .1 are the
        ends of the 95 % interval of KEY.
        """
        return [flat(row) for row in self["summary"]]

    def to_pandas(self) -> Any:
        """`rows` as a pandas.DataFrame. Raises InputError where pandas is not installed."""
        return frame(self.rows)

    def _repr_html_(self) -> str:
        shown = [{k: v for k, v in row.items() if "." not in k and v is not None}
                 for row in self.summary]
        head = list(dict.fromkeys(key for row in shown for key in row))
        notes = "".join(f"<li>{html.escape(note)}</li>" for note in self["notes"])
        return (f"<b>{html.escape(self['title'])}</b>"
                + _table(head, ([row.get(key) for key in head] for row in shown))
                + f"<ul>{notes}</ul>")


@dataclass(frozen=True)
class Training:
    """A run that reached its end. It is a path too, its folder's."""

    folder: Path
    report: dict[str, Any]
    """`report.json`."""
    rows: list[Row] = field(repr=False)
    """The curve, `metrics.jsonl`: one row a chunk of updates, held-out scores where they were
    taken; `seconds` and `env_steps` so far."""

    @classmethod
    def of(cls, folder: Path) -> Training:
        """Reads the folder of a run."""
        lines = (folder / "metrics.jsonl").read_text(encoding="utf-8").splitlines()
        return cls(folder, files.read_json(folder / "report.json", dict[str, Any]),
                   [flat(json.loads(line)) for line in lines])

    @property
    def policy(self) -> Path:
        """The policy's file, for `planner="policy", policy=run.policy`."""
        return self.folder / "policy.safetensors"

    def __fspath__(self) -> str:
        return os.fspath(self.folder)

    def to_pandas(self) -> Any:
        """`rows` as a pandas.DataFrame. Raises InputError where pandas is not installed."""
        return frame(self.rows)

    def _repr_html_(self) -> str:
        said = [(key, value) for key, value in flat(self.report).items()
                if isinstance(value, (str, int, float))]
        return (f"<b>{html.escape(str(self.report.get('preset', '')))}</b>, "
                f"{html.escape(str(self.policy))}" + _picture(self.folder / "curve.png")
                + _table(("", ""), said))


@dataclass(frozen=True)
class Rollout:
    """A mission that was driven in physics."""

    report: Report
    """`report.json`: SI units."""
    record: Record = field(repr=False)
    """All that happened: `times` and `qpos` in chunks, `legs`, `decisions`, `solves`, `losses`."""
    folder: Path
    film: Callable[[Path], None] = field(repr=False)
    """Draws the film into a file."""
    video: Path | None = None
    """The film, if it was made."""

    @property
    def success(self) -> bool:
        """Whether every target was solved."""
        return self.report.success

    @property
    def seconds(self) -> float:
        """Of the mission."""
        return self.report.seconds

    @property
    def targets(self) -> tuple[TargetReport, ...]:
        """What became of each target."""
        return self.report.targets

    @property
    def robots(self) -> tuple[RobotReport, ...]:
        """What each robot did."""
        return self.report.robots

    def save_video(self, path: str | os.PathLike[str] | None = None) -> Path:
        """Makes the film, video.mp4 in the folder by default; returns its path.

        Where no 3-D pictures can be made it is of the map alone, and standard error says so.
        Raises InputError for a name that is not one of an .mp4.
        """
        to = self.folder / "video.mp4" if path is None else Path(path)
        if to.suffix != ".mp4":
            raise InputError(to, "is not allowed; a name that ends with .mp4", "save_video")
        self.film(to)
        object.__setattr__(self, "video", to)
        return to

    def _repr_html_(self) -> str:
        report = self.report
        end = "success" if report.success else f"failed: {report.detail or report.cause}"
        title = (f"<b>{html.escape(report.mission)}</b>: {html.escape(end)}, "
                 f"{report.seconds:.1f} s, {html.escape(report.planner)}")
        targets = _table(("target", "solved", "s", "by"), (
            (one.name, one.solved, one.time_s, ", ".join(one.robots)) for one in report.targets))
        robots = _table(("robot", "kind", "m", "J", "lost"), (
            (one.name, one.kind, one.distance_m, one.energy_j, one.lost)
            for one in report.robots))
        seen = _video(self.video) or _picture(self.folder / "paths.png")
        return title + seen + targets + robots


def _table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    return table(head, rows, lambda value: f"{value:.4g}")


def _inside(path: Path | None, kind: str) -> str:
    """A file's content as an address; empty where it is not there, or too large."""
    if path is None or not path.is_file() or path.stat().st_size > LARGEST_VIDEO:
        return ""
    return data_uri(path.read_bytes(), kind)


def _picture(path: Path) -> str:
    address = _inside(path, "image/png")
    return f'<br><img style="max-width:480px" src="{address}"><br>' if address else "<br>"


def _video(path: Path | None) -> str:
    address = _inside(path, "video/mp4")
    return f'<br><video controls style="max-width:640px" src="{address}"></video><br>' \
        if address else ""
