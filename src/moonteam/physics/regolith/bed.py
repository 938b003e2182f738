"""Tables of what the soil does to each wheel and foot of a scene: what the forces look up.

The sums along a wheel's rim cost too much in a physics step, so they are taken once for each wheel
and soil over a grid of loads and slips. A foot is a flat plate: it does not roll, so nothing but
the displacement since it stood down counts.

Legend: C treads (wheels and feet), L loads, S slips.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array

from moonteam.physics.regolith import wheel
from moonteam.robots.base import Tread
from moonteam.terrain.soil import Soil

Floats = npt.NDArray[np.float64]

SLIPS = np.linspace(0.0, 1.0, 26)
LOADS = 9
SPAN = 16.0
"""The grid of loads reaches from a nominal load divided to multiplied by this."""

FOOT_REACH = 3.0
"""Displacement, in the soil's K, at which a foot's grip counts as all there."""

STEP = 2.0 * float(np.log(SPAN)) / (LOADS - 1)
"""Between the logarithms of the grid's loads."""

DEEPEST = 0.45
"""Most sinkage, of a tread's radius."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Bed:
    """What the soil knows of the treads of a scene; arrays, so that scenes share programs.

    With `which`, the table is that of G soils [G, C, L, S, 4], of which it is that one.
    """

    table: Array  # [C, L, S, 4] thrust, resistance, torque as shares of the load; sinkage m
    nominal: Array  # [C] N, the load in the middle of the grid
    length: Array  # [C] m, displacement at which slip counts as 1
    radius: Array  # [C] m, at which a tread is borne: a wheel's without its grousers
    tip: Array  # [C] m, at which it shears the soil
    axis: Array  # [C, 3] of the wheel in its body; zero for a foot
    rolls: Array  # [C] 1 for wheels, 0 for feet
    which: Array | None = None  # [] index of a soil


def bed_of(soil: Soil, treads: Sequence[Tread], tips: Floats, axes: Floats, loads: Floats) -> Bed:
    """Tables for treads [C] that are spheres of `tips` [C] m and turn about `axes` [C, 3].

    `loads` [C] N: about what each carries at rest.
    """
    radii = [float(tip) - t.grousers * t.rolls for t, tip in zip(treads, tips, strict=True)]
    made = [_tread(soil, tread, radius, float(load))
            for tread, radius, load in zip(treads, radii, loads, strict=True)]

    def single(values: object) -> Array:
        return jnp.asarray(np.asarray(values, np.float32))

    return Bed(single(np.stack([table for table, _ in made])), single(loads),
               single([length for _, length in made]), single(radii), single(tips), single(axes),
               single([float(t.rolls) for t in treads]))


@cache
def _tread(soil: Soil, tread: Tread, radius: float, load: float) -> tuple[Floats, float]:
    """Table [L, S, 4] and the displacement m at which slip counts as 1."""
    loads = load * np.geomspace(1.0 / SPAN, SPAN, LOADS)
    if not tread.rolls:
        return _foot(soil, tread, radius, loads), FOOT_REACH * soil.shear
    shape = wheel.Shape(radius, tread.width, tread.grousers)
    found = wheel.curves(shape, soil, loads, SLIPS)
    # The soil under a rolling wheel has been moved on average by half of slip times contact length.
    middle = float(found.sinkage[LOADS // 2, len(SLIPS) // 4])
    length = 0.5 * shape.tip * float(np.arccos((radius - middle) / shape.tip))
    depth = np.minimum(found.sinkage, DEEPEST * radius)
    return np.stack([found.thrust, found.resistance, found.torque, depth], axis=-1), length


def _foot(soil: Soil, tread: Tread, radius: float, loads: Floats) -> Floats:
    """A round plate's table [L, S, 4]."""
    area = np.pi * tread.width**2 / 4.0
    cohesion, tangent = wheel.interface(soil, tread.grousers)
    grown = 1.0 - np.exp(-FOOT_REACH * SLIPS)
    grip = (tangent + cohesion * area / loads)[:, None] * grown[None, :]
    stiffness = soil.k_c / (tread.width / 2.0) + soil.k_phi
    depth = (loads / area / stiffness) ** (1.0 / soil.n0)
    depth = np.minimum(depth, DEEPEST * radius)[:, None] * np.ones_like(grown)
    return np.stack([grip, np.zeros_like(grip), grip, depth], axis=-1)
