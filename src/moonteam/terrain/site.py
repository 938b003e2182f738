"""A piece of lunar ground: elevations on a regular grid plus boulders too big to be ground.

Sites come from a preset and a seed (`make_site`), from an elevation model (`import_dem`), or
from what a mission asks for (`for_mission`). Row 0 is the south edge, column 0 the west edge,
the site's centre is the origin, heights are metres.
"""

from __future__ import annotations

import functools
import math
import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

from moonteam.errors import InputError, meant
from moonteam.problem.mission import Mission
from moonteam.problem.piece import WHOLE, Piece
from moonteam.problem.sun import SunPosition
from moonteam.terrain import dem, generate
from moonteam.terrain import soil as soils
from moonteam.terrain.soil import Soil
from moonteam.terrain.surface import Surface

SPACING = 0.25
"""Default distance between elevation samples, m; finer grids cost collision time."""

MARGIN = 4.0
"""Ground kept around a mission's map, m, so that a robot at the edge still stands on some."""

OVERHANG = 0.6
"""What flies keeps above a boulder's top from this far beside it on, m: its own half width and
how far it strays.
"""

MAX_SAMPLES = 1_500_000
"""Largest number of elevation samples in a site."""

SITES = (*generate.PRESETS, "flat")
"""Presets of ground."""


@dataclass(frozen=True)
class Boulder:
    """A rock that stands out of the ground as an obstacle.

    The engines collide with the sphere; `vertices`, a convex hull drawn around that sphere, is
    what is rendered.
    """

    centre: np.ndarray  # [3] m, of the sphere, often below ground: the rock is part buried
    radius: float  # m
    vertices: np.ndarray  # [n, 3] m, hull corners about `centre`

    def reach(self, ground: float) -> float:
        """Horizontal radius m of what stands above `ground` m, 0 if nothing does."""
        below = max(0.0, ground - float(self.centre[2]))
        return math.sqrt(max(0.0, self.radius**2 - below**2))


@dataclass(frozen=True)
class Site:
    """Ground that the physics stands on. `meta` says how it was made, for reports."""

    name: str
    seed: int
    heights: np.ndarray  # [ny, nx] m, float32
    spacing: float  # m
    boulders: tuple[Boulder, ...] = ()
    meta: dict[str, Any] = field(default_factory=dict)
    sun: SunPosition | None = None  # None: nobody asks for it, and pictures have their own
    soil: Soil | None = None  # what the ground is made of; None: it is rigid
    known: bool = True  # whether maps and fields know the soil, or believe that it is rigid

    @functools.cached_property
    def surface(self) -> Surface:
        """The ground as a function of (x, y); boulders show in its `top` alone.

        Made outside any trace, since it is kept and would carry the first tracer along.
        """
        with jax.ensure_compile_time_eval():
            ground = jnp.asarray(self.heights, jnp.float32)
            return Surface(ground, self.spacing, jnp.asarray(self._tops(), jnp.float32),
                           self.soil is not None)

    def _tops(self) -> np.ndarray:
        """Elevations [ny, nx] m, raised to a boulder's top as far as OVERHANG around it."""
        tops = self.heights.astype(np.float32)
        y, x = (self.spacing * (np.arange(n) - (n - 1) / 2) for n in tops.shape)
        for boulder in self.boulders:
            away = np.hypot(x[None, :] - boulder.centre[0], y[:, None] - boulder.centre[1])
            high = float(boulder.centre[2]) + boulder.radius
            ground = float(self.heights.flat[away.argmin()])
            over = away <= boulder.reach(ground) + OVERHANG
            tops[over] = np.maximum(tops[over], high)
        return tops

    @property
    def extent(self) -> tuple[float, float]:
        """Half widths (x, y) in metres."""
        ny, nx = self.heights.shape
        return (nx - 1) * self.spacing / 2, (ny - 1) * self.spacing / 2


