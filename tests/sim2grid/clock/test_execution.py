"""Missions by the clock on sliding points: choices, services, windows, losses, closed ground."""

from dataclasses import dataclass

import numpy as np
import pytest

from moonteam.planners.seconds.base import NEVER
from sim2grid.clock import steer
from sim2grid.clock.roads import OpenGround, Straight
from sim2grid.measure.metrics import target_reports

ROVER = {"name": "rover", "kind": "wheeled", "skills": ["A"], "start": [0, 0]}
WALKER = {"name": "walker", "kind": "legged", "skills": ["B"], "start": [0, 6]}
HOPPER = {"name": "hopper", "kind": "drone", "skills": ["C"], "start": [11, 11]}
LOOK = 0.2  # s between two looks


def test_a_straight_way_takes_its_time(mission, drive):
    spec = mission([ROVER], [{"at": [3, 4], "skills": ["A"]}])
    done = drive(spec, (0, (0,)))
    assert done.record.success
    assert done.record.solves[0].time_s == pytest.approx(5 / 0.5, abs=2 * LOOK + 0.25 / 0.5)
    assert [d.actions.tolist() for d in done.record.decisions] == [[0]]
    leg = done.record.legs[0]
    assert leg.expected_s == pytest.approx(10)
    assert leg.ended == "arrived"


def test_places_off_the_lattice_are_driven_to(mission, drive):
    spec = mission([ROVER], [{"at": [3.4, 4.3], "skills": ["A"]}])
    done = drive(spec, (0, (0,)))
    goal = done.task.place((3.4, 4.3))
    assert np.hypot(*(done.known.xy[0] - goal)) <= 0.25
    assert done.record.solves[0].distance_m[0] <= 0.25


def test_a_service_is_stood_through_by_its_whole_coalition(mission, drive):
    spec = mission([ROVER, HOPPER], [
        {"at": [6, 6], "coalition": {"A": 1, "C": 1}, "service": 7},
        {"at": [8, 8], "skills": ["C"], "after": ["T1"]}])
    done = drive(spec, (0, (0, 1)), (1, (1,)))
    first, second = done.record.solves
    there = np.hypot(6, 6) / 0.5
    assert first.time_s == pytest.approx(there + 7, abs=1.0)
    assert first.robots == (0, 1)
    assert second.time_s > first.time_s
    times, xy = np.concatenate(done.record.times), np.concatenate(done.record.qpos)[:, :2]
    during = (times > first.time_s - 6.5) & (times < first.time_s)
    assert np.ptp(xy[during], axis=0).max() < 0.25


def test_who_drifts_off_breaks_the_service_and_comes_back(mission, drive):
    spec = mission([ROVER], [{"at": [3, 0], "skills": ["A"], "service": 10}])
    done = drive(spec, (0, (0,)), faults={(0, 9.0): ("drift", 0.5, 0.0), (0, 11.0): "none"})
    assert done.record.success
    assert done.record.solves[0].time_s > 11 + 10


def test_nothing_starts_before_it_appears(mission, drive):
    spec = mission([HOPPER], [{"at": [9, 11], "skills": ["C"], "appears": 20, "service": 2}])
    done = drive(spec, (0, (0,)))
    assert done.record.solves[0].time_s == pytest.approx(22, abs=2 * LOOK)


def test_what_has_lapsed_ends_the_mission(mission, drive):
    spec = mission([ROVER], [{"at": [9, 9], "skills": ["A"], "lapses": 10}])
    done = drive(spec, (0, (0,)))
    assert not done.record.success
    assert done.record.failure == "unsolvable"
    assert "T1" in done.record.detail


WORTH = [{"at": [9, 9], "skills": ["A"], "lapses": 10, "worth": 3},
         {"at": [4, 0], "skills": ["A"], "lapses": 60, "worth": 2, "service": 5}]


def test_what_is_worth_something_may_lapse_and_the_mission_goes_on(mission, drive):
    spec = mission([ROVER], WORTH)
    done = drive(spec, (0, (0,)), spare=(1, (0,)))
    assert done.record.success
    assert done.record.lapsed == [0]
    assert [solve.target for solve in done.record.solves] == [1]
    assert ("lapsed" in [cause for _, cause in done.record.replans])
    lapsed = [d for d in done.record.decisions if d.solved[0]]
    assert lapsed[0].time_s == pytest.approx(10, abs=2 * LOOK)
    reports = target_reports(done.record, spec)
    assert [(t.worth, t.solved) for t in reports] == [(3, False), (2, True)]


