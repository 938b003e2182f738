"""What macro-MAPPO runs are compared by: success and gap on held-out problems, argmax."""

from __future__ import annotations

from typing import Any

import msgspec

from training.mappo.macro.curve import draw_curve
from training.run.compare import Final, Kind, Line


class FamilyRow(msgspec.Struct, frozen=True):
    """See `training.mappo.macro.held_out.HeldOut.score`."""

    family: str
    success: float
    makespan_gap: float


class MacroLine(Line, frozen=True, kw_only=True):
    """With or without an evaluation."""

    families: list[FamilyRow] | None = None


class MacroFinal(Final, frozen=True, kw_only=True):
    """The last evaluation; `scenarios` of each family."""

    families: list[FamilyRow]


def _ended(config: dict[str, Any], line: MacroLine) -> MacroFinal | None:
    if line.families is None:
        return None
    return MacroFinal(env_steps=line.env_steps, seconds=line.seconds,
                      scenarios=config.get("eval_scenarios", 0), families=line.families)


def _figures(final: MacroFinal) -> dict[str, float]:
    return {key: sum(getattr(row, key) for row in final.families) / len(final.families)
            for key, _, _ in COLUMNS}


COLUMNS = (("success", "success, argmax", 3), ("makespan_gap", "makespan over the optimum", 3))

MACRO = Kind("macro", MacroLine, MacroFinal, _ended, _figures, COLUMNS,
             note="means over the families; failures count with the limit", draw=draw_curve)
