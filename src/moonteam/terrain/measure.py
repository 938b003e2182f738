"""What a site's ground is like, in figures: slopes, roughness, craters and boulders by law."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from moonteam.terrain import generate
from moonteam.terrain.site import Site

PERCENTILES = (50, 75, 90, 95, 99, 100)
CRATER_EDGES = (1.5, 3.0, 6.0, 12.0, 24.0)
"""Bounds of the diameter bins in which craters are counted, m; the last is open above."""


def measure(site: Site) -> dict[str, Any]:
    """Figures for `site.json`. Lengths m, slopes degrees."""
    hurst, deviation = generate.roughness_exponent(site.heights, site.spacing)
    return {
        "name": site.name,
        "seed": site.seed,
        "size_m": [2 * half for half in site.extent],
        "samples": list(site.heights.shape[::-1]),
        "spacing_m": site.spacing,
        "relief_m": float(np.ptp(site.heights)),
        "slope_deg": _slopes(site, site.spacing),
        "slope_over_1m_deg": _slopes(site, 1.0),
        "roughness": {"hurst": hurst, "rms_step_m": deviation, "at_lag_m": site.spacing},
        "craters": crater_counts(site),
        "boulders": {
            "obstacles": len(site.boulders),
            "radii_m": sorted(round(b.radius, 3) for b in site.boulders),
            "in_ground": site.meta.get("boulders_in_ground", 0),
        },
        "source": {k: v for k, v in site.meta.items() if k not in ("craters",)},
    }


def slope_map(site: Site, baseline: float) -> np.ndarray:
    """Slope [ny, nx] rad over a baseline of about that many metres, by central differences."""
    steps = max(1, round(baseline / site.spacing / 2))
    padded = np.pad(site.heights.astype(np.float64), steps, mode="reflect", reflect_type="odd")
    run = 2 * steps * site.spacing
    gx = (padded[steps:-steps, 2 * steps:] - padded[steps:-steps, :-2 * steps]) / run
    gy = (padded[2 * steps:, steps:-steps] - padded[:-2 * steps, steps:-steps]) / run
    return np.arctan(np.hypot(gx, gy))


def roughness_map(site: Site, window: float = 1.0) -> np.ndarray:
    """Roughness [ny, nx] m: rms height about the local plane in a window of that side."""
    reach = max(1, round(window / site.spacing / 2))
    side = 2 * reach + 1
    padded = np.pad(site.heights.astype(np.float64), reach, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (side, side))
    offset = np.arange(side) - reach
    spread = side * float((offset**2).sum())
    mean = windows.mean(axis=(2, 3))
    gx = np.einsum("ijkl,l->ij", windows, offset) / spread
    gy = np.einsum("ijkl,k->ij", windows, offset) / spread
    square = np.einsum("ijkl,ijkl->ij", windows, windows) / side**2 - mean**2
    return np.sqrt(np.maximum(square - (gx**2 + gy**2) * spread / side**2, 0.0))


def crater_counts(site: Site) -> list[dict[str, Any]]:
    """Craters centred on the site by diameter, against what its preset's law expects.

    Each row: from_m, to_m (None: no bound), counted, expected, and the central 95 % of a
    Poisson count with that mean. A preset's hand-placed rim is not counted.
    """
    if "craters" not in site.meta:
        return []
    table, preset = site.meta["craters"], generate.PRESETS[site.meta["preset"]]
    random = ~np.asarray(table["rim"], bool)
    diameter = np.asarray(table["diameter"])[random]
    area = 4 * site.extent[0] * site.extent[1]
    rows = []
    for low, high in zip(CRATER_EDGES, (*CRATER_EDGES[1:], math.inf), strict=True):
        if low >= preset.largest_crater:
            continue
        expected = generate.expected_craters(preset, area, low)
        if high < preset.largest_crater:
            expected -= generate.expected_craters(preset, area, high)
        rows.append({
            "from_m": low, "to_m": high if math.isfinite(high) else None,
            "counted": int(((diameter >= low) & (diameter < high)).sum()),
            "expected": round(expected, 3), "poisson_95": poisson_interval(expected)})
    return rows


def poisson_interval(mean: float) -> list[int]:
    """The central interval that holds at least 95 % of Poisson counts of a mean."""
    probability, total, low, k = math.exp(-mean), 0.0, 0, 0
    while True:
        total += probability
        if total < 0.025:
            low = k + 1
        if total >= 0.975:
            return [low, k]
        k += 1
        probability *= mean / k


def _slopes(site: Site, baseline: float) -> dict[str, float]:
    degrees = np.degrees(slope_map(site, baseline))
    found = {f"p{p}": round(float(np.percentile(degrees, p)), 2) for p in PERCENTILES}
    return found | {"rms": round(float(np.sqrt((degrees**2).mean())), 2)}