def test_a_service_under_way_does_not_lapse_but_one_broken_off_does(mission, drive):
    spec = mission([ROVER], [{"at": [3, 0], "skills": ["A"], "service": 10, "lapses": 7,
                              "worth": 1}])
    done = drive(spec, (0, (0,)))
    assert [solve.target for solve in done.record.solves] == [0]
    assert not done.record.lapsed
    away = drive(spec, (0, (0,)), faults={(0, 9.0): ("drift", 0.5, 0.0)})
    assert away.record.success
    assert away.record.lapsed == [0]
    assert not away.record.solves


def test_a_mission_ends_when_everybody_is_home(mission, drive):
    robot = ROVER | {"home": [0, 0]}
    spec = mission([robot], [{"at": [4, 0], "skills": ["A"]}])
    done = drive(spec, (0, (0,)))
    assert done.record.success
    assert done.record.seconds() == pytest.approx(8 / 0.5, abs=2.0)
    assert np.hypot(*(done.known.xy[0] - done.task.place((0, 0)))) <= 0.25


def test_the_time_of_a_mission_runs_out(mission, drive):
    spec = mission([ROVER], [{"at": [9, 9], "skills": ["A"]}], max_seconds=5)
    done = drive(spec, (0, (0,)))
    assert done.record.failure == "max_seconds"
    assert done.record.detail == "T1 not solved within 5 s"


def test_who_is_left_goes_on_without_a_lost_robot(mission, drive):
    second = ROVER | {"name": "spare", "start": [11, 0]}
    spec = mission([ROVER, second], [{"at": [5, 0], "skills": ["A"]}],
                   events=[{"at_s": 3, "lost": "rover"}])

    done = drive(spec, (0, (0,)), spare=(0, (1,)))
    assert done.record.success
    assert done.record.solves[0].robots == (1,)
    assert [cause for _, cause in done.record.replans] == ["robot_lost"]
    assert done.record.seconds() == pytest.approx(3 + 6 / 0.5, abs=2.0)


def test_a_mission_that_a_loss_makes_unsolvable_ends_at_once(mission, drive):
    spec = mission([ROVER, WALKER], [{"at": [5, 0], "skills": ["A"]}],
                   events=[{"at_s": 3, "lost": "rover"}])
    done = drive(spec, (0, (0,)))
    assert done.record.failure == "unsolvable"
    assert done.record.seconds() == pytest.approx(3, abs=2 * LOOK)
    assert "rover (event)" in done.record.detail


HOME_CLOSES = {"at_s": 4, "impassable": {"kind": "wheeled", "at": [0, 0]}}


def test_who_has_no_way_home_any_more_serves_on_and_then_the_mission_is_over(mission, drive):
    spec = mission([ROVER | {"home": [0, 0]}], [{"at": [6, 0], "skills": ["A"]}],
                   events=[HOME_CLOSES])
    done = drive(spec, (0, (0,)), roads=Shut({"wheeled": 0.5, "legged": 0.4}))
    assert [solve.target for solve in done.record.solves] == [0]
    assert done.record.failure == "unsolvable"
    assert done.record.detail == "no way leads rover home"
    assert done.record.seconds() == pytest.approx(6 / 0.5, abs=2.0)


def test_who_is_at_home_when_it_closes_stays_there(mission, drive):
    spec = mission([ROVER | {"home": [0, 0]}, WALKER | {"skills": ["A"]}],
                   [{"at": [6, 0], "skills": ["A"]}], events=[HOME_CLOSES])
    done = drive(spec, (0, (1,)), roads=Shut({"wheeled": 0.5, "legged": 0.4}))
    assert done.record.success
    assert done.planner._planner.asked[-1].start[0].min() >= NEVER


def test_events_of_all_sorts_are_noted(mission, drive):
    spec = mission([ROVER], [{"at": [6, 0], "skills": ["A"]}], events=[
        {"at_s": 2, "slow": {"robot": "rover", "factor": 0.5}},
        {"at_s": 4, "silent": {"robot": "rover", "seconds": 3}},
        {"at_s": 5, "target": {"at": [8, 0], "skills": ["A"]}}])
    done = drive(spec, (0, (0,)), (1, (0,)))
    causes = [cause for _, cause in done.record.replans]
    assert causes == ["slowed", "silent", "new_target", "heard_again"]
    assert done.record.success
    assert done.record.target_names == ["T1", "T2"]
    assert done.record.seconds() == pytest.approx(2 + 7 / 0.25, abs=2.0)


