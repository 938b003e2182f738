"""The quadruped: walks to a waypoint by placing feet and sharing out the force they bear.

Each control step: the waypoint becomes a wanted body velocity; a gait clock says which feet
carry and which swing; a wanted wrench on the body (velocity, height and attitude feedback
plus weight) is split over the carrying feet by weighted least squares, each force cut to the
friction cone about the ground's normal, and becomes joint torques tau = -J^T f; a swinging
foot is drawn along an arc to a foothold that catches the body (Raibert 1986, "Legged Robots
That Balance": hip + v T_stance / 2 + k (v - v_wanted)) at the terrain's height. The body
aligns with a plane fitted to the ground under the four hips. No inverse kinematics.

Shapes: L = 4 legs in the order front left, front right, rear left, rear right; J = 3 joints a
leg: abduction about x, hip about y, knee about y. Unless said otherwise vectors are in the
world frame; "level" is the world turned by the body's heading only.
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
    RobotKind,
    Telemetry,
    Tread,
    Tuning,
    paces_of,
    quat_matrix,
    times,
    turned,
)
from moonteam.robots.legs import END, FOOT_RADIUS, LINK, SIDE, leg_kinematics, odometry
from moonteam.terrain.surface import Surface

MASS = 15.0  # kg
INERTIA = np.array([0.26, 0.53, 0.66])  # kg m^2, whole robot standing at home, about its axes
CENTRE = np.array([-0.017, 0.0, -0.018])  # m, centre of mass in the base frame, likewise
TORQUE_LIMIT = 40.0  # N m
FALLEN = np.cos(np.radians(70.0))  # the base's up axis below this: no torques

LEG_OFFSETS = np.array([0.0, 0.5, 0.5, 0.0])  # [L] share of the period: a trot


class Gait(NamedTuple):
    """Gait and gains: what `moonteam.physics.trials.tune` tunes.

    These come from eleven generations of `--search 12 --size 12 --seed 2`, begun at numbers
    set by hand (period 0.52, duty 0.6, height 0.27, velocity 10, attitude 190), rounded.

    Feedback is per unit mass, inertia and (where a force bears weight) gravity, so that a
    heavier robot or another planet needs no other numbers.
    """

    period: float | Array = 0.56  # s
    duty: float | Array = 0.555  # share of the period that a foot carries
    height: float | Array = 0.277  # m, base above the ground plane
    stance: float | Array = 0.17  # m, nominal foothold beside the base
    length: float | Array = 0.21  # m, nominal foothold ahead of or behind the base
    clearance: float | Array = 0.042  # m, swing arc above the higher of its ends
    catch: float | Array = 0.13  # s, foothold moved per unit of velocity error
    lean: float | Array = -0.12  # m, footholds moved uphill per unit of slope
    follow: float | Array = 0.87  # share of the ground's slope that the body takes on
    speed: float | Array = 0.45  # m/s, most it tries
    slow: float | Array = 0.8  # share of speed lost per unit of slope
    velocity: float | Array = 11.5  # 1/s, velocity feedback
    push: float | Array = 0.83  # most that velocity feedback asks for, in weights
    lift: float | Array = 70.0  # 1/s^2, height feedback
    lift_damping: float | Array = 14.0  # 1/s
    attitude: float | Array = 194.0  # 1/s^2, attitude feedback
    attitude_damping: float | Array = 19.8  # 1/s
    swing: float | Array = 36.5  # rad/s, bandwidth of the swinging foot
    moment: float | Array = 0.26  # m^2, moment error traded against force error in the split
    friction: float | Array = 0.7  # friction that the force split relies on


GAIT = Gait()

SPANS = {
    "period": (0.3, 0.7), "duty": (0.52, 0.8), "height": (0.24, 0.32), "stance": (0.15, 0.22),
    "length": (0.17, 0.24), "clearance": (0.03, 0.10), "catch": (0.0, 0.25),
    "lean": (-0.2, 0.3), "follow": (0.5, 1.0), "velocity": (3.0, 20.0), "push": (0.4, 1.2),
    "lift": (30.0, 200.0), "lift_damping": (5.0, 30.0),
    "attitude": (60.0, 400.0), "attitude_damping": (8.0, 40.0),
    "swing": (20.0, 60.0), "moment": (0.005, 1.0), "friction": (0.4, 0.75),
}  # fmt: skip
"""What a search may change, and within which limits."""

TURN_RATE = 0.7  # rad/s, most it turns
ACCELERATION = 0.4  # m/s^2, most the wanted velocity changes
NEAR = 0.35  # m, within it the robot steps sideways or backwards instead of turning
ARRIVED, LEFT = 0.05, 0.18  # m, stands within the first, walks again beyond the second
DRAG = 0.7  # 1/s, what landing feet take from the body's speed
SLACK = 0.02  # what the force split gives up of the wrench, per unit of weight on a foot
PASSES = 3  # of the force split, each on what the friction cones cut from the last
NEAR_STRAIGHT = 4e-4  # m^2/rad^2, damps swinging legs where the foot can hardly be moved
LEG_INERTIA = np.array([[0.030, 0.0, 0.0], [0.0, 0.031, 0.002], [0.0, 0.002, 0.0166]])  # kg m^2


class LeggedState(NamedTuple):
    """What the controller remembers."""

    phase: Array  # [] share of the gait period, 0 to 1
    grip: Array  # [L, 3] m, where each foot is or last was on the ground
    wanted: Array  # [3] velocity asked of the body: x, y m/s (world), heading rad/s
    holding: Array  # [] bool, at the waypoint: standing


class _Body(NamedTuple):
    """What the controller senses, from the joint state and the map."""

    at: Array  # [3] m
    rotation: Array  # [3, 3] base to world
    velocity: Array  # [3] m/s
    spin: Array  # [3] rad/s
    level: Array  # [2, 2] rotation by the heading alone
    feet: Array  # [L, 3] m
    foot_velocity: Array  # [L, 3] m/s
    jacobian: Array  # [L, 3, J] m/rad, foot over joint angle
    ground: Array  # [] m, fitted plane under the base
    gradient: Array  # [2] fitted plane's rise in world x and y
    gap: Array  # [L] m, foot over the ground
    normal: Array  # [L, 3] ground's normal under each foot


def init(qpos: Array, qvel: Array) -> LeggedState:
    """Standing still, feet where the joint angles put them, the clock where all carry."""
    feet, _ = leg_kinematics(qpos[7:].reshape(4, 3))
    grip = qpos[None, :3] + turned(quat_matrix(qpos[3:7]), feet)
    phase = jnp.asarray((GAIT.duty - 0.5) / 2.0)
    return LeggedState(phase, grip, jnp.zeros(3), jnp.array(True))


def control(
    state: LeggedState, time: Array, qpos: Array, qvel: Array, command: Command, surface: Surface
) -> tuple[Array, LeggedState, Telemetry]:
    """Joint torques [12] N m toward the command; see `RobotKind`."""
    return control_with(GAIT, state, time, qpos, qvel, command, surface)


def control_with(
    gait: Gait,
    state: LeggedState,
    time: Array,
    qpos: Array,
    qvel: Array,
    command: Command,
    surface: Surface,
) -> tuple[Array, LeggedState, Telemetry]:
    """`control` with a gait of one's own; its numbers may be traced."""
    del time
    qpos = jnp.clip(jnp.nan_to_num(qpos), -1e3, 1e3)
    qvel = jnp.clip(jnp.nan_to_num(qvel), -1e2, 1e2)
    body = _sense(gait, qpos, qvel, surface)
    state = _guide(gait, state, body, command)
    state, swing, progress = _clock(gait, state, body)
    foothold = _footholds(gait, state, body, swing, progress, surface)
    forces = _stance_forces(gait, state, body, swing)
    torque = times(jnp.swapaxes(body.jacobian, 1, 2), -forces)
    torque = torque + _swing_torques(gait, state, body, swing, progress, foothold)
    torque = torque.reshape(12)
    torque = jnp.nan_to_num(torque)
    off = command.lost | (body.rotation[2, 2] < FALLEN)
    torque = jnp.where(off, 0.0, jnp.clip(torque, -TORQUE_LIMIT, TORQUE_LIMIT))
    power = jnp.sum(jnp.maximum(torque * qvel[6:], 0.0))
    return torque, state, Telemetry(power, jnp.zeros_like(power))


