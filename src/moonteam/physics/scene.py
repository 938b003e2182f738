"""Terrain and robots put together into one MuJoCo model that both engines can step.

The height field carries the ground, spheres carry the boulders (rendered as convex hulls),
every robot is attached under `name/`. Gravity is the Moon's, there is no air. Contact bits
are those of `moonteam.robots.base`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import mujoco
import numpy as np

from moonteam.errors import InputError
from moonteam.physics import mjx
from moonteam.physics.grounds import (
    PARKED,
    PARKED_RADIUS,
    Ground,
    Grounds,
    check_alike,
    hfield_name,
    make_grounds,
)
from moonteam.physics.regolith import treads
from moonteam.physics.regolith.bed import Bed
from moonteam.physics.regolith.treads import Treads
from moonteam.robots.base import GRAVITY, PHYSICS_DT, RobotKind
from moonteam.terrain.site import Site
from moonteam.terrain.surface import Surface

FRICTION = 0.75
"""Sliding friction of regolith: the tangent of its angle of repose, about 37 degrees."""

GEOM = mujoco.mjtGeom

NO_TREADS = Treads(*np.zeros((5, 0), np.intp))
"""Of rigid ground."""


@dataclass(frozen=True)
class Placement:
    """Where a robot starts: on the ground at `xy` m, heading `yaw` rad from east."""

    name: str
    kind: RobotKind
    xy: tuple[float, float]
    yaw: float = 0.0


@dataclass(frozen=True)
class SceneRobot:
    """A robot in a scene: its slices of qpos, qvel and ctrl, and its base body's id."""

    name: str
    kind: RobotKind
    qpos: slice
    qvel: slice
    ctrl: slice
    body: int


@dataclass(frozen=True)
class Scene:
    """A compiled model with all that the backends and the renderer need to know about it.

    Where worlds stand on different sites, these are `grounds`, and site and surface the first's.
    """

    model: mujoco.MjModel
    robots: tuple[SceneRobot, ...]
    surface: Surface
    site: Site
    qpos0: np.ndarray  # [nq] every robot standing at its start
    spec: mujoco.MjSpec  # what the model was compiled from
    bed: Bed | None = None  # ground that gives way, and
    treads: Treads = NO_TREADS  # which wheels and feet feel it
    grounds: Grounds | None = None  # None: one

    @property
    def ground(self) -> Ground:
        """What its worlds stand on."""
        return Ground(self.surface, self.bed) if self.grounds is None else self.grounds.ground

    @property
    def sites(self) -> tuple[Site, ...]:
        """Those that a world can stand on, by index."""
        return (self.site,) if self.grounds is None else self.grounds.sites


def build_scene(
    site: Site | Sequence[Site],
    placements: Sequence[Placement],
    *,
    dt: float = PHYSICS_DT,
    iterations: int = 8,
    ls_iterations: int = 8,
    friction: float = FRICTION,
) -> Scene:
    """Compiles a site and robots into a scene.

    Args:
      site: the ground; or several with the same grid, one of which each world then stands on.
      placements: the robots, with names that differ, as they start on the first site. For their
        starts on another see `start_pose`.
      dt: physics step, s.
      iterations: most Newton iterations of the contact solver a step; mostly it takes one, but
        a skidding wheel can need six, and cut short at four a robot drifted 4 cm in 5 s.
      ls_iterations: line-search iterations within each.
      friction: sliding friction of ground and boulders.

    Raises:
      InputError: a start that cannot be: off the site, in a boulder, on too steep ground, on
        top of another robot; sites that are unlike.
    """
    sites = (site,) if isinstance(site, Site) else tuple(site)
    site = sites[0]
    check_alike(sites)
    check_starts(site, placements)
    spec = mujoco.MjSpec()
    _set_options(spec, dt, iterations, ls_iterations)
    _bound_contacts(spec, placements)
    _add_ground(spec, sites, friction)
    _add_boulders(spec, sites, friction)
    for placement in placements:
        robot, prefix = placement.kind.load(), placement.name + "/"
        felt = treads.mark(robot) if site.soil else []
        spec.worldbody.add_frame().attach_body(robot.body(placement.kind.base), prefix, "")
        treads.add_sensors(spec, prefix, felt)
    model = spec.compile()
    for index, one in enumerate(sites):
        set_heights(model, one.heights, index)
    check_collisions(model)
    robots = tuple(_find_robot(model, placement) for placement in placements)
    qpos0 = model.qpos0.copy()
    for robot, placement in zip(robots, placements, strict=True):
        qpos0[robot.qpos] = start_pose(site, placement)
    # model.qpos0 stays: it is where joint angles are measured from, not only a start.
    named = [(placement.name + "/", placement.kind) for placement in placements]
    found = treads.find(model, named) if site.soil else NO_TREADS
    beds = [treads.bed_for(one.soil, model, found, named) for one in sites if one.soil]
    grounds = make_grounds(model, sites, beds) if len(sites) > 1 else None
    return Scene(model, robots, site.surface, site, qpos0, spec, beds[0] if beds else None, found,
                 grounds)


