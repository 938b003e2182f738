"""Kinds that missions name: registered, in a file beside the mission, or nobody's."""

import re
from pathlib import Path

import pytest

from moonteam.errors import InputError
from moonteam.robots import KINDS, OWN, team
from moonteam.terrain.site import make_site

MISSION = """
map: {size: [8, 6]}
robots:
  - {name: flyer, kind: drone, skills: [A], start: [0, 5]}
  - {name: rover, kind: wheeled, skills: [B], start: [7, 0]}
targets: [{at: [3, 3], skills: [A]}]
events: [{at_decision: 4, impassable: {kind: legged, at: [1, 1]}}]
"""
ROVER = """
from dataclasses import replace
from moonteam.robots import KINDS
ROVER = replace(KINDS.get("wheeled"), name="my-rover", speed=0.3)
OTHER = replace(ROVER, speed=0.2)
NUMBER = 3
"""


@pytest.fixture
def write(tmp_path):
    def write(old="", new=""):
        assert old in MISSION
        (tmp_path / "rovers").mkdir()
        (tmp_path / "rovers" / "mine.py").write_text(ROVER)
        path = tmp_path / "mission.yaml"
        path.write_text(MISSION.replace(old, new))
        return path

    return write


def test_registered_kinds_are_found_by_name(write):
    mission, kinds = team.load(write())
    assert [robot.kind for robot in mission.robots] == ["drone", "wheeled"]
    assert kinds == {name: KINDS.get(name) for name in OWN}
    assert set(team.limits(kinds, make_site("flat", 0, 12.0))) == set(OWN)


def test_a_kind_in_a_file_beside_the_mission_goes_by_its_own_name(write, monkeypatch, tmp_path):
    path = write("kind: wheeled", "kind: rovers/mine.py:ROVER")
    monkeypatch.chdir("/")
    mission, kinds = team.load(path)
    assert mission.robots[1].kind == "my-rover"
    assert kinds["my-rover"].speed == 0.3
    assert "my-rover" not in KINDS.names(), "a file of one mission is nobody else's"


@pytest.mark.parametrize(("old", "new", "told"), [
    ("kind: drone", "kind: submarine",
     "robots[0].kind: submarine: no such robot kind; registered: drone, legged, wheeled"),
    ("kind: wheeled", "kind: weeled", "robots[1].kind: weeled: no such robot kind; did you mean "
     "wheeled? registered: drone, legged, wheeled; or FILE.py:OBJECT"),
    ("kind: legged", "kind: leged",
     "events[0].impassable.kind: leged: no such robot kind; did you mean legged?"),
    ("kind: wheeled", "kind: rovers/none.py:ROVER", "robots[1].kind: "),
    ("kind: wheeled", "kind: rovers/mine.py:ROWER", "holds no 'ROWER'; did you mean ROVER?"),
    ("kind: wheeled", "kind: rovers/mine.py:NUMBER",
     "is a int, not a RobotKind, which a robot kind must be"),
    ("kind: drone, skills: [A], start: [0, 5]}\n  - {name: rover, kind: wheeled",
     "kind: rovers/mine.py:OTHER, skills: [A], start: [0, 5]}\n"
     "  - {name: rover, kind: rovers/mine.py:ROVER", "another kind is called 'my-rover' here"),
])
def test_each_mistake_gets_one_line(write, old, new, told):
    path = write(old, new)
    with pytest.raises(InputError) as caught:
        team.load(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert told in message
    assert "\n" not in message


def test_no_line_outside_robots_names_a_kind():
    top = Path(__file__).parents[2]
    names = re.compile(r"\b(" + "|".join(OWN) + r")\b", re.IGNORECASE)
    said = [f"{file.relative_to(top)}:{number}: {line.strip()}"
            for package in ("src/moonteam", "training", "sim2grid")
            for file in sorted((top / package).rglob("*.py"))
            if not file.is_relative_to(top / "src/moonteam/robots")
            for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(), 1)
            if names.search(line)]
    assert not said