def _sense(gait: Gait, qpos: Array, qvel: Array, surface: Surface) -> _Body:
    quat = qpos[3:7] / (jnp.linalg.norm(qpos[3:7]) + 1e-9)
    rotation = quat_matrix(quat)
    velocity, spin = qvel[:3], times(rotation, qvel[3:6])
    joint_velocity = qvel[6:].reshape(4, 3)
    feet, jacobian = leg_kinematics(qpos[7:].reshape(4, 3))
    arms = turned(rotation, feet)
    jacobian = jnp.sum(rotation[None, :, :, None] * jacobian[:, None, :, :], axis=2)
    feet = qpos[:3][None, :] + arms
    foot_velocity = velocity[None, :] + jnp.cross(spin[None, :], arms)
    foot_velocity = foot_velocity + times(jacobian, joint_velocity)
    ahead = rotation[:2, 0] / (jnp.linalg.norm(rotation[:2, 0]) + 1e-6)
    level = jnp.stack([ahead, jnp.stack([-ahead[1], ahead[0]])], axis=1)
    under = qpos[:2][None, :] + turned(level, _nominal(gait))
    heights = surface.height(jnp.concatenate([under, feet[:, :2]]))
    plane, below = heights[:4], heights[4:]
    rise = jnp.stack([jnp.sum(plane * END) / gait.length, jnp.sum(plane * SIDE) / gait.stance])
    normal = surface.normal(feet[:, :2])
    gap = (feet[:, 2] - below) * normal[:, 2] - FOOT_RADIUS
    return _Body(
        qpos[:3], rotation, velocity, spin, level, feet, foot_velocity, jacobian,
        jnp.mean(plane), times(level, rise) / 4.0, gap, normal,
    )  # fmt: skip


