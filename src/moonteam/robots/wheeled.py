"""The wheeled rover: four torque-limited wheels, skid steering, pure pursuit.

Joints in order: rocker left, front and back wheel left, rocker right, front and back wheel
right; actuators: the four wheels in that order. Rigid ground, so no sinkage: what limits the
rover is friction, torque and tilt.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from moonteam.paths import assets
from moonteam.robots.base import (
    CONTROL_PERIOD,
    GRAVITY,
    Camera,
    Command,
    Floats,
    Height,
    RobotKind,
    Telemetry,
    Tread,
    paces_of,
    quat_matrix,
    wheel_odometry,
)
from moonteam.robots.path import Path, braking_speed, measure, start_path, update_path
from moonteam.terrain.surface import Surface

WHEEL_RADIUS = 0.14  # m
HALF_TRACK, HALF_BASE = 0.28, 0.21  # m, wheel centres from the chassis' centre
STANDING_HEIGHT = 0.22  # m
MASS = 15.0  # kg
FOOTPRINT = 0.4  # m
MAX_TORQUE = 1.2  # N m, each wheel
CRUISE_SPEED = 0.5  # m/s, analogue of a flight rover's 0.2 m/s

WHEELS = np.array([1, 2, 4, 5])  # which joints are wheels
SIDE = np.array([1.0, 1.0, -1.0, -1.0])  # left +, right -
# Turning on the spot drags each wheel sideways; with Coulomb friction the drag and the drive
# balance when the wheels run faster than rolling by (half base / half track)^2.
SCRUB = 1.0 + (HALF_BASE / HALF_TRACK) ** 2

PURSUIT_DISTANCE = 0.7  # m ahead on the line
HEADING_GAIN = 1.8  # 1/s
MAX_TURN = 0.8  # rad/s
DECELERATION = 0.12 * GRAVITY  # m/s^2
POSITION_GAIN = 1.0  # 1/s
STOP, RESTART = 0.04, 0.10  # m from the waypoint: stops within, moves again beyond
REVERSE_WITHIN = 1.6  # m; a shorter way back is driven backwards
SLIP = 0.15  # m/s between rim and ground, plus half the ground speed
SPINNING = 0.7  # slip of wheels that get nowhere in soft ground
DIGGING = 0.08  # m/s of the rim from which on that counts
PATIENCE, BACK_OUT, BACK_SPEED = 1.5, 2.5, 0.25  # s of it, s back, m/s
MAX_SLOPE = float(np.deg2rad(18.0))  # of the ground it is sent over
REFUSED = np.deg2rad(19.7)  # of the ground ahead: there it stands still
CAUTION = np.deg2rad(1.0)  # before that it slows down
TILT_LIMIT = np.deg2rad(30.0)  # of the chassis

SPEED_GAIN = MASS * GRAVITY * WHEEL_RADIUS * 0.2  # N m per rad/s, one wheel
INTEGRAL_GAIN = 4.0 * SPEED_GAIN  # N m per rad


class WheeledState(NamedTuple):
    """What the controller remembers."""

    path: Path
    arrived: Array  # [] bool
    reverse: Array  # [] bool, driving backwards
    integral: Array  # [4] rad, wheel angle lacking
    dug: Array  # [] s that its wheels have been spinning in soft ground
    backing: Array  # [] s that it still backs out for


def load() -> mujoco.MjSpec:
    """The rover alone, with its wheels' visual mesh."""
    spec = mujoco.MjSpec.from_file(str(assets() / "robots" / "wheeled.xml"))
    vertices, faces = _wheel_mesh()
    spec.add_mesh(name="grousers", uservert=vertices.ravel(), userface=faces.ravel(),
                  inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    for body in spec.bodies:
        if body.name.startswith("wheel_"):
            body.add_geom(spec.find_default("visual"), type=mujoco.mjtGeom.mjGEOM_MESH,
                          meshname="grousers", material="tyre")
            body.add_geom(spec.find_default("visual"), type=mujoco.mjtGeom.mjGEOM_CYLINDER,
                          size=[0.045, 0.052, 0.0], quat=[0.70710678, 0.70710678, 0.0, 0.0],
                          material="dark")
            # A bar across the disc shows from afar that the wheel turns.
            body.add_geom(spec.find_default("visual"), type=mujoco.mjtGeom.mjGEOM_BOX,
                          size=[0.016, 0.054, 0.112], material="frame")
    return spec


def _wheel_mesh(grousers: int = 18, width: float = 0.10) -> tuple[np.ndarray, np.ndarray]:
    """A toothed disc about the y axis: vertices [n, 3] m and triangles [m, 3]."""
    step = 2.0 * np.pi / grousers
    tooth = np.array([[0.0, 0.130], [0.80, 0.130], [0.82, WHEEL_RADIUS], [0.98, WHEEL_RADIUS]])
    angle = (np.arange(grousers)[:, None] + tooth[None, :, 0]).ravel() * step
    radius = np.tile(tooth[:, 1], grousers)
    ring = np.stack([radius * np.sin(angle), radius * np.cos(angle)], axis=1)
    count = len(ring)
    y = np.full((count, 1), width / 2)
    sides = [np.concatenate([ring[:, :1], s * y, ring[:, 1:]], axis=1) for s in (-1.0, 1.0)]
    centres = np.array([[0.0, -width / 2, 0.0], [0.0, width / 2, 0.0]])
    i, j = np.arange(count), (np.arange(count) + 1) % count
    low, high = np.full(count, 2 * count), np.full(count, 2 * count + 1)
    faces = [(low, i, j), (high, count + j, count + i), (i, count + i, j),
             (j, count + i, count + j)]
    return (np.concatenate([*sides, centres]),
            np.concatenate([np.stack(f, axis=1) for f in faces]).astype(np.int32))


def init(qpos: Array, qvel: Array) -> WheeledState:
    """Standing at qpos [7 + 6], holding that place."""
    del qvel
    still = jnp.array(False)
    never = jnp.zeros(())
    return WheeledState(start_path(qpos[:2]), still, still, jnp.zeros(4), never, never)


def control(
    state: WheeledState, time: Array, qpos: Array, qvel: Array, command: Command,
    surface: Surface
) -> tuple[Array, WheeledState, Telemetry]:
    """Wheel torques [4] N m that drive along the line to command.xy and stop there."""
    del time
    rotation = quat_matrix(qpos[3:7] / (jnp.linalg.norm(qpos[3:7]) + 1e-9))
    path = update_path(state.path, qpos[:2], command)
    state, speed, turn = _steer(state._replace(path=path), qpos, rotation, command)
    wheel = qvel[6 + WHEELS]
    if surface.soft:
        state, speed, turn = _unstuck(state, speed, turn, wheel, rotation, qvel)
    speed = speed * _passable(speed, qpos, rotation, surface)
    wanted = _wheel_speeds(speed, turn, rotation, qvel)
    error = wanted - wheel
    torque = SPEED_GAIN * error + INTEGRAL_GAIN * state.integral
    inside = (jnp.abs(torque) < MAX_TORQUE) | (torque * error < 0.0)
    integral = state.integral + jnp.where(inside, error, 0.0) * CONTROL_PERIOD
    integral = jnp.where(command.lost, 0.0, jnp.nan_to_num(integral))
    torque = jnp.clip(jnp.nan_to_num(torque), -MAX_TORQUE, MAX_TORQUE)
    torque = jnp.where(command.lost, 0.0, torque)
    power = jnp.sum(jnp.maximum(torque * wheel, 0.0))  # brakes do not recover energy
    return torque, state._replace(integral=integral), Telemetry(power, jnp.zeros(()))


def _steer(
    state: WheeledState, qpos: Array, rotation: Array, command: Command
) -> tuple[WheeledState, Array, Array]:
    """Forward speed [] m/s and turn rate [] rad/s: pure pursuit of a point ahead on the line."""
    offset = measure(state.path, qpos[:2])
    near = jnp.where(state.arrived, RESTART, STOP)
    arrived = offset.distance < near
    ahead = jnp.clip(offset.remaining - PURSUIT_DISTANCE, 0.0)
    aim = state.path.goal - ahead * offset.direction - qpos[:2]
    bearing = jnp.arctan2(aim[1], aim[0]) - jnp.arctan2(rotation[1, 0], rotation[0, 0])
    bearing = jnp.arctan2(jnp.sin(bearing), jnp.cos(bearing))

    # 10 deg of hysteresis, so that a waypoint abeam does not make it dither.
    behind = jnp.abs(bearing) > jnp.deg2rad(jnp.where(state.reverse, 80.0, 100.0))
    reverse = behind & (offset.distance < REVERSE_WITHIN)
    back = bearing - jnp.sign(bearing) * jnp.pi
    bearing = jnp.where(reverse, back, bearing)

    limit = jnp.where(command.speed > 0.0, jnp.minimum(command.speed, CRUISE_SPEED), 0.2)
    speed = braking_speed(offset.distance, limit, DECELERATION, POSITION_GAIN)
    speed = jnp.maximum(speed, 0.05)  # the last centimetres in finite time
    facing = jnp.clip((jnp.cos(bearing) - 0.75) / 0.2, 0.0, 1.0)  # turns on the spot past 41 deg
    speed = speed * facing * jnp.where(reverse, -1.0, 1.0)
    turn = jnp.clip(HEADING_GAIN * bearing, -MAX_TURN, MAX_TURN)
    moving = jnp.where(arrived, 0.0, 1.0)
    state = state._replace(arrived=arrived, reverse=reverse)
    return state, speed * moving, turn * moving


def _unstuck(state: WheeledState, speed: Array, turn: Array, wheel: Array, rotation: Array,
             qvel: Array) -> tuple[WheeledState, Array, Array]:
    """Wheels that spin dig themselves in: it notices, and backs out the way that it came."""
    rolling, ground = jnp.mean(wheel) * WHEEL_RADIUS, jnp.sum(rotation[:, 0] * qvel[:3])
    way = jnp.sign(rolling)
    spinning = (jnp.abs(rolling) > DIGGING) & (ground * way < (1.0 - SPINNING) * jnp.abs(rolling))
    spinning = spinning & (state.backing <= 0.0)
    dug = jnp.where(spinning, state.dug + CONTROL_PERIOD,
                    jnp.maximum(state.dug - CONTROL_PERIOD, 0.0))
    stuck = dug > PATIENCE
    backing = jnp.where(stuck, BACK_OUT, jnp.maximum(state.backing - CONTROL_PERIOD, 0.0))
    reverse = jnp.where(stuck, way < 0.0, state.reverse)
    back = jnp.where(reverse, 1.0, -1.0) * BACK_SPEED
    state = state._replace(dug=jnp.where(stuck, 0.0, dug), backing=backing, reverse=reverse)
    return (state, jnp.where(backing > 0.0, back, speed), jnp.where(backing > 0.0, 0.0, turn))


def _passable(speed: Array, qpos: Array, rotation: Array, surface: Surface) -> Array:
    """1 on ground it may enter, falling to 0 at REFUSED ahead or TILT_LIMIT now.

    Slope is that of the plane under its footprint, which is also what traversability is judged
    by. Where it already stands too steep it may still move to flatter ground, and where it
    tilts too far, to its lower side.
    """
    forward = rotation[:2, 0] / (jnp.linalg.norm(rotation[:2, 0]) + 1e-6)
    way = jnp.where(speed < 0.0, -1.0, 1.0) * forward
    points = qpos[None, :2] + jnp.array([[0.0], [FOOTPRINT]]) * way[None, :]
    _, normals = surface.plane(points, FOOTPRINT)
    here, ahead = jnp.arccos(jnp.clip(normals[:, 2], -1.0, 1.0))
    slope = (jnp.maximum(REFUSED, here - CAUTION) - ahead) / CAUTION
    tilt = (rotation[2, 2] - jnp.cos(TILT_LIMIT)) / 0.03
    downwards = jnp.sum(way * rotation[:2, 2]) > 0.2
    tilt = jnp.where(downwards, 1.0, tilt)
    return jnp.clip(jnp.minimum(slope, tilt), 0.0, 1.0)


def _wheel_speeds(speed: Array, turn: Array, rotation: Array, qvel: Array) -> Array:
    """Wheel speeds [4] rad/s for a forward speed and a turn rate, with the slip kept small."""
    side = jnp.array(SIDE, jnp.float32)
    wanted = speed - side * HALF_TRACK * SCRUB * turn
    ground = jnp.sum(rotation[:, 0] * qvel[:3]) - side * HALF_TRACK * qvel[5]
    slack = SLIP + 0.5 * jnp.abs(ground)
    return jnp.clip(wanted, ground - slack, ground + slack) / WHEEL_RADIUS


def odometry(qpos: Floats, height: Height | None) -> tuple[float, float]:
    """What the wheels count and what the chassis really went, m; qpos [T, 13]."""
    del height
    return wheel_odometry(qpos, WHEELS, WHEEL_RADIUS)


WHEELED = RobotKind(
    name="wheeled", load=load, base="chassis", spawn_height=STANDING_HEIGHT, home=np.zeros(6),
    speed=CRUISE_SPEED, footprint=FOOTPRINT, max_slope=MAX_SLOPE, init=init,
    control=control,
    max_step=0.12,  # under a wheel's radius
    settle=0.6, slowing=0.05,  # from `moonteam evaluate slopes`
    tread=Tread(width=0.10, grousers=0.010, rolls=True), paces=paces_of("wheeled"),
    odometry=odometry, callsign="rover", glyph="square", colour="#c9bfb1",
    camera=Camera(distance=2.9, seconds=10.0))
