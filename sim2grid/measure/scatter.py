"""How ways that were driven scatter about what was reckoned, by kind and steepness."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np

from sim2grid.measure.metrics import Report

STEEP = (0.0, 3.0, 6.0)
"""Degrees at which one class of ways ends and the next begins."""
FEWEST = 8
"""Ways of a class of which a spread is told."""


def scatter(reports: Sequence[Report]) -> list[dict[str, Any]]:
    """A line for each kind and class of steepness, and one for all, about the medians of these.

    `ratio`: median of what ways took over what was reckoned; `spread`: standard deviation of its
    logarithm, which is what `expects: {scatter: ..}` of a mission means. Empty without ways.
    """
    classes: dict[tuple[str, float], list[float]] = {}
    for report in reports:
        for robot in report.robots:
            for way in () if robot.ways is msgspec.UNSET else robot.ways:
                if way.steep_deg is not None and way.took_s > 0.0:
                    low = max(edge for edge in STEEP if edge <= way.steep_deg)
                    classes.setdefault((robot.kind, low), []).append(
                        float(np.log(way.took_s / way.expected_s)))
    lines, rest = [], []
    for (kind, low), logs in sorted(classes.items()):
        if len(logs) < FEWEST:
            continue
        high = next((edge for edge in STEEP if edge > low), None)
        middle = float(np.median(logs))
        lines.append(_line(kind, low, high, logs, float(np.exp(middle))))
        rest += [log - middle for log in logs]
    return [*lines, _line("all", None, None, rest, None)] if lines else []


def _line(kind: str, low: float | None, high: float | None, logs: list[float],
          ratio: float | None) -> dict[str, Any]:
    return {"kind": kind, "from_deg": low, "to_deg": high, "ways": len(logs), "ratio": ratio,
            "spread": float(np.std(logs, ddof=1))}