def _nominal(gait: Gait) -> Array:
    """Feet [L, 2] m under a standing robot, level frame."""
    return jnp.stack([jnp.asarray(END) * gait.length, jnp.asarray(SIDE) * gait.stance], axis=1)


def _guide(gait: Gait, state: LeggedState, body: _Body, command: Command) -> LeggedState:
    """From the waypoint to a wanted velocity that changes smoothly."""
    way = command.xy - body.at[:2]
    distance = jnp.linalg.norm(way)
    near = jnp.where(state.holding, distance < LEFT, distance < ARRIVED)
    holding = near | (command.speed <= 0.0)
    local = times(body.level.T, way)
    error = jnp.where(distance > NEAR, jnp.arctan2(local[1], local[0]), 0.0)
    facing = jnp.clip(1.6 * jnp.cos(error) - 0.6, 0.0, 1.0)
    limit = jnp.minimum(command.speed, gait.speed)
    limit = limit * jnp.clip(1.0 - gait.slow * jnp.linalg.norm(body.gradient), 0.3, 1.0)
    speed = jnp.minimum(limit, 1.2 * distance) * facing
    velocity = way / (distance + 1e-6) * speed
    turn = jnp.clip(1.5 * error, -TURN_RATE, TURN_RATE)
    goal = jnp.where(holding, 0.0, jnp.concatenate([velocity, turn[None]]))
    most = ACCELERATION * CONTROL_PERIOD * jnp.array([1.0, 1.0, 4.0])
    wanted = state.wanted + jnp.clip(goal - state.wanted, -most, most)
    return state._replace(wanted=wanted, holding=holding)


