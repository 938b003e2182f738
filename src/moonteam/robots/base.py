"""What the three kinds of robot share: one model and one controller each.

Controllers are pure JAX functions over a small typed state, so both backends and vmap use
the same code. Units: SI, radians. World frame: x east, y north, z up, site centre at the
origin. Robot state is MuJoCo's: qpos = free joint (position [3], quaternion wxyz [4]) then
joints; qvel = linear velocity in the world frame [3], angular in the body frame [3], joints.

Contacts, as contype/conaffinity: height field 1/0, boulder 3/0, foot or wheel 0/1 (touches
ground and boulders), hull 2/2 (one coarse sphere or so: touches boulders and other robots'
hulls, never the height field, whose cost in MJX grows with geom size), visual 0/0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from moonteam.terrain.surface import Surface

GRAVITY = 1.62
"""Lunar gravity, m/s^2."""

PHYSICS_DT = 0.004
"""Physics step, s."""

CONTROL_PERIOD = 0.008
"""Time between two calls of every controller, s; actuator commands are held in between."""


class Command(NamedTuple):
    """Where a robot should go. Arrays so that it can be vmapped and traced."""

    xy: Array  # [2] m, waypoint in the world frame; a drone holds its height above ground there
    speed: Array  # [] m/s, upper limit; 0: hold the place; below 0: a drone lands at xy
    lost: Array  # [] bool, True: actuators off (the robot left the team)


class Telemetry(NamedTuple):
    """What a controller reports each control step."""

    power: Array  # [] W, mechanical power asked of the actuators, >= 0
    propellant: Array  # [] kg/s used; 0 for legged and wheeled


@dataclass(frozen=True)
class RobotKind:
    """One kind of robot, as the scene and the backends use it.

    `init(qpos, qvel) -> state` and `control(state, time, qpos, qvel, command, surface) ->
    (ctrl [nu], state, Telemetry)`, all of this robot's own slices; called every
    CONTROL_PERIOD seconds. Pure, jittable, vmappable.
    """

    name: str
    load: Callable[[], mujoco.MjSpec]  # the robot alone, base body with a free joint first
    base: str  # name of the base body
    spawn_height: float  # m, base above ground along the normal, standing still
    home: np.ndarray  # [joints] joint angles at spawn, rad
    speed: float  # m/s, the speed it travels at
    footprint: float  # m, radius of what touches the ground
    max_slope: float  # rad, beyond which it must not go
    init: Callable[[Array, Array], Any]
    control: Callable[[Any, Array, Array, Array, Command, Surface], tuple[Array, Any, Telemetry]]


def times(matrix: Array, vector: Array) -> Array:
    """Matrices [..., n, k] times vectors [..., k], as sums: [..., n].

    For matrices this small a library call, which is what XLA makes of `@` on a CPU, costs more
    than the arithmetic, and it cannot be fused with what stands around it.
    """
    return jnp.sum(matrix * vector[..., None, :], axis=-1)


def turned(matrix: Array, vectors: Array) -> Array:
    """One matrix [n, k] times each of vectors [L, k]: [L, n]. See `times`."""
    return jnp.sum(matrix[None] * vectors[:, None, :], axis=-1)


def quat_matrix(quat: Array) -> Array:
    """Rotation matrix [3, 3], body to world, of a unit quaternion wxyz [4]."""
    w, x, y, z = quat
    return jnp.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])
