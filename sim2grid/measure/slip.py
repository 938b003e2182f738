"""Slip: how far a robot's own odometry and its real travel are apart, from logged poses alone.

    slip = (counted - real) / max(counted, real), in -1 .. 1

0: nothing slips; 0.2: a fifth of what wheels or legs did was lost; below 0: it slid further than
they moved; the classical slip of a driven and skid of a braked wheel. Both distances are sums over
the log's intervals.

- wheeled: counted is the mean turn of the four wheel joints times the wheel's radius (so turning on
  the spot, left against right, counts nothing), real the displacement along the chassis' heading.
- legged: counted is the displacement that would keep the bearing feet where they touch the ground
  (a foot's sphere rolls as its shank turns), real the base's horizontal displacement. Intervals in
  which no foot bears at both ends are left out of both.
- drones have none.

Legend: T logged moments, L legs. Metres, radians, quaternions wxyz.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from moonteam.robots.legged import FOOT_RADIUS, HIPS, LINK, OFFSET, SIDE
from moonteam.robots.wheeled import WHEEL_RADIUS, WHEELS

Floats = npt.NDArray[np.float64]
Height = Callable[[Floats], Floats]  # ground height [...] m under points [..., 2] m

JOINTS = {"wheeled": 6, "legged": 12}

BEARS = 0.004
"""A foot bears while its sphere is within this of the ground, m."""

LEAST = 0.05
"""Below this distance, m, there is no slip to speak of."""


def slip(kind: str, qpos: npt.NDArray, height: Height | None = None) -> float | None:
    """Slip of a robot from its own qpos [T, 7 + joints]; None where there is none to measure.

    `height` is needed for a legged robot: without the ground nobody knows which feet bear.
    Poses that are not a number are skipped.
    """
    qpos = np.asarray(qpos, np.float64)
    qpos = qpos[np.isfinite(qpos).all(axis=1)]
    if len(qpos) < 2 or kind not in JOINTS or qpos.shape[1] != 7 + JOINTS[kind]:
        return None
    if kind == "wheeled":
        counted, real = wheel_travel(qpos)
    elif height is not None:
        counted, real = leg_travel(qpos, height)
    else:
        return None
    longer = max(counted, real)
    return (counted - real) / longer if longer >= LEAST else None


def wheel_travel(qpos: Floats) -> tuple[float, float]:
    """What the wheels count and what the chassis really went, m; qpos [T, 13]."""
    turned = np.diff(qpos[:, 7 + WHEELS], axis=0).mean(axis=1) * WHEEL_RADIUS
    forward = rotations(qpos[:, 3:7])[:, :, 0]
    along = (np.diff(qpos[:, :3], axis=0) * (forward[1:] + forward[:-1]) / 2).sum(axis=1)
    return float(np.abs(turned).sum()), float(np.abs(along).sum())


def leg_travel(qpos: Floats, height: Height) -> tuple[float, float]:
    """What the legs count and what the base really went, m; qpos [T, 19]."""
    feet, shanks = feet_of(qpos)
    bears = feet[..., 2] - FOOT_RADIUS - height(feet[..., :2]) < BEARS  # [T, L]
    bears = bears[1:] & bears[:-1]
    # The contact point is as the centre less the rolling about it: v_c - r (w x up).
    turn = shanks[1:] @ np.swapaxes(shanks[:-1], -1, -2)  # [T - 1, L, 3, 3]
    about_x, about_y = ((turn[..., 2, 1] - turn[..., 1, 2]) / 2,
                        (turn[..., 0, 2] - turn[..., 2, 0]) / 2)
    rolled = FOOT_RADIUS * np.stack([about_y, -about_x], axis=-1)
    slid = np.diff(feet[..., :2], axis=0) - rolled  # [T - 1, L, 2]
    moved = np.diff(qpos[:, :2], axis=0)
    some = bears.any(axis=1)
    share = bears / np.maximum(bears.sum(axis=1, keepdims=True), 1)
    counted = moved - (slid * share[..., None]).sum(axis=1)
    return (float(np.hypot(*counted[some].T).sum()), float(np.hypot(*moved[some].T).sum()))


def feet_of(qpos: Floats) -> tuple[Floats, Floats]:
    """Foot centres [T, L, 3] m and shank rotations [T, L, 3, 3] of qpos [T, 19]."""
    base = rotations(qpos[:, 3:7])[:, None]  # [T, 1, 3, 3]
    roll, hip, knee = np.moveaxis(qpos[:, 7:19].reshape(-1, 4, 3), -1, 0)  # [T, L] each
    shank = hip + knee
    x = -LINK * (np.sin(hip) + np.sin(shank))
    z = -LINK * (np.cos(hip) + np.cos(shank))
    y = np.broadcast_to(SIDE * OFFSET, x.shape)
    in_body = HIPS + np.stack([x, y * np.cos(roll) - z * np.sin(roll),
                               y * np.sin(roll) + z * np.cos(roll)], axis=-1)
    feet = qpos[:, None, :3] + (base @ in_body[..., None])[..., 0]
    one, none = np.ones_like(roll), np.zeros_like(roll)
    about_x = np.stack([one, none, none, none, np.cos(roll), -np.sin(roll),
                        none, np.sin(roll), np.cos(roll)], axis=-1).reshape(*roll.shape, 3, 3)
    about_y = np.stack([np.cos(shank), none, np.sin(shank), none, one, none,
                        -np.sin(shank), none, np.cos(shank)], axis=-1).reshape(about_x.shape)
    return feet, base @ about_x @ about_y


def rotations(quat: Floats) -> Floats:
    """Rotation matrices [..., 3, 3], body to world, of quaternions [..., 4]."""
    w, x, y, z = np.moveaxis(quat / np.linalg.norm(quat, axis=-1, keepdims=True), -1, 0)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    return np.stack(rows, axis=-1).reshape(*quat.shape[:-1], 3, 3)


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
