"""A robot of one's own: a two-wheeled scout with a tail, after JPL's Axel.

Turning left against right steers it; the tail takes up what the wheels' torque does to the
body. Joints and actuators in order: left wheel, right wheel.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from moonteam.robots import RobotKind
from moonteam.robots.base import (
    CONTROL_PERIOD,
    GRAVITY,
    Camera,
    Command,
    Floats,
    Height,
    Telemetry,
    quat_matrix,
    wheel_odometry,
)
from moonteam.robots.path import Path as Way
from moonteam.robots.path import braking_speed, measure, start_path, update_path
from moonteam.terrain.surface import Surface

WHEELS = np.array([0, 1])  # which joints are wheels
RADIUS = 0.15  # m, of a wheel
HALF_TRACK = 0.2  # m, wheels from the middle
MASS = 5.0  # kg
MAX_TORQUE = 0.6  # N m, each wheel
CRUISE_SPEED = 0.4  # m/s

PURSUIT_DISTANCE = 0.6  # m ahead on the line
HEADING_GAIN, MAX_TURN = 2.0, 0.9  # 1/s, rad/s
DECELERATION = 0.06 * GRAVITY  # m/s^2; braking harder would lift the tail
POSITION_GAIN = 1.0  # 1/s
STOP, RESTART = 0.04, 0.12  # m from the waypoint: stops within, moves again beyond
SPEED_GAIN = MASS * GRAVITY * RADIUS * 0.2  # N m per rad/s, one wheel
INTEGRAL_GAIN = 4.0 * SPEED_GAIN  # N m per rad
FALLEN = np.cos(np.radians(60.0))  # the body's up axis below this: no torques


class ScoutState(NamedTuple):
    """What the controller remembers."""

    way: Way
    arrived: Array  # [] bool
    integral: Array  # [2] rad, wheel angle lacking


def load() -> mujoco.MjSpec:
    """The scout alone."""
    return mujoco.MjSpec.from_file(str(Path(__file__).with_name("scout.xml")))


def init(qpos: Array, qvel: Array) -> ScoutState:
    """Standing at qpos [7 + 2], holding that place."""
    del qvel
    return ScoutState(start_path(qpos[:2]), jnp.array(False), jnp.zeros(2))


def control(
    state: ScoutState, time: Array, qpos: Array, qvel: Array, command: Command, surface: Surface
) -> tuple[Array, ScoutState, Telemetry]:
    """Wheel torques [2] N m that drive along the line to command.xy and stop there."""
    del time, surface
    rotation = quat_matrix(qpos[3:7] / (jnp.linalg.norm(qpos[3:7]) + 1e-9))
    state = state._replace(way=update_path(state.way, qpos[:2], command))
    state, speed, turn = _steer(state, qpos, rotation, command)
    wheel = qvel[6:8]
    error = (speed + jnp.array([-1.0, 1.0]) * HALF_TRACK * turn) / RADIUS - wheel
    torque = SPEED_GAIN * error + INTEGRAL_GAIN * state.integral
    inside = (jnp.abs(torque) < MAX_TORQUE) | (torque * error < 0.0)
    integral = state.integral + jnp.where(inside, error, 0.0) * CONTROL_PERIOD
    off = command.lost | (rotation[2, 2] < FALLEN)
    integral = jnp.where(off, 0.0, jnp.nan_to_num(integral))
    torque = jnp.where(off, 0.0, jnp.clip(jnp.nan_to_num(torque), -MAX_TORQUE, MAX_TORQUE))
    power = jnp.sum(jnp.maximum(torque * wheel, 0.0))  # brakes do not recover energy
    return torque, state._replace(integral=integral), Telemetry(power, jnp.zeros(()))


def _steer(
    state: ScoutState, qpos: Array, rotation: Array, command: Command
) -> tuple[ScoutState, Array, Array]:
    """Forward speed [] m/s and turn rate [] rad/s: pure pursuit of a point ahead on the line."""
    offset = measure(state.way, qpos[:2])
    arrived = offset.distance < jnp.where(state.arrived, RESTART, STOP)
    ahead = jnp.clip(offset.remaining - PURSUIT_DISTANCE, 0.0)
    aim = state.way.goal - ahead * offset.direction - qpos[:2]
    bearing = jnp.arctan2(aim[1], aim[0]) - jnp.arctan2(rotation[1, 0], rotation[0, 0])
    bearing = jnp.arctan2(jnp.sin(bearing), jnp.cos(bearing))
    limit = jnp.where(command.speed > 0.0, jnp.minimum(command.speed, CRUISE_SPEED), 0.2)
    speed = braking_speed(offset.distance, limit, DECELERATION, POSITION_GAIN)
    speed = jnp.maximum(speed, 0.05)  # the last centimetres in finite time
    facing = jnp.clip((jnp.cos(bearing) - 0.75) / 0.2, 0.0, 1.0)  # turns on the spot past 41 deg
    turn = jnp.clip(HEADING_GAIN * bearing, -MAX_TURN, MAX_TURN)
    moving = jnp.where(arrived, 0.0, 1.0)
    return state._replace(arrived=arrived), speed * facing * moving, turn * moving


def odometry(qpos: Floats, height: Height | None) -> tuple[float, float]:
    """What the wheels count and what the body really went, m; qpos [T, 9]."""
    del height
    return wheel_odometry(qpos, WHEELS, RADIUS)


SCOUT = RobotKind(
    name="scout", load=load, base="axle", spawn_height=0.15, home=np.zeros(2),
    speed=CRUISE_SPEED, footprint=0.32, max_slope=float(np.radians(12.0)), init=init,
    control=control, max_step=0.08, slowing=0.05, odometry=odometry,
    callsign="scout", glyph="pentagon", colour="#b9c6c4", camera=Camera(2.2, 10.0))