def test_a_robot_that_falls_behind_is_an_event(mission, drive):
    spec = mission([ROVER], [{"at": [6, 0], "skills": ["A"]}])
    done = drive(spec, (0, (0,)), faults={(0, 2.0): "leisurely"})
    assert "behind" in [cause for _, cause in done.record.replans]
    assert done.record.success


def test_a_robot_that_never_comes_free_is_lost(mission, drive):
    spec = mission([ROVER, WALKER | {"skills": ["A"]}], [{"at": [6, 0], "skills": ["A"]}])
    done = drive(spec, (0, (0,)), faults={(0, 2.0): "still"})
    assert [loss.cause for loss in done.record.losses] == ["stuck"]
    assert "timeout" in [cause for _, cause in done.record.replans]


@dataclass(frozen=True)
class Wall(OpenGround):
    """Ground whose ways turn a corner about x = 0, and that learns."""

    closed: tuple = ()

    def way(self, kind, start, to):
        if (start[0] < 0) == (to[0] < 0):
            return Straight(np.stack([start, to]), float(np.linalg.norm(to - start)) / 0.5)
        corner = np.array([0.0, 4.0])
        points = np.stack([start, corner, to])
        return Bent(points, np.linalg.norm(np.diff(points, axis=0), axis=1) / self.speeds[kind])

    def matrix(self, kind, starts, to):
        return np.array([[self.way(kind, a, b).seconds for b in to] for a in starts])

    def close(self, kind, xy):
        return Wall(self.speeds, (*self.closed, (kind, *np.round(xy, 3))))


@dataclass(frozen=True)
class Shut(OpenGround):
    """Open ground where no way leads to what was closed."""

    closed: tuple = ()

    def matrix(self, kind, starts, to):
        seconds = super().matrix(kind, starts, to)
        seconds[:, [not self.passable(kind, at) for at in to]] = np.inf
        return seconds

    def passable(self, kind, xy):
        return all(of != kind or np.linalg.norm(at - xy) > 0.5 for of, at in self.closed)

    def close(self, kind, xy):
        return Shut(self.speeds, (*self.closed, (kind, xy)))


@dataclass(frozen=True)
class Bent:
    points: np.ndarray
    legs: np.ndarray

    @property
    def seconds(self):
        return float(self.legs.sum())


def test_a_way_round_a_corner_is_followed_piece_by_piece(mission, drive):
    spec = mission([ROVER], [{"at": [11, 0], "skills": ["A"]}])
    done = drive(spec, (0, (0,)), roads=Wall({"wheeled": 0.5}))
    legs = done.record.legs
    assert [leg.action for leg in legs] == [5, 4]
    assert [leg.ended for leg in legs] == ["arrived", "arrived"]
    length = 2 * np.hypot(5.5, 9.5)
    assert done.record.seconds() == pytest.approx(length / 0.5, rel=0.04)


def test_ground_that_stops_a_robot_is_learned(mission, drive):
    spec = mission([ROVER], [{"at": [11, 0], "skills": ["A"]}], max_seconds=120)
    done = drive(spec, (0, (0,)), roads=Wall({"wheeled": 0.5}), traps=[((-3.0, -1.0), 0.8)])
    assert "impassable" in [cause for _, cause in done.record.replans]
    assert [loss.cause for loss in done.record.losses] == ["stuck"]  # these ways never bend


def test_two_that_meet_head_on_pass_each_other(mission, drive):
    other = ROVER | {"name": "other", "start": [10, 0], "skills": ["B"]}
    spec = mission([ROVER, other], [{"at": [10, 0], "skills": ["A"]}, {"at": [0, 0],
                                                                      "skills": ["B"]}])
    done = drive(spec, (0, (0,)), (1, (1,)))
    assert done.record.success
    xy = np.concatenate(done.record.qpos)[:, [0, 1, 7, 8]].reshape(-1, 2, 2)
    assert np.linalg.norm(xy[:, 0] - xy[:, 1], axis=-1).min() > 0.55
    assert done.record.seconds() < 10 / 0.5 + 5


