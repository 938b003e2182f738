"""Missions in which not everything is known, on sliding points: who is shown what, and when."""

import msgspec
import numpy as np
import pytest

from moonteam.errors import InputError
from moonteam.planners.kind import PlannerOptions
from moonteam.planners.seconds import registry
from moonteam.problem import mission as missions
from sim2grid.clock.prepare import choosing
from sim2grid.clock.roads import OpenGround
from sim2grid.clock.unfold import LOOK, Scouting

DRONE = {"name": "d", "kind": "drone", "skills": ["A"], "start": [1, 1], "sensor_m": 4.0}
ROVER = {"name": "r", "kind": "wheeled", "skills": ["B"], "start": [2, 1], "sensor_m": 4.0}
HIDDEN = [{"on_sight": True, "target": {"at": [20, 18], "skills": ["A"]}},
          {"on_sight": True, "target": {"at": [3, 15], "skills": ["A", "B"], "type": "AND"}}]
SPEEDS = {"drone": 2.0, "legged": 0.4, "wheeled": 0.5}


class Spy:
    """A decider that notes what another is shown."""

    def __init__(self, decider):
        self.decider, self.views = decider, []

    def act(self, view):
        self.views.append(view)
        return self.decider.act(view)


def who(spec, name="exact", **options):
    planner = registry.find(name).make(PlannerOptions(time_limit=0.05))
    return choosing(planner, spec, **options)


@pytest.fixture
def hidden(mission):
    return mission([DRONE, ROVER], [], size=(24, 24), events=HIDDEN)


@pytest.mark.parametrize(("name", "search", "futures"), [
    ("exact", "nearest", 0), ("exact", "sweep", 0), ("lns", "places", 0), ("lns", "places", 4)])
def test_hidden_targets_are_found_and_served(drive, hidden, name, search, futures):
    done = drive(hidden, chooser=who(hidden, name, search=search, futures=futures))
    assert done.record.success
    assert [cause for _, cause in done.record.replans].count("found") == 2
    assert 0.2 < done.unfolding.ground.share <= 1.0


def test_nobody_is_shown_a_target_before_a_robot_is_near_it(drive, hidden):
    chooser = who(hidden, search="nearest")
    spy = Spy(chooser._decider)
    done = drive(hidden, chooser=Scouting("spy", spy))
    known = [len(view.targets) for view in spy.views]
    assert known[0] == 0
    assert spy.views[0].coming == 2
    assert known == sorted(known)
    assert known[-1] == 2
    frame = done.asked.frame
    for count in (1, 2):
        view = next(view for view in spy.views if len(view.targets) >= count)
        at = done.task.points[count - 1]
        assert np.hypot(*(view.places - at).T).min() <= 4.0
        before = [view for view in spy.views if len(view.targets) < count][-1]
        gone = max(SPEEDS.values()) * (view.now - before.now) / 1000
        assert np.hypot(*(before.places - at).T).min() > 4.0 - 1e-6 or gone > 0
    assert frame.cell_m == 1.0


def test_a_robot_without_eyes_finds_nothing(drive, mission):
    blind = {key: value for key, value in DRONE.items() if key != "sensor_m"}
    spec = mission([blind, ROVER], [{"at": [20, 18], "skills": ["A"]}], size=(24, 24),
                   events=[{"on_sight": True, "target": {"at": [20, 17], "skills": ["A"]}}],
                   max_seconds=30.0)  # the drone is there after some 13, the rover never
    done = drive(spec, chooser=who(spec))
    assert not done.record.success
    assert done.record.solves[0].target == 0
    assert "1 still to come" in done.record.detail


def test_targets_follow_on_those_that_are_solved(drive, mission):
    events = [{"at_solved": k, "target": {"at": [5 + k, 5], "skills": ["A"]}} for k in (1, 2)]
    spec = mission([DRONE], [{"at": [5, 5], "skills": ["A"]}], events=events)
    done = drive(spec, chooser=who(spec))
    assert done.record.success
    assert [solve.target for solve in done.record.solves] == [0, 1, 2]
    assert [cause for _, cause in done.record.replans] == ["new_target", "new_target"]


