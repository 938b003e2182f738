"""What macro-MAPPO runs are compared by: success and gap on held-out problems, argmax."""

from __future__ import annotations

import msgspec

from training.mappo.macro.curve import draw_curve
from training.run import families


class FamilyRow(msgspec.Struct, frozen=True):
    """See `training.mappo.macro.held_out.HeldOut.score`."""

    family: str
    success: float
    makespan_gap: float


MACRO = families.kind(
    "macro", FamilyRow,
    (("success", "success, argmax", 3), ("makespan_gap", "makespan over the optimum", 3)),
    "means over the families; failures count with the limit", draw_curve,
    lambda config: config.get("eval_scenarios", 0))
