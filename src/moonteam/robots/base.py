"""What a kind of robot is: one object that answers whatever anybody asks about it.

Controllers are pure JAX functions over a small typed state, so both backends and vmap use
the same code. Units: SI, radians. World frame: x east, y north, z up, site centre at the
origin. Robot state is MuJoCo's: qpos = free joint (position [3], quaternion wxyz [4]) then
joints; qvel = linear velocity in the world frame [3], angular in the body frame [3], joints.

Contacts, as contype/conaffinity: height field 1/0, boulder 3/0, foot or wheel 0/1 (touches
ground and boulders), hull 2/2 (one coarse sphere or so: touches boulders and other robots'
hulls, never the height field, whose cost in MJX grows with geom size), visual 0/0.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Literal, NamedTuple, get_args

import jax.numpy as jnp
import mujoco
import numpy as np
import numpy.typing as npt
from jax import Array

from moonteam import files
from moonteam.paths import assets
from moonteam.terrain.surface import Surface
from moonteam.terrain.traversability import Limits

Floats = npt.NDArray[np.float64]
Height = Callable[[Floats], Floats]  # ground height [...] m under points [..., 2] m
Glyph = Literal["triangle", "disc", "square", "pentagon", "hexagon"]
GLYPHS: tuple[Glyph, ...] = get_args(Glyph)

GRAVITY = 1.62
"""Lunar gravity, m/s^2."""

PHYSICS_DT = 0.004
"""Physics step, s."""

CONTROL_PERIOD = 0.008
"""Time between two calls of every controller, s; actuator commands are held in between."""


class Command(NamedTuple):
    """Where a robot should go. Arrays so that it can be vmapped and traced."""

    xy: Array  # [2] m, waypoint in the world frame; what flies holds its height above ground there
    speed: Array  # [] m/s, upper limit; 0: hold the place; below 0: what flies lands at xy
    lost: Array  # [] bool, True: actuators off (the robot left the team)


class Telemetry(NamedTuple):
    """What a controller reports each control step."""

    power: Array  # [] W, mechanical power asked of the actuators, >= 0
    propellant: Array  # [] kg/s used; 0 where there is none


class Tread(NamedTuple):
    """What touches the ground, for soil that gives way: each sphere that meets it is a wheel, or a
    foot with a flat round sole.
    """

    width: float = 0.06  # m, of a wheel; diameter of a sole
    grousers: float = 0.0  # m high, of a wheel within the sphere's radius; 0: smooth
    rolls: bool = False  # whether it is a wheel, about the hinge of its body


class Pace(NamedTuple):
    """How fast a kind is on a soil, as maps and travel fields believe it."""

    speed: float  # m/s on the level
    max_slope: float  # rad, beyond which it must not go
    slowing: float  # share of its speed lost there, in proportion to the slope
    slopes: tuple[float, ...] = ()  # rad along its way, downhill below 0, ascending, of
    slip: tuple[float, ...] = ()  # its wheels' slip there; none: it has no wheels, and
    energy: tuple[float, ...] = ()  # J/m there


class Camera(NamedTuple):
    """How a film of one robot is taken."""

    distance: float = 2.9  # m from the robot
    seconds: float = 10.0  # of a clip


CAMERA = Camera()
SOLE = Tread()


class Tuning(NamedTuple):
    """What `python -m moonteam.physics.trials.tune` may change, and the way to try it."""

    numbers: Any  # NamedTuple of scalars: the controller's own
    spans: Mapping[str, tuple[float, float]]  # limits of those that a search changes
    control: Callable[..., tuple[Array, Any, Telemetry]]  # RobotKind.control, `numbers` first


@dataclass(frozen=True)
class RobotKind:
    """One kind of robot: all that scene, backends, maps, films and reports ask about it.

    `init(qpos, qvel) -> state` and `control(state, time, qpos, qvel, command, surface) ->
    (ctrl [nu], state, Telemetry)`, all of this robot's own slices; called every
    CONTROL_PERIOD seconds. Pure, jittable, vmappable.

    `odometry(qpos [T, 7 + joints], height) -> (counted, real) m`: what wheels or legs count
    and how far the robot really went; None where that cannot be told. A kind without
    `odometry` does not slip.

    `moonteam.physics.trials.conformance` holds a kind to all this.
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
    max_step: float = math.inf  # m, highest step it takes
    slowing: float = 0.0  # share of its speed lost on max_slope; in proportion to the slope
    settle: float = 0.0  # s that setting out and coming to rest cost it beside the way
    flies: bool = False
    lands_for: float = math.inf  # s of service from which what flies comes down for it
    fall_tilt: float = math.radians(60.0)  # rad of the base from the vertical: fallen
    odometry: Callable[[Floats, Height | None], tuple[float, float] | None] | None = None
    tread: Tread = SOLE
    paces: Mapping[str, Pace] = field(default_factory=dict)  # by soil; without: as on rigid ground
    contacts: int = 8  # with ground and boulders that count at once: two a foot or wheel
    callsign: str = ""  # of the one in a random team; "": its kind's name
    glyph: Glyph = "disc"  # how a map marks it
    colour: str = "#bfb8b0"  # #rrggbb, of ground that is closed to it
    camera: Camera = CAMERA
    tuning: Tuning | None = None

    @property
    def limits(self) -> Limits:
        """What rigid ground it can cross, as maps ask for it."""
        return self.limits_on(None)

    def limits_on(self, soil: str | None) -> Limits:
        """What ground of a soil it can cross, as maps ask for it; None: rigid ground."""
        pace = self.paces.get(soil or "", Pace(self.speed, self.max_slope, self.slowing))
        there = dict(zip(pace.slopes, pace.energy, strict=True))
        joules = tuple((slope, (there[slope] + there.get(-slope, there[slope])) / 2.0)
                       for slope in pace.slopes if slope >= 0.0) if there else ()
        return Limits(self.footprint, pace.max_slope, self.max_step, pace.speed, pace.slowing,
                      self.flies, joules)