def make_site(
    preset: str, seed: int, extent_m: float | tuple[float, float], spacing: float = SPACING
) -> Site:
    """Ground of a preset: one of `generate.PRESETS` (mare, highland, crater_rim, polar), or flat.

    The same arguments give the same site to the bit. `extent_m`: side, or (x, y) sides.
    Raises InputError for an unknown preset or a size that cannot be made.
    """
    shape = _shape(preset, extent_m, spacing)
    if preset == "flat":
        return Site("flat", seed, np.zeros(shape, np.float32), spacing, meta={"preset": "flat"})
    if preset not in generate.PRESETS:
        raise InputError("site", f"no preset {preset!r}; {meant(preset, SITES)}presets: "
                         + ", ".join(SITES), "preset")
    heights, craters, rocks = generate.evaluate(preset, seed, shape, spacing)
    site = Site(preset, seed, heights, spacing)
    meta = {
        "preset": preset,
        "summary": generate.PRESETS[preset].summary,
        "craters": {key: craters[key].tolist() for key in ("x", "y", "diameter", "rim")},
        "boulders_in_ground": int((rocks["diameter"] < generate.OBSTACLE_DIAMETER).sum()),
    }
    return replace(site, boulders=tuple(_boulders(site, rocks)), meta=meta)


def rough_ground(shape: tuple[int, int], rms: float, seed: int, spacing: float) -> np.ndarray:
    """Self-affine heights [ny, nx] m of that rms: amplitude ~ 1 / wavelength^1.5 above 8 m."""
    wave = [np.fft.fftfreq(n, spacing) for n in shape]
    size = np.hypot(*np.meshgrid(*wave, indexing="ij"))
    gain = np.where(size > 0, 1.0 / np.maximum(size, 1 / 8) ** 1.5, 0.0)
    noise = np.random.default_rng(seed).standard_normal(shape)
    heights = np.fft.ifft2(np.fft.fft2(noise) * gain).real
    return heights / heights.std() * rms


def for_mission(mission: Mission, spacing: float = SPACING, source: object = None) -> Site:
    """The ground that a mission asks for: its map plus a margin, map centre = site centre.

    An elevation model has to cover the map alone. The sun is the mission's. Raises InputError
    naming `source`, where one is given, and the key.
    """
    try:
        site = _ground_for(mission, spacing)
    except InputError as error:
        if source is None:
            raise
        its = mission.site
        raise InputError(source, f"{error.source}: {error.problem}" if its.dem else error.problem,
                         _mission_key(mission, error.key)) from None
    if mission.sun is not None:
        site = replace(site, sun=mission.sun.position())
    if mission.site.ground == "regolith":
        site = with_soil(site, mission.site.soil)
    return replace(site, known=mission.site.fields == "measured")


def with_soil(site: Site, soil: str) -> Site:
    """The site with ground that gives way, of a soil as its seed draws it; `meta` tells which.

    Raises InputError for an unknown soil.
    """
    found = soils.drawn(soils.find(soil, f"site {site.name}", "soil"), site.seed)
    told = {key: getattr(found, key) for key in ("k_phi", "cohesion", "friction", "shear")}
    return replace(site, soil=found, meta=site.meta | {"soil": {"name": found.name} | told})


def _ground_for(mission: Mission, spacing: float) -> Site:
    width, height = (n * mission.map.cell_m for n in mission.map.size)
    its = mission.site
    if its.dem is None:
        return make_site(its.preset or "mare", its.seed,
                         (width + 2 * MARGIN, height + 2 * MARGIN), spacing)
    return import_dem(
        its.dem, its.piece, need=(width, height), margin=MARGIN, pixel=its.pixel,
        band=its.band, scale=its.scale, detrend=its.detrend, detail=its.detail,
        spacing=spacing, seed=its.seed)


def _mission_key(mission: Mission, key: str) -> str:
    """Where a mission's file says what is wrong with its ground."""
    if key == "size" and mission.site.size is None:
        return "map.size"
    return f"site.{key or ('dem' if mission.site.dem else 'preset')}"


