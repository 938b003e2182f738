"""Missions whose robots cannot stand where they should start: one line, exit code 2."""

import numpy as np
import pytest

from moonteam.cli import main
from moonteam.problem.mission import Map, Mission, Robot, Target
from moonteam.problem.mission import Site as MissionSite
from moonteam.robots import KINDS
from moonteam.terrain.site import for_mission
from moonteam.terrain.traversability import boulder_distance, ground_under

SIDE = 16
TEXT = """
map: {{size: [{side}, {side}], cell_m: 1.0}}
site: {{preset: crater_rim, seed: 4}}
robots: [{{name: one, kind: {kind}, skills: [A], start: [{x}, {y}]}}]
targets: [{{at: [8, 8], skills: [A]}}]
"""


@pytest.fixture(scope="module")
def cells():
    """The cell nearest to a boulder's middle and the steepest one."""
    mission = Mission(Map((SIDE, SIDE), 1.0), (Robot("one", "wheeled", ("A",), (0, 0)),),
                      (Target((8, 8), ("A",)),), MissionSite(preset="crater_rim", seed=4))
    site = for_mission(mission)
    middle = np.arange(SIDE) - (SIDE - 1) / 2
    centres = np.stack(np.meshgrid(middle, middle), axis=-1)
    away, limits = boulder_distance(site, centres), KINDS.get("wheeled").limits
    slope, _ = ground_under(site, centres, limits.footprint)
    assert away.min() < limits.footprint
    assert slope.max() > limits.max_slope
    found = {"boulder": away.argmin(), "wall": slope.argmax()}
    return {name: divmod(int(at), SIDE)[::-1] for name, at in found.items()}


@pytest.mark.parametrize(("place", "kind", "words"), [
    ("boulder", "wheeled", "boulder"), ("boulder", "drone", "boulder"),
    ("wall", "legged", "slope"), ("outside", "drone", "off the map")])
def test_a_mission_cannot_start_there(cells, tmp_path, capsys, place, kind, words):
    x, y = cells.get(place, (SIDE, 3))
    file = tmp_path / "mission.yaml"
    file.write_text(TEXT.format(side=SIDE, kind=kind, x=x, y=y))
    out = tmp_path / "out"
    assert main(["rollout", str(file), "--no-video", "--out", str(out)]) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.count("\n") == 1
    assert words in told.err
    assert not out.exists()