def _clock(gait: Gait, state: LeggedState, body: _Body) -> tuple[LeggedState, Array, Array]:
    """Advances the gait; which feet swing [L] bool and how far they are, 0 to 1 [L].

    The clock rests where all feet carry while nothing is asked and the feet stand well.
    """
    asked = jnp.linalg.norm(state.wanted * jnp.array([1.0, 1.0, 0.25])) > 0.02
    nominal = turned(body.level, _nominal(gait))
    nominal = nominal + (body.at[:2] + gait.lean * body.gradient)[None, :]
    astray = jnp.max(jnp.linalg.norm(body.feet[:, :2] - nominal, axis=1)) > 0.08
    pushed = jnp.linalg.norm(body.velocity[:2]) > 0.15
    offsets = jnp.asarray(LEG_OFFSETS)
    resting = jnp.all((state.phase + offsets) % 1.0 < gait.duty)
    go = asked | astray | pushed | ~resting
    phase = jnp.where(go, (state.phase + CONTROL_PERIOD / gait.period) % 1.0, state.phase)
    legs = (phase + offsets) % 1.0
    progress = jnp.clip((legs - gait.duty) / (1.0 - gait.duty), 0.0, 1.0)
    landed = (progress > 0.6) & (body.gap < 0.004)
    swing = (legs >= gait.duty) & ~landed
    grip = jnp.where(swing[:, None], state.grip, body.feet)
    return state._replace(phase=phase, grip=grip), swing, progress


def _footholds(
    gait: Gait, state: LeggedState, body: _Body, swing: Array, progress: Array, surface: Surface
) -> Array:
    """Where each foot's centre is to land [L, 3] m."""
    hips = turned(body.level, _nominal(gait)) + gait.lean * body.gradient[None, :]  # [L, 2]
    aside = jnp.stack([-hips[:, 1], hips[:, 0]], axis=1)
    wanted = state.wanted[None, :2] + state.wanted[2] * aside
    velocity = body.velocity[None, :2] + body.spin[2] * aside
    stride = gait.period * gait.duty / 2.0
    left = (1.0 - progress) * (1.0 - gait.duty) * gait.period
    place = body.at[:2][None, :] + hips + wanted * stride + gait.catch * (velocity - wanted)
    place = place + velocity * left[:, None]
    reach = place - body.at[:2][None, :] - hips
    far = jnp.linalg.norm(reach, axis=1, keepdims=True)
    place = place - reach * jnp.maximum(0.0, 1.0 - 0.18 / (far + 1e-6))
    # A foot that should carry but hangs just above the ground goes straight down.
    down = ~swing & (body.gap < 0.03)
    place = jnp.where(down[:, None], body.feet[:, :2], place)
    ground = surface.height(place)
    return jnp.concatenate([place, ground[:, None] + FOOT_RADIUS - 0.005], axis=1)


