"""Mission files: what is read, and one clear line for each thing that is wrong."""

import pytest

from moonteam.errors import InputError
from moonteam.problem import mission
from moonteam.problem.piece import Piece

GOOD = """
name: two
map: {size: [8, 6], cell_m: 1.5}
site: {preset: mare, seed: 4}
max_steps: 50
robots:
  - {name: flyer, kind: drone, skills: [A], start: [0, 5]}
  - {name: rover, kind: wheeled, skills: [B, camera], start: [7, 0]}
targets:
  - {name: ridge, at: [3, 3], skills: [A, B], type: AND}
  - {at: [1, 1], skills: [camera]}
events:
  - {at_decision: 4, lost: flyer}
"""


def write(tmp_path, text):
    path = tmp_path / "mission.yaml"
    path.write_text(text)
    return path


def test_a_mission_becomes_a_scenario(tmp_path):
    m = mission.load(write(tmp_path, GOOD))
    s = m.scenario()
    assert s.size == (8, 6)
    assert s.agents[1].at == (7, 0)
    assert s.agents[1].kind == "wheeled"
    assert s.targets[0].type == "AND"
    assert s.targets[1].type == "OR"
    # A and B keep their letters' bits; other names take what is left.
    assert s.skill_bits == {"A": 1, "B": 2, "camera": 4}
    assert m.target_name(0) == "ridge"
    assert m.target_name(1) == "T2"
    assert m.events[0].lost == "flyer"