def import_dem(
    path: str | os.PathLike[str],
    piece: Piece = WHOLE,
    *,
    need: tuple[float, float] | None = None,
    margin: float = 0.0,
    pixel: float | None = None,
    band: int = 0,
    scale: float | None = None,
    detrend: bool = False,
    detail: bool = True,
    spacing: float = SPACING,
    seed: int = 0,
) -> Site:
    """Ground from an elevation model, GeoTIFF or `.npy`. Boulders are not added.

    Args:
      path: the file, see `dem.window`. An .npy array is [rows, columns] m, row 0 in the north
        like a picture.
      piece: which part of it; all of it by default.
      need: (x, y) sides m that must be there, which the part has if it says no size.
      margin: m of ground kept around what is needed, past the model's edge going on as the ground
        does there.
      pixel: metres a pixel; needed for .npy and for a GeoTIFF that does not say.
      band: of a GeoTIFF, counted from 0.
      scale: metres a unit of elevation; None: as the file says, else 1.
      detrend: takes out the plane of best fit, else only the mean.
      detail: adds relief finer than the model, continuing its power spectrum, where the model
        is coarser than the site and large enough to have one.
      spacing: of the site, m.
      seed: of the added detail.

    Raises InputError: not readable, no data, a scale that cannot be ground, a window outside.
    """
    found = dem.window(path, piece, need=need, margin=margin, pixel=pixel, band=band, scale=scale)
    core, past = found.core, math.ceil(found.made_up / found.pixel)
    dem.check_relief(path, core[past:len(core) - past, past:core.shape[1] - past], found.pixel)
    window = found.heights - (dem.plane(found.heights) if detrend else core.mean())
    sides = found.sides
    if piece.size is None and need is None:  # to the last pixel
        sides = ((core.shape[1] - 1) * found.pixel, (core.shape[0] - 1) * found.pixel)
    shape = _shape(path, sides, spacing)
    # The spectrum is of more of the model: a window has too few pixels to take one from.
    fine = generate.spectrum(found.about, found.pixel) if (
        detail and found.pixel > 2 * spacing) else None
    ground = generate.refine(window, found.pixel, found.shift, shape, spacing, seed, fine)
    meta = {"dem": os.fspath(path), "pixel_m": found.pixel, "centre_m": list(found.centre),
            "rotation_deg": piece.rotation, "band": band, "scale": found.scale,
            "detrend": detrend, "detail": fine is not None, "made_up_m": found.made_up}
    return Site(Path(path).stem, seed, ground, spacing, meta=meta)


def _shape(source: object, extent_m: float | tuple[float, ...], spacing: float
           ) -> tuple[int, int]:
    """Samples (ny, nx) that cover the extent. Raises InputError if it is none or too many."""
    width, height = extent_m if isinstance(extent_m, tuple) else (extent_m, extent_m)
    if not 0.05 <= spacing <= 2.0:
        raise InputError(source, f"{spacing} m is not allowed; 0.05 to 2", "spacing")
    if not all(4.0 <= side <= 1000.0 for side in (width, height)):
        raise InputError(source, f"{width:g} by {height:g} m is not allowed; sides of 4 to 1000 m",
                         "size")
    ny, nx = (math.ceil(side / spacing - 1e-6) + 1 for side in (height, width))
    if ny * nx > MAX_SAMPLES:
        raise InputError(source, f"{nx} by {ny} samples are too many; at most {MAX_SAMPLES} in "
                         "all: a smaller size or a wider spacing is needed", "size")
    return ny, nx


def _boulders(site: Site, rocks: dict[str, np.ndarray]) -> list[Boulder]:
    """Obstacles: the sphere whose cap stands as wide and as high as the rock does."""
    found = []
    half = np.array(site.extent)
    for i in np.flatnonzero(rocks["diameter"] >= generate.OBSTACLE_DIAMETER):
        xy = np.array([rocks["x"][i], rocks["y"][i]])
        wide = rocks["diameter"][i] / 2
        if (np.abs(xy) > half - wide).any():
            continue
        high = rocks["height"][i] * (1 - rocks["burial"][i])
        radius = float((wide**2 + high**2) / (2 * high))
        ground = float(site.surface.height(jnp.asarray(xy, jnp.float32)))
        centre = np.array([*xy, ground + high - radius])
        random = np.random.default_rng([site.seed, int(i)])
        found.append(Boulder(centre, radius, _rock(radius, random)))
    return found


def _rock(radius: float, random: np.random.Generator) -> np.ndarray:
    """Corners [n, 3] m of a rough convex rock about a sphere, spread as a Fibonacci spiral.

    Corners stand a little out of the sphere so that the facets between them lie about on it.
    """
    count = 48
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    turn = np.pi * (1 + 5**0.5) * index + random.uniform(0, 2 * np.pi)
    flat = np.sqrt(1 - z**2)
    points = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)
    points = points + random.normal(scale=0.08, size=points.shape)
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    corners = points * radius * random.uniform(0.97, 1.10, size=(count, 1))
    hull = trimesh.convex.convex_hull(corners)
    return np.array(hull.vertices)