def start_pose(site: Site, placement: Placement) -> np.ndarray:
    """The robot's qpos at its start: standing along the ground's normal, joints at home."""
    kind = placement.kind
    xy = np.asarray(placement.xy, np.float64)
    surface = site.surface
    height, normal = (np.asarray(a, np.float64)
                      for a in surface.plane(jnp.asarray(xy, jnp.float32), kind.footprint))
    around = xy[None] + _disc(kind.footprint)
    ground = np.asarray(surface.height(jnp.asarray(around, jnp.float32)), np.float64)
    plane = height - (around - xy[None]) @ normal[:2] / normal[2]
    # Stand clear of the highest bump under the robot; it settles in the first steps.
    clearance = max(0.0, float(np.max(ground - plane)) * normal[2])
    position = np.array([*xy, height]) + normal * (kind.spawn_height + clearance)
    return np.concatenate([position, _align(normal, placement.yaw), kind.home])


def check_starts(site: Site, placements: Sequence[Placement]) -> None:
    """Raises InputError for the first start that cannot be."""
    for index, placement in enumerate(placements):
        problem = _start_problem(site, placement, placements[:index])
        if problem:
            raise InputError(f"site {site.name}", problem, f"start of robot {placement.name}")


def check_collisions(model: mujoco.MjModel) -> None:
    """Raises ValueError naming the first pair of geoms that MJX could not collide.

    The bits decide which pairs meet; a height field meets only spheres, capsules, boxes and
    meshes, without contact margin.
    """
    for first, second, _ in mjx.geom_pairs(model):
        types = [mjx.GeomType(int(model.geom_type[g])) for g in (first, second)]
        names = " and ".join(
            f"{model.geom(g).name or f'geom {g}'} ({t.name.lower()})"
            for g, t in zip((first, second), types, strict=True))
        if not mjx.has_collision_fn(types[0], types[1]):
            raise ValueError(f"MJX cannot collide {names}")
        if types[0] == mjx.GeomType.HFIELD and (model.geom_margin[[first, second]] > 0).any():
            raise ValueError(f"MJX collides height fields without margin: {names}")


def _start_problem(site: Site, placement: Placement, others: Sequence[Placement]) -> str:
    kind, xy = placement.kind, np.asarray(placement.xy, np.float64)
    where = f"({xy[0]:.2f}, {xy[1]:.2f}) m"
    if any(abs(v) > half - kind.footprint for v, half in zip(xy, site.extent, strict=True)):
        return f"{where} is off the site, which reaches to {site.extent[0]:.1f}, " \
               f"{site.extent[1]:.1f} m"
    _, normal = site.surface.plane(jnp.asarray(xy, jnp.float32), kind.footprint)
    slope = math.acos(min(1.0, float(normal[2])))
    if slope > kind.max_slope:
        return f"{where} is on a slope of {math.degrees(slope):.0f} degrees; at most " \
               f"{math.degrees(kind.max_slope):.0f} for {kind.name}"
    ground = float(site.surface.height(jnp.asarray(xy, jnp.float32)))
    for boulder in site.boulders:
        if boulder.reach(ground) + kind.footprint > math.dist(xy, boulder.centre[:2]):
            return f"{where} is in a boulder of {2 * boulder.radius:.1f} m"
    for other in others:
        if math.dist(xy, other.xy) < 0.8 * (kind.footprint + other.kind.footprint):
            return f"{where} is where robot {other.name} stands"
    return ""


def _set_options(spec: mujoco.MjSpec, dt: float, iterations: int, ls_iterations: int) -> None:
    option = spec.option
    option.timestep = dt
    option.gravity = [0, 0, -GRAVITY]
    option.density = option.viscosity = 0.0  # no air
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.iterations = iterations
    option.ls_iterations = ls_iterations
    # A world that blows up must be seen by the guard, not silently put back to the start.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    spec.compiler.degree = False
    spec.compiler.autolimits = True


