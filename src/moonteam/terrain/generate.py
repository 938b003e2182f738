"""Lunar ground from terraingen: craters, relief, roughness and boulders by preset and seed.

The only file that touches `terraingen`, whose interface is young. Rows of every array run
from south to north, columns from west to east.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from typing import Any

import numpy as np
import terraingen as tg

FINE = 0.5
"""Ground is evaluated at this share of the site's spacing and then blurred onto it, so that a
rock or a rim narrower than a sample becomes a bump, not a spike."""

BLUR = 1.0
"""Standard deviation of that blur, in site samples."""

OBSTACLE_DIAMETER = 0.5
"""Boulders at least this wide, m, are obstacles; smaller ones are bumps in the ground."""

PEBBLE_DIAMETER = 0.3
"""The smallest boulder generated, m: narrower ones do not show at a quarter of a metre."""


@dataclass(frozen=True)
class Preset:
    """A kind of lunar ground. Lengths in metres, angles in degrees.

    `craters` and `boulders` name size-frequency distributions; `age_gyr` is the surface's age,
    which sets how worn its craters are.
    """

    summary: str
    relief: tuple[tuple[float, float, int], ...]  # (longest wavelength, amplitude, octaves)
    roughness: float  # rms slope over 1 m
    craters: str
    largest_crater: float
    age_gyr: float
    boulders: str
    tilt_deg: float = 0.0  # regional slope, towards a direction drawn from the seed
    rim: bool = False  # the rim of one big crater runs through the site


PRESETS = {
    "mare": Preset(
        "old basalt plain: gentle relief, worn craters, few rocks",
        ((60.0, 0.5, 5),), 0.03, "trask", 30.0, 3.3, "viper"),
    "highland": Preset(
        "uplands: rolling relief, crowded craters, more rocks",
        ((40.0, 2.0, 5),), 0.045, "uplands", 40.0, 3.9, "golombek"),
    "crater_rim": Preset(
        "the rim of a large, worn crater, with blocks, through the middle of the site",
        ((40.0, 0.6, 5),), 0.035, "viper", 12.0, 3.8, "sp8023", rim=True),
    "polar": Preset(
        "a tilted polar ridge: long slopes, craters of the VIPER specification",
        ((50.0, 1.6, 5),), 0.035, "viper", 40.0, 3.9, "viper", tilt_deg=5.0),
}

SMALLEST_CRATER = 1.5
"""m; below this, roughness stands for craters."""


def crater_law(name: str) -> tg.SizeFrequencyDistribution:
    """Cumulative number of craters a square metre by diameter.

    trask: Trask (1966), equilibrium; uplands: Moore (1971); viper: the VIPER specification.
    """
    return {
        "trask": tg.trask_equilibrium,
        "uplands": lambda: tg.moore_distribution(tg.MooreTerrain.UPLANDS),
        "viper": tg.viper_specification,
    }[name]()


def boulder_law(name: str) -> tg.SizeFrequencyDistribution:
    """Cumulative number of boulders a square metre by diameter.

    golombek: Golombek and Rapp (1997) covering 4 %; inter_crater, viper: synthterrain's;
    sp8023: NASA SP-8023, nominal, between craters.
    """
    return {
        "golombek": lambda: tg.GolombekRappSfd(0.04),
        "inter_crater": lambda: tg.synthterrain_boulder_distribution(
            tg.SynthterrainBoulders.INTER_CRATER),
        "viper": lambda: tg.synthterrain_boulder_distribution(
            tg.SynthterrainBoulders.VIPER_SPECIFICATION),
        "sp8023": lambda: tg.sp8023_intercrater_blocks(tg.SpecificationCurve.NOMINAL),
    }[name]()


def evaluate(name: str, seed: int, shape: tuple[int, int], spacing: float
             ) -> tuple[np.ndarray, dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Elevations [ny, nx] float32 m, a table of craters, a table of boulders.

    The crater table has x, y, diameter, depth_ratio, rim (bool: the preset's big crater); the
    boulder table has x, y, ground, diameter, height, burial; only those inside the site.
    """
    preset = PRESETS[name]
    seeds = _seeds(seed, 6, name)
    craters = _crater_layers(preset, seeds, max(shape) * spacing)
    noise = [
        tg.NoiseLayer(tg.FractalParams(
            seed=seeds[2] + i, wavelength=wavelength, amplitude=amplitude, octaves=octaves,
            gain=tg.gain_from_hurst(0.9)))
        for i, (wavelength, amplitude, octaves) in enumerate(preset.relief)
    ]
    roughness = tg.RoughnessLayer(tg.RoughnessOptions(
        rms_slope=preset.roughness, baseline=1.0, hurst=0.8, max_wavelength=4.0,
        min_wavelength=2 * spacing, seed=seeds[3]))
    rocks = tg.BoulderLayer(_boulder_options(preset, seeds[4]), craters[-1])
    generator = tg.TerrainGenerator(None, [tg.NoiseRelief(noise), *craters, roughness, rocks])
    heights = _sample(generator, shape, spacing) + _tilt(preset, seeds[5], shape, spacing)
    grid = tg.RasterGrid.centered(shape[1] - 1, shape[0] - 1, spacing)
    return (heights.astype(np.float32), _craters_inside(generator, grid),
            dict(tg.placed_boulders(generator, grid).table))


