"""Ways driven by the clock, by hand, and how they scatter."""

import numpy as np
import pytest

from sim2grid.loop.record import GOING_ON, SETTING_OUT, Leg, Record
from sim2grid.measure.metrics import Report, RobotReport
from sim2grid.measure.scatter import scatter
from sim2grid.measure.ways import WayReport, ways_driven


def leg(action, a, b, begin, end, expected, ended="arrived", robot=0):
    return Leg(robot, 0, action, (0, 0), (1, 0), np.array(a, float), np.array(b, float), begin,
               99.0, end, ended, (1, 0), expected)


def test_a_way_is_all_its_pieces_and_counts_if_it_came_to_its_end():
    record = Record([], [])
    record.legs = [
        leg(SETTING_OUT, (0, 0), (3, 0), 0.0, 4.0, 3.0),
        leg(GOING_ON, (3, 0), (3, 4), 4.0, 9.0, 5.0),
        leg(SETTING_OUT, (0, 0), (3, 0), 0.0, 4.0, 3.0, robot=1),
        leg(SETTING_OUT, (3, 4), (9, 4), 9.0, 12.0, 6.0, ended="cut"),
        leg(SETTING_OUT, (6, 4), (0, 4), 12.0, 19.0, 6.0),
        leg(GOING_ON, (0, 4), (0, 0), 19.0, 21.0, 4.0, ended="cut")]
    # Up by a quarter along x, level along y.
    ways = ways_driven(record, 0, 0.5, lambda xy: 0.25 * xy[:, 0])
    assert ways == (WayReport(8.5, 9.0, pytest.approx(np.degrees(np.arctan(0.75 / 7)), abs=0.01)),)
    assert ways_driven(record, 1, 0.0) == (WayReport(3.0, 4.0, None),)
    record.legs = [Leg(0, 0, 3, (0, 0), (1, 0), np.zeros(2), np.ones(2), 0.0, 9.0, 4.0, "arrived")]
    assert ways_driven(record, 0, 0.5) == ()  # a move of a cell


def report(kind, ways):
    robot = RobotReport("r", kind, (), (0, 0), None, None, 0, 0, None, None, None, 0, 0, None, 0.0,
                        None, 0, 0, 0.0, 0.0, 0.0, ways=tuple(ways))
    return Report("m", True, None, "", "exact", None, "clock", "native", 0, 1.0, 1, 1, None, None,
                  {}, (), (robot,))


def test_the_spread_is_about_the_median_of_its_kind_and_steepness():
    rng = np.random.default_rng(0)

    def driven(count, steep, ratio, spread):
        return [WayReport(10.0, float(10.0 * ratio * np.exp(spread * z)), steep)
                for z in rng.standard_normal(count)]

    reports = [report("rover", driven(4000, 1.0, 1.2, 0.1) + driven(4000, 8.0, 2.0, 0.1)
                      + driven(3, 4.0, 9.0, 0.0)),
               report("drone", driven(2000, 2.0, 1.0, 0.05)), report("rover", [])]
    *lines, whole = scatter(reports)
    assert [(one["kind"], one["from_deg"], one["to_deg"], one["ways"]) for one in lines] == [
        ("drone", 0.0, 3.0, 2000), ("rover", 0.0, 3.0, 4000), ("rover", 6.0, None, 4000)]
    assert [one["ratio"] for one in lines] == pytest.approx([1.0, 1.2, 2.0], rel=0.01)
    assert [one["spread"] for one in lines] == pytest.approx([0.05, 0.1, 0.1], rel=0.05)
    assert (whole["kind"], whole["ways"]) == ("all", 10000)
    assert whole["spread"] == pytest.approx(0.0922, rel=0.05)
    assert scatter([report("rover", [])]) == []
