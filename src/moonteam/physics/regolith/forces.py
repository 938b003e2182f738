"""Forces of the soil on wheels and feet, for both engines: one pure function of one world.

The engine's contact, without friction, carries the weight. What acts along the ground is the
soil's: it follows from how far the soil under a tread has been moved, a displacement u in the
ground's plane that grows with the slip velocity and is left behind as a wheel rolls on,

    du/dt = v_slip - u v / L,        slip s = u / L,

so that rolling steadily s is the slip ratio (v_roll - v) / v_roll, and standing still the soil
holds like a spring until it shears. Grip, resistance, torque and sinkage are looked up over load
and slip (`bed`). Forces are made anew every CONTROL_PERIOD and held in between.

Legend: C treads.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from moonteam.physics.regolith.bed import STEP, Bed
from moonteam.robots.base import CONTROL_PERIOD
from moonteam.terrain.surface import Surface

PATCH = 0.08
"""Radius of the ground whose plane a tread stands on, m."""

NEAR = 0.02
"""A tread farther than this from the ground, m, stands on something else: a rock."""

DAMPING = 0.1
"""s; moving soil resists more than still soil, by this times the rate at which it is moved."""

CREEP = 0.005
"""Speed, m/s, at which the resistance to rolling is three quarters there."""

SETTLING = 0.3
"""Seconds in which a tread that stands comes to its depth."""

BEARING = 0.02
"""A tread with less than this share of its nominal load has left the ground."""


class Felt(NamedTuple):
    """What a tread's body is doing, as the engine has it after its last step."""

    centre: Array  # [C, 3] m, of the sphere
    axes: Array  # [C, 3, 3] of the body, columns
    spin: Array  # [C, 3] rad/s
    drift: Array  # [C, 3] m/s, at `root`
    root: Array  # [C, 3] m
    com: Array  # [C, 3] m, of the body: where forces are applied
    load: Array  # [C] N, normal force of the contact


class Memory(NamedTuple):
    """What the soil remembers of a tread."""

    moved: Array  # [C, 2] m, displacement of the soil: forward, left
    depth: Array  # [C] m
    load: Array  # [C] N, smoothed


class Told(NamedTuple):
    """What is reported of a tread."""

    slip: Array  # [C] in -1..1: rim against ground along the wheel; 0 for feet and off the ground
    depth: Array  # [C] m
    load: Array  # [C] N


def fresh(num_treads: int) -> Memory:
    """Soil that nobody has touched."""
    return Memory(jnp.zeros((num_treads, 2)), jnp.zeros(num_treads), jnp.zeros(num_treads))


def soil_forces(bed: Bed, surface: Surface, memory: Memory, felt: Felt
                ) -> tuple[Array, Memory, Told]:
    """Forces N and torques N m on the treads' bodies [C, 6], applied at their centres of mass."""
    height, normal = surface.plane(felt.centre[:, :2], PATCH)
    gap = (felt.centre[:, 2] - height) * normal[:, 2] - (bed.radius - memory.depth)
    load = jnp.where(gap < NEAR, felt.load, 0.0)
    load = memory.load + 0.5 * (load - memory.load)

    forward, left, axle = _frame(bed, felt, normal)
    lever = -normal * (bed.tip - memory.depth * (1.0 - bed.rolls))[:, None]
    velocity = felt.drift + jnp.cross(felt.spin, felt.centre - felt.root)
    slipping = -(velocity + jnp.cross(felt.spin, lever))
    slipping = jnp.stack([_dot(slipping, forward), _dot(slipping, left)], axis=1)
    along = _dot(velocity, forward)
    rolling = bed.rolls * _dot(felt.spin, axle) * bed.tip
    pace = bed.rolls * jnp.maximum(jnp.abs(rolling), jnp.abs(along))

    moved = (memory.moved + CONTROL_PERIOD * slipping) / (
        1.0 + CONTROL_PERIOD * pace / bed.length)[:, None]
    size = jnp.linalg.norm(moved, axis=1)
    moved = moved * jnp.minimum(1.0, bed.length / (size + 1e-9))[:, None]
    bears = load > BEARING * bed.nominal
    moved = jnp.where(bears[:, None], moved, 0.0)
    rate = (moved - memory.moved) / CONTROL_PERIOD
    strain = (moved + DAMPING * rate) / bed.length[:, None]
    slip = jnp.linalg.norm(strain, axis=1)
    way = strain / (slip + 1e-6)[:, None]

    thrust, resistance, torque, depth = _looked_up(bed, load, jnp.minimum(slip, 1.0))
    push = load * thrust * way[:, 0] - load * resistance * jnp.tanh(along / CREEP)
    aside = load * thrust * way[:, 1]
    force = push[:, None] * forward + aside[:, None] * left
    # On a wheel the thrust acts by the torque of the rim's shear, on a foot by its lever.
    turning = jnp.cross(lever, jnp.where(bed.rolls > 0.0, aside, 0.0)[:, None] * left) - (
        load * torque * bed.tip * way[:, 0])[:, None] * axle
    turning = jnp.where(bed.rolls[:, None] > 0.0, turning, jnp.cross(lever, force))
    turning = turning + jnp.cross(felt.centre - felt.com, force)

    share = jnp.clip(CONTROL_PERIOD * (pace / bed.length + 1.0 / SETTLING), 0.0, 1.0)
    depth = memory.depth + share * (jnp.where(bears, depth, 0.0) - memory.depth)
    ratio = jnp.where(bears, bed.rolls * (rolling - along) / jnp.maximum(pace, 0.02), 0.0)
    return (jnp.concatenate([force, turning], axis=1), Memory(moved, depth, load),
            Told(jnp.clip(ratio, -1.0, 1.0), depth, load))


def _frame(bed: Bed, felt: Felt, normal: Array) -> tuple[Array, Array, Array]:
    """Forward and left in the ground's plane, and the axle [C, 3]; of a foot, east and north."""
    axle = jnp.sum(felt.axes * bed.axis[:, None, :], axis=-1)
    north = jnp.array([[0.0, 1.0, 0.0]])
    forward = jnp.cross(jnp.where(bed.rolls[:, None] > 0.0, axle, north), normal)
    forward = forward / (jnp.linalg.norm(forward, axis=1, keepdims=True) + 1e-6)
    return forward, jnp.cross(normal, forward), axle


def _looked_up(bed: Bed, load: Array, slip: Array) -> tuple[Array, Array, Array, Array]:
    """The table at loads [C] and slips [C], linear in slip and in the load's logarithm."""
    loads, slips = bed.table.shape[-3:-1]
    at = jnp.log(jnp.maximum(load, 1e-6) / bed.nominal) / STEP + 0.5 * (loads - 1)
    row, row_part = _between(at, loads)
    column, column_part = _between(slip * (slips - 1), slips)
    which = (*(() if bed.which is None else (bed.which,)), jnp.arange(len(load)))

    def line(r: Array) -> Array:
        near, far = bed.table[*which, r, column], bed.table[*which, r, column + 1]
        return near + column_part[:, None] * (far - near)

    low, high = line(row), line(row + 1)
    found = low + row_part[:, None] * (high - low)
    return found[:, 0], found[:, 1], found[:, 2], found[:, 3]


def _between(at: Array, count: int) -> tuple[Array, Array]:
    """Index and share of the way to the next, of a place in a grid of `count`."""
    at = jnp.clip(at, 0.0, count - 1.0)
    index = jnp.minimum(jnp.floor(at), count - 2.0).astype(jnp.int32)
    return index, at - index


def _dot(a: Array, b: Array) -> Array:
    return jnp.sum(a * b, axis=1)
