"""Which spheres of a scene are wheels and feet, and what the engines feel of them.

Legend: C treads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
import numpy.typing as npt
from jax import Array

from moonteam.physics.regolith.bed import Bed, bed_of
from moonteam.physics.regolith.forces import Felt
from moonteam.robots.base import GRAVITY, RobotKind
from moonteam.terrain.soil import Soil

Ints = npt.NDArray[np.intp]

SENSED = 1.4
"""A touch sensor counts the contacts within this many radii of a tread's centre."""

WIDTH = 25
"""Numbers that make up what is felt of a tread."""

FELT_FIELDS = ("geom_xpos", "xmat", "cvel", "subtree_com", "xipos", "sensordata")
"""Of MjData, from which what is felt is made."""

LEAST_RADIUS = 0.004
"""Of a tread's sphere, m, however deep it sinks."""


@dataclass(frozen=True)
class Treads:
    """Ids of all treads of a scene [C] in its compiled model, and which robot each is of."""

    geoms: Ints
    bodies: Ints
    roots: Ints
    sensors: Ints  # addresses in sensordata
    robots: Ints

    def felt(self, data: Any, loads: Any, xp: Any) -> Any:
        """Side by side [..., C, WIDTH], of the fields of MjData, MJX's or a batch's and the loads
        [..., C] N, by `xp`.
        """
        parts = (data.geom_xpos[..., self.geoms, :], _rows(data.xmat, 9)[..., self.bodies, :],
                 data.cvel[..., self.bodies, :], data.subtree_com[..., self.roots, :],
                 data.xipos[..., self.bodies, :], loads[..., None])
        return xp.concatenate(parts, axis=-1)


def _rows(matrices: Any, size: int) -> Any:
    """Matrices [..., n, 3, 3] or [..., n, 9] as [..., n, 9]."""
    return matrices if matrices.shape[-1] == size else matrices.reshape(
        (*matrices.shape[:-2], size))


def felt_of(row: Array) -> Felt:
    """What is felt, from its numbers side by side [C, WIDTH]."""
    centre, axes, spin, drift, root, com, load = jnp.split(row, (3, 12, 15, 18, 21, 24), axis=1)
    return Felt(centre, axes.reshape((-1, 3, 3)), spin, drift, root, com, load[:, 0])


def mark(robot: mujoco.MjSpec) -> list[str]:
    """Adds a site about every sphere of a robot that meets the ground; returns their names."""
    names = []
    for geom in list(robot.geoms):
        if geom.contype == 0 and geom.conaffinity == 1:
            name = f"tread{len(names)}"
            geom.parent.add_site(name=name, pos=geom.pos, size=[SENSED * geom.size[0]] * 3,
                                 group=5)
            names.append(name)
    return names


def add_sensors(spec: mujoco.MjSpec, prefix: str, names: Sequence[str]) -> None:
    """Touch sensors for the sites of a robot that is attached under `prefix`."""
    for name in names:
        spec.add_sensor(name=prefix + name, type=mujoco.mjtSensor.mjSENS_TOUCH,
                        objtype=mujoco.mjtObj.mjOBJ_SITE, objname=prefix + name)


def find(model: mujoco.MjModel, robots: Sequence[tuple[str, RobotKind]]) -> Treads:
    """The treads of robots (prefix, kind) in a compiled scene."""
    rows = []
    for index, (prefix, _) in enumerate(robots):
        for sensor in range(model.nsensor):
            if not model.sensor(sensor).name.startswith(prefix + "tread"):
                continue
            site = int(model.sensor_objid[sensor])
            body = int(model.site_bodyid[site])
            rows.append((geom_at(model, site), body, int(model.body_rootid[body]),
                         int(model.sensor_adr[sensor]), index))
    return Treads(*np.array(rows, np.intp).reshape(-1, 5).T)


def geom_at(model: mujoco.MjModel, site: int) -> int:
    """The sphere that meets the ground about which `mark` has put a site."""
    return next(g for g in range(model.ngeom)
                if model.geom_bodyid[g] == model.site_bodyid[site]
                and model.geom_contype[g] == 0 and model.geom_conaffinity[g] == 1
                and np.allclose(model.geom_pos[g], model.site_pos[site]))


def bed_for(soil: Soil, model: mujoco.MjModel, treads: Treads,
            robots: Sequence[tuple[str, RobotKind]]) -> Bed:
    """The tables for a scene's treads. Raises ValueError for a wheel without a hinge."""
    axes, loads = np.zeros((len(treads.geoms), 3)), np.zeros(len(treads.geoms))
    kinds = [robots[r][1] for r in treads.robots]
    for c, (body, root, kind) in enumerate(zip(treads.bodies, treads.roots, kinds, strict=True)):
        loads[c] = model.body_subtreemass[root] * GRAVITY / 4.0
        if kind.tread.rolls:
            joint = int(model.body_jntadr[body])
            if joint < 0 or model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_HINGE:
                raise ValueError(f"a tread of {kind.name} rolls, but its body has no hinge")
            axes[c] = model.jnt_axis[joint]
    return bed_of(soil, [kind.tread for kind in kinds], model.geom_size[treads.geoms, 0], axes,
                  loads)


def radii(bed: Bed, depth: Array) -> Array:
    """Radii [C] m of the spheres in contact, at a sinkage [C] m."""
    return jnp.maximum(bed.radius - depth, LEAST_RADIUS)