def test_of_two_side_by_side_whose_ways_meet_one_goes_on():
    """Each has the other before it on nearly the same way: both would wait for ever."""
    xy = np.array([[-1.17, -0.26], [-0.66, -0.15]])
    aims = np.array([[-0.72, 0.28], [-0.918, 0.918]])
    _, holds = steer.mind(xy, aims, aims, np.ones(2, bool), np.ones(2, bool), np.full(2, 0.3),
                          lambda *_: True)
    assert holds.tolist() == [False, True]


def test_nobody_walks_into_a_robot_that_stands(mission, drive):
    other = WALKER | {"name": "other", "start": [5, 0]}
    spec = mission([ROVER, other], [{"at": [10, 0], "skills": ["A"]}])
    done = drive(spec, (0, (0,)))
    assert done.record.success
    xy = np.concatenate(done.record.qpos)[:, [0, 1, 7, 8]].reshape(-1, 2, 2)
    assert np.linalg.norm(xy[:, 0] - xy[:, 1], axis=-1).min() > 0.55


def test_each_of_a_large_coalition_has_a_place_of_its_own(mission, drive):
    """Five that may help, four quarters: no two are sent to one place, lost ones out of it."""
    team = [ROVER | {"name": f"r{i}", "start": [2 * i, 0]} for i in range(5)]
    spec = mission(team, [{"at": [5, 6], "coalition": {"A": 4}, "service": 2}],
                   events=[{"at_s": 2, "lost": "r3"}])
    done = drive(spec, (0, (0, 1, 2, 4)))
    assert done.record.success
    at = done.known.xy[[0, 1, 2, 4]]
    apart = np.linalg.norm(at[:, None] - at[None], axis=-1)[np.triu_indices(4, 1)]
    assert apart.min() > 0.3


def test_two_that_fly_have_a_place_each_above_who_stands(mission, drive):
    second = HOPPER | {"name": "second", "start": [0, 11]}
    spec = mission([HOPPER, second, ROVER],
                   [{"at": [6, 6], "coalition": {"C": 2, "A": 1}, "service": 2}])
    done = drive(spec, (0, (0, 1, 2)))
    assert done.record.success
    xy = np.concatenate(done.record.qpos).reshape(-1, 3, 7)[:, :, :2]
    assert np.linalg.norm(xy[:, 0] - xy[:, 1], axis=-1).min() > 0.35
    hopper, second, rover = done.record.solves[0].distance_m
    assert max(hopper, second) < 0.57
    assert rover <= 0.25  # nobody of its like is there


def test_a_place_that_somebody_lies_in_is_left_to_it(mission, drive):
    """The first that comes is lost in the middle of the target; the second stands beside it."""
    second = ROVER | {"name": "second", "start": [11, 0]}
    spec = mission([ROVER, second], [{"at": [5, 0], "skills": ["A"], "service": 30}],
                   events=[{"at_s": 15, "lost": "rover"}])
    done = drive(spec, (0, (0,)), spare=(0, (1,)))
    assert done.record.success
    assert 0.3 < np.hypot(*(done.known.xy[1] - done.known.xy[0])) < 1.0


def test_the_same_mission_twice_is_the_same(mission, drive):
    spec = mission([ROVER, WALKER, HOPPER], [
        {"at": [6, 6], "skills": ["A", "B"], "type": "AND", "service": 3},
        {"at": [2, 9], "skills": ["C", "B"], "type": "OR"}])
    runs = [drive(spec, (0, (0, 1)), (1, (2,))) for _ in range(2)]
    assert runs[0].record.success
    assert np.array_equal(*[np.concatenate(one.record.qpos) for one in runs])


def test_an_empty_battery_breaks_off_a_service_for_good(mission, drive):
    battery = {"capacity_wh": 12 * 20 / 3600, "idle_w": 20}
    spec = mission([ROVER | {"battery": battery}, ROVER | {"name": "other", "start": [0, 8]}],
                   [{"at": [2, 0], "skills": ["A"], "service": 30}])
    done = drive(spec, (0, (0,)), spare=(0, (1,)))
    [loss] = done.record.losses
    assert (loss.robot, loss.cause) == (0, "battery")
    assert loss.time_s == pytest.approx(12, abs=2 * LOOK)
    assert done.record.success
    assert done.record.solves[0].robots == (1,)
    assert done.record.solves[0].time_s > 12 + 30
