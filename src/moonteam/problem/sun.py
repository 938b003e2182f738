"""Where the sun stands over a mission, as its file says it: two angles, or a place and a time.

The Moon turns under the sun by half a degree an hour, and a mission lasts minutes: the sun stands
still while one is under way.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from datetime import UTC, datetime
from typing import NamedTuple

import msgspec

from moonteam.errors import InputError
from moonteam.problem.subsolar import subsolar_point

ANGLES, PLACED = ("azimuth", "elevation"), ("latitude", "longitude", "time")
LIMITS = {"azimuth": (-360.0, 360.0), "elevation": (-90.0, 90.0), "latitude": (-90.0, 90.0),
          "longitude": (-360.0, 360.0)}
"""Least and most degrees."""

YEARS = 1900, 2100
"""For which the formula of the subsolar point is good."""

DARKEST = 100.0
"""Times as long that shadowed ground may count."""


class SunPosition(NamedTuple):
    """Where the sun stands in the sky."""

    azimuth: float  # rad from north (the map's up) clockwise, east is pi / 2
    elevation: float  # rad above the horizon

    @property
    def toward(self) -> tuple[float, float, float]:
        """Unit vector (east, north, up) to the sun."""
        flat = math.cos(self.elevation)
        return (flat * math.sin(self.azimuth), flat * math.cos(self.azimuth),
                math.sin(self.elevation))


class Sun(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """The sun: `azimuth` (from north clockwise, east is 90) and `elevation`, degrees; or the
    selenographic `latitude` and `longitude` of the site, degrees, and a `time`, ISO 8601, UTC.

    `dark`: so many times as long counts a way over shadowed ground, where a robot with a battery
    looks for one; what it takes is told as it is.
    """

    azimuth: float | None = None
    elevation: float | None = None
    latitude: float | None = None
    longitude: float | None = None
    time: str | None = None
    dark: float = 1.0

    def position(self) -> SunPosition:
        """Where it stands; of a sun that was checked."""
        if self.azimuth is not None and self.elevation is not None:
            return SunPosition(math.radians(self.azimuth), math.radians(self.elevation))
        assert self.time is not None
        assert self.latitude is not None
        assert self.longitude is not None
        return seen_from(self.latitude, self.longitude, instant(self.time))

    def check(self, fail: Callable[[str, str], InputError]) -> None:
        """Raises what `fail` makes of a key, "" for the sun itself, and what is wrong with it."""
        said = {key for key in (*ANGLES, *PLACED) if getattr(self, key) is not None}
        if said not in ({*ANGLES}, {*PLACED}):
            raise fail("", "give azimuth and elevation, or latitude, longitude and time")
        for key, (least, most) in LIMITS.items():
            value = getattr(self, key)
            if value is not None and not least <= value <= most:
                raise fail(key, f"{value:g} is not allowed; {least:g} to {most:g} degrees")
        if self.time is not None:
            try:
                when = instant(self.time)
            except ValueError:
                raise fail("time", f"{self.time!r} is not allowed; a time in UTC such as "
                           "2027-03-20T12:00") from None
            if not YEARS[0] <= when.year <= YEARS[1]:
                raise fail("time", f"{self.time!r} is not allowed; a year of {YEARS[0]} to "
                           f"{YEARS[1]}")
        if not 1 <= self.dark <= DARKEST:
            raise fail("dark", f"{self.dark:g} is not allowed; 1 to {DARKEST:g}")


def instant(text: str) -> datetime:
    """A time as ISO 8601 has it; UTC where it says no offset. Raises ValueError."""
    try:
        when = datetime.fromisoformat(text)
        return when.replace(tzinfo=UTC) if when.tzinfo is None else when.astimezone(UTC)
    except OverflowError:
        raise ValueError(text) from None


def seen_from(latitude: float, longitude: float, when: datetime) -> SunPosition:
    """The sun over a place on a spherical Moon, degrees selenographic, at a time in UTC.

    The sun is far: it stands in the same direction from everywhere on the Moon (to 0.0007
    degrees), so its elevation is 90 degrees less the arc from here to the subsolar point.
    """
    sun = subsolar_point(when)
    here, there = math.radians(latitude), math.radians(sun.latitude)
    away = math.radians(sun.longitude - longitude)
    east = math.cos(there) * math.sin(away)
    north = (math.cos(here) * math.sin(there)
             - math.sin(here) * math.cos(there) * math.cos(away))
    up = math.sin(here) * math.sin(there) + math.cos(here) * math.cos(there) * math.cos(away)
    return SunPosition(math.atan2(east, north), math.atan2(up, math.hypot(east, north)))
