"""What imitation and refinement runs are compared by: success and true gaps, mean over families."""

from __future__ import annotations

from pathlib import Path

import msgspec

from training.run import families
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


def _draw(path: Path, groups: dict[str, list[list[Row]]]) -> None:
    draw_curve(path, {name if len(group) == 1 else f"{name} ({number})": rows
                      for name, group in groups.items() for number, rows in enumerate(group, 1)})


TAUGHT = families.kind(
    "preset", FamilyRow,
    (("success", "success, preference 0", 3), ("makespan_gap", "makespan gap", 3),
     ("success_effort", "success, preference 1", 3), ("moves_gap", "moves gap", 3)),
    "means over the families; failures count with the horizon, and with a move of every robot "
    "at each of its steps", _draw, lambda config: SCENARIOS)
