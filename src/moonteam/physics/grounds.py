"""Another ground under each world: many sites of one grid in one scene.

A scene's model holds a height field for each site, all to one vertical scale, and as many boulders
as the stoniest site has; where a site has fewer, the rest are parked far below it. C MuJoCo's
batch lets each simulation choose its height field and boulders (`Rocks.fields`), in MJX each world
makes the model its own (`Rocks.model`). What controllers and soil ask is kept side by side, too,
and looked up by the world's index.

Legend: B worlds, G grounds, S geoms of a ground: its height field and boulders, C treads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import numpy.typing as npt
from jax import Array

from moonteam.errors import InputError
from moonteam.physics import mjx
from moonteam.physics.regolith.bed import Bed
from moonteam.terrain.site import Site
from moonteam.terrain.surface import Surface

PARKED = -1000.0
"""Height of boulders that a ground does not have, m."""

PARKED_RADIUS = 0.05
"""Of those, m; MJX takes no radius at all for a plane."""

FIELDS = ("geom_dataid", "geom_pos", "geom_size", "geom_rbound", "geom_aabb")
"""Of a model, which say what a ground's geoms are."""


class Ground(NamedTuple):
    """What worlds stand on, as MJX's programs take it: one ground, or G side by side."""

    surface: Surface
    bed: Bed | None  # None: rigid
    rocks: Rocks | None = None  # None: one ground, whose geoms are the model's

    def under(self, which: Array | None) -> Ground:
        """Of one world: what controllers and soil ask. `which`: its index, None of one ground."""
        if which is None:
            return self
        surface = replace(self.surface, which=which)
        bed = self.bed and replace(self.bed, which=which, length=self.bed.length[which])
        return Ground(surface, bed, self.rocks)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Rocks:
    """The geoms of G grounds; arrays, so that scenes share programs."""

    geoms: Array  # [S] ids, the height field first
    pos: Array  # [G, S, 3] m
    size: Array  # [G, S, 3] m
    rbound: Array  # [G, S] m

    def model(self, model: mjx.Model, which: Array) -> mjx.Model:
        """The model with ground `which` in place of the first."""
        count = model.hfield_data.shape[0] // self.pos.shape[0]
        return model.replace(
            # Every height field's geom is one and the same, which reads the first.
            hfield_data=jax.lax.dynamic_slice(model.hfield_data, (which * count,), (count,)),
            geom_pos=model.geom_pos.at[self.geoms].set(self.pos[which]),
            geom_size=model.geom_size.at[self.geoms].set(self.size[which]),
            geom_rbound=model.geom_rbound.at[self.geoms].set(self.rbound[which]))


@dataclass(frozen=True)
class Grounds:
    """Of a scene with more than one."""

    sites: tuple[Site, ...]  # G
    ground: Ground  # all side by side
    geoms: npt.NDArray[np.intp]  # [S]
    fields: dict[str, npt.NDArray]  # of FIELDS, [G, S, ...]


def check_alike(sites: Sequence[Site]) -> None:
    """Raises InputError unless all have one grid and all give way, or none does."""
    first = sites[0]
    for site in sites[1:]:
        where = f"site {site.name} {site.seed}"
        if (site.heights.shape, site.spacing) != (first.heights.shape, first.spacing):
            raise InputError(where, f"has {_grid(site)}, and {first.name} {first.seed} "
                             f"{_grid(first)}; sites in one scene need the same grid")
        if (site.soil is None) != (first.soil is None):
            raise InputError(where, f"and {first.name} {first.seed}: one is rigid and one gives "
                             "way; sites in one scene are all rigid or all regolith")


def _grid(site: Site) -> str:
    ny, nx = site.heights.shape
    return f"{nx} x {ny} heights {site.spacing:g} m apart"


def make_grounds(model: mujoco.MjModel, sites: Sequence[Site], beds: Sequence[Bed]) -> Grounds:
    """The grounds of a compiled scene, whose height fields and first boulders are those of `sites`.

    `beds`: one for each site where they give way, else none.
    """
    most = max(len(site.boulders) for site in sites)
    geoms = np.array([model.geom(name).id for name in
                      ("ground", *(f"boulder{i}" for i in range(most)))], np.intp)
    # A geom at its body's own place would be kept there, wherever a world moves it.
    model.geom_sameframe[geoms] = mujoco.mjtSameFrame.mjSAMEFRAME_BODYROT
    # The tree over the boulders is that of the first ground.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE
    fields = {name: np.repeat(getattr(model, name)[geoms][None], len(sites), axis=0)
              for name in FIELDS}
    for g, site in enumerate(sites):
        fields["geom_dataid"][g, 0] = model.hfield(hfield_name(g)).id
        fields["geom_pos"][g, 0, 2] = float(site.heights.min())
        fields["geom_pos"][g, 1:] = (0.0, 0.0, PARKED)
        radii = np.full(most, PARKED_RADIUS)
        for i, boulder in enumerate(site.boulders):
            fields["geom_pos"][g, 1 + i], radii[i] = boulder.centre, boulder.radius
        fields["geom_size"][g, 1:, 0] = fields["geom_rbound"][g, 1:] = radii
        fields["geom_aabb"][g, 1:, 3:] = radii[:, None]
    rocks = Rocks(jnp.asarray(geoms), *(jnp.asarray(fields[name], jnp.float32) for name in
                                        ("geom_pos", "geom_size", "geom_rbound")))
    ground = Ground(_surfaces(sites), _beds(beds), rocks)
    return Grounds(tuple(sites), ground, geoms, fields)


def hfield_name(index: int) -> str:
    """Of a site's height field in the model; the geom that all of them share is called `ground`."""
    return f"ground{index}" if index else "ground"


def standing(grounds: Grounds | None, batch: int, which: npt.ArrayLike | None) -> Array | None:
    """Index of the ground of each of B worlds, the first by default; None where there is but one.

    Raises ValueError for a ground that the scene does not have.
    """
    have = 1 if grounds is None else len(grounds.sites)
    index = np.broadcast_to(np.asarray(0 if which is None else which, np.int32), (batch,))
    for one in index[(index < 0) | (index >= have)].tolist():
        raise ValueError(f"ground {one} of a world is not allowed; the scene has 0 to {have - 1}")
    return None if grounds is None else jnp.asarray(index)


def _surfaces(sites: Sequence[Site]) -> Surface:
    each = [site.surface for site in sites]
    tops = [surface.heights if surface.tops is None else surface.tops for surface in each]
    return replace(each[0], heights=jnp.stack([surface.heights for surface in each]),
                   tops=jnp.stack(tops))


def _beds(beds: Sequence[Bed]) -> Bed | None:
    """Side by side what soils differ in: tables [G, C, L, S, 4] and lengths [G, C]."""
    if not beds:
        return None
    return replace(beds[0], table=jnp.stack([bed.table for bed in beds]),
                   length=jnp.stack([bed.length for bed in beds]))
