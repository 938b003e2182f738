"""Single wheels in soil as others have measured them, on Earth: what the model is held against.

Points were read off published figures by those who are named; their numbers are quoted, nothing
else of theirs is used.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from moonteam.physics.regolith.wheel import Shape
from moonteam.terrain.soil import SOILS

EARTH = 9.81  # m/s^2


@dataclass(frozen=True)
class Climb:
    """Slip at which a free wheel climbs a slope."""

    name: str
    source: str
    shape: Shape
    mass: float  # kg, that it carries
    rate: float  # rad/s
    degrees: tuple[float, ...]
    slip: tuple[float, ...]


@dataclass(frozen=True)
class Pull:
    """Drawbar pull and sinkage of a wheel held at a slip."""

    name: str
    source: str
    shape: Shape
    load: float  # N
    slip: tuple[float, ...]
    pull: tuple[float, ...]  # N
    sinkage: tuple[float, ...]  # m


VIPER = Climb(
    "VIPER's prototype wheel, GRC-1",
    "NASA Glenn's tests as plotted in uwsbel/chrono-wisc, "
    "python_scripts/viper_singleWheel_DepthVar_plotting.py",
    Shape(0.225, 0.2, 0.03), 17.5, 0.8,
    (0.27, 5.24, 10.03, 14.96, 20.23, 25.10), (0.032, 0.052, 0.135, 0.434, 0.756, 0.885))

RASHID = Pull(
    "Rashid-1's wheel, loose FJS-1",
    "Hurrell et al. 2025, Space Sci. Rev. 221:37, read off by roverdevkit "
    "(data/validation/single_wheel_experiments.csv)",
    Shape(0.100, 0.080, 0.020), 24.5,
    (0.1, 0.2, 0.3, 0.4, 0.5), (8.1, 8.6, 8.8, 9.6, 10.5),
    (0.006, 0.0095, 0.011, 0.016, 0.0195))

DING = Pull(
    "Ding's wheel with lugs of 10 mm, planetary simulant",
    "Ding et al. 2011, J. Terramechanics 48:27, read off by roverdevkit (same file)",
    Shape(0.15735, 0.165, 0.010), 80.0,
    (0.0, 0.1, 0.2, 0.3, 0.4, 0.6), (-6.5, 14.0, 20.0, 22.0, 23.0, 24.5),
    (0.0045, 0.005, 0.0075, 0.0105, 0.014, 0.027))

PULLS = (RASHID, DING)

GRC1 = replace(
    SOILS["grc1"], name="grc1 of Hu", cohesion=0.0, friction=math.atan(0.6593),
    source="GRC-1 at 1670 kg/m^3 as uwsbel/chrono-wisc has it (friction 0.6593, no cohesion); "
    "stiffness and K as of grc1")
"""The same simulant by others, who disagree about its strength: shown beside `grc1`."""

SPACEBOK_SLOPE = math.radians(25.0)
"""The end of the test bed, which SpaceBok climbed on soles of 110 cm^2 (arXiv 2106.01974)."""

SPACEBOK_SOLE = 2.0 * math.sqrt(110e-4 / math.pi)
"""Diameter m of a round sole of that area."""

GROUSER_GAIN = (0.22, 0.66)
"""Grousers of 12 mm gave that much more traction (same source)."""
