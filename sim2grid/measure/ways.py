"""Ways that robots drove to their ends by the clock: how long they took beside what was reckoned.

Legend: P points of a way. Metres, seconds.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from moonteam.robots.base import Height
from sim2grid.loop.record import SETTING_OUT, Leg, Record

SPACING = 0.5
"""m between the points at which a way's steepness is taken."""


class WayReport(msgspec.Struct, frozen=True):
    """One way of a robot, from where it set out or turned to where it went."""

    expected_s: float  # by the travel field, and what setting out and coming to rest cost its kind
    took_s: float
    steep_deg: float | None  # mean of the ground's slope along it, up or down; None: not known


def ways_driven(record: Record, robot: int, settle: float, height: Height | None = None
                ) -> tuple[WayReport, ...]:
    """The ways that a robot drove to their ends; none of those that it was called away from.

    `settle` is what setting out and coming to rest cost it, s.
    """
    ways: list[list[Leg]] = []
    for leg in record.legs:
        if leg.robot == robot and leg.expected_s is not None:
            if leg.action == SETTING_OUT:
                ways.append([])
            ways[-1].append(leg)
    found = []
    for pieces in ways:
        expected = sum(leg.expected_s or 0.0 for leg in pieces)
        if expected > 0.0 and all(leg.ended == "arrived" for leg in pieces):
            took = sum((leg.end_s or leg.start_s) - leg.start_s for leg in pieces)
            found.append(WayReport(round(settle + expected, 4), round(took, 4),
                                   None if height is None else _steepness(pieces, height)))
    return tuple(found)


def _steepness(pieces: list[Leg], height: Height) -> float | None:
    """Degrees, the mean over the straight pieces by their lengths."""
    rise = run = 0.0
    for leg in pieces:
        begin, end = np.asarray(leg.start_xy, float), np.asarray(leg.waypoint, float)
        metres = float(np.hypot(*(end - begin)))
        count = max(2, math.ceil(metres / SPACING) + 1)
        tall = height(begin + np.linspace(0.0, 1.0, count)[:, None] * (end - begin))  # [P]
        rise, run = rise + float(np.abs(np.diff(tall)).sum()), run + metres
    return round(math.degrees(math.atan2(rise, run)), 2) if run > 0.0 else None
