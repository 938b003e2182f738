"""The point of the Moon that has the sun in its zenith.

After J. Meeus, Astronomical Algorithms (2nd ed., 1998): chapter 53 for the point, 25 for the sun,
and of chapter 47's series for the Moon the largest terms, for its place moves the point by at most
0.15 degrees. Nutation and physical libration are left out: the point is good to 0.1 degrees (the
physical libration alone is up to 0.04), as far as the sun moves in ten minutes.
"""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import NamedTuple

INCLINATION = math.radians(1.54242)
"""Of the Moon's equator to the ecliptic (Meeus, ch. 53)."""

AU_KM = 149597870.7
J2000 = datetime(2000, 1, 1, 12, tzinfo=UTC)
CENTURY_S = 36525.0 * 86400.0


class Subsolar(NamedTuple):
    """Selenographic, degrees."""

    latitude: float  # within about 1.6
    longitude: float  # -180 to 180, 0 towards the Earth, east positive


def subsolar_point(when: datetime) -> Subsolar:
    """Where the sun stands in the zenith at a time that knows its zone.

    UTC is taken for dynamical time, from which it is about a minute: 0.01 degrees.
    """
    t = (when - J2000).total_seconds() / CENTURY_S
    sun, distance = _sun(t)
    moon, above, away = _moon(t)
    # Heliocentric longitude and latitude of the Moon.
    ratio = away / (distance * AU_KM)
    longitude = sun + math.pi + ratio * math.cos(above) * math.sin(sun - moon)
    latitude = ratio * above
    node = _angle(125.0445479, -1934.1362891, t)
    w, tilt = longitude - node, INCLINATION
    along = math.atan2(
        math.sin(w) * math.cos(latitude) * math.cos(tilt) - math.sin(latitude) * math.sin(tilt),
        math.cos(w) * math.cos(latitude))
    up = -(math.sin(w) * math.cos(latitude) * math.sin(tilt)
           + math.sin(latitude) * math.cos(tilt))
    east = math.remainder(along - _angle(93.2720950, 483202.0175233, t), 2.0 * math.pi)
    return Subsolar(math.degrees(math.asin(up)), math.degrees(east))


def _angle(degrees: float, per_century: float, t: float) -> float:
    """A mean angle, rad, `t` centuries after J2000."""
    return math.radians((degrees + per_century * t) % 360.0)


def _sun(t: float) -> tuple[float, float]:
    """Geocentric ecliptic longitude of the sun, rad, and its distance, au (Meeus, ch. 25)."""
    mean = _angle(280.46646, 36000.76983, t)
    anomaly = _angle(357.52911, 35999.05029, t)
    centre = ((1.914602 - 0.004817 * t) * math.sin(anomaly)
              + 0.019993 * math.sin(2 * anomaly) + 0.000289 * math.sin(3 * anomaly))
    eccentricity = 0.016708634 - 0.000042037 * t
    true = anomaly + math.radians(centre)
    return (mean + math.radians(centre),
            1.000001018 * (1 - eccentricity**2) / (1 + eccentricity * math.cos(true)))


def _moon(t: float) -> tuple[float, float, float]:
    """Geocentric ecliptic longitude and latitude of the Moon, rad, and its distance, km (Meeus,
    ch. 47, the largest terms: to about 0.2 degrees).
    """
    d = _angle(297.8501921, 445267.1114034, t)  # mean elongation
    m = _angle(357.5291092, 35999.0502909, t)  # the sun's mean anomaly
    a = _angle(134.9633964, 477198.8675055, t)  # the Moon's
    f = _angle(93.2720950, 483202.0175233, t)  # argument of latitude
    longitude = (6.288774 * math.sin(a) + 1.274027 * math.sin(2 * d - a)
                 + 0.658314 * math.sin(2 * d) + 0.213618 * math.sin(2 * a)
                 - 0.185116 * math.sin(m) - 0.114332 * math.sin(2 * f))
    latitude = (5.128122 * math.sin(f) + 0.280602 * math.sin(a + f)
                + 0.277693 * math.sin(a - f) + 0.173237 * math.sin(2 * d - f))
    distance = (385000.56 - 20905.355 * math.cos(a) - 3699.111 * math.cos(2 * d - a)
                - 2955.968 * math.cos(2 * d))
    return (_angle(218.3164477, 481267.88123421, t) + math.radians(longitude),
            math.radians(latitude), distance)
