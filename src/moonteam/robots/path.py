"""The straight way to a waypoint, which every controller follows: origin, goal, errors."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from moonteam.robots.base import Command


class Path(NamedTuple):
    """The segment a robot is on. A new waypoint starts a new segment where the robot stands."""

    origin: Array  # [2] m
    goal: Array  # [2] m
    holding: Array  # [] bool, the last command was to hold the place


class Offset(NamedTuple):
    """Where a robot is with respect to its path."""

    direction: Array  # [2] unit vector from origin to goal
    remaining: Array  # [] m along `direction` to the goal, < 0 past it
    cross: Array  # [] m to the left of the line
    distance: Array  # [] m to the goal


def start_path(xy: Array) -> Path:
    """A path that holds the place xy [2] m."""
    return Path(xy, xy, jnp.array(True))


def update_path(path: Path, xy: Array, command: Command) -> Path:
    """Takes up the command: its waypoint, or the robot's place where its speed is 0."""
    holding = command.speed == 0.0
    place = jnp.where(path.holding, path.goal, xy)
    goal = jnp.where(holding, place, command.xy)
    changed = jnp.any(goal != path.goal)
    return Path(jnp.where(changed, xy, path.origin), goal, holding)


def measure(path: Path, xy: Array) -> Offset:
    """The robot's offset from its path; on a path of no length every way is along."""
    line = path.goal - path.origin
    away = path.goal - xy
    distance = jnp.sqrt(jnp.sum(away**2) + 1e-12)
    length = jnp.sqrt(jnp.sum(line**2))
    direction = jnp.where(length > 1e-3, line / jnp.maximum(length, 1e-3), away / distance)
    remaining = jnp.sum(direction * away)
    cross = direction[1] * away[0] - direction[0] * away[1]
    return Offset(direction, remaining, cross, distance)


def braking_speed(distance: Array, limit: Array, deceleration: float, gain: float) -> Array:
    """Fastest speed [] m/s from which `deceleration` still stops; `gain`·distance at the end.

    Odd in distance, so that a robot past its goal comes back.
    """
    far = jnp.abs(distance)
    stop = jnp.sqrt(2.0 * deceleration * far)
    return jnp.sign(distance) * jnp.minimum(limit, jnp.minimum(stop, gain * far))
