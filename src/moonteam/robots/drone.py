"""The drone: a thruster hopper that flies at a constant height above ground and boulders.

There is no air to push against, so four fixed thrusters do everything: their sum carries the
weight, their differences roll and pitch, and their lean (alternately left and right about the
arms) yaws. Control is a cascade: path -> velocity -> acceleration -> attitude -> thrust.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from moonteam.paths import assets
from moonteam.robots.base import (
    GRAVITY,
    Camera,
    Command,
    RobotKind,
    Telemetry,
    Tread,
    quat_matrix,
    times,
)
from moonteam.robots.path import Offset, Path, braking_speed, measure, start_path, update_path
from moonteam.terrain.surface import Surface

CRUISE_HEIGHT = 1.5  # m above the highest ground or boulder within LOOK_AHEAD and NEAR
STANDING_HEIGHT = 0.30  # m, base above the feet
CRUISE_SPEED = 2.0  # m/s
SPECIFIC_IMPULSE = 220.0  # s, a hydrazine monopropellant
EXHAUST_SPEED = SPECIFIC_IMPULSE * 9.80665  # m/s

LOOK_AHEAD = (0.0, 0.4, 0.8, 1.2, 1.6)  # s of flight at the present velocity
NEAR = (0.6, 1.2)  # m along the way: it rises above what is there before it goes there
CLIMB, SINK, TOUCHDOWN = 1.0, 0.7, 0.25  # m/s, vertical speed limits
POSITION_GAIN, HEIGHT_GAIN = 0.9, 1.4  # 1/s
VELOCITY_GAIN, CLIMB_GAIN = 2.0, 3.0  # 1/s
ATTITUDE_RATE, ATTITUDE_DAMPING = 6.5, 0.85  # rad/s, of critical
YAW_RATE = 2.0  # rad/s
MAX_ACCELERATION = 0.55 * GRAVITY  # m/s^2, sideways
BRAKING = 0.30 * GRAVITY  # m/s^2, planned; less than the maximum so that errors can be mended


class DroneState(NamedTuple):
    """What the controller remembers."""

    path: Path
    yaw: Array  # [] rad, heading to hold


def load() -> mujoco.MjSpec:
    """The drone alone."""
    return mujoco.MjSpec.from_file(str(assets() / "robots" / "drone.xml"))


def _thrusters() -> tuple[float, np.ndarray, np.ndarray, float]:
    """Mass kg, inertia [3] kg m^2, allocation [4, 4] and one thruster's limit N.

    The allocation turns (collective N, torque x, y, z N m) into thrusts.
    """
    model = load().compile()
    axes = np.stack([_site_axis(model, i) for i in range(4)])
    torques = np.cross(model.site_pos, axes)
    effect = np.concatenate([axes[:, 2:3], torques], axis=1).T
    return (float(model.body_mass[1]), model.body_inertia[1].copy(), np.linalg.inv(effect),
            float(model.actuator_ctrlrange[0, 1]))


def _site_axis(model: mujoco.MjModel, site: int) -> np.ndarray:
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, model.site_quat[site])
    return matrix.reshape(3, 3)[:, 2]


MASS, INERTIA, ALLOCATION, MAX_THRUST = _thrusters()


def init(qpos: Array, qvel: Array) -> DroneState:
    """Standing at qpos [7], holding that place."""
    del qvel
    return DroneState(start_path(qpos[:2]), _yaw(quat_matrix(qpos[3:7])))


def control(
    state: DroneState, time: Array, qpos: Array, qvel: Array, command: Command, surface: Surface
) -> tuple[Array, DroneState, Telemetry]:
    """Thrusts [4] N towards command.xy at CRUISE_HEIGHT; a negative speed lands there."""
    del time
    path = update_path(state.path, qpos[:2], command)
    state = state._replace(path=path)
    landing = command.speed < 0.0
    offset = measure(path, qpos[:2])
    feet = qpos[2] - STANDING_HEIGHT
    clearance = feet - surface.height(qpos[:2])
    along = jnp.clip(offset.remaining, -jnp.array(NEAR), jnp.array(NEAR))
    near = qpos[None, :2] + along[:, None] * offset.direction[None, :]
    ahead = qpos[None, :2] + jnp.array(LOOK_AHEAD)[:, None] * qvel[None, :2]
    tops = surface.top(jnp.concatenate([near, ahead]))
    room = feet - jnp.max(tops[:len(NEAR) + 1])  # LOOK_AHEAD begins with where it is
    climb = jnp.max(tops) + CRUISE_HEIGHT - qpos[2]
    wanted = _velocity(offset, command, clearance, room, climb)
    force = _acceleration(wanted, qvel[:3]) + jnp.array([0.0, 0.0, GRAVITY])
    thrust = _allocate(*_wrench(state, qpos, qvel, force * MASS))
    off = command.lost | (landing & (clearance < 0.03))
    thrust = jnp.where(off, 0.0, jnp.nan_to_num(thrust))
    total = jnp.sum(thrust)
    return thrust, state, Telemetry(0.5 * EXHAUST_SPEED * total, total / EXHAUST_SPEED)


def _velocity(
    offset: Offset, command: Command, clearance: Array, room: Array, climb: Array
) -> Array:
    """Wanted velocity [3] m/s: along the path, back onto it, and to the right height.

    `clearance` [] m of the feet from the ground, `room` [] m of the feet from the highest thing
    here and NEAR, `climb` [] m missing to cruise.
    """
    landing = command.speed < 0.0
    # Holding and landing have no speed of their own; they need a little to keep their place.
    limit = jnp.where(command.speed > 0.0, jnp.minimum(command.speed, CRUISE_SPEED), 0.5)
    along = braking_speed(offset.remaining, limit, BRAKING, POSITION_GAIN)
    aside = jnp.clip(-POSITION_GAIN * offset.cross, -0.7, 0.7)
    left = jnp.array([-1.0, 1.0]) * offset.direction[::-1]
    # No sideways dash at take-off, nor towards what is still higher than the feet.
    airborne = jnp.clip((room - 0.15) / 0.5, 0.0, 1.0)
    sideways = (along * offset.direction + aside * left) * jnp.where(landing, 1.0, airborne)
    up = jnp.clip(HEIGHT_GAIN * climb, -SINK, CLIMB)
    settle = -jnp.clip(0.6 * clearance, TOUCHDOWN, SINK)
    up = jnp.where(landing & (offset.distance < 0.15), settle, up)
    return jnp.concatenate([sideways, up[None]])


def _acceleration(wanted: Array, velocity: Array) -> Array:
    """Wanted acceleration [3] m/s^2, within what tilt and thrust allow."""
    up = jnp.clip(CLIMB_GAIN * (wanted[2] - velocity[2]), -0.5 * GRAVITY, 0.8 * GRAVITY)
    sideways = VELOCITY_GAIN * (wanted[:2] - velocity[:2])
    limit = jnp.minimum(MAX_ACCELERATION, 0.6 * (GRAVITY + up))
    size = jnp.sqrt(jnp.sum(sideways**2) + 1e-12)
    return jnp.concatenate([sideways * jnp.minimum(1.0, limit / size), up[None]])


def _wrench(
    state: DroneState, qpos: Array, qvel: Array, force: Array
) -> tuple[Array, Array]:
    """Collective thrust [] N and body torque [3] N m that point the thrust along force [3] N."""
    rotation = quat_matrix(qpos[3:7] / (jnp.linalg.norm(qpos[3:7]) + 1e-9))
    size = jnp.sqrt(jnp.sum(force**2) + 1e-12)
    wanted = times(rotation.T, force / size)
    # Sine of the tilt error about body x and y, kept at full size when upside down.
    tilt = jnp.stack([-wanted[1], wanted[0]])
    tilt = jnp.where(wanted[2] > 0.0, tilt, tilt / (jnp.linalg.norm(tilt) + 1e-6))
    turn = state.yaw - _yaw(rotation)
    turn = jnp.clip(jnp.arctan2(jnp.sin(turn), jnp.cos(turn)), -0.5, 0.5)
    rate = jnp.array([ATTITUDE_RATE, ATTITUDE_RATE, YAW_RATE])
    error = jnp.concatenate([tilt, turn[None]])
    spin = rate**2 * error - 2.0 * ATTITUDE_DAMPING * rate * qvel[3:6]
    collective = jnp.maximum(jnp.sum(force * rotation[:, 2]), 0.0)
    return collective, jnp.array(INERTIA, jnp.float32) * spin


def _allocate(collective: Array, torque: Array) -> Array:
    """Thrusts [4] N within [0, MAX_THRUST]: attitude first, then lift, then yaw."""
    allocation = jnp.array(ALLOCATION, jnp.float32)
    tilt = allocation[:, 1] * torque[0] + allocation[:, 2] * torque[1]
    tilt = tilt * jnp.minimum(1.0, MAX_THRUST / (jnp.max(tilt) - jnp.min(tilt) + 1e-9))
    lift = jnp.clip(allocation[0, 0] * collective, -jnp.min(tilt), MAX_THRUST - jnp.max(tilt))
    thrust = lift + tilt
    yaw = allocation[:, 3] * torque[2]
    room = jnp.where(yaw > 0.0, MAX_THRUST - thrust, thrust)
    share = jnp.min(jnp.where(jnp.abs(yaw) > 1e-6, room / (jnp.abs(yaw) + 1e-9), 1.0))
    return jnp.clip(thrust + yaw * jnp.clip(share, 0.0, 1.0), 0.0, MAX_THRUST)


def _yaw(rotation: Array) -> Array:
    return jnp.arctan2(rotation[1, 0], rotation[0, 0])


DRONE = RobotKind(
    name="drone", load=load, base="drone", spawn_height=STANDING_HEIGHT, home=np.zeros(0),
    speed=CRUISE_SPEED, footprint=0.3, max_slope=float(np.deg2rad(30.0)), init=init,
    control=control, settle=1.9, flies=True, lands_for=20.0, tread=Tread(width=0.09),
    callsign="hopper", glyph="triangle",
    camera=Camera(distance=4.2, seconds=16.0))  # from take-off to the goal
