"""Events and learned ground on sliding points: what the planner hears of them, and what follows."""

import msgspec
import numpy as np
import pytest

from moonteam.errors import InputError
from moonteam.planners.exact import ExactPlanner
from sim2grid.loop.asked import Route


def test_a_slowed_robot_gets_the_time_it_needs(mission, execute, script):
    targets = ["A OR 3 0"]
    slow = [{"at_decision": 1, "slow": {"robot": "a", "factor": 0.2}}]
    spec = mission(["a wheeled A 0 0"], targets, events=slow)
    done = execute(spec, script("right", "right", "right"))
    legs = done.record.legs
    assert done.record.success
    assert [leg.ended for leg in legs] == ["arrived"] * 3
    spent = [leg.end_s - leg.start_s for leg in legs]
    assert spent[1] > 3 * spent[0]
    assert done.record.replans == [(1, "slowed")]
    assert done.commands()[0][1] <= 0.2 * 0.5 + 1e-9


def test_a_silent_robot_gets_no_orders_and_is_believed_where_it_was_sent(
        mission, execute, script):
    silent = [{"at_decision": 1, "silent": {"robot": "a", "decisions": 2}}]
    spec = mission(["a wheeled A 0 0", "b legged B 0 3"], ["A OR 2 0", "B OR 3 3"], events=silent,
                   max_steps=4)
    planner = script(*["right right"] * 4)
    done = execute(spec, planner, faults={(0, 0.0): "still"})
    assert [leg.decision for leg in done.record.legs if leg.robot == 0][:2] == [0, 3]
    assert [leg.decision for leg in done.record.legs if leg.robot == 1] == [0, 1, 2, 3]
    seen = [tuple(s.cells[0].tolist()) for s in planner.seen]
    assert seen[:4] == [(0, 0), (1, 0), (1, 0), (0, 0)], "it never moved, and nobody knew"
    causes = dict.fromkeys(cause for _, cause in done.record.replans)
    assert {"silent", "heard_again", "timeout"} <= set(causes)


def test_what_a_silent_robot_does_counts(mission, execute, script):
    silent = [{"at_decision": 1, "silent": {"robot": "a", "decisions": 9}}]
    spec = mission(["a wheeled A 0 0", "b legged B 0 3"], ["A OR 1 0", "B OR 3 3"], events=silent)
    done = execute(spec, script(*["right right"] * 4))
    assert done.record.success
    assert [s.decision for s in done.record.solves] == [1, 3]


@pytest.mark.parametrize("mode", ["barrier", "async"])
def test_a_team_that_waits_for_a_silent_robot_goes_on(mission, execute, mode):
    silent = [{"at_decision": 1, "silent": {"robot": "a", "decisions": 4}}]
    spec = mission(["a wheeled A 0 0", "b legged B 0 3"], ["A OR 2 0", "B OR 1 3"], events=silent)
    done = execute(spec, ExactPlanner(), mode=mode)
    assert done.record.success
    assert done.record.seconds() < 30


def test_ground_where_a_robot_timed_out_is_closed_to_its_kind(mission, execute):
    """Cell (1, 0) holds the rover back; it goes round by the row above."""
    spec = mission(["a wheeled A 0 0"], ["A OR 2 0"], size=(3, 2))
    done = execute(spec, ExactPlanner(), traps=[((0.0, -0.5), 0.55)])
    record = done.record
    assert record.success
    assert record.replans[:2] == [(1, "timeout"), (1, "impassable")]
    assert not done.snapshot.passable[0, 0, 1]
    assert (1, 0) not in [leg.goal_cell for leg in record.legs[1:]]


def test_ground_that_is_the_only_way_is_not_closed(mission, execute, script):
    spec = mission(["a wheeled A 0 0"], ["A OR 2 0"], size=(3, 1), max_steps=9)
    done = execute(spec, script(*["right"] * 9), faults={(0, 0.0): "slow"})
    assert (1, "timeout") in done.record.replans
    assert "impassable" not in [cause for _, cause in done.record.replans]
    assert done.record.failure != "unsolvable" or done.record.losses


def test_learned_ground_is_forgotten_when_it_would_end_the_mission(mission, execute, script):
    """Closed while another could still solve the target; that one is lost, so it is tried again."""
    events = [{"at_decision": 1, "impassable": {"kind": "wheeled", "at": [1, 0]}},
              {"at_decision": 3, "lost": "b"}]
    spec = mission(["a wheeled A 0 0", "b drone A 3 0"], ["A OR 2 0"], size=(4, 1),
                   events=events, max_steps=12)
    done = execute(spec, script("stay stay", "right stay", "stay stay", "right stay",
                                "right stay"))
    assert (1, "impassable") in done.record.replans
    assert done.record.legs[2].goal_cell == (0, 0), "thrown back by what is known"
    assert done.record.success
    assert done.record.solves[0].robots == (0,)


def test_a_neighbour_in_the_way_says_nothing_of_the_ground(mission, execute, script):
    spec = mission(["a wheeled A 0 0", "b legged B 1 0"], ["A OR 3 0", "B OR 3 3"], max_steps=3)
    done = execute(spec, script(*["right stay"] * 3), faults={(0, 0.0): "slow"})
    assert (1, "timeout") in done.record.replans
    assert "impassable" not in [cause for _, cause in done.record.replans]


