"""Pictures of a site from above: hillshade, slope, roughness, where each kind can go."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from moonteam import files
from moonteam.problem.sun import SunPosition
from moonteam.terrain.measure import roughness_map, slope_map
from moonteam.terrain.site import Site
from moonteam.terrain.traversability import BoolMap, FloatMap

EDGE = 1.0
"""Ground kept free around the grid, m: no robot can stand on the very edge."""


def draw_all(site: Site, folder: Path, cell_m: float, times: dict[str, FloatMap]) -> list[Path]:
    """Writes hillshade.png, slope.png, roughness.png and traversability.png; their paths.

    `times`: kind -> [H, W] s to cross each cell of the grid about the site's centre.
    """
    import matplotlib

    matplotlib.use("Agg")
    slope = np.degrees(slope_map(site, site.spacing))
    return [
        _draw(site, folder / "hillshade.png", f"{site.name}, seed {site.seed}: height, m",
              site.heights, "gray", shaded=True),
        _draw(site, folder / "slope.png", "slope, degrees", slope, "inferno", limits=(0, 30)),
        _draw(site, folder / "roughness.png", "roughness over 1 m: rms about the plane, m",
              roughness_map(site), "viridis"),
        _draw_traversability(site, folder / "traversability.png", cell_m, times),
    ]


def hillshade(site: Site, azimuth_deg: float = 315.0, elevation_deg: float = 25.0) -> np.ndarray:
    """Brightness [ny, nx] 0 to 1 of the ground under a low sun, row 0 in the south."""
    from matplotlib.colors import LightSource

    light = LightSource(azimuth_deg, elevation_deg)
    # matplotlib expects row 0 in the north.
    return light.hillshade(site.heights[::-1], dx=site.spacing, dy=site.spacing)[::-1]


def grid_of(site: Site, cell_m: float) -> tuple[int, int]:
    """Size (W, H) of the largest grid of cells that fits on the site, a little off its edge."""
    width, height = (max(1, int((2 * half - 2 * EDGE) / cell_m + 1e-6)) for half in site.extent)
    return width, height


def box(site: Site) -> tuple[float, float, float, float]:
    """West, east, south and north border, m."""
    x, y = site.extent
    return (-x, x, -y, y)


def _draw(site: Site, path: Path, title: str, values: np.ndarray, colors: str, *,
          limits: tuple[float, float] | None = None, shaded: bool = False) -> Path:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 5.6), layout="constrained")
    axes = figure.subplots()
    low, high = limits or (float(values.min()), float(values.max()))
    place: dict[str, Any] = {"origin": "lower", "extent": box(site)}
    shown = axes.imshow(values, cmap=colors, vmin=low, vmax=high, **place)
    if shaded:
        axes.imshow(hillshade(site), cmap="gray", vmin=0, vmax=1, **place)
        axes.contour(values, levels=8, colors="tab:orange", linewidths=0.6, **place)
    _rocks(axes, site)
    figure.colorbar(shown, ax=axes, shrink=0.85)
    _finish(figure, axes, title, path)
    return path


def _draw_traversability(site: Site, path: Path, cell_m: float, times: dict[str, FloatMap]
                         ) -> Path:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.2 * len(times), 4.6), layout="constrained")
    places = figure.subplots(1, len(times), squeeze=False)[0]
    for axes, kind in zip(places, times, strict=True):
        axes.imshow(hillshade(site), cmap="gray", vmin=0, vmax=1, origin="lower",
                    extent=box(site))
        seconds = times[kind]
        half = [n * cell_m / 2 for n in seconds.shape[::-1]]
        open_share = np.isfinite(seconds).mean()
        least = float(seconds.min()) if open_share else 1.0
        color = axes.imshow(np.ma.masked_invalid(seconds), cmap="viridis_r", alpha=0.45,
                            vmin=least, vmax=1.5 * least, origin="lower",
                            extent=(-half[0], half[0], -half[1], half[1]))
        axes.imshow(np.ma.masked_array(np.ones_like(seconds), np.isfinite(seconds)),
                    cmap="Reds", vmin=0, vmax=1.3, alpha=0.8, origin="lower",
                    extent=(-half[0], half[0], -half[1], half[1]))
        _rocks(axes, site)
        axes.set_title(f"{kind}: {100 * open_share:.1f} % of cells open", fontsize=10)
        figure.colorbar(color, ax=axes, shrink=0.8, label="s to cross a cell")
    with files.replacing(path) as temporary:
        figure.savefig(temporary, dpi=110)
    return path


def draw_travel(site: Site, path: Path, title: str, half: tuple[float, float], seconds: FloatMap,
                ways: Sequence[tuple[npt.NDArray[np.float64], float]]) -> Path:
    """Isochrones to a target over the shaded ground, and ways to it; the picture's path.

    `seconds` [H, W] at points over a map of half widths `half` (x, y) m, infinite where closed;
    `ways`: points [P, 2] m, the target last, and how many seconds each takes.
    """
    from matplotlib.figure import Figure
    from matplotlib.patheffects import withStroke

    figure = Figure(figsize=(7.2, 6.2), layout="constrained")
    axes = figure.subplots()
    axes.imshow(hillshade(site), cmap="gray", vmin=0, vmax=1, origin="lower", extent=box(site))
    x, y = (np.linspace(-h, h, n) for h, n in zip(half, seconds.shape[::-1], strict=True))
    able = np.isfinite(seconds)
    reached = np.ma.masked_invalid(seconds)
    levels = _levels(float(seconds[able].max()) if able.any() else 1.0)
    bands = axes.contourf(x, y, reached, levels=levels, cmap="viridis", alpha=0.4)
    lines = axes.contour(x, y, reached, levels=levels[1:], colors="white", linewidths=0.7)
    axes.clabel(lines, levels[2::2], fmt="%g", fontsize=7)
    sides = (x[1] - x[0]) / 2, (y[1] - y[0]) / 2
    axes.imshow(np.ma.masked_array(np.ones_like(seconds), able), cmap="Reds", vmin=0, vmax=1.3,
                alpha=0.8, origin="lower", interpolation="nearest",
                extent=(x[0] - sides[0], x[-1] + sides[0], y[0] - sides[1], y[-1] + sides[1]))
    _rocks(axes, site)
    halo = [withStroke(linewidth=2.5, foreground="black")]
    for points, takes in ways:
        axes.plot(*points.T, "-", color="orange", linewidth=1.6, path_effects=halo)
        axes.plot(*points[:-1].T, "o", color="orange", markersize=3.5, path_effects=halo)
        axes.annotate(f"{takes:.0f} s", points[0], xytext=(5, 5), textcoords="offset points",
                      color="white", fontsize=9, path_effects=halo)
    if ways:
        axes.plot(*ways[0][0][-1], "*", color="gold", markersize=15, markeredgecolor="black")
    figure.colorbar(bands, ax=axes, shrink=0.85, label="s to the star")
    _finish(figure, axes, title, path)
    return path


def draw_light(site: Site, path: Path, sun: SunPosition, lit: BoolMap, panels: BoolMap) -> Path:
    """Which ground the sun lights, and over which a robot's panel has light [ny, nx], on the ground
    shaded from there; the picture's path. An arrow says where the light goes.
    """
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure

    azimuth, elevation = math.degrees(sun.azimuth) % 360, math.degrees(sun.elevation)
    figure = Figure(figsize=(6.4, 5.6), layout="constrained")
    axes = figure.subplots()
    place: dict[str, Any] = {"origin": "lower", "extent": box(site)}
    axes.imshow(hillshade(site, azimuth, 25.0), cmap="gray", vmin=0, vmax=1, **place)
    axes.contour(site.heights, levels=8, colors="tab:orange", linewidths=0.5, alpha=0.7, **place)
    for dark, alpha in ((lit, 0.5), (panels, 0.6)):
        axes.imshow(np.ma.masked_array(np.ones(dark.shape), dark), interpolation="nearest",
                    alpha=alpha, cmap=ListedColormap(["#0b1230"]), **place)
    _rocks(axes, site)
    east, north, _ = sun.toward
    east, north = (0.08 * v / max(math.hypot(east, north), 1e-9) for v in (east, north))
    axes.annotate("", (0.88 - east, 0.88 - north), (0.88 + east, 0.88 + north),
                  xycoords="axes fraction",
                  textcoords="axes fraction",
                  arrowprops={"arrowstyle": "-|>", "color": "gold", "linewidth": 2.2})
    _finish(figure, axes, f"{site.name}, seed {site.seed}: sun {elevation:.1f} degrees high at "
            f"azimuth {azimuth:.0f}, {100 * lit.mean():.0f} % of the ground lit,\n"
            f"{100 * panels.mean():.0f} % for a robot's panel (darkest: neither)", path)
    return path


def _levels(most: float) -> npt.NDArray[np.float64]:
    """Seconds of isochrones, round and about ten, from 0 to past `most`."""
    rough = max(most, 1e-6) / 10
    unit = 10.0 ** np.floor(np.log10(rough))
    step = unit * next(n for n in (1, 2, 2.5, 5, 10) if n * unit >= rough * (1 - 1e-9))
    return step * np.arange(np.ceil(most / step) + 1.5)


def _rocks(axes: Any, site: Site) -> None:
    from matplotlib.patches import Circle

    for boulder in site.boulders:
        centre = (float(boulder.centre[0]), float(boulder.centre[1]))
        axes.add_patch(Circle(centre, boulder.radius, facecolor="none",
                              edgecolor="deepskyblue", linewidth=1.2))


def _finish(figure: Any, axes: Any, title: str, path: Path) -> None:
    axes.set_title(title, fontsize=10)
    axes.set_xlabel("east, m")
    axes.set_ylabel("north, m")
    with files.replacing(path) as temporary:
        figure.savefig(temporary, dpi=110)
