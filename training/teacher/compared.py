"""What imitation and refinement runs are compared by: success and true gaps, mean over families."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from training.run.compare import Final, Kind, Line
from training.run.trainee import Row
from training.teacher.curve import draw_curve
from training.teacher.pupil import SCENARIOS


class FamilyRow(msgspec.Struct, frozen=True):
    """See `training.teacher.scores.family_row`."""

    family: str
    success: float
    makespan_gap: float
    success_effort: float
    moves_gap: float


class TaughtLine(Line, frozen=True, kw_only=True):
    """With or without an evaluation."""

    families: list[FamilyRow] | None = None


class TaughtFinal(Final, frozen=True, kw_only=True):
    """The last evaluation; `scenarios` of each family."""

    families: list[FamilyRow]


def _ended(config: dict[str, Any], line: TaughtLine) -> TaughtFinal | None:
    if line.families is None:
        return None
    return TaughtFinal(env_steps=line.env_steps, seconds=line.seconds, scenarios=SCENARIOS,
                       families=line.families)


def _figures(final: TaughtFinal) -> dict[str, float]:
    return {key: sum(getattr(row, key) for row in final.families) / len(final.families)
            for key, _, _ in COLUMNS}


def _draw(path: Path, groups: dict[str, list[list[Row]]]) -> None:
    draw_curve(path, {name if len(group) == 1 else f"{name} ({number})": rows
                      for name, group in groups.items() for number, rows in enumerate(group, 1)})


COLUMNS = (("success", "success, preference 0", 3), ("makespan_gap", "makespan gap", 3),
           ("success_effort", "success, preference 1", 3), ("moves_gap", "moves gap", 3))

TAUGHT = Kind(
    "preset", TaughtLine, TaughtFinal, _ended, _figures, COLUMNS,
    note="means over the families; failures count with the horizon, and with a move of every robot "
    "at each of its steps", draw=_draw)
