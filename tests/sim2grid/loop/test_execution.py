"""The executor's logic on sliding points: arrival, time-out, wrong cell, losses, events."""

import numpy as np
import pytest

from sim2grid.frame import Frame
from sim2grid.waypoints import waypoints


def test_two_moves_solve_a_target_and_everything_is_logged(mission, execute, script):
    spec = mission(["a wheeled A 0 0"], ["A OR 2 0"])
    planner = script("right", "right")
    done = execute(spec, planner)
    record = done.record
    assert record.success
    assert record.failure is None
    assert len(record.decisions) == 2
    solve = record.solves[0]
    assert (solve.decision, solve.robots) == (2, (0,))
    assert solve.distance_m[0] <= 0.25
    assert [leg.ended for leg in record.legs] == ["arrived", "arrived"]
    assert [leg.end_cell for leg in record.legs] == [(1, 0), (2, 0)]
    assert [s.cells.tolist() for s in planner.seen] == [[[0, 0]], [[1, 0]]]
    assert not record.replans


def test_a_requirement_that_holds_at_the_start_is_solved_at_decision_zero(mission, execute, script):
    done = execute(mission(["a legged A 1 1"], ["A OR 1 1"]), script())
    assert done.record.success
    assert (done.record.solves[0].decision, done.record.solves[0].time_s) == (0, 0.0)
    assert done.record.decisions == []


def test_barrier_waits_for_the_slowest(mission, execute, script):
    spec = mission(["a drone A 0 0", "b wheeled B 0 2"], ["A OR 1 0", "B OR 2 2"])
    done = execute(spec, script("right right", "stay right"), faults={(1, 0.0): "leisurely"})
    fast = [leg for leg in done.record.legs if leg.robot == 0]
    assert fast[0].end_s < fast[1].start_s - 2
    assert len({leg.start_s for leg in done.record.legs}) == len(done.record.decisions)


def test_and_target_needs_both_in_the_cell_at_the_same_decision(mission, execute, script):
    spec = mission(["a drone A 0 0", "b wheeled B 2 0"], ["AB AND 1 0"])
    alone = execute(spec, script("right stay", "left left", "right stay"))
    assert alone.record.solves[0].decision == 3
    assert alone.record.solves[0].robots == (0, 1)


def test_time_out_with_progress_is_replanned_from_the_true_cell(mission, execute, script):
    spec = mission(["a wheeled A 0 0"], ["A OR 1 0"])
    planner = script("right", "right", "right", "right", "right", "right", "right", "right")
    done = execute(spec, planner, faults={(0, 1.2): "slow"})
    first = done.record.legs[0]
    assert first.ended == "timeout"
    assert first.end_cell == (1, 0)
    assert done.record.success, "it is in the target's cell, if not at its centre"
    assert 0.25 < done.record.solves[0].distance_m[0] <= 0.5
    assert done.record.replans == [(1, "timeout")]


def test_stuck_after_three_time_outs_without_progress(mission, execute, script):
    spec = mission(["a wheeled A 1 0", "b legged A 3 3"], ["A OR 3 0"])
    steps = ["right stay", "up stay", "left stay", *["stay down"] * 3]
    done = execute(spec, script(*steps), faults={(0, 0.0): "still"})
    assert [(x.robot, x.cause) for x in done.record.losses] == [(0, "stuck")]
    assert done.record.success
    assert done.record.solves[0].robots == (1,)
    assert (1, "timeout") in done.record.replans
    assert (2, "timeout") in done.record.replans
    assert (3, "robot_lost") in done.record.replans


@pytest.mark.parametrize(("fault", "cause"), [
    ("tilt", "fallen"), ("nan", "not_a_number"), (("drift", -1.0, 0.0), "off_the_map")])
def test_lost_robots_leave_the_team_and_unsolvable_ends_at_once(
        mission, execute, script, fault, cause):
    spec = mission(["a wheeled A 0 0", "b legged B 3 3"], ["A OR 3 0"])
    done = execute(spec, script(*["right stay"] * 9), faults={(0, 1.0): fault})
    record = done.record
    assert [(x.robot, x.cause) for x in record.losses] == [(0, cause)]
    assert not record.success
    assert record.failure == "unsolvable"
    assert "T1" in record.detail
    assert f"a ({cause})" in record.detail
    waited = {"fallen": 2.0, "not_a_number": 0.0, "off_the_map": 1.0}[cause]
    assert 1.0 + waited <= record.losses[0].time_s <= 1.6 + waited
    assert record.seconds() == record.losses[0].time_s


