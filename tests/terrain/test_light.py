"""Shadows against what geometry says, and against a slow march along each ray."""

import math

import numpy as np
import pytest

from moonteam.problem.sun import SunPosition
from moonteam.terrain.light import lit, lit_at
from moonteam.terrain.site import Boulder, Site, make_site


def sun(azimuth, elevation):
    return SunPosition(math.radians(azimuth), math.radians(elevation))


def ground(heights, spacing=0.25):
    return Site("made", 0, np.asarray(heights, np.float32), spacing)


@pytest.mark.parametrize("elevation", [4.0, 10.0, 35.0])
def test_a_walls_shadow_is_as_long_as_its_height_over_the_tangent(elevation):
    heights = np.zeros((41, 401))
    heights[:, 320] = 1.0
    dark = ~lit(ground(heights), sun(90, elevation))[20, :320]
    length = 1.0 / math.tan(math.radians(elevation))
    assert 0.25 * dark.sum() == pytest.approx(length, abs=0.25)
    assert dark[-1]
    assert not dark[: 320 - math.ceil(length / 0.25) - 1].any()


@pytest.mark.parametrize(("azimuth", "dark"), [
    (0, (8, 20)), (90, (20, 8)), (180, (32, 20)), (270, (20, 32)), (45, (12, 12))])
def test_a_shadow_falls_away_from_the_sun(azimuth, dark):
    heights = np.zeros((41, 41))
    heights[18:23, 18:23] = 1.0  # row 0 in the south
    made = lit(ground(heights), sun(azimuth, 15))
    assert not made[dark]
    assert made[40 - dark[0], 40 - dark[1]]


def test_a_slope_is_lit_while_the_sun_is_higher_than_it_falls():
    x = 0.25 * np.arange(60.0)
    falling = np.tile(-np.tan(np.radians(10)) * x, (30, 1))  # to the east: away from the west
    assert lit(ground(falling), sun(270, 10.5)).all()
    made = lit(ground(falling), sun(270, 9.5))
    assert not made[:, 1:].any()
    assert made[:, 0].all()  # the edge itself: nothing stands beyond it
    assert lit(ground(falling), sun(90, 1)).all()


def test_the_floor_of_a_crater_is_dark_until_the_sun_looks_over_its_rim():
    y, x = 0.25 * (np.mgrid[:161, :161] - 80)
    away = np.hypot(x, y)
    bowl = np.where(away < 10, 3.0 * (away / 10) ** 2, 3.0 * np.exp(-(away - 10)))
    rim = math.degrees(math.atan2(3.0, 10.0))
    for azimuth in (20, 133, 290):
        assert not lit(ground(bowl), sun(azimuth, rim - 0.5))[80, 80]
        assert lit(ground(bowl), sun(azimuth, rim + 0.5))[80, 80]


def test_a_boulder_throws_a_shadow_and_what_stands_high_is_out_of_it():
    rock = Boulder(np.array([0.0, 0.0, 0.0]), 1.0, np.zeros((4, 3)))
    site = Site("rock", 0, np.zeros((81, 81), np.float32), 0.25, (rock,))
    # The rays that touch a half sphere reach the ground at radius / sin(elevation).
    reach = 1.0 / math.sin(math.radians(20))
    at = np.array([[-reach + 0.05, 0.0], [-reach - 0.05, 0.0], [-2.0, 1.05], [2.0, 0.0]])
    assert lit_at(site, sun(90, 20), at).tolist() == [False, True, True, True]
    assert not lit_at(site, sun(90, 20), [0.5, 0.0])  # under the rock
    assert lit_at(site, sun(90, 20), [-2.0, 0.0], above=0.5)


def test_no_sun_no_light_and_a_high_sun_lights_all():
    site = ground(np.zeros((9, 9)))
    assert not lit(site, sun(0, 0)).any()
    assert not lit(site, sun(0, -5)).any()
    assert lit(site, sun(0, 90)).all()


@pytest.mark.parametrize(("azimuth", "elevation"), [(37, 6), (200, 12), (270, 3), (315, 20)])
def test_rough_ground_against_a_march_in_small_steps(azimuth, elevation):
    site = ground(4 * make_site("highland", 5, 16.0).heights)
    where, toward = sun(azimuth, elevation), sun(azimuth, elevation).toward
    rng = np.random.default_rng(1)
    points = rng.uniform(-8, 8, (80, 2))
    height = np.asarray(site.surface.height(points.astype(np.float32)))
    steps = np.arange(1, 6000)[:, None] * 0.004
    line = points[None] + steps[..., None] * np.array(toward[:2]) / math.cos(where.elevation)
    over = height[None] + steps * math.tan(where.elevation) + 1e-3
    inside = (np.abs(line) <= 8.0).all(axis=-1)
    above = np.asarray(site.surface.height(line.astype(np.float32))) > over
    slow = ~(above & inside).any(axis=0)
    assert (lit_at(site, where, points) == slow).mean() > 0.96  # rays that graze
    assert 0.03 < slow.mean() < 0.97