def test_impassable_ground_makes_a_following_planner_plan_again(mission, execute):
    events = [{"at_decision": 1, "impassable": {"kind": "wheeled", "at": [2, 0]}}]
    spec = mission(["a wheeled A 0 0"], ["A OR 3 0"], size=(4, 2), events=events)
    done = execute(spec, ExactPlanner())
    assert done.record.success
    assert (2, 0) not in [leg.end_cell for leg in done.record.legs]


def test_open_loop_walks_the_plan_whatever_happens(mission, execute, script):
    spec = mission(["a wheeled A 0 0", "b legged B 0 2"], ["A OR 2 0", "B OR 2 2"])
    right = [[[k, 0], [k, 2]] for k in range(3)]
    route = Route(np.array(right, np.int32), np.full((2, 2), 3, np.int32))
    planner = script()
    done = execute(spec, planner, route=route)
    assert done.record.success
    assert planner.seen == [], "nobody is asked"
    late = execute(spec, planner, route=route, faults={(0, 1.0): "still"})
    assert late.record.failure == "plan_over"
    assert "T1" in late.record.detail
    assert late.record.replans == []
    ways = [leg.goal_cell for leg in late.record.legs if leg.robot == 0]
    assert ways == [(1, 0), (2, 0)], "the plan's next cell, wherever it is"


def test_open_loop_never_hears_of_new_targets(mission, execute, script):
    events = [{"at_decision": 1, "target": {"at": [3, 3], "skills": ["A"]}}]
    spec = mission(["a wheeled A 0 0"], ["A OR 1 0"], events=events)
    route = Route(np.array([[[0, 0]], [[1, 0]]], np.int32), np.array([[3]], np.int32))
    done = execute(spec, script(), route=route)
    assert done.record.failure == "plan_over"


def test_more_targets_than_a_planner_takes_are_refused_before_the_start(mission, execute):
    spec = mission(["a drone A 0 0"], ["A OR 3 3"], size=(8, 8), events=[
        {"at_decision": 1 + k, "target": {"at": [k % 8, 1 + k // 8], "skills": ["A"],
                                          "name": f"N{k}"}} for k in range(12)])
    with pytest.raises(InputError, match="13 targets"):
        execute(spec, ExactPlanner())


def test_the_clock_of_async_is_the_teams(mission, execute, script):
    spec = mission(["a drone A 0 0", "b wheeled B 0 3"], ["A OR 3 0", "B OR 2 3"])
    planner = script(*["right right"] * 6)
    done = execute(spec, planner, mode="async", faults={(1, 0.0): "leisurely"})
    assert [s.max_steps for s in planner.seen] == [128] * len(planner.seen)
    assert [s.step for s in planner.seen] == [k // 2 for k in range(len(planner.seen))]
    assert done.asked.limit == 256


def test_two_that_would_change_places_pass_each_other_in_one_cell(mission, execute):
    spec = mission(["a legged A 1 0", "b wheeled B 2 0"], ["A OR 3 0", "B OR 0 0"], size=(4, 1))
    done = execute(spec, ExactPlanner())
    legs = [(leg.robot, leg.from_cell, leg.goal_cell) for leg in done.record.legs]
    assert legs[:4] == [(0, (1, 0), (2, 0)), (1, (2, 0), (2, 0)),
                        (0, (2, 0), (3, 0)), (1, (2, 0), (1, 0))]
    assert done.record.success
    first, second = (leg.waypoint for leg in done.record.legs[:2])
    assert np.abs(first - second).tolist() == pytest.approx([0.0, 0.6])


def test_who_stays_behind_keeps_its_side(mission, execute, script):
    spec = mission(["a legged A 1 0", "b wheeled B 2 0"], ["A OR 3 0", "B OR 0 3"], max_steps=3)
    done = execute(spec, script("right stay", "right stay", "stay stay"))
    first, last = (leg.waypoint for leg in done.record.legs if leg.robot == 1 and
                   leg.decision in (0, 2))
    np.testing.assert_allclose(last, first)
    assert np.abs(first - done.asked.frame.centre(np.array([2.0, 0.0]))).max() == pytest.approx(0.3)


def test_a_lost_robot_is_not_waited_for(mission, execute, script):
    spec = mission(["a wheeled A 1 0", "b legged A 2 0"], ["A OR 3 0"], size=(4, 1), max_steps=2,
                   events=[{"at_decision": 1, "lost": "a"}])
    done = execute(spec, script("right stay", "stay left"), faults={(0, 0.0): "slow"})
    assert (1, (1, 0)) in [(leg.robot, leg.goal_cell) for leg in done.record.legs]


def test_events_survive_the_way_to_json_and_back(mission):
    spec = mission(["a drone A 0 0"], ["A OR 3 3"], events=[
        {"at_decision": 2, "silent": {"robot": "a", "decisions": 3}},
        {"at_decision": 3, "impassable": {"kind": "drone", "at": [1, 1]}}])
    again = msgspec.json.decode(msgspec.json.encode(spec), type=type(spec))
    assert again == spec