def test_a_lost_robot_gets_no_more_commands(mission, execute, script):
    spec = mission(["a wheeled A 0 0", "b legged A 2 3"], ["A OR 3 3"])
    planner = script("right stay", "right right")
    done = execute(spec, planner, faults={(0, 0.5): "tilt"})
    assert done.record.success
    assert done.commands()[0][2] is True
    assert planner.seen[-1].agent_mask.tolist() == [False, True]
    assert [leg.robot for leg in done.record.legs if leg.decision == 1] == [1]


def test_a_robot_pushed_out_of_its_cell_counts_as_wrong_cell(mission, execute, script):
    spec = mission(["a drone A 0 0", "b wheeled B 0 3"], ["B OR 2 3", "A OR 2 1"], max_steps=4)
    done = execute(spec, script("stay right", "stay right"),
                   faults={(0, 0.0): ("drift", 0.0, 0.3)})
    assert (1, "wrong_cell") in done.record.replans
    assert done.record.legs[0].end_cell == (0, 1)


def test_border_and_barred_cells_mask_the_move(mission, execute, script):
    spec = mission(["a wheeled A 0 0", "b drone B 0 0"], ["A OR 0 2", "B OR 2 0"], max_steps=3)
    barred = np.ones((4, 4), bool)
    barred[0, 1] = False
    done = execute(spec, script("right right", "left right"), passable={"wheeled": barred})
    goals = [(leg.robot, leg.goal_cell, leg.action) for leg in done.record.legs[:4]]
    assert goals == [(0, (0, 0), 3), (1, (1, 0), 3), (0, (0, 0), 2), (1, (2, 0), 3)]
    assert done.record.failure == "max_steps"
    assert "T1" in done.record.detail
    assert len(done.record.decisions) == 3


def test_walled_in_is_unsolvable_before_the_first_move(mission, execute, script):
    spec = mission(["a wheeled A 0 0"], ["A OR 3 3"])
    barred = np.ones((4, 4), bool)
    barred[:, 2] = False
    done = execute(spec, script("right"), passable={"wheeled": barred})
    assert done.record.failure == "unsolvable"
    assert done.record.decisions == []


def test_events_a_robot_is_lost_and_a_target_appears(mission, execute, script):
    spec = mission(
        ["a drone A 0 0", "b wheeled A 0 2"], ["A OR 3 2"],
        events=[{"at_decision": 1, "lost": "a"},
                {"at_decision": 5, "target": {"at": [3, 3], "skills": ["A"], "name": "late"}}])
    planner = script("stay right", "right right", "stay right", "stay up")
    done = execute(spec, planner)
    record = done.record
    assert record.success
    assert [(x.cause, x.decision) for x in record.losses] == [("event", 1)]
    assert record.target_names == ["T1", "late"]
    assert record.replans == [(1, "robot_lost"), (5, "new_target")]
    assert [s.decision for s in record.solves] == [3, 6]
    assert len(planner.seen) == 4, "the planner is not asked while nothing is open"


def test_an_engine_that_cannot_go_on_ends_the_mission(mission, execute, script):
    spec = mission(["a wheeled A 0 0"], ["A OR 3 3"])
    done = execute(spec, script("right"), faults={(0, 1.0): "diverge"})
    assert done.record.failure == "engine"


def test_async_lets_the_fast_robot_go_on(mission, execute, script):
    spec = mission(["a drone A 0 0", "b wheeled B 0 3"], ["A OR 3 0", "B OR 2 3"])
    steps = ["right right"] * 6
    done = {mode: execute(spec, script(*steps), faults={(1, 0.0): "leisurely"}, mode=mode)
            for mode in ("barrier", "async")}
    first = {mode: d.record.solves[0] for mode, d in done.items()}
    assert first["async"].target == 0
    assert first["async"].time_s < 8
    assert first["async"].time_s < 0.7 * first["barrier"].time_s
    fast, slow = ([leg for leg in done["async"].record.legs if leg.robot == i] for i in (0, 1))
    assert fast[1].start_s < slow[0].end_s, "its action stands while the other decides"


def test_robots_that_share_a_cell_get_their_own_places_flyers_the_centre():
    frame = Frame((4, 4), 2.0)
    points = waypoints(frame, np.array([(1, 1), (1, 1), (1, 1), (0, 0)]),
                       np.array([True, False, True, True]))
    np.testing.assert_allclose(points[1:4:2], [[-1, -1], [-3, -3]])
    assert np.hypot(*(points[0] - points[2])) > 1.2, "room for two bodies"
    assert frame.inside(points[[0, 2]], np.array([[1, 1], [1, 1]])).all()
