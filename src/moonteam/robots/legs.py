"""Four legs of three joints: where their feet are, and how far they say the robot has gone.

Shapes: L = 4 legs in the order front left, front right, rear left, rear right; J = 3 joints a
leg: abduction about x, hip about y, knee about y; T logged moments. Metres, radians.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from moonteam.robots.base import Floats, Height, rotations

SIDE = np.array([1.0, -1.0, 1.0, -1.0])  # [L] +1 left, -1 right
END = np.array([1.0, 1.0, -1.0, -1.0])  # [L] +1 front, -1 rear
HIP_X, HIP_Y = 0.20, 0.10  # m, abduction axes from the base
OFFSET = 0.07  # m, sideways from the abduction axis to the leg's plane
LINK = 0.22  # m, thigh and shank
FOOT_RADIUS = 0.03  # m
HIPS = np.stack([END * HIP_X, SIDE * HIP_Y, np.zeros(4)], axis=1)  # [L, 3] m, base frame

BEARS = 0.004
"""A foot bears while its sphere is within this of the ground, m."""


def leg_kinematics(angles: Array) -> tuple[Array, Array]:
    """Feet [L, 3] m in the base frame and their Jacobians [L, 3, J] from angles [L, J] rad."""
    roll, hip, knee = angles[:, 0], angles[:, 1], angles[:, 1] + angles[:, 2]
    x = -LINK * (jnp.sin(hip) + jnp.sin(knee))
    z = -LINK * (jnp.cos(hip) + jnp.cos(knee))
    shank_x, shank_z = -LINK * jnp.sin(knee), -LINK * jnp.cos(knee)
    y = jnp.asarray(SIDE * OFFSET, x.dtype)
    cos, sin = jnp.cos(roll), jnp.sin(roll)
    feet = jnp.stack([x, y * cos - z * sin, y * sin + z * cos], axis=1) + jnp.asarray(HIPS, x.dtype)
    by_roll = jnp.stack([jnp.zeros_like(x), -y * sin - z * cos, y * cos - z * sin], axis=1)
    by_hip = jnp.stack([z, x * sin, -x * cos], axis=1)
    by_knee = jnp.stack([shank_z, shank_x * sin, -shank_x * cos], axis=1)
    return feet, jnp.stack([by_roll, by_hip, by_knee], axis=2)


def odometry(qpos: Floats, height: Height | None) -> tuple[float, float] | None:
    """What the legs count and what the base really went, m; qpos [T, 19].

    Counted is the displacement that would keep the bearing feet where they touch the ground
    (a foot's sphere rolls as its shank turns), real the base's horizontal displacement.
    Intervals in which no foot bears at both ends are left out of both. None without `height`:
    nobody knows then which feet bear.
    """
    if height is None:
        return None
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
