"""The sun over a mission: against almanacs, and one clear line for what is wrong."""

import itertools
import math
from datetime import UTC, datetime, timedelta

import msgspec
import pytest

from moonteam.errors import InputError
from moonteam.problem.subsolar import subsolar_point
from moonteam.problem.sun import Sun, seen_from

SYNODIC = 29.530589  # days


def at(*when):
    return datetime(*when, tzinfo=UTC)


def test_the_example_of_the_book():
    """Meeus, Astronomical Algorithms, example 53.a."""
    point = subsolar_point(at(1992, 4, 12))
    assert point.longitude == pytest.approx(67.89, abs=0.1)
    assert point.latitude == pytest.approx(1.46, abs=0.1)


@pytest.mark.parametrize(("when", "longitude"), [
    (at(2000, 1, 21, 4, 40), 0), (at(2000, 1, 6, 18, 14), 180),  # full and new moon
    (at(2024, 4, 8, 18, 21), 180), (at(2025, 3, 14, 6, 55), 0)])
def test_it_is_noon_in_the_middle_of_the_near_side_at_full_moon(when, longitude):
    # Off by the Moon's libration in longitude, up to 8 degrees.
    assert abs(math.remainder(subsolar_point(when).longitude - longitude, 360)) < 8.5


def test_the_sun_stays_near_the_equator_and_goes_round_in_a_synodic_month():
    start = at(2026, 1, 1)
    points = [subsolar_point(start + timedelta(days=day)) for day in range(400)]
    latitudes = [point.latitude for point in points]
    assert 1.4 < max(latitudes) < 1.62
    assert -1.62 < min(latitudes) < -1.4
    turned = sum(math.remainder(b.longitude - a.longitude, 360)
                 for a, b in itertools.pairwise(points))
    assert turned == pytest.approx(-360 * 399 / SYNODIC, abs=8)


def test_the_sun_seen_from_the_middle_a_pole_and_the_west():
    when = at(2000, 1, 21, 4, 40)
    point = subsolar_point(when)
    zenith = seen_from(point.latitude, point.longitude, when)
    assert math.degrees(zenith.elevation) == pytest.approx(90, abs=1e-4)
    pole = seen_from(-90, 0, when)
    assert math.degrees(pole.elevation) == pytest.approx(-point.latitude, abs=1e-9)
    west = seen_from(0, point.longitude - 80, when)  # the sun is low in the east there
    assert math.degrees(west.elevation) == pytest.approx(10, abs=0.2)
    assert math.degrees(west.azimuth) == pytest.approx(90, abs=1)


def test_azimuth_is_from_north_clockwise():
    east, north, up = Sun(azimuth=90, elevation=30).position().toward
    assert (east, north, up) == pytest.approx((math.cos(math.pi / 6), 0, 0.5))
    assert Sun(azimuth=0, elevation=0).position().toward == pytest.approx((0, 1, 0))


def test_a_time_may_say_its_offset():
    place = {"latitude": -89.5, "longitude": 12.0}
    assert Sun(**place, time="2027-03-20T12:00").position() == Sun(
        **place, time="2027-03-20T14:00:00+02:00").position()


@pytest.mark.parametrize(("sun", "told"), [
    ({}, "sun: give azimuth and elevation, or latitude, longitude and time"),
    ({"azimuth": 90}, "sun: give azimuth and elevation"),
    ({"azimuth": 90, "elevation": 5, "time": "2027-03-20"}, "sun: give azimuth"),
    ({"azimuth": 90, "elevation": 91}, "sun.elevation: 91 is not allowed; -90 to 90 degrees"),
    ({"latitude": 95, "longitude": 0, "time": "2027-03-20"}, "sun.latitude: 95 is not"),
    ({"latitude": 5, "longitude": 0, "time": "noon"}, "sun.time: 'noon' is not allowed; a time"),
    ({"latitude": 5, "longitude": 0, "time": "1492-10-12"}, "a year of 1900 to 2100"),
    ({"azimuth": 90, "elevation": 5, "dark": 0.5}, "sun.dark: 0.5 is not allowed; 1 to 100")])
def test_what_is_wrong_is_one_line(sun, told):
    def fail(key, problem):
        return InputError("m.yaml", problem, f"sun.{key}" if key else "sun")

    with pytest.raises(InputError) as error:
        msgspec.convert(sun, Sun).check(fail)
    assert told in str(error.value)
