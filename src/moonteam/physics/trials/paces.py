"""How soil slows each kind: straight drives up, down and across planes of regolith.

What comes out is what travel fields believe of a kind on that soil (`robots.base.Pace`), by the
same few numbers as on rigid ground: speed on the level, the share of it lost on the steepest slope
it is sent over, that slope.

Legend: B drives, T log samples, C treads.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from moonteam.physics.trials.slopes import LEVEL, SLOPED, incline, routes
from moonteam.physics.trials.traverse import BEARS, SAMPLE_SECONDS, Route, under_way
from moonteam.robots.base import Pace, RobotKind
from moonteam.terrain.site import Site
from moonteam.terrain.soil import Soil

WAYS = ("up", "down", "across")
WATCHED = 3.0
"""m to either side of a plane's middle between which a drive is measured."""

PATIENCE = 5.0
"""Times the time that a drive takes at the kind's own speed."""

SLOWEST = 0.4
"""The steepest slope that a kind is sent over is where it climbs at this share of its speed on the
level: below that a plan by the clock is a guess, and wheels dig in.
"""

ROUGHNESS = 0.02
"""rms height of the relief laid over a plane, m."""

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Drive:
    """Means over drives on one plane, one way."""

    degrees: float
    way: str
    through: int  # drives that crossed what is watched
    count: int
    speed_mps: float  # nan where none did
    slip: float | None  # of wheels; None: the kind has none
    sinkage_m: float
    energy_j_per_m: float


def measure(kind: RobotKind, soil: Soil, degrees: Sequence[float], count: int = 3, seed: int = 0,
            backend: str = "native", threads: int = 0) -> list[Drive]:
    """`count` drives a slope and way; on level ground one way."""
    rng = np.random.default_rng(seed)
    found = []
    for slope in degrees:
        for way in WAYS if slope else ("level",):
            across = way == "across"
            site = replace(incline(slope, across, ROUGHNESS, seed), soil=soil)
            # Across, the plane begins behind a blend.
            begin, end = (0.0, WATCHED) if across else (-WATCHED, WATCHED)
            found.append(_drive(kind, site, slope, way, routes(way, count, rng), (begin, end),
                                backend, threads))
    return found


def _drive(kind: RobotKind, site: Site, degrees: float, way: str, drives: Sequence[Route],
           watched: tuple[float, float], backend: str, threads: int) -> Drive:
    longest = PATIENCE * (SLOPED + 2 * LEVEL) / kind.speed
    _, seconds = under_way(kind, site, drives, backend, threads)
    logs = []
    for _, (_, log) in zip(range(math.ceil(longest)), seconds, strict=False):
        logs.append([np.asarray(part) for part in log])
        x = logs[-1][0][:, -1, 0]
        if (x < watched[0]).all() if way == "down" else (x > watched[1]).all():
            break
    qpos, power, _, treads = (np.concatenate(parts, axis=1) for parts in zip(*logs, strict=True))
    return _row(kind, degrees, way, qpos[..., 0], power[..., 0], treads, watched)


def _row(kind: RobotKind, degrees: float, way: str, x: Floats, power: Floats, treads: Floats,
         watched: tuple[float, float]) -> Drive:
    """From x [B, T] m, power [B, T] W and what treads told [B, T, C, 3]."""
    inside = (x >= watched[0]) & (x <= watched[1])
    done = (x < watched[0]).any(axis=1) if way == "down" else (x > watched[1]).any(axis=1)
    speed, slip, depth, energy = [], [], [], []
    for b in np.flatnonzero(done):
        at = inside[b]
        seconds = at.sum() * SAMPLE_SECONDS
        # Along the slope; across it there is none.
        metres = (watched[1] - watched[0]) / (
            1.0 if way == "across" else math.cos(math.radians(degrees)))
        speed.append(metres / seconds)
        energy.append(power[b][at].sum() * SAMPLE_SECONDS / metres)
        borne = treads[b][at][..., 2] > BEARS
        slip.append(float(treads[b][at][..., 0][borne].mean()))
        depth.append(float(treads[b][at][..., 1][borne].mean()))

    def mean(values: list[float]) -> float:
        return float(np.mean(values)) if values else math.nan

    return Drive(degrees, way, int(done.sum()), len(x), mean(speed),
                 mean(slip) if kind.tread.rolls else None, mean(depth), mean(energy))


def pace_of(kind: RobotKind, drives: Sequence[Drive]) -> Pace:
    """What fields believe of a kind, from its drives.

    A field asks no direction, so seconds a metre are the mean of up, down and across. The line
    through them is fitted up to the steepest slope, which no soil makes steeper than rigid ground.
    """
    level = next(d.speed_mps for d in drives if not d.degrees)
    slopes = sorted({d.degrees for d in drives if d.degrees})

    def climbing(slope: float) -> float:
        """Speed uphill; 0 unless most drives made it, up, down and across."""
        mine = [d for d in drives if d.degrees == slope]
        ups = [d.speed_mps for d in mine if d.way == "up"]
        return ups[0] if all(2 * d.through > d.count for d in mine) else 0.0

    steepest, before, at_before = 0.0, level, 0.0
    for slope in slopes:
        now = climbing(slope)
        if now < SLOWEST * level:
            share = (before - SLOWEST * level) / (before - now)
            steepest = at_before + share * (slope - at_before) * (now > 0.0)
            break
        steepest, before, at_before = slope, now, slope
    steepest = min(steepest, math.degrees(kind.max_slope))
    used = [slope for slope in slopes if slope <= steepest + 1e-9] or slopes[:1]
    lost = [1.0 - 1.0 / (level * np.mean([1.0 / d.speed_mps for d in drives
                                          if d.degrees == slope])) for slope in used]
    share = np.array(used) / max(steepest, 1e-9)
    slowing = float(np.clip((share @ np.array(lost)) / (share @ share), 0.0, 0.95))
    along = sorted((-d.degrees if d.way == "down" else d.degrees, d) for d in drives
                   if d.way != "across" and d.through)
    return Pace(round(level, 3), round(math.radians(steepest), 4), round(slowing, 3),
                tuple(round(math.radians(slope), 4) for slope, _ in along),
                tuple(round(d.slip, 3) for _, d in along if d.slip is not None),
                tuple(round(d.energy_j_per_m, 2) for _, d in along))


def table(found: dict[str, dict[str, list[Drive]]], kinds: dict[str, RobotKind]
          ) -> dict[str, Any]:
    """By soil and kind what `paces.json` holds: the pace, and the drives that it comes from."""
    return {soil: {name: {"pace": pace_of(kinds[name], drives)._asdict(),
                          "drives": [asdict(d) for d in drives]}
                   for name, drives in by_kind.items()} for soil, by_kind in found.items()}
