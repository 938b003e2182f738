"""Problems by the clock: what scenario and mission files may say of time."""

import json

import msgspec
import pytest

from moonteam.errors import InputError
from moonteam.problem import mission as missions
from moonteam.problem import scenario, timed
from moonteam.problem.mission import cell_of

GOOD = {
    "clock": "seconds", "id": "two sites", "max_seconds": 100,
    "agents": [{"at": [0.5, 0], "skills": ["drill"], "speed": 0.5, "home": [0, 0]},
               {"at": [4, 0], "skills": ["drill", "eye"]}],
    "targets": [{"at": [1.5, 2], "coalition": {"drill": 2}, "service": 5, "lapses": 60},
                {"at": [3, 3], "skills": ["eye", "drill"], "type": "OR", "after": [0]},
                {"at": [0, 9], "skills": ["eye"], "appears": 30}]}


def changed(path, value):
    made = json.loads(json.dumps(GOOD))
    *way, last = path
    part = made
    for key in way:
        part = part[key]
    part[last] = value
    return made


def test_a_problem_is_read_and_survives_a_round_trip(tmp_path):
    file = tmp_path / "one.json"
    file.write_text(json.dumps(GOOD))
    found = timed.load(file)
    assert found.targets[0].needs() == {"drill": 2}
    assert found.targets[1].needs() == {"eye": 1, "drill": 1}
    assert found.skill_names == ("drill", "eye")
    assert timed.convert(msgspec.to_builtins(found), "again") == found


@pytest.mark.parametrize(("path", "value", "says"), [
    (("agents",), [], "agents: at least one agent"),
    (("targets",), [], "targets: at least one target"),
    (("agents", 0, "speed"), 0, "agents[0].speed: 0 is not allowed; above 0"),
    (("agents", 0, "home"), [0, 1e400], "agents[0].home"),
    (("targets", 0, "service"), -1, "targets[0].service: -1 is not allowed; seconds, at least 0"),
    (("targets", 0, "lapses"), -1, "targets[0].lapses: -1 is not allowed; at least `appears`, 0"),
    (("targets", 2, "lapses"), 20, "targets[2].lapses: 20 is not allowed; at least `appears`, 30"),
    (("targets", 0, "lapses"), 2, "targets[0].lapses: 2 s is over before it can be reached"),
    (("targets", 0, "worth"), -1, "targets[0].worth: -1 is not allowed; 0 to 1e+06"),
    (("targets", 2, "worth"), 2, "targets[2].worth: is of a target that may lapse; say after how"),
    (("targets", 0, "worth"), 2, "targets[1].after: it comes after a target that has a worth"),
    (("targets", 0, "coalition"), {"drill": 3}, "targets[0].coalition.drill: 3 agents with it are"),
    (("targets", 0, "coalition"), {"drill": 0}, "targets[0].coalition.drill: 0 is not allowed"),
    (("targets", 0, "coalition"), {"arm": 1}, "the team has 0"),
    (("targets", 0, "coalition"), {}, "targets[0].skills: at least one"),
    (("targets", 0, "skills"), ["eye"], "targets[0].coalition: give skills or coalition, not both"),
    (("targets", 0, "after"), [0], "targets[0].after: 0 is not allowed; another target's number"),
    (("targets", 0, "after"), [9], "targets[0].after: 9 is not allowed; another target's number"),
    (("targets", 0, "after"), [1], "targets[0].after: it would come before itself"),
    (("targets", 2, "skills"), ["arm"], "targets[2].skills: no agent has arm; the team has drill"),
    (("max_seconds",), 2, "targets[0].at: -3 s is over before it can be reached"),
    (("targets", 0, "servise"), 5, "servise"),
    (("clock",), "hours", "clock")])
def test_a_mistake_is_named(path, value, says):
    with pytest.raises(InputError) as caught:
        timed.convert(changed(path, value), "file.json")
    message = str(caught.value)
    assert says in message
    assert "\n" not in message


def test_a_scenario_in_steps_is_a_case():
    steps = scenario.Scenario((8, 8), (scenario.Agent((0, 0), ("A",)),),
                              (scenario.Target((3, 4), ("A", "B"), "OR"),), "one")
    by_clock = timed.of(steps)
    assert timed.distance(by_clock.agents[0].at, by_clock.targets[0].at, by_clock.metric) == 7
    assert timed.check(by_clock, "it") == by_clock


MISSION = """
name: service
clock: seconds
map: {size: [8, 8]}
robots:
  - {name: one, kind: drone, skills: [drill], start: [0.25, 0], home: [0, 0]}
  - {name: two, kind: wheeled, skills: [drill, eye], start: [7, 0], speed: 0.3}
targets:
  - {name: core, at: [3.5, 3], coalition: {drill: 2}, service: 8}
  - {name: look, at: [5, 5], skills: [eye], after: [core], appears: 10, lapses: 90}
"""


def read(tmp_path, text):
    file = tmp_path / "mission.yaml"
    file.write_text(text)
    return missions.load(file)


def test_a_mission_by_the_clock_is_read(tmp_path):
    found = read(tmp_path, MISSION)
    assert found.clock == "seconds"
    assert found.targets[0].cell == (4, 3)
    assert found.scenario().targets[1].at == (5, 5)
    assert [cell_of((x, 0))[0] for x in (-0.4, 0.4, 0.5, 1)] == [0, 0, 1, 1]


