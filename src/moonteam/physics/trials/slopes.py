"""How steep a robot can go: straight drives up, down and across planes of a known slope.

A drive begins on level ground, meets a plane of SLOPED m, and ends on level ground again
(up, down) or still on the plane (across). Roughness is self-affine relief laid over it.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from moonteam.physics.trials.traverse import Route, Traverse, run_traverses, summarise
from moonteam.robots.base import RobotKind
from moonteam.terrain.site import SPACING, Site, rough_ground

SLOPED, LEVEL = 8.0, 2.5  # m, of a drive's 13 m: on the plane, and before and after it
BLEND = 4.0  # m over which level ground turns into a plane to be crossed
HALF_LENGTH, HALF_WIDTH = 9.0, 4.0  # m, of the ground
LANE = 1.5  # m, drives start up to this far to either side of the middle


def incline(degrees: float, across: bool, roughness_m: float, seed: int) -> Site:
    """A plane that rises to the east between level ends, or to the north from the west end on."""
    shape = tuple(round(2 * half / SPACING) + 1 for half in (HALF_WIDTH, HALF_LENGTH))
    y, x = (SPACING * (np.arange(n) - (n - 1) / 2) for n in shape)
    grade = math.tan(math.radians(degrees))
    if across:
        share = np.clip((x + SLOPED / 2 + BLEND / 2) / BLEND, 0.0, 1.0)
        heights = grade * y[:, None] * (share * share * (3 - 2 * share))[None, :]
    else:
        rise = grade * np.clip(x + SLOPED / 2, 0.0, SLOPED)
        heights = np.tile(rise, (len(y), 1))
    if roughness_m > 0.0:
        heights = heights + rough_ground((len(y), len(x)), roughness_m, seed, SPACING)
    return Site(f"incline {degrees:g}", seed, heights.astype(np.float32), SPACING)


def routes(way: str, count: int, rng: np.random.Generator) -> list[Route]:
    """Straight drives beside each other, each facing its goal."""
    end = SLOPED / 2 + LEVEL
    ends, yaw = ((end, -end), math.pi) if way == "down" else ((-end, end), 0.0)
    return [Route((ends[0], float(y)), (ends[1], float(y)), yaw)
            for y in rng.uniform(-LANE, LANE, count)]


def measure(kind: RobotKind, degrees: float, roughness_m: float, count: int, seed: int, *,
            threads: int = 0) -> list[dict[str, Any]]:
    """A summary of `count` drives for each way; on level ground there is one way only."""
    rng = np.random.default_rng(seed)
    rows: list[dict[str, Any]] = []
    for ways in (("up", "down"), ("across",)) if degrees else (("level",),):
        site = incline(degrees, ways == ("across",), roughness_m, seed)
        drawn = [route for way in ways for route in routes(way, count, rng)]
        found, _ = run_traverses(kind, site, drawn, threads=threads)
        rows += [_row(found[i * count:(i + 1) * count], degrees, way, roughness_m)
                 for i, way in enumerate(ways)]
    return rows


def _row(found: list[Traverse], degrees: float, way: str, roughness_m: float) -> dict[str, Any]:
    head = {"degrees": degrees, "way": way, "roughness_m": roughness_m}
    highest = max(max(r.progress_m for r in found), 0.0)
    return head | summarise(found) | {"farthest_m": highest}
