"""A rigid wheel in loose soil: stresses along its rim, summed up (Wong and Reece 1967).

    W  = b int r sigma cos t + r_s tau sin t dt        vertical, gives the sinkage
    H  = b int r_s tau cos t dt                         thrust
    R  = b int r sigma sin t dt                         resistance; H - R is the drawbar pull
    M  = b int r_s^2 tau dt                             torque

from the bottom (t = 0) to where the wheel enters the soil; sigma is Bekker's pressure, greatest at
a share of that angle, tau Janosi and Hanamoto's shear stress over the displacement

    j(t) = r_s ((t_s - t) - (1 - s) (sin t_s - sin t)).

Grousers shear the soil at their tips, r_s = r + h; a wheel without them slides on soil at an angle
of friction two thirds of the soil's own.

Legend: L loads, S slips, A angles.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from moonteam.terrain.soil import Soil

Floats = npt.NDArray[np.float64]

ANGLES = 64
HALVINGS = 40
SMOOTH = 2.0 / 3.0
"""Angle of friction of soil on metal, of the soil's own."""


class Shape(NamedTuple):
    """A wheel."""

    radius: float  # m, of the rim
    width: float  # m
    grousers: float = 0.0  # m, their height

    @property
    def tip(self) -> float:
        """Radius at which the soil is sheared, m."""
        return self.radius + self.grousers


class Curves(NamedTuple):
    """What the soil does to a wheel [L, S]: as shares of the load but for the sinkage."""

    thrust: Floats
    resistance: Floats
    torque: Floats  # over load and r_s
    sinkage: Floats  # m

    @property
    def pull(self) -> Floats:
        """Drawbar pull over load."""
        return self.thrust - self.resistance


def interface(soil: Soil, grousers: float) -> tuple[float, float]:
    """Cohesion Pa and tangent of the angle of friction where wheel or foot and soil slide."""
    if grousers > 0.0:
        return soil.cohesion, float(np.tan(soil.friction))
    return SMOOTH * soil.cohesion, float(np.tan(SMOOTH * soil.friction))


def curves(shape: Shape, soil: Soil, loads: Floats, slips: Floats) -> Curves:
    """The wheel at loads [L] N and slips [S] in 0 to 1.

    Sinkage by halving until the soil carries the load; a load that it cannot carry leaves the
    wheel nine tenths of its radius deep.
    """
    load, slip = (np.asarray(a, np.float64) for a in (loads, slips))
    low = np.full((len(load), len(slip)), 1e-6)
    high = np.full_like(low, 0.9 * shape.radius)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        carried = _sums(shape, soil, middle, slip)[0] >= load[:, None]
        low, high = np.where(carried, low, middle), np.where(carried, middle, high)
    depth = 0.5 * (low + high)
    carried, thrust, resistance, torque = _sums(shape, soil, depth, slip)
    return Curves(thrust / carried, resistance / carried, torque / carried / shape.tip, depth)


def _sums(shape: Shape, soil: Soil, depth: Floats, slip: Floats
          ) -> tuple[Floats, Floats, Floats, Floats]:
    """Vertical force, thrust, resistance N and torque N m [L, S] at a sinkage [L, S] m."""
    r, tip = shape.radius, shape.tip
    entry = np.arccos(np.clip(1.0 - depth / r, -1.0, 1.0))[..., None]
    sheared = np.arccos(np.clip((r - depth) / tip, -1.0, 1.0))[..., None]
    exponent = (soil.n0 + soil.n1 * slip)[None, :, None]
    angle = sheared * (np.arange(ANGLES) + 0.5) / ANGLES
    inside = np.minimum(angle, entry)
    peak = (soil.peak + soil.peak_slip * slip)[None, :, None] * entry
    # Behind its peak the pressure falls as it rose before it.
    mirrored = entry - inside / np.maximum(peak, 1e-9) * (entry - peak)
    at = np.where(inside > peak, inside, np.clip(mirrored, 0.0, entry))
    reach = np.maximum(np.cos(at) - np.cos(entry), 0.0) * r
    stiffness = soil.k_c / shape.width + soil.k_phi
    pressure = np.where(angle < entry, stiffness * reach**exponent, 0.0)
    moved = tip * (sheared - angle - (1.0 - slip)[None, :, None]
                   * (np.sin(sheared) - np.sin(angle)))
    cohesion, tangent = interface(soil, shape.grousers)
    stress = (cohesion + pressure * tangent) * (1.0 - np.exp(-np.maximum(moved, 0.0) / soil.shear))
    area = (shape.width * sheared / ANGLES)[..., 0]

    def summed(values: Floats) -> Floats:
        return np.asarray(area * values.sum(axis=-1))

    return (summed(r * pressure * np.cos(angle) + tip * stress * np.sin(angle)),
            summed(tip * stress * np.cos(angle)), summed(r * pressure * np.sin(angle)),
            summed(tip * tip * stress))