def _swing_torques(
    gait: Gait, state: LeggedState, body: _Body, swing: Array, progress: Array, foothold: Array
) -> Array:
    """Joint torques that draw each free foot along its arc [L, J] N m; zero where it carries."""
    time = (1.0 - gait.duty) * gait.period
    u = jnp.minimum(progress / 0.85, 1.0)  # there a little before it lands
    along, rate, change = u * u * (3 - 2 * u), 6 * u * (1 - u) / 0.85, (6 - 12 * u) / 0.85**2
    change = jnp.where(u < 1.0, change, 0.0)
    angle = 2 * jnp.pi * progress
    bump, bump_rate = 0.5 * (1 - jnp.cos(angle)), jnp.pi * jnp.sin(angle)
    bump_change = 2 * jnp.pi**2 * jnp.cos(angle)
    way = foothold - state.grip
    arc = gait.clearance + 0.5 * jnp.abs(way[:, 2])
    rise = jnp.array([0.0, 0.0, 1.0])[None, :] * arc[:, None]
    target = state.grip + way * along[:, None] + rise * bump[:, None]
    velocity = (way * rate[:, None] + rise * bump_rate[:, None]) / time
    push = (way * change[:, None] + rise * bump_change[:, None]) / time**2
    hanging = ~swing & (body.gap > 0.01)
    target = jnp.where(swing[:, None], target, foothold)
    drop = jnp.array([0.0, 0.0, -0.25])
    velocity = jnp.where(swing[:, None], velocity, drop[None, :] + body.velocity[None, :])
    pull = gait.swing**2 * jnp.clip(target - body.feet, -0.1, 0.1)
    pull = pull + 1.6 * gait.swing * (velocity - body.foot_velocity)
    pull = pull + jnp.where(swing[:, None], push, 0.0)
    square = jnp.sum(body.jacobian[:, :, None, :] * body.jacobian[:, None, :, :], axis=3)
    square = square + NEAR_STRAIGHT * jnp.eye(3)[None]
    joints = times(jnp.swapaxes(body.jacobian, 1, 2), _solve(square, pull))
    torque = turned(jnp.asarray(LEG_INERTIA, joints.dtype), joints)  # symmetric
    return jnp.where((swing | hanging)[:, None], torque, 0.0)


def _solve(matrix: Array, vector: Array) -> Array:
    """x [n, 3] of matrix [n, 3, 3] x = vector [n, 3], by Cramer's rule."""
    a, b, c = matrix[:, :, 0], matrix[:, :, 1], matrix[:, :, 2]
    rows = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=1)
    det = jnp.sum(a * rows[:, 0], axis=1)
    return times(rows, vector) / det[:, None]


def _standing(state: LeggedState) -> Array:
    """Whether no motion is asked for [] bool."""
    return jnp.linalg.norm(state.wanted) < 0.01


def _wrench(gait: Gait, state: LeggedState, body: _Body) -> Array:
    """Wanted force [3] N and moment [3] N m of the ground on the robot."""
    gradient = gait.follow * body.gradient
    up = jnp.concatenate([-gradient, jnp.ones(1)])
    up = up / jnp.linalg.norm(up)
    feet = jnp.mean(body.feet[:, :2], axis=0) - body.at[:2] - gait.lean * body.gradient
    ends = jnp.sum(body.feet[:, :2] * END[:, None], axis=0) / 2.0
    local = times(body.level.T, ends)
    standing = _standing(state)
    yaw = jnp.where(standing, jnp.arctan2(local[1], local[0]), 0.0)
    push = gait.velocity * (state.wanted[:2] - body.velocity[:2]) + DRAG * state.wanted[:2]
    push = push + jnp.where(standing, 8.0 * feet, 0.0)
    push = push / jnp.maximum(1.0, jnp.linalg.norm(push) / (gait.push * GRAVITY))
    rise = body.ground + gait.height - body.at[2]
    climb = jnp.sum(body.gradient * body.velocity[:2]) - body.velocity[2]
    lift = GRAVITY + gait.lift * jnp.clip(rise, -0.05, 0.05) + gait.lift_damping * climb
    lift = jnp.clip(lift, 0.2 * GRAVITY, 3.0 * GRAVITY)
    force = MASS * jnp.concatenate([push, lift[None]])
    tilt = jnp.cross(body.rotation[:, 2], up) + jnp.array([0.0, 0.0, 1.0]) * 0.3 * yaw
    spin = jnp.array([0.0, 0.0, 1.0]) * state.wanted[2] - body.spin
    twist = gait.attitude * tilt + gait.attitude_damping * spin
    moment = times(body.rotation, jnp.asarray(INERTIA) * times(body.rotation.T, twist))
    return jnp.concatenate([force, moment])


