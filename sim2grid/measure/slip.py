"""Slip: how far a robot's own odometry and its real travel are apart, from logged poses alone.

    slip = (counted - real) / max(counted, real), in -1 .. 1

0: nothing slips; 0.2: a fifth of what wheels or legs did was lost; below 0: it slid further than
they moved; the classical slip of a driven and skid of a braked wheel. Both distances are sums over
the log's intervals.

What is counted, and what is real, is each kind's own `odometry`; a kind without has no slip.

Legend: T logged moments. Metres, radians, quaternions wxyz.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from moonteam.robots.base import Floats, Height, Pace, RobotKind

LEAST = 0.05
"""Below this distance, m, there is no slip to speak of."""

STRIDE = 0.2
"""m over which the slope along a way is taken."""


def slip(kind: RobotKind, qpos: npt.NDArray, height: Height | None = None) -> float | None:
    """Slip of a robot from its own qpos [T, 7 + joints]; None where there is none to measure.

    `height` is needed by kinds whose feet bear: without the ground nobody knows which do.
    Poses that are not a number are skipped.
    """
    qpos = np.asarray(qpos, np.float64)
    qpos = qpos[np.isfinite(qpos).all(axis=1)]
    if len(qpos) < 2 or kind.odometry is None or qpos.shape[1] != 7 + len(kind.home):
        return None
    ways = kind.odometry(qpos, height)
    if ways is None:
        return None
    counted, real = ways
    longer = max(counted, real)
    return (counted - real) / longer if longer >= LEAST else None


def expected(pace: Pace, qpos: npt.NDArray, height: Height) -> tuple[float | None, float | None]:
    """Slip, and energy J, that a robot's way [T, 7 + joints] takes by what is known of its kind on
    this soil, from the ground's slope along it; None where that is not known.
    """
    qpos = np.asarray(qpos, np.float64)
    xy = qpos[np.isfinite(qpos).all(axis=1)][:, :2]
    if len(xy) < 2 or not pace.slopes:
        return None, None
    way = xy[strides(xy, STRIDE)]  # steps too short to have a direction are left out
    metres = np.hypot(*np.diff(way, axis=0).T)
    if metres.sum() < LEAST:
        return None, None
    slope = np.arctan2(np.diff(height(way)), metres)
    energy = float((np.interp(slope, pace.slopes, pace.energy) * metres).sum())
    if not pace.slip:
        return None, energy
    share = np.clip(np.interp(slope, pace.slopes, pace.slip), -1.0, 0.95)
    counted = np.where(share > 0.0, metres / (1.0 - share), metres * (1.0 + share)).sum()
    return float((counted - metres.sum()) / max(counted, metres.sum())), energy


def strides(xy: npt.NDArray, least: float) -> list[int]:
    """Indices of points xy [T, 2] m, the first one's and of each that is `least` m or more from the
    one before it in the list.
    """
    kept = [0]
    for k in range(1, len(xy)):
        if np.hypot(*(xy[k] - xy[kept[-1]])) >= least:
            kept.append(k)
    return kept


def ground_height(heights: npt.NDArray, spacing: float) -> Height:
    """`height` of elevations [ny, nx] m about the origin, row 0 in the south.

    The same two triangles a square as `moonteam.terrain.surface`, on the host and for any
    number of points without compiling anew.
    """
    tall = np.asarray(heights, np.float64)
    last = np.array([tall.shape[1] - 1, tall.shape[0] - 1])

    def height(xy: Floats) -> Floats:
        at = np.clip(xy / spacing + last / 2, 0, last)
        x, y = np.moveaxis(np.minimum(np.floor(at), last - 1).astype(int), -1, 0)
        fx, fy = at[..., 0] - x, at[..., 1] - y
        sw, se, nw, ne = tall[y, x], tall[y, x + 1], tall[y + 1, x], tall[y + 1, x + 1]
        south = fx >= fy
        return sw + fx * np.where(south, se - sw, ne - nw) + fy * np.where(south, ne - se, nw - sw)

    return height
