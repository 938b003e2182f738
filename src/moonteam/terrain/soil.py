"""What regolith is made of, as far as wheels and feet feel it.

Pressure under a plate of width b at depth z (Bekker): p = (k_c / b + k_phi) z^n. Shear stress after
a displacement j (Janosi and Hanamoto): tau = (c + p tan phi) (1 - exp(-j / K)). A slipping wheel
digs: n = n0 + n1 s (Ding et al. 2011).

All of it is measured on Earth, in simulants. Nobody has validated how it scales to the Moon: in
parabolic flights slip rose under less than half a g.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from moonteam.errors import InputError, meant


@dataclass(frozen=True)
class Soil:
    """One soil."""

    name: str
    k_c: float  # N/m^(n+1), cohesive modulus of sinkage
    k_phi: float  # N/m^(n+2), frictional modulus of sinkage
    n0: float  # exponent of sinkage
    n1: float  # how much it grows from no slip to spinning on the spot
    cohesion: float  # Pa
    friction: float  # rad, angle of internal friction
    shear: float  # m, K: shear displacement at which 63 % of the strength is there
    peak: float = 0.3  # share of the contact angle, from the front, where the pressure peaks
    peak_slip: float = 0.2  # how much that grows from no slip to spinning
    source: str = ""


FITTED = "fitted to VIPER's wheel on GRC-1 and the sinkage of Rashid-1's: `moonteam evaluate soil`"

SOILS = {soil.name: soil for soil in (
    Soil("nominal", 0.0, 8.97e6, 1.1214, 1.2, 200.0, math.radians(33.03), 0.056, 0.2, 0.0, FITTED),
    Soil("loose", 0.0, 4.5e6, 1.1214, 1.2, 120.0, math.radians(30.5), 0.064, 0.2, 0.0,
         "nominal with half the stiffness, looser in shear"),
    Soil("dense", 0.0, 1.8e7, 1.1214, 1.0, 350.0, math.radians(36.0), 0.045, 0.2, 0.0,
         "nominal with twice the stiffness, firmer in shear"),
    Soil("lunar", 1400.0, 820e3, 1.0, 0.0, 170.0, math.radians(35.0), 0.0178,
         source="Ding et al. 2015"),
    Soil("grc1", 700.0, 505e3, 0.8, 0.0, 250.0, math.radians(38.0), 0.0178,
         source="GRC-1: Oravec et al. 2010; K as of the lunar soil"),
)}
"""The soils that a site may have, by name."""

SCATTER = {"k_phi": 0.25, "cohesion": 0.25, "shear": 0.1}
"""Standard deviation of the logarithm of what is drawn from one site to the next."""

FRICTION_SCATTER = math.radians(1.0)
"""Standard deviation of the angle of friction, rad."""


def find(name: str, source: object = "soil", key: str = "") -> Soil:
    """The soil called so. Raises InputError naming `source`, `key` and the soils there are."""
    if name not in SOILS:
        raise InputError(source, f"no soil {name!r}; {meant(name, SOILS)}soils: "
                         + ", ".join(SOILS), key)
    return SOILS[name]


def drawn(soil: Soil, seed: int) -> Soil:
    """The soil as one site has it: strength and stiffness scattered about the soil's own.

    The same seed draws the same soil.
    """
    rng = np.random.default_rng([seed, 0x501])
    changed = {key: getattr(soil, key) * math.exp(spread * float(rng.standard_normal()))
               for key, spread in SCATTER.items()}
    angle = soil.friction + FRICTION_SCATTER * float(np.clip(rng.standard_normal(), -2.0, 2.0))
    return replace(soil, friction=angle, **changed)