def _stance_forces(gait: Gait, state: LeggedState, body: _Body, swing: Array) -> Array:
    """Force of the ground on each carrying foot [L, 3] N: the wanted wrench, split.

    min |A f - b|^2_(1/s) + |f|^2_(1/w), so f = w A^T y with (A w A^T + s) y = b, repeated on
    what the friction cones cut away. The force block of A w A^T is a multiple of the unit
    matrix (each foot adds w), so that only its 3 x 3 Schur complement needs inverting.
    """
    wanted = _wrench(gait, state, body)
    legs = (state.phase + jnp.asarray(LEG_OFFSETS)) % 1.0
    ease = jnp.clip(jnp.minimum(legs, gait.duty - legs) / 0.06 + 0.15, 0.15, 1.0)
    ease = jnp.where(_standing(state), 1.0, ease)
    touch = jnp.clip(1.0 - (body.gap - 0.004) / 0.012, 0.0, 1.0)
    weight = jnp.where(swing, 0.0, ease * touch)[:, None]  # [L, 1]
    arms = body.feet - (body.at + times(body.rotation, jnp.asarray(CENTRE, jnp.float32)))[None, :]
    total, lever = jnp.sum(weight) + SLACK, jnp.sum(weight * arms, axis=0)
    second = jnp.sum((weight * arms)[:, :, None] * arms[:, None, :], axis=0)
    second = second - lever[:, None] * lever[None, :] / total
    schur = (jnp.trace(second) + SLACK * gait.moment) * jnp.eye(3) - second
    forces = jnp.zeros((4, 3))
    for _ in range(PASSES):
        force = wanted[:3] - jnp.sum(forces, axis=0)
        moment = wanted[3:] - jnp.sum(jnp.cross(arms, forces), axis=0)
        turn = _solve(schur[None], (moment - jnp.cross(lever, force) / total)[None])[0]
        pull = (force - jnp.cross(turn, lever)) / total
        forces = forces + weight * (pull[None, :] + jnp.cross(turn[None, :], arms))
        forces = _cut(gait, forces, body.normal, weight[:, 0])
    return forces


def _cut(gait: Gait, forces: Array, normal: Array, weight: Array) -> Array:
    """Forces [L, 3] inside the friction cones about normal [L, 3], none pulling."""
    least = 0.05 * MASS * GRAVITY * weight
    pressed = jnp.clip(jnp.sum(forces * normal, axis=1), least, 2.5 * MASS * GRAVITY)
    along = forces - jnp.sum(forces * normal, axis=1, keepdims=True) * normal
    size = jnp.linalg.norm(along, axis=1)
    along = along * jnp.minimum(1.0, gait.friction * pressed / (size + 1e-6))[:, None]
    return pressed[:, None] * normal + along


def _load() -> mujoco.MjSpec:
    return mujoco.MjSpec.from_file(str(assets() / "robots" / "legged.xml"))


_HIP_ANGLE = float(np.arccos((GAIT.height - FOOT_RADIUS) / (2 * LINK)))

LEGGED = RobotKind(
    name="legged",
    load=_load,
    base="base",
    spawn_height=float(GAIT.height),
    home=np.tile([0.0, _HIP_ANGLE, -2 * _HIP_ANGLE], 4),
    speed=0.4,
    footprint=0.32,
    max_slope=float(np.radians(20.0)),
    init=init,
    control=control,
    max_step=0.16,  # half a leg's reach
    settle=0.8,
    slowing=0.3,  # from `moonteam evaluate slopes`
    tread=Tread(width=0.07, grousers=0.006),
    paces=paces_of("legged"),
    odometry=odometry,
    callsign="strider",
    glyph="disc",
    colour="#a79b8e",
    camera=Camera(distance=2.6, seconds=11.0),
    tuning=Tuning(GAIT, SPANS, control_with),
)