BAD = {
    "unknown key": ("cell_m: 1.5", "cell: 1.5",
                    "map: unknown key `cell`; did you mean cell_m? allowed: size, "),
    "unknown key in a list": ("start: [0, 5]", "start: [0, 5], legs: 4",
                              "robots[0]: unknown key `legs`"),
    "wrong type": ("size: [8, 6]", "size: [8, six]", "map.size[1]: Expected `int`, got `str`"),
    "float cell": ("at: [3, 3]", "at: [3.5, 3]", "targets[0].at: [3.5, 3] is no cell"),
    "truth is no number": ("at: [3, 3]", "at: [true, 3]", "targets[0].at[0]: Expected `int"),
    "missing key": ("kind: drone, ", "", "robots[0]: missing required field `kind`"),
    "target off the map": ("at: [3, 3]", "at: [3, 6]",
                           "targets[0].at: cell [3, 6] is off the map; x in 0..7, y in 0..5"),
    "start off the map": ("start: [0, 5]", "start: [-1, 5]", "robots[0].start: cell [-1, 5]"),
    "skill nobody has": ("skills: [camera]", "skills: [drill]",
                         "targets[1].skills: no robot has skill drill; the team has A, B, camera"),
    "duplicate names": ("name: rover", "name: flyer", "robots[1].name: 'flyer' is already"),
    "duplicate target names": ("{at: [1, 1]", "{name: ridge, at: [1, 1]",
                               "targets[1].name: 'ridge' is already"),
    "duplicate target cells": ("at: [1, 1]", "at: [3, 3]", "targets[1].at: [3, 3] is already"),
    "key twice": ("max_steps: 50", "max_steps: 50\nmax_steps: 60",
                  "key 'max_steps' is given twice"),
    "no robots": (GOOD[GOOD.index("robots:"):GOOD.index("targets:")], "robots: []\n",
                  "robots: at least one"),
    "no steps": ("max_steps: 50", "max_steps: 0", "max_steps: 0 is not allowed; 1 to 100000"),
    "cell size": ("cell_m: 1.5", "cell_m: .nan", "'.nan' is no finite number (line"),
    "two sites": ("preset: mare", "preset: mare, dem: a.tif", "site: give one of preset and dem"),
    "piece of a preset": ("preset: mare", "preset: mare, detrend: true",
                          "site.detrend: is for an elevation model; give dem in place of preset"),
    "unknown units": ("preset: mare", "dem: a.tif, units: miles",
                      "site.units: unknown value 'miles'; allowed: degrees"),
    "no latitude": ("preset: mare", "dem: a.tif, units: degrees, centre: [120, 0]",
                    "site.centre: 120, 0 is not allowed; a latitude of -90 to 90 and a longitude"),
    "degrees from where": ("preset: mare", "dem: a.tif, units: degrees",
                           "site.centre: is needed where units are degrees"),
    "turned too far": ("preset: mare", "dem: a.tif, rotation: 700",
                       "site.rotation: 700 is not allowed; -360 to 360 degrees"),
    "no size": ("preset: mare", "dem: a.tif, size: [20, 0]",
                "site.size: 0 is not allowed; above 0 metres"),
    "three sizes": ("preset: mare", "dem: a.tif, size: [20, 0, 3]", "site.size: "),
    "no band": ("preset: mare", "dem: a.tif, band: -1", "site.band: -1 is not allowed; at least 0"),
    "event of nobody": ("lost: flyer", "lost: yutu", "events[0].lost: no robot is named 'yutu'"),
    "event's skill nobody has": ("lost: flyer", "target: {at: [2, 2], skills: [drill]}",
                                 "events[0].target.skills: no robot has skill drill"),
    "event off the map": ("lost: flyer", "target: {at: [8, 2], skills: [A]}",
                          "events[0].target.at: cell [8, 2] is off the map"),
    "event without a what": ("lost: flyer", "lost: null", "events[0]: give one of lost, target,"),
    "two events in one": ("lost: flyer", "lost: flyer, slow: {robot: rover, factor: 0.5}",
                          "events[0]: give one of lost, target,"),
    "slower than allowed": ("lost: flyer", "slow: {robot: rover, factor: 0.0}",
                            "events[0].slow.factor: 0.0 is not allowed; 0.1 to 1"),
    "slow robot of no name": ("lost: flyer", "slow: {robot: yutu, factor: 0.5}",
                              "events[0].slow.robot: no robot is named 'yutu'"),
    "silent for no decision": ("lost: flyer", "silent: {robot: rover, decisions: 0}",
                               "events[0].silent.decisions: 0 is not allowed; 1 to 100000"),
    "impassable off the map": ("lost: flyer", "impassable: {kind: wheeled, at: [9, 0]}",
                               "events[0].impassable.at: cell [9, 0] is off the map"),
    "path in a name": ("name: flyer", "name: ../x", "robots[0].name: '../x' is not allowed"),
    "not YAML": ("map: {", "map: [", "not YAML:"),
}


@pytest.mark.parametrize("case", BAD)
def test_each_mistake_gets_one_line(tmp_path, case):
    old, new, expected = BAD[case]
    assert old in GOOD
    path = write(tmp_path, GOOD.replace(old, new, 1))
    with pytest.raises(InputError) as caught:
        mission.load(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert expected in message
    assert "\n" not in message


@pytest.mark.parametrize(("text", "expected"), [
    ("", "is empty"), ("- 1\n- 2\n", "is not a mapping"), ("just words", "is not a mapping")])
def test_files_that_hold_no_mission(tmp_path, text, expected):
    with pytest.raises(InputError, match=expected):
        mission.load(write(tmp_path, text))


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        mission.load(tmp_path / "none.yaml")
    with pytest.raises(InputError, match="is a folder"):
        mission.load(tmp_path)


def test_an_elevation_model_is_looked_for_beside_the_mission(tmp_path):
    found = mission.load(write(tmp_path, GOOD.replace(
        "preset: mare", "dem: moon/a.tif, centre: [512, 300.5], units: pixels, detail: false")))
    assert found.site.dem == str(tmp_path / "moon" / "a.tif")
    assert found.site.piece == Piece(None, (512, 300.5), "pixels")
    assert not found.site.detail
    full = mission.load(write(tmp_path, GOOD.replace("preset: mare", "dem: /moon/a.tif")))
    assert full.site.dem == "/moon/a.tif"
