"""The example robot: in a mission's file, and installed as another package's."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from moonteam.cli import main

SCOUT = Path(__file__).parents[2] / "examples" / "scout"
DRIVEN = ["--planner", "exact", "--backend", "native", "--no-video", "--json"]


def test_a_mission_names_the_file(tmp_path, capsys):
    assert main(["rollout", str(SCOUT / "mission.yaml"), *DRIVEN, "--out", str(tmp_path)]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["success"]
    scout = report["robots"][0]
    assert scout["name"] == "scout"
    assert scout["distance_m"] > 3.0


def test_a_wrong_kind_says_where_and_what_there_is(tmp_path, capsys):
    path = tmp_path / "mission.yaml"
    text = (SCOUT / "mission.yaml").read_text()
    for wrong, said in (("wheled", "did you mean wheeled?"), ("none.py:SCOUT", "no such file")):
        path.write_text(text.replace('"scout.py:SCOUT"', wrong))
        for command in (["plan"], ["rollout", "--out", str(tmp_path / "run")]):
            assert main([command[0], str(path), *command[1:]]) == 2
            err = capsys.readouterr().err
            assert "mission.yaml: robots[0].kind" in err
            assert said in err
            assert not (tmp_path / "run").exists()


@pytest.fixture
def installed(tmp_path):
    """A folder as pip leaves it: the module, its model, and the entry point."""
    for name in ("scout.py", "scout.xml"):
        shutil.copy(SCOUT / name, tmp_path)
    info = tmp_path / "moonteam_scout-0.1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: moonteam-scout\nVersion: 0.1.0\n")
    (info / "entry_points.txt").write_text("[moonteam.robots]\nscout = scout:SCOUT\n")
    return tmp_path


def test_installed_it_goes_by_its_name(installed, tmp_path):
    mission = tmp_path / "by_name.yaml"
    text = (SCOUT / "mission.yaml").read_text()
    mission.write_text(text.replace('"scout.py:SCOUT"', "scout"))
    paths = [str(installed), *filter(None, [os.environ.get("PYTHONPATH")])]
    done = subprocess.run(
        [sys.executable, "-m", "moonteam.cli", "rollout", str(mission), *DRIVEN,
         "--out", str(tmp_path / "run")], capture_output=True, text=True, check=False,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)}, cwd=Path(__file__).parents[2])
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["success"]


def test_its_pyproject_offers_the_same_entry_point():
    text = (SCOUT / "pyproject.toml").read_text()
    assert '[project.entry-points."moonteam.robots"]\nscout = "scout:SCOUT"' in text