@pytest.mark.parametrize(("old", "new", "says"), [
    ("clock: seconds\n", "", "robots[0].home: is for missions by the clock"),
    ("clock: seconds", "clock: hours", "clock"),
    ("after: [core]", "after: [corn]", "after: 'corn' is not allowed; did you mean core"),
    ("after: [core]", "after: [look]", "targets[1].after: 'look' is not allowed"),
    ("service: 8", "service: 8, after: [look]", "targets[0].after: it would come before itself"),
    ("drill: 2", "drill: 3", "targets[0].coalition.drill: 3 robots with it are needed; the team"),
    ("lapses: 90", "lapses: 9", "targets[1].lapses: 9 is not allowed"),
    ("service: 8", "service: 8, lapses: 60, worth: 2", "targets[1].after: it comes after a target"),
    ("after: [core], appears: 10, lapses: 90", "worth: 2", "targets[1].worth: is of a target that"),
    ("speed: 0.3", "speed: 0", "robots[1].speed: 0 is not allowed"),
    ("home: [0, 0]", "home: [0, 9]", "robots[0].home: cell [0, 9] is off the map"),
    ("at: [3.5, 3]", "at: [7.6, 3]", "targets[0].at: cell [8, 3] is off the map"),
    ("clock: seconds", "clock: seconds\nmax_seconds: 0", "max_seconds: 0 is not allowed")])
def test_a_mistake_in_a_mission_is_named(tmp_path, old, new, says):
    assert old in MISSION
    with pytest.raises(InputError) as caught:
        read(tmp_path, MISSION.replace(old, new, 1))
    assert says in str(caught.value)


def test_steps_know_cells_only(tmp_path):
    text = MISSION.replace("clock: seconds\n", "").replace(", home: [0, 0]", "").replace(
        ", speed: 0.3", "").replace("coalition: {drill: 2}, service: 8", "skills: [drill]").replace(
        ", after: [core], appears: 10, lapses: 90", "")
    with pytest.raises(InputError, match=r"robots\[0\].start: \[0.25, 0\] is no cell"):
        read(tmp_path, text)


UNFOLDS = {
    "clock": "seconds", "max_seconds": 100,
    "agents": [{"at": [0, 0], "skills": ["eye"], "sensor": 3, "pace": [1.2, 1, 0.9]},
               {"at": [4, 0], "skills": ["eye", "drill"], "lost": 20}],
    "targets": [{"at": [1, 2], "skills": ["eye"]},
                {"at": [3, 3], "skills": ["drill"], "hidden": True},
                {"at": [0, 9], "skills": ["eye"], "following": 1}],
    "expects": {"more": 2, "area": [0, 0, 9, 9], "loss": {"share": 0.5, "until": 30}}}


def test_what_unfolds_is_read_and_survives_a_round_trip():
    found = timed.convert(UNFOLDS, "one")
    assert found.unfolds
    assert not timed.convert(GOOD, "good").unfolds
    assert timed.convert(msgspec.to_builtins(found), "again") == found


@pytest.mark.parametrize(("path", "value", "says"), [
    (("agents", 0, "sensor"), 0, "agents[0].sensor: 0 is not allowed; above 0"),
    (("agents", 0, "sensor"), None, "targets[1].hidden: no agent has a sensor"),
    (("agents", 1, "lost"), -1, "agents[1].lost: -1 is not allowed; seconds, at least 0"),
    (("agents", 0, "pace"), [1, 1], "agents[0].pace: has 2 numbers; one for each of the 3"),
    (("agents", 0, "pace"), [1, 0, 1], "agents[0].pace: 0 is not allowed; 0.01 to 100"),
    (("targets", 2, "following"), -1, "targets[2].following: -1 is not allowed"),
    (("targets", 2, "appears"), 5, "targets[2].following: 1 is not allowed; a number of targets"),
    (("targets", 2, "following"), 3, "targets: one follows on 3 others, and only 2 can be solved"),
    (("targets", 0, "after"), [1], "targets[0].after: it comes after a target that is hidden"),
    (("targets", 1, "at"), [10, 3], "targets[1].at: [10.0, 3.0] is hidden and outside"),
    (("expects", "area"), None, "targets[1].hidden: where to look is not said; give expects.area"),
    (("expects", "area"), [5, 0, 4, 9], "expects.area: [5.0, 0.0, 4.0, 9.0] is not allowed; west"),
    (("expects", "area"), [0, 0, 1e9, 9], "expects.area"),
    (("expects", "more"), -1, "expects.more: -1 is not allowed; 0 to"),
    (("expects", "every"), 0, "expects.every: 0 is not allowed; above 0"),
    (("expects", "worth"), [1, 5], "expects.worth: is of targets that arrive; say how often"),
    (("expects", "stays"), [5, 1], "expects.stays: [5.0, 1.0] is not allowed; the least and the"),
    (("expects", "scatter"), 3, "expects.scatter: 3 is not allowed; 0 to 2"),
    (("expects", "loss"), {"share": 2, "until": 30}, "expects.loss: 2 by 30 s is not allowed"),
    (("expects", "luck"), 1, "luck"),
])
def test_what_cannot_unfold_is_one_line_that_names_it(path, value, says):
    made = json.loads(json.dumps(UNFOLDS))
    *way, last = path
    part = made
    for key in way:
        part = part[key]
    part[last] = value
    with pytest.raises(InputError) as error:
        timed.convert(made, "one")
    assert says in str(error.value)