def paces_of(name: str) -> dict[str, Pace]:
    """The bundled paces of a kind by soil, as `moonteam evaluate paces` has measured them."""
    found = {soil: by_kind[name]["pace"] for soil, by_kind in _measured().items()
             if name in by_kind}
    return {soil: Pace(its["speed"], its["max_slope"], its["slowing"], tuple(its["slopes"]),
                       tuple(its["slip"]), tuple(its["energy"])) for soil, its in found.items()}


@cache
def _measured() -> dict[str, Any]:
    """By soil and kind, read once for all kinds."""
    return files.read_json(assets() / "robots" / "paces.json")["soils"]


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


def rotations(quat: Floats) -> Floats:
    """Rotation matrices [..., 3, 3], body to world, of quaternions [..., 4], on the host."""
    w, x, y, z = np.moveaxis(quat / np.linalg.norm(quat, axis=-1, keepdims=True), -1, 0)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    return np.stack(rows, axis=-1).reshape(*quat.shape[:-1], 3, 3)


def wheel_odometry(qpos: Floats, joints: npt.NDArray[np.integer], radius: float
                   ) -> tuple[float, float]:
    """What wheels count and what the base really went, m; qpos [T, 7 + joints].

    Counted is the mean turn of the wheel `joints` times their radius (so turning on the spot,
    left against right, counts nothing), real the displacement along the heading.
    """
    turned = np.diff(qpos[:, 7 + joints], axis=0).mean(axis=1) * radius
    forward = rotations(qpos[:, 3:7])[:, :, 0]
    along = (np.diff(qpos[:, :3], axis=0) * (forward[1:] + forward[:-1]) / 2).sum(axis=1)
    return float(np.abs(turned).sum()), float(np.abs(along).sum())
