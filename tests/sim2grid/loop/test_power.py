"""Batteries: the account of one, and robots that run out of power in steps and by the clock."""

import math
from dataclasses import dataclass

import msgspec
import numpy as np
import pytest

from moonteam.errors import InputError
from moonteam.problem import mission as missions
from moonteam.problem.battery import Battery
from sim2grid.env.session import Stage
from sim2grid.loop.asked import Body
from sim2grid.loop.fused import whole
from sim2grid.loop.power import Charge, Power
from sim2grid.measure.metrics import battery_report, make_report

SUN = {"azimuth": 90, "elevation": 30}


@dataclass(frozen=True)
class EastLit:
    """Light to the east of x m alone."""

    x: float = 0.0
    elevation: float = math.radians(30)

    def at(self, xy):
        return np.asarray(xy)[..., 0] > self.x


def powered(spec, *batteries, sun=SUN):
    robots = tuple(msgspec.structs.replace(robot, battery=battery) for robot, battery in zip(
        spec.robots, batteries, strict=True))
    spec = msgspec.structs.replace(spec, robots=robots, sun=sun and msgspec.convert(
        sun, missions.Sun))
    return missions.check(spec, "test")


def balanced(charge):
    return charge.start_wh + charge.gained_wh - charge.used_wh == pytest.approx(charge.now_wh)


def test_a_battery_drains_fills_and_is_never_more_than_full():
    one = Charge(Battery(capacity_wh=10, panel_w=40, idle_w=20, charge=0.5, efficiency=0.5))
    one.pass_time(moving_w=5.0, light=0.0, seconds=360)  # (20 + 5 / 0.5) W for a tenth of an hour
    assert one.now_wh == pytest.approx(2.0)
    one.pass_time(moving_w=0.0, light=0.5, seconds=3600)  # as much as it draws
    assert (one.now_wh, one.lowest_wh) == pytest.approx((2.0, 2.0))
    one.pass_time(moving_w=0.0, light=1.0, seconds=3600)  # 20 Wh more than it draws, 8 go in
    assert one.now_wh == pytest.approx(10.0)
    assert one.gained_wh == pytest.approx(20.0 + 28.0)
    assert balanced(one)
    assert (one.dark_s, one.counted_s) == (360, 360 + 7200)
    one.pass_time(moving_w=0.0, light=0.0, seconds=7200)
    assert one.empty
    assert balanced(one)


def test_panels_give_by_light_and_elevation_and_propellant_is_no_current(mission):
    battery = Battery(capacity_wh=100, panel_w=36, charge=0.5, efficiency=1.0)
    spec = powered(mission(["a wheeled A 0 0", "b wheeled A 3 0", "c drone A 3 3"], ["A OR 2 2"]),
                   battery, battery, battery)
    charges = {}

    class Its:
        mission, bodies = spec, [Body(0, 0.5, light=EastLit())] * 3

    power = Power(Its, charges)
    xy = np.array([[-1.5, 0.0], [1.5, 0.0], [1.5, 1.0]])
    watts, burnt = np.full((2, 3), 18.0), np.array([[0.0, 0.0, 0.1]] * 2)
    assert power.spend(np.array([True, True, True]), xy, watts, burnt, 100.0) == []
    sunlit = math.cos(math.radians(30))
    assert charges[0].gained_wh == 0.0
    assert charges[0].used_wh == pytest.approx(0.5)
    assert charges[1].gained_wh == pytest.approx(sunlit)
    assert charges[2].used_wh == 0.0
    power.spend(np.array([False, True, True]), xy, watts, burnt, 100.0)
    assert charges[0].counted_s == 100.0


def test_a_robot_without_power_leaves_the_team_and_the_rest_goes_on(mission, execute, script):
    spec = mission(["a wheeled A 0 0", "b wheeled A 0 3"], ["A OR 3 3"])
    spec = powered(spec, Battery(capacity_wh=20 * 3 / 3600, idle_w=20), None)
    done = execute(spec, script(*["stay right"] * 3))
    assert done.record.success
    [loss] = done.record.losses
    assert (loss.robot, loss.cause) == (0, "battery")
    assert loss.time_s == pytest.approx(3.0, abs=0.21)
    report = battery_report(done.record, 0)
    assert (report.end_wh, report.lowest_wh, report.in_shadow) == (0.0, 0.0, 1.0)
    assert not battery_report(done.record, 1)


def test_a_mission_that_needs_who_has_no_power_left_ends_at_once(mission, execute, script):
    spec = powered(mission(["a wheeled A 0 0", "b wheeled B 0 3"], ["A OR 3 0"]),
                   Battery(capacity_wh=20 * 3 / 3600, idle_w=20), None)
    done = execute(spec, script(*["right stay"] * 9))
    assert done.record.failure == "unsolvable"
    assert "a (battery)" in done.record.detail
    assert done.record.seconds() == pytest.approx(3.0, abs=0.25)


def test_light_keeps_it_going(mission, execute, script):
    spec = powered(mission(["a wheeled A 0 0"], ["A OR 3 0"]),
                   Battery(capacity_wh=20 * 3 / 3600, idle_w=20, panel_w=30))
    assert execute(spec, script(*["right"] * 9), light=EastLit(9.0)).record.losses
    done = execute(spec, script(*["right"] * 9), light=EastLit(-1.0))
    assert done.record.success
    charge = done.record.charges[0]
    assert 0 < charge.dark_s < charge.counted_s
    assert charge.lowest_wh < charge.now_wh
    report = make_report(done.record, spec, done.asked.frame, [0], planner="script",
                         objective=None, mode="barrier", backend="points", seed=0, grid_plan=None)
    assert report.robots[0].battery.from_sun_wh == pytest.approx(charge.gained_wh, abs=1e-4)


def test_without_a_battery_the_report_is_as_it_was(mission, execute, script):
    done = execute(mission(["a wheeled A 0 0"], ["A OR 1 0"]), script("right"))
    report = make_report(done.record, done.asked.mission, done.asked.frame, [0], planner="script",
                         objective=None, mode="barrier", backend="points", seed=0, grid_plan=None)
    assert "battery" not in msgspec.to_builtins(report)["robots"][0]


def test_what_counts_no_power_says_so(mission, execute, script):
    spec = powered(mission(["a wheeled A 0 0"], ["A OR 1 0"]), Battery(capacity_wh=5))
    with pytest.raises(InputError, match=r"robots\[0\].battery: environments count no power"):
        Stage.of(spec, "test", "native")
    done = execute(spec, script("right"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(whole, "decider_of", lambda planner: None)
        with pytest.raises(InputError, match="takes missions without batteries"):
            whole.check(done)


@pytest.mark.parametrize(("battery", "sun", "told"), [
    ({"capacity_wh": 0}, SUN, "robots[0].battery.capacity_wh: 0 is not allowed; above 0"),
    ({"capacity_wh": 1, "charge": 1.5}, SUN, "robots[0].battery.charge: 1.5 is not allowed"),
    ({"capacity_wh": 1, "idle_w": -2}, SUN, "robots[0].battery.idle_w: -2 is not allowed; 0 to"),
    ({"capacity_wh": 1, "panel_w": 9}, None,
     "robots[0].battery.panel_w: 9 is not allowed without a sun"),
    ({"capacity_wh": 1}, {"azimuth": 5}, "sun: give azimuth and elevation, or latitude")])
def test_bad_batteries_and_suns_are_one_line(mission, battery, sun, told):
    with pytest.raises(InputError) as error:
        powered(mission(["a wheeled A 0 0"], ["A OR 1 0"]), Battery(**battery), sun=sun)
    assert told in str(error.value)
