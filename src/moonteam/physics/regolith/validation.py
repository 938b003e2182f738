"""The soil model beside published experiments: figure by figure.

All of them were made on Earth. Scaling to the Moon's gravity is not validated by anybody.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from moonteam import files
from moonteam.physics.regolith import published, wheel
from moonteam.physics.regolith.published import EARTH, PULLS, RASHID, VIPER, Pull
from moonteam.physics.regolith.rig import climb
from moonteam.physics.regolith.wheel import Shape
from moonteam.terrain.soil import Soil

Floats = npt.NDArray[np.float64]
Tables = list[tuple[list[str], list[list[str]]]]

SLIPS = np.linspace(0.0, 1.0, 201)
SLID = math.inf
"""Slip of a wheel that cannot hold itself on its slope."""

FITTED = ("k_phi", "n0", "n1", "friction", "shear")
"""What a fit moves; cohesion is left at the lunar order of magnitude."""

SPANS = ((1e5, 1e8), (0.5, 1.6), (0.0, 1.2), (math.radians(25), math.radians(42)), (0.01, 0.08))


def slip_on(shape: Shape, soil: Soil, load: float, slopes: Sequence[float]) -> Floats:
    """Slip [S] at which a wheel climbs `slopes` [S] rad, by the sums along its rim; SLID where the
    soil's pull falls short of the slope. `load` N on level ground.
    """
    pull = wheel.curves(shape, soil, np.array([load * math.cos(np.mean(slopes))]), SLIPS).pull[0]
    out = []
    for slope in slopes:
        enough = np.flatnonzero(pull >= math.tan(slope))
        first = int(enough[0]) if enough.size else -1
        out.append(SLID if first < 0 else 0.0 if first == 0 else float(np.interp(
            math.tan(slope), pull[first - 1:first + 1], SLIPS[first - 1:first + 1])))
    return np.array(out)


def climbs(soils: Sequence[Soil]) -> list[dict[str, Any]]:
    """A row a slope of VIPER's experiment: measured slip, by the sums for each soil, and by the
    forces in the engine for the first.
    """
    angles = [math.radians(d) for d in VIPER.degrees]
    by_sums = {soil.name: slip_on(VIPER.shape, soil, VIPER.mass * EARTH, angles)
               for soil in soils}
    rows = []
    for i, (degrees, slip, angle) in enumerate(zip(VIPER.degrees, VIPER.slip, angles, strict=True)):
        found, depth = climb(VIPER.shape, soils[0], VIPER.mass, VIPER.rate, angle, EARTH)
        rows.append({
            "degrees": degrees, "measured": slip,
            "sums": {name: _finite(float(values[i])) for name, values in by_sums.items()},
            "engine": found, "engine_sinkage_m": depth})
    return rows


def pulls(test: Pull, soils: Sequence[Soil]) -> list[dict[str, Any]]:
    """A row a slip of an experiment: drawbar pull N and sinkage m, measured and for each soil."""
    found = {soil.name: wheel.curves(test.shape, soil, np.array([test.load]),
                                     np.array(test.slip)) for soil in soils}
    return [{"slip": slip, "measured": {"pull_n": test.pull[i], "sinkage_m": test.sinkage[i]},
             "sums": {name: {"pull_n": float(c.pull[0, i]) * test.load,
                             "sinkage_m": float(c.sinkage[0, i])} for name, c in found.items()}}
            for i, slip in enumerate(test.slip)]


def legs(soils: Sequence[Soil], load: float = 50.0) -> list[dict[str, Any]]:
    """A row a soil: the steepest slope a sole of SpaceBok's area holds on, rad, and how much
    grousers add to a smooth one. `load` N a foot.
    """
    area = math.pi * published.SPACEBOK_SOLE**2 / 4.0
    rows = []
    for soil in soils:
        grips = []
        for grousers in (0.0, 0.012):
            cohesion, tangent = wheel.interface(soil, grousers)
            grips.append(tangent + cohesion * area / load)
        rows.append({"soil": soil.name, "slope": math.atan(grips[0]),
                     "slope_grousers": math.atan(grips[1]), "gain": grips[1] / grips[0] - 1.0})
    return rows


def report(soils: Sequence[Soil]) -> dict[str, Any]:
    """All of it."""
    climbed, pulled = climbs(soils), {test.name: pulls(test, soils) for test in PULLS}
    return {"climb": climbed, "pulls": pulled, "legs": legs(soils),
            "worst": _worst(climbed, pulled[RASHID.name], soils[0])}


def worst(soil: Soil) -> dict[str, float]:
    """Largest error in slip up to 15 degrees, in the engine, and in Rashid-1's sinkage as a share
    of what was measured.
    """
    return _worst(climbs([soil]), pulls(RASHID, [soil]), soil)


def _worst(climbed: list[dict[str, Any]], pulled: list[dict[str, Any]], soil: Soil
           ) -> dict[str, float]:
    slips = [abs(row["engine"] - row["measured"]) for row in climbed if row["degrees"] < 16.0]
    depths = [abs(row["sums"][soil.name]["sinkage_m"] / row["measured"]["sinkage_m"] - 1.0)
              for row in pulled]
    return {"slip": max(slips), "sinkage_share": max(depths)}


def fitted(start: Soil, rounds: int = 40) -> Soil:
    """The soil from `start` on that comes nearest to VIPER's slips and Rashid-1's sinkage.

    Least squares; an error of 0.03 in slip (0.06 at 20 degrees) weighs as much as 12 % in sinkage.
    """
    from scipy.optimize import least_squares

    angles = [math.radians(d) for d in VIPER.degrees[:5]]
    weight = np.array([0.03, 0.03, 0.03, 0.03, 0.06])

    def soil_of(x: Floats) -> Soil:
        values = dict(zip(FITTED, (float(v) for v in x), strict=True))
        return replace(start, **values | {"k_phi": math.exp(values["k_phi"])})

    def errors(x: Floats) -> Floats:
        soil = soil_of(x)
        slip = np.minimum(slip_on(VIPER.shape, soil, VIPER.mass * EARTH, angles), 1.3)
        depth = wheel.curves(RASHID.shape, soil, np.array([RASHID.load]),
                             np.array(RASHID.slip)).sinkage[0]
        return np.concatenate([(slip - VIPER.slip[:5]) / weight,
                               (depth / np.array(RASHID.sinkage) - 1.0) / 0.12])

    low, high = (np.array([math.log(s[i]) if name == "k_phi" else s[i]
                           for name, s in zip(FITTED, SPANS, strict=True)]) for i in (0, 1))
    begin = np.array([math.log(start.k_phi) if name == "k_phi" else getattr(start, name)
                      for name in FITTED])
    found = least_squares(errors, np.clip(begin, low + 1e-6, high - 1e-6), bounds=(low, high),
                          max_nfev=rounds, diff_step=1e-3)
    return soil_of(found.x)


def tables(document: dict[str, Any]) -> Tables:
    """The report's tables."""
    names = list(document["climb"][0]["sums"])
    shown: Tables = [(
        ["slope, deg", "measured", f"{names[0]}, in the engine", *names],
        [[f"{row['degrees']:.1f}", f"{row['measured']:.3f}", f"{row['engine']:.3f}",
          *(_slip(row["sums"][n]) for n in names)] for row in document["climb"]])]
    for rows in document["pulls"].values():
        shown.append((
            ["slip", "sinkage, mm", *names, "pull, N", *names],
            [[f"{row['slip']:g}", f"{1e3 * row['measured']['sinkage_m']:.1f}",
              *(f"{1e3 * row['sums'][n]['sinkage_m']:.1f}" for n in names),
              f"{row['measured']['pull_n']:.1f}",
              *(f"{row['sums'][n]['pull_n']:.1f}" for n in names)] for row in rows]))
    shown.append((
        ["soil", "smooth sole holds to, deg", "with grousers, deg", "traction gained"],
        [[row["soil"], f"{math.degrees(row['slope']):.0f}",
          f"{math.degrees(row['slope_grousers']):.0f}", f"{100 * row['gain']:.0f} %"]
         for row in document["legs"]]))
    return shown


