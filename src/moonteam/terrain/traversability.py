"""Where each kind of robot can go, as maps on the mission's grid.

A robot drives along the lines that join cell centres, so a cell is judged on the cross of
those lines, as wide as robots stray from them. It is closed to a kind if anywhere on the
cross the plane under the kind's footprint is too steep, the ground stands too far off that
plane (a step), or a boulder is too near. Planners and policies see these very maps.

Maps are indexed [y, x], row 0 in the south; the map's centre is the site's centre.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from moonteam.problem.mission import Mission
from moonteam.terrain.site import Site
from moonteam.terrain.surface import Surface

BoolMap = npt.NDArray[np.bool_]
FloatMap = npt.NDArray[np.float64]

STRAY = 0.3
"""How far robots stray from the line between two cells, m, but not past a quarter cell."""

CLEARANCE = 0.1
"""Kept between a footprint and a boulder, m."""

POINT_SPACING = 0.25
"""Between the points that a cell is judged on, m."""

@dataclass(frozen=True)
class Limits:
    """What a kind can cross."""

    footprint: float  # m, radius
    max_slope: float  # rad
    max_step: float  # m
    speed: float  # m/s on the level
    slowing: float  # share of speed lost on max_slope
    flies: bool
    joules: tuple[tuple[float, float], ...] = ()  # slope rad, J/m there up and down in the mean


def passable_cells(site: Site, mission: Mission, limits: Mapping[str, Limits]
                   ) -> dict[str, BoolMap]:
    """kind -> [H, W]: the cells of the mission's map that a kind with these limits can be in."""
    return traversability(site, mission.map.size, mission.map.cell_m, limits)


def traversability(
    site: Site, size: tuple[int, int], cell_m: float, limits: Mapping[str, Limits]
) -> dict[str, BoolMap]:
    """kind -> [H, W]: the cells of a map of `size` (W, H) that the kind can be in."""
    times = travel_times(site, size, cell_m, limits)
    return {kind: np.isfinite(seconds) for kind, seconds in times.items()}


def travel_times(
    site: Site, size: tuple[int, int], cell_m: float, limits: Mapping[str, Limits]
) -> dict[str, FloatMap]:
    """kind -> [H, W] s to cross each cell; infinite where the kind cannot be."""
    points = _cross_points(size, cell_m)  # [H, W, P, 2]
    return {kind: _cell_seconds(site, points, cell_m, its) for kind, its in limits.items()}


def passable(site: Site, xy: npt.NDArray[np.floating], limits: Limits) -> BoolMap:
    """Whether a robot with these limits can stand at points xy [..., 2] m: bool [...]."""
    return judge(site, xy, limits, *ground_under(site, xy, limits.footprint))


def ground_under(site: Site, xy: npt.NDArray[np.floating], radius: float
                 ) -> tuple[FloatMap, FloatMap]:
    """Slope [...] rad of the plane under a footprint, and step [...] m: how far the ground
    stands above or below that plane.
    """
    slope, step = _plane_and_step(site.surface, jnp.asarray(xy, jnp.float32), radius)
    return np.asarray(slope, np.float64), np.asarray(step, np.float64)


def boulder_distance(site: Site, xy: npt.NDArray[np.floating]) -> FloatMap:
    """Distance [...] m from points xy [..., 2] to the nearest boulder; infinite if none."""
    nearest = np.full(xy.shape[:-1], np.inf)
    if not site.boulders:
        return nearest
    centres = np.stack([boulder.centre for boulder in site.boulders])
    ground = np.asarray(site.surface.height(jnp.asarray(centres[:, :2], jnp.float32)))
    for boulder, level in zip(site.boulders, ground, strict=True):
        gap = np.linalg.norm(xy - boulder.centre[:2], axis=-1) - boulder.reach(float(level))
        nearest = np.minimum(nearest, gap)
    return nearest


def _cross_points(size: tuple[int, int], cell_m: float) -> npt.NDArray[np.float64]:
    """Points [H, W, P, 2] m that each cell of a map about the origin is judged on."""
    half = cell_m / 2
    count = max(3, 2 * math.ceil(half / POINT_SPACING) + 1)
    steps = np.linspace(-half, half, count)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    stray = min(STRAY, cell_m / 4)
    cross = grid[np.abs(grid).min(axis=1) <= stray + 1e-9]
    width, height = size
    x, y = (cell_m * (np.arange(n) - (n - 1) / 2) for n in (width, height))
    centres = np.stack(np.meshgrid(x, y), axis=-1)  # [H, W, 2]
    return centres[:, :, None, :] + cross[None, None, :, :]


def judge(site: Site, xy: npt.NDArray[np.floating], limits: Limits, slope: FloatMap,
          step: FloatMap) -> BoolMap:
    """`passable` [...] at points xy [..., 2] m whose `slope` and `step` are known."""
    able = np.all(np.abs(xy) <= np.asarray(site.extent) - limits.footprint, axis=-1)
    if not limits.flies:
        able &= (slope <= limits.max_slope) & (step <= limits.max_step)
        able &= boulder_distance(site, xy) >= limits.footprint + CLEARANCE
    return np.asarray(able, np.bool_)


def _cell_seconds(site: Site, points: npt.NDArray[np.float64], cell_m: float, limits: Limits
                  ) -> FloatMap:
    """Seconds [H, W] from one border to the other; turning and stopping are not in it."""
    slope, step = ground_under(site, points, limits.footprint)
    able = judge(site, points, limits, slope, step).all(axis=-1)
    slope = slope.mean(axis=-1)
    slowing = limits.slowing * np.minimum(slope / limits.max_slope, 1.0)
    return np.where(able, cell_m / (limits.speed * (1 - slowing)), np.inf)


@jax.jit
def _plane_and_step(surface: Surface, xy: jax.Array, radius: float
                    ) -> tuple[jax.Array, jax.Array]:
    height, normal = surface.plane(xy, radius)
    slope = jnp.arccos(jnp.clip(normal[..., 2], -1.0, 1.0))
    offsets = (radius * jnp.asarray(_RINGS)).reshape((1,) * (xy.ndim - 1) + _RINGS.shape)
    ground = surface.height(xy[..., None, :] + offsets)
    gradient = normal[..., None, :2] / normal[..., None, 2:]
    plane = height[..., None] - jnp.sum(gradient * offsets, axis=-1)
    return slope, jnp.abs(ground - plane).max(axis=-1)


_RINGS = np.array(
    [[share * np.cos(angle), share * np.sin(angle)] for share in (0.0, 0.5, 1.0)
     for angle in np.linspace(0, 2 * np.pi, 12, endpoint=False)], np.float32)
"""Points [36, 2] of a disc of radius 1."""