def expected_craters(preset: Preset, area: float, smallest: float) -> float:
    """Craters at least `smallest` m wide that the law puts on `area` m^2."""
    law = crater_law(preset.craters)
    return float(law.expected_count(area, smallest, preset.largest_crater))


def roughness_exponent(heights: np.ndarray, spacing: float) -> tuple[float, float]:
    """Hurst exponent and rms height difference m at one sample, by the variogram.

    Not a number and 0 for ground without relief.
    """
    if np.ptp(heights) < 1e-6:
        return math.nan, 0.0
    found = tg.estimate_base_roughness(_raster(heights, spacing), spacing)
    return float(found.hurst), float(found.deviation)


def write_dem(path: str | os.PathLike[str], heights: np.ndarray, spacing: float) -> None:
    """Writes elevations [ny, nx] m as a float32 GeoTIFF with the site's centre at (0, 0)."""
    try:
        tg.write_geotiff(path, _raster(heights, spacing))
    except tg.GeoTiffError as error:  # the disk's
        raise OSError(str(error).rpartition(": ")[2]) from None


def spectrum(heights: np.ndarray, pixel: float) -> tuple[float, float] | None:
    """Slope of an elevation model's power spectrum and the rms height m that it puts into the
    octave just finer than the model; None where the model is too small or flat to say.
    """
    try:
        found = tg.estimate_power_law_spectrum(_raster(heights, pixel))
    except ValueError:
        return None
    return (min(max(found.slope, 2.0), 4.0), found.octave_rms) if found.octave_rms > 0 else None


def refine(heights: np.ndarray, pixel: float, shift: tuple[float, float], shape: tuple[int, int],
           spacing: float, seed: int, detail: tuple[float, float] | None) -> np.ndarray:
    """Elevations [rows, columns] at `pixel` m resampled to `shape` at `spacing` m.

    Its centre is `shift` m east and north of theirs.
    With `detail`, a spectrum, relief finer than the source's pixels continues it.
    """
    raster = _raster(heights, pixel)
    layers = []
    if detail is not None:
        layers.append(tg.SpectralContinuationLayer(tg.SpectralContinuationOptions(
            pixel_size=pixel, slope=detail[0], octave_rms=detail[1],
            min_wavelength=4 * spacing, seed=_seeds(seed, 1)[0])))
    generator = tg.TerrainGenerator(tg.RasterSource(raster), layers)
    grid = tg.RasterGrid.centered(shape[1], shape[0], spacing, shift)
    return np.array(tg.evaluate(generator, grid=grid).values, np.float32)[::-1].copy()


