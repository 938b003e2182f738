from dataclasses import replace

import numpy as np
import pytest

from moonteam.physics.trials import slopes
from moonteam.physics.trials.traverse import SAMPLE_SECONDS, run_traverses
from moonteam.robots import KINDS
from moonteam.terrain.site import Boulder, Site, make_site
from moonteam.terrain.traversability import (
    boulder_distance,
    passable,
    travel_times,
    traversability,
)

ALL = ("drone", "legged", "wheeled")


def limits(*kinds):
    return {kind: KINDS.get(kind).limits for kind in kinds}


def slope_site(degrees: float) -> Site:
    x = np.arange(-40, 41) * 0.25
    heights = np.tile(np.tan(np.radians(degrees)) * x, (81, 1)).astype(np.float32)
    return Site("slope", 0, heights, 0.25)


@pytest.mark.parametrize("kind", ["legged", "wheeled"])
def test_slopes_close_where_the_kinds_limit_is(kind):
    limit = np.degrees(KINDS.get(kind).max_slope)
    assert traversability(slope_site(limit - 1), (12, 12), 1.0, limits(kind))[kind].all()
    assert not traversability(slope_site(limit + 1), (12, 12), 1.0, limits(kind))[kind].any()


def test_a_flyer_does_not_mind_slopes_nor_boulders():
    site = replace(slope_site(35), boulders=(Boulder(np.zeros(3), 1.0, np.zeros((0, 3))),))
    assert traversability(site, (12, 12), 1.0, limits("drone"))["drone"].all()


def test_a_boulder_closes_its_cell_and_only_near_ones():
    rock = Boulder(np.array([2.5, -1.5, 0.0]), 0.4, np.zeros((0, 3)))
    site = replace(make_site("flat", 0, 20.0), boulders=(rock,))
    maps = traversability(site, (12, 12), 1.0, limits(*ALL))
    # Cell (8, 4) of a 12 by 12 map has its centre at (2.5, -1.5).
    assert not maps["wheeled"][4, 8]
    assert not maps["legged"][4, 8]
    assert maps["wheeled"].sum() > 144 - 9
    assert maps["wheeled"][4, 10]
    assert maps["wheeled"][0, 0]
    assert boulder_distance(site, np.array([4.5, -1.5])) == pytest.approx(1.6, abs=1e-3)


def test_a_ledge_is_a_step_too_high():
    heights = np.zeros((81, 81), np.float32)
    heights[:, 41:] = 0.3
    site = Site("ledge", 0, heights, 0.25)
    able = traversability(site, (16, 16), 1.0, limits("wheeled"))["wheeled"]
    assert not able[:, 7:9].any()
    assert able[:, :6].all()
    assert able[:, 10:].all()


@pytest.mark.parametrize("kind", ["legged", "wheeled"])
def test_steeper_is_slower_and_closed_is_for_ever(kind):
    times = [travel_times(slope_site(d), (4, 4), 1.0, limits(kind))[kind].mean()
             for d in (0, 8, 16)]
    assert times[0] == pytest.approx(1.0 / KINDS.get(kind).speed, rel=1e-3)
    assert times[0] < times[1] < times[2] < 1.5 * times[0]
    assert np.isinf(travel_times(slope_site(30), (4, 4), 1.0, limits(kind))[kind]).all()


@pytest.mark.parametrize(("kind", "degrees"), [("legged", 18), ("wheeled", 15)])
def test_a_slope_takes_as_long_as_the_map_says(kind, degrees):
    """The middle 5 m of the plane up, from when the robot enters to when it leaves them."""
    site = slopes.incline(degrees, False, 0.0, 0)
    route = slopes.routes("up", 1, np.random.default_rng(0))
    _, (recording,) = run_traverses(KINDS.get(kind), site, route, record=[0])
    x = recording.qpos[:, 0]
    took = np.count_nonzero((x > -2.5) & (x < 2.5)) * SAMPLE_SECONDS
    told = travel_times(site, (5, 1), 1.0, limits(kind))[kind].sum()
    assert told == pytest.approx(took, rel=0.1)


def test_off_the_site_nobody_stands():
    site = make_site("flat", 0, 8.0)
    assert passable(site, np.array([[0.0, 0.0], [5.0, 0.0], [0.0, -3.9]]),
                    KINDS.get("drone").limits).tolist() == [
        True, False, False]


@pytest.mark.parametrize(("preset", "least"), [("mare", 0.9), ("highland", 0.6), ("polar", 0.8)])
def test_presets_are_mostly_open(preset, least):
    maps = traversability(make_site(preset, 3, 28.0), (20, 20), 1.0, limits(*ALL))
    assert maps["drone"].all()
    assert maps["wheeled"].mean() > least
    assert maps["legged"].mean() > least