def notes(document: dict[str, Any]) -> list[str]:
    """What the tables are of."""
    bad = document["worst"]
    return [
        f"First table: slip of {VIPER.name} ({VIPER.source}); by the sums along the rim for each "
        "soil, and of the first soil by the forces in the engine on a test bed. -: it slides back.",
        *(f"Then {test.name}: {test.source}." for test in PULLS),
        *([f"{published.GRC1.name}: {published.GRC1.source}."]
          if published.GRC1.name in document["climb"][0]["sums"] else []),
        f"Last: a sole of 110 cm2 at 50 N a foot; SpaceBok climbed 25 deg, the end of its bed, and "
        f"grousers of 12 mm gave it {100 * published.GROUSER_GAIN[0]:.0f} to "
        f"{100 * published.GROUSER_GAIN[1]:.0f} % more traction (arXiv 2106.01974).",
        f"{document['soil']}: at most {bad['slip']:.3f} off in slip up to 15 deg in the engine, "
        f"{100 * bad['sinkage_share']:.0f} % in Rashid-1's sinkage. The same soil gives a "
        "fraction of Rashid-1's measured pull: one set of numbers does not fit both wheels.",
        "All tests were made under Earth's gravity; how they scale to the Moon is not validated.",
    ]


def draw(path: Path, document: dict[str, Any], soils: Sequence[Soil]) -> None:
    """Slip over slope, sinkage and pull over slip, with the published points."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.5, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    left, middle, right = figure.subplots(1, 3)
    degrees = np.linspace(0.0, 27.0, 55)
    rows = document["pulls"][RASHID.name]
    slips = np.linspace(0.02, 0.6, 30)
    for number, soil in enumerate(soils):
        color = f"C{number}"
        slip = slip_on(VIPER.shape, soil, VIPER.mass * EARTH, np.radians(degrees).tolist())
        left.plot(degrees[slip <= 1.0], slip[slip <= 1.0], color=color, label=soil.name)
        found = wheel.curves(RASHID.shape, soil, np.array([RASHID.load]), slips)
        middle.plot(slips, 1e3 * found.sinkage[0], color=color)
        right.plot(slips, found.pull[0] * RASHID.load, color=color)
    left.plot(VIPER.degrees, VIPER.slip, "k^", label="measured")
    left.plot(VIPER.degrees, [row["engine"] for row in document["climb"]], "x", color="C0",
              label=f"{document['soil']}, in the engine")
    middle.plot(RASHID.slip, [1e3 * row["measured"]["sinkage_m"] for row in rows], "k^")
    right.plot(RASHID.slip, [row["measured"]["pull_n"] for row in rows], "k^")
    for axis, title, x in ((left, "slip of VIPER's wheel", "slope, degrees"),
                           (middle, "sinkage of Rashid-1's wheel, mm", "slip"),
                           (right, "pull of Rashid-1's wheel, N", "slip")):
        axis.set_title(title, fontsize=10, loc="left")
        axis.set_xlabel(x)
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    left.set_ylim(-0.02, 1.05)
    left.legend(fontsize=8, frameon=False)
    with files.replacing(path) as temporary:
        figure.savefig(temporary, dpi=130)


def _finite(slip: float) -> float | None:
    return None if math.isinf(slip) else slip


def _slip(slip: float | None) -> str:
    return "-" if slip is None else f"{slip:.3f}"