def _crater_layers(preset: Preset, seeds: list[int], side: float
                   ) -> list[tg.CraterLayer]:
    """The layer of random craters, under it that of the big one if there is one."""
    production = tg.extended_neukum_production_function()
    production.allows_extrapolation = True  # published down to 10 m; its power law goes on
    ages = tg.SteadyStateAges(
        production, tg.trask_equilibrium(), preset.age_gyr, tg.neukum_lunar_chronology)
    models = tg.CraterModels(
        crater_law(preset.craters), ages,
        tg.DiffusionDegradation(
            tg.lunar_fresh_crater_morphometry, tg.fassett_2022_trask_diffusivity(),
            tg.DiffusedProfile(tg.FassettThomsonProfile())),
        tg.DiffusedProfile(tg.FassettThomsonProfile()))
    options = tg.CraterLayerOptions(seed=seeds[0])
    options.generation = tg.CraterGenerationOptions(
        d_min=SMALLEST_CRATER, d_max=preset.largest_crater)
    layers = [tg.CraterLayer(models, options)]
    if not preset.rim:
        return layers
    diameter = 1.2 * side
    angle = 2 * math.pi * seeds[1] / 2**31
    # The centre lies so that the crest passes through the middle of the site.
    rim = tg.Crater(diameter / 2 * math.cos(angle), diameter / 2 * math.sin(angle), diameter,
                    age_gyr=0.5, depth=0.09 * diameter)
    return [tg.CraterLayer.manual(models, [rim]), *layers]


def _boulder_options(preset: Preset, seed: int) -> tg.BoulderLayerOptions:
    options = tg.BoulderLayerOptions()
    law = boulder_law(preset.boulders)
    law.allows_extrapolation = True
    options.distribution = law
    options.min_diameter_m, options.max_diameter_m = PEBBLE_DIAMETER, 2.5
    options.min_height_ratio, options.max_height_ratio = 0.5, 0.8
    options.min_burial, options.max_burial = 0.1, 0.5
    options.models = tg.BoulderModelThreshold(min_diameter_m=OBSTACLE_DIAMETER)
    options.max_slope_deg = 30.0
    options.seed = seed
    return options


def _sample(generator: tg.TerrainGenerator, shape: tuple[int, int], spacing: float) -> np.ndarray:
    """The generator's heights [ny, nx], anti-aliased."""
    factor = round(1 / FINE)
    pad = 4 * factor  # so that the blur at the edge sees ground
    rows, columns = ((n - 1) * factor + 1 + 2 * pad for n in shape)
    grid = tg.RasterGrid.centered(columns, rows, spacing / factor)
    blurred = tg.gaussian_blur(tg.evaluate(generator, grid=grid), BLUR * factor)
    inside = np.array(blurred.values)[::-1][pad:rows - pad:factor, pad:columns - pad:factor]
    return inside - inside.mean()


def _tilt(preset: Preset, seed: int, shape: tuple[int, int], spacing: float) -> np.ndarray:
    angle, grade = 2 * math.pi * seed / 2**31, math.tan(math.radians(preset.tilt_deg))
    y, x = (spacing * (np.arange(n) - (n - 1) / 2) for n in shape)
    return grade * (x[None, :] * math.cos(angle) + y[:, None] * math.sin(angle))


def _craters_inside(generator: tg.TerrainGenerator, grid: tg.RasterGrid) -> dict[str, np.ndarray]:
    """The table of craters whose centres lie on the grid, plus the big one."""
    table: dict[str, Any] = dict(tg.placed_craters(generator, grid).table)
    west, south, east, north = grid.bounds
    rim = np.asarray(table["manual"]) == 1
    inside = (table["x"] >= west) & (table["x"] <= east)
    inside &= (table["y"] >= south) & (table["y"] <= north)
    table["rim"] = rim
    return {key: np.asarray(table[key])[inside | rim]
            for key in ("x", "y", "diameter", "depth_ratio", "rim")}


def _raster(heights: np.ndarray, spacing: float) -> tg.Raster:
    rows, columns = heights.shape
    grid = tg.RasterGrid.centered(columns, rows, spacing)
    north_up = np.ascontiguousarray(heights[::-1], np.float32)
    return tg.Raster.from_array(north_up, grid.transform)


def _seeds(seed: int, count: int, name: str = "") -> list[int]:
    """Independent 31-bit seeds, others for other names."""
    entropy = [seed, *name.encode()]
    return [int(s) >> 1 for s in np.random.SeedSequence(entropy).generate_state(count)]
