"""Which seconds of a mission a film shows, how fast, and that nothing is left out."""

import itertools
from types import SimpleNamespace

import pytest

from sim2grid.loop.record import Loss, Solve
from sim2grid.measure.story import Replan
from sim2grid.show.cut import Shot, cut, events


def story(ends, solves=(), losses=(), replans=(), robots=3, success=True):
    record = SimpleNamespace(
        seconds=lambda: ends, success=success, losses=list(losses),
        solves=[Solve(k, 0, t, (0,), (0.0,)) for k, t in enumerate(solves)],
        target_names=[f"T{k}" for k in range(9)])
    mission = SimpleNamespace(robots=[SimpleNamespace(name=f"r{i}") for i in range(robots)])
    return SimpleNamespace(record=record, mission=mission, replans=list(replans))


LONG = story(120.0, [20.0, 60.0, 90.0, 120.0])


def test_a_long_mission_fills_the_film_and_close_pictures_run_at_true_speed():
    shots = cut(LONG, 24.0, 30.0)
    assert sum(shot.frames for shot in shots) == 24 * 30
    assert [shots[0].kind, shots[-1].kind] == ["title", "end"]
    for shot in shots[1:-1]:
        if shot.kind == "wide":
            assert shot.speed(30.0) > 5
        else:
            assert shot.speed(30.0) == pytest.approx(1.0, abs=0.03)
    assert sum(shot.frames for shot in shots if shot.kind in ("chase", "close")) > 240


def test_no_second_is_left_out_or_shown_twice():
    shots = cut(LONG, 24.0, 30.0)
    for before, after in itertools.pairwise(shots[1:-1]):
        assert after.start_s == pytest.approx(before.end_s)
    assert shots[1].start_s == 0.0
    assert shots[-2].end_s >= 120.0


def test_the_last_target_and_a_lost_robot_come_first():
    lost = story(120.0, [20.0, 60.0, 90.0, 120.0], [Loss(1, "fallen", 3, 40.0)])
    shown = [(s.robot, s.target) for s in cut(lost, 14.0, 30.0) if s.kind == "close"]
    assert (None, 3) in shown
    assert shown == [(1, None), (None, 3)] or shown == [(None, 3)]
    longer = {s.robot: s for s in cut(lost, 24.0, 30.0) if s.kind == "close"}
    assert longer[1].happens_s == pytest.approx(40.0)


def test_a_short_mission_is_shown_at_true_speed_and_no_longer_than_it_is():
    shots = cut(story(6.0, [4.0, 6.0]), 24.0, 30.0)
    assert all(shot.speed(30.0) <= 1.05 for shot in shots)
    assert sum(shot.frames for shot in shots) / 30 < 2 + 6.0 + 0.9 + 2.7


def test_speed_says_how_long_the_film_is():
    fast = cut(LONG, 24.0, 30.0, speed=40.0)
    slow = cut(LONG, 24.0, 30.0, speed=4.0)
    assert sum(s.frames for s in fast) < 24 * 30 < sum(s.frames for s in slow)
    wide = [s for s in slow if s.kind == "wide"]
    assert all(s.speed(30.0) == pytest.approx(4.0, rel=0.05) for s in wide)


@pytest.mark.parametrize(("camera", "kind", "robot"), [
    ("wide", "wide", None), ("chase", "chase", 0), ("r2", "chase", 2)])
def test_one_camera_all_the_time(camera, kind, robot):
    title, only, end = cut(LONG, 24.0, 30.0, camera=camera)
    assert (only.kind, only.robot) == (kind, robot)
    assert (only.start_s, only.end_s) == (0.0, 120.0)
    assert title.frames + only.frames + end.frames == 720


def test_what_goes_wrong_is_an_event():
    late = Replan(30.0, 4, "timeout", 2, None, "r2 late")
    new = Replan(31.0, 4, "new_target", None, None, "new target T4")
    found = {e.words: e for e in events(story(60.0, [50.0], replans=[late, new]))}
    assert found["r2 late"].robot == 2
    assert found["new target T4"].target == 4
    assert set(found) == {"r2 late", "new target T4", "T0 solved"}


def test_events_at_the_same_second_do_not_matter():
    assert cut(story(60.0, [50.0, 50.0, 50.0]), 24.0, 30.0)


def test_an_interrupted_mission_has_a_film_too():
    assert cut(story(0.0, success=False), 24.0, 30.0)
    assert Shot("wide", 10, 0.0, 5.0).time(5) == 2.5