def _bound_contacts(spec: mujoco.MjSpec, placements: Sequence[Placement]) -> None:
    """Bounds MJX's work, which has a row for every contact that could ever be.

    Kept are the nearest pairs where many boulders stand, and the deepest contacts: as many as
    the kinds say.
    """
    contacts = sum(placement.kind.contacts for placement in placements)
    spec.add_numeric(name="max_geom_pairs", data=[4 + contacts // 2])
    spec.add_numeric(name="max_contact_points", data=[max(contacts, 8)])


def _add_ground(spec: mujoco.MjSpec, sites: Sequence[Site], friction: float) -> None:
    """One geom, which stands on the first of the sites' height fields."""
    site = sites[0]
    rows, columns = site.heights.shape
    half_x, half_y = site.extent
    low = float(site.heights.min())
    # One scale for all: engines take a geom's bounds, and MJX the scale itself, from the first.
    scale = max(vertical_range(one.heights) for one in sites)
    for index in range(len(sites)):
        spec.add_hfield(name=hfield_name(index), nrow=rows, ncol=columns,
                        size=[half_x, half_y, scale, 1.0], userdata=np.zeros(rows * columns))
    spec.worldbody.add_geom(
        name="ground", type=GEOM.mjGEOM_HFIELD, hfieldname="ground", pos=[0, 0, low],
        # Where soil gives way the contact carries the weight, and the soil does the rest.
        contype=1, conaffinity=0, condim=1 if site.soil else 3, priority=1,
        friction=[friction, 0.005, 0.0001], rgba=[0.5, 0.5, 0.5, 1])


def vertical_range(heights: np.ndarray) -> float:
    """The height field's full scale, m: a power of two at least as large as the relief.

    MJX compiles this number in, so a coarse choice lets many sites share one compilation.
    """
    return float(2.0 ** math.ceil(math.log2(max(1.0, float(np.ptp(heights))))))


def set_heights(model: mujoco.MjModel, heights: np.ndarray, index: int = 0) -> None:
    """Writes a site's elevations [ny, nx] m into a compiled scene, that of the first or another.

    The compiler itself would stretch them to the full scale.
    """
    field = model.hfield(hfield_name(index)).id
    scaled = (heights.astype(np.float64) - float(heights.min())) / model.hfield_size[field, 2]
    first = int(model.hfield_adr[field])
    model.hfield_data[first:first + scaled.size] = scaled.astype(np.float32).ravel()


def _add_boulders(spec: mujoco.MjSpec, sites: Sequence[Site], friction: float) -> None:
    """Those of the first site, and parked ones for sites that have more."""
    boulders = [(boulder.centre, boulder.radius) for boulder in sites[0].boulders]
    more = max(len(site.boulders) for site in sites) - len(boulders)
    parked = [(np.array([0.0, 0.0, PARKED]), PARKED_RADIUS)] * more
    for index, (centre, radius) in enumerate(boulders + parked):
        spec.worldbody.add_geom(
            name=f"boulder{index}", type=GEOM.mjGEOM_SPHERE, size=[radius, 0, 0],
            pos=centre, contype=3, conaffinity=0, condim=3, priority=1,
            friction=[friction, 0.005, 0.0001], group=3)


def _find_robot(model: mujoco.MjModel, placement: Placement) -> SceneRobot:
    """The robot's slices. Raises ValueError if its base has no free joint."""
    prefix = placement.name + "/"
    body = model.body(prefix + placement.kind.base).id
    joint = int(model.body_jntadr[body])
    if joint < 0 or model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
        raise ValueError(f"base {placement.kind.base} of {placement.name} has no free joint")
    mine = [j for j in range(model.njnt) if model.body_rootid[model.jnt_bodyid[j]] == body]
    actuators = [a for a in range(model.nu) if model.actuator(a).name.startswith(prefix)]
    qpos, qvel = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    first = actuators[0] if actuators else 0
    return SceneRobot(
        placement.name, placement.kind, slice(qpos, qpos + 6 + len(mine)),
        slice(qvel, qvel + 5 + len(mine)), slice(first, first + len(actuators)), body)


def _disc(radius: float) -> np.ndarray:
    """Points [n, 2] m that fill a disc about the origin."""
    steps = np.linspace(-radius, radius, 9)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    return grid[np.linalg.norm(grid, axis=1) <= radius]


def _align(normal: np.ndarray, yaw: float) -> np.ndarray:
    """Unit quaternion wxyz [4]: z along `normal` [3], x towards the heading `yaw`."""
    x = np.array([math.cos(yaw), math.sin(yaw), 0.0])
    x = x - normal * (x @ normal)
    x /= np.linalg.norm(x)
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.stack([x, np.cross(normal, x), normal], axis=1).ravel())
    return quat
