"""What the film and the page tell of a record: states, speeds, and where new plans came from."""

import numpy as np
import pytest

from sim2grid.frame import Frame
from sim2grid.measure.story import Story

EVENTS = [
    {"at_decision": 1, "lost": "c"},
    {"at_decision": 1, "target": {"name": "late", "at": [0, 2], "skills": ["A"]}},
    {"at_decision": 2, "slow": {"robot": "a", "factor": 0.5}},
    {"at_decision": 2, "silent": {"robot": "b", "decisions": 1}},
    {"at_decision": 2, "impassable": {"kind": "wheeled", "at": [3, 3]}},
]


@pytest.fixture
def story(mission, execute, script):
    spec = mission(["a drone A 0 0", "b wheeled B 3 0", "c legged B 0 3"],
                   ["A OR 0 1", "B OR 2 0"], events=EVENTS)
    done = execute(spec, script("right stay stay", "left stay stay", "up stay stay",
                                "up left stay"))
    assert done.record.success
    return Story(spec, done.record, Frame((4, 4), 1.0), [0, 7, 14])


def test_every_cause_has_its_words_and_its_place(story):
    told = {replan.words: replan for replan in story.replans}
    assert set(told) == {"c lost", "new target late", "a slowed", "b silent", "b heard again",
                         "wheeled: no way over 3, 3"}
    np.testing.assert_allclose(told["c lost"].xy, [-1.5, 1.5])
    np.testing.assert_allclose(told["new target late"].xy, [-1.5, 0.5])
    np.testing.assert_allclose(told["wheeled: no way over 3, 3"].xy, [1.5, 1.5])
    first = story.record.decisions[1].time_s
    assert told["c lost"].time_s == first
    assert [r.time_s for r in story.replans] == sorted(r.time_s for r in story.replans)


def test_a_late_robot_is_marked_where_it_was_late(mission, execute, script):
    spec = mission(["a drone A 0 0", "b wheeled B 3 0"], ["A OR 2 0", "B OR 3 3"])
    done = execute(spec, script("right stay", "right stay"),
                   faults={(0, 1.0): "still", (0, 14.0): "go"})
    story = Story(spec, done.record, Frame((4, 4), 1.0), [0, 7])
    late = next(replan for replan in story.replans if replan.cause == "timeout")
    assert (late.robot, late.words) == (0, "a late")
    np.testing.assert_allclose(late.xy, [-1.0, -1.5], atol=0.05)
    assert story.state(0, late.time_s - 1.0)[0] == "moving"
    assert story.state(0, late.time_s - 1e-3)[0] in ("moving", "late")


def test_states_speeds_and_known_targets(story):
    assert story.state(2, 0.0)[0] == "waiting"
    assert story.state(2, story.record.seconds())[0] == "lost"
    assert story.state(0, 0.5)[0] == "moving"
    assert story.speed(0, 0.5) == pytest.approx(0.5, rel=0.05)
    assert story.speed(2, 0.5) == 0.0
    assert (story.targets_at(1), story.targets_at(2)) == (2, 3)