@pytest.mark.parametrize("name", ["exact", "policy"])
def test_when_all_is_done_everybody_goes_home(drive, mission, name):
    home = DRONE | {"home": [1, 1]}
    spec = mission([home], [{"at": [5, 5], "skills": ["A"]}], max_seconds=100.0,
                   events=[{"at_solved": 1, "target": {"at": [9, 9], "skills": ["A"]}}])
    planner = registry.find(name).make(PlannerOptions(policy="unfolding"))
    done = drive(spec, chooser=choosing(planner, spec))
    assert done.record.success, done.record.detail
    assert done.errands[0].at_home


def test_a_decision_over_futures_drives_too(drive, mission):
    spec = mission([DRONE, ROVER], [{"at": [5, 5], "skills": ["A"]}],
                   expects={"every": 10.0},
                   events=[{"at_s": 3.0, "target": {"at": [9, 9], "skills": ["B"]}}])
    assert drive(spec, chooser=who(spec, futures=2)).record.success


class Walled(OpenGround):
    """Open ground but for a square that nobody can be in."""

    def passable(self, kind, at):
        return bool(np.abs(np.asarray(at)).max() > 1.6)

    def matrix(self, kind, starts, to):
        closed = np.abs(to).max(-1) <= 1.6
        return np.where(closed[None], np.inf, super().matrix(kind, starts, to))


def test_a_place_that_is_closed_is_looked_at_from_beside_it(drive, mission):
    spec = mission([DRONE], [], size=(12, 12),
                   events=[{"on_sight": True, "target": {"at": [10, 10], "skills": ["A"]}}],
                   max_seconds=60.0)

    class ToTheMiddle:
        def act(self, view):
            return [0 if view.targets else (0.0, 0.0)]

    done = drive(spec, chooser=Scouting("middle", ToTheMiddle()), roads=Walled(SPEEDS))
    looked = [d for d in done.record.decisions if d.actions[0] == LOOK]
    assert looked
    ways = np.concatenate([qpos[:, :2] for qpos in done.record.qpos])
    assert np.hypot(*ways.T).min() < 3.5  # it came near


def test_the_same_mission_ends_the_same(drive, hidden):
    first, second = (drive(hidden, chooser=who(hidden, search="nearest")) for _ in range(2))
    assert first.book.time == second.book.time
    assert [d.actions.tolist() for d in first.record.decisions] == [
        d.actions.tolist() for d in second.record.decisions]


@pytest.mark.parametrize(("change", "key"), [
    ({"events": [{"on_sight": True, "lost": "d"}]}, "events[0].on_sight"),
    ({"events": [{"on_sight": True, "at_s": 3, "target": {"at": [1, 2], "skills": ["A"]}}]},
     "events[0]"),
    ({"events": [{"at_solved": 2, "target": {"at": [1, 2], "skills": ["A"]}}]},
     "events[0].at_solved"),
    ({"events": [{"at_solved": -1, "target": {"at": [1, 2], "skills": ["A"]}}]},
     "events[0].at_solved"),
    ({"robots": [DRONE | {"sensor_m": 0}]}, "robots[0].sensor_m"),
    ({"robots": [{k: v for k, v in DRONE.items() if k != "sensor_m"}],
      "events": [{"on_sight": True, "target": {"at": [1, 2], "skills": ["A"]}}]},
     "events[0].on_sight"),
    ({"expects": {"every": -1}}, "expects.every"),
    ({"clock": "steps"}, "robots[0].sensor_m"),
    ({"targets": []}, "targets"),
])
def test_a_mission_that_cannot_be_says_why(change, key):
    value = {"clock": "seconds", "map": {"size": [12, 12]}, "robots": [DRONE],
             "targets": [{"at": [5, 5], "skills": ["A"]}]} | change
    with pytest.raises(InputError) as error:
        missions.check(msgspec.convert(value, missions.Mission), "test.yaml")
    assert error.value.key == key


def test_options_that_mean_nothing_are_refused(mission):
    plain = mission([DRONE], [{"at": [5, 5], "skills": ["A"]}])
    with pytest.raises(InputError, match="--search"):
        who(plain, search="nearest")
    with pytest.raises(InputError, match="--futures"):
        who(plain, futures=8)
