"""Planes of a known slope, and what a rover does before one that is too steep."""

import json

import numpy as np
import pytest

from moonteam.cli import main
from moonteam.commands import evaluate_slopes
from moonteam.physics.trials import slopes
from moonteam.robots import KINDS


@pytest.mark.parametrize("across", [False, True])
def test_a_plane_has_its_slope_and_drives_begin_on_level_ground(across):
    site = slopes.incline(15.0, across, 0.0, 0)
    plane = np.array([[0.3, 0.2], [2.0, -1.0], [3.5, 1.3]], np.float32)
    assert np.allclose(np.degrees(site.surface.slope(plane)), 15.0, atol=0.1)
    for way in ("across",) if across else ("up", "down"):
        for route in slopes.routes(way, 3, np.random.default_rng(0)):
            start = np.array(route.start, np.float32)
            _, normal = site.surface.plane(start, 0.5)
            assert float(normal[2]) > np.cos(np.radians(1.0))
            assert np.hypot(*(start - route.goal)) == pytest.approx(13.0)


def test_roughness_is_laid_over_it():
    heights = slopes.incline(0.0, False, 0.04, 1).heights
    assert heights.std() == pytest.approx(0.04, rel=1e-3)
    assert not np.array_equal(heights, slopes.incline(0.0, False, 0.04, 2).heights)


def test_a_rover_is_reported_stuck_before_20_degrees():
    rows = slopes.measure(KINDS.get("wheeled"), 20.0, 0.0, 1, 0)
    assert [row["way"] for row in rows] == ["up", "down", "across"]
    assert all(row["stuck"] == row["count"] == 1 for row in rows)
    # The plane begins at 2.5 m; that to be crossed tilts by and by from 0.5 to 4.5 m.
    assert all(1.5 < row["farthest_m"] < 4.5 for row in rows)


def test_the_command_prints_one_document(monkeypatch, capsys):
    row = {"kind": "legged", "count": 2, "arrived": 0, "fallen": 1, "diverged": 0, "stuck": 1,
           "late": 0, "degrees": 12.0, "way": "up", "roughness_m": 0.0, "farthest_m": 3.0}
    monkeypatch.setattr(slopes, "measure", lambda *a, **k: [row])
    words = ["evaluate", "slopes", "--kind", "legged", "--degrees", "12", "--roughness", "0"]
    assert main([*words, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["rows"] == [row]
    assert report["meta"]["command"] == (
        "moonteam evaluate slopes --kind legged --degrees 12 --roughness 0")
    assert main(words) == 0
    assert main([*words, "--markdown"]) == 0
    text = capsys.readouterr().out
    assert text.count("0 of 2") == 2
    assert all(name in text for name in evaluate_slopes.COLUMNS)


def test_bad_options_get_one_line(capsys):
    for words in (["--degrees", "60"], ["--roughness", "-1"], ["--count", "0"], ["--seed", "-1"]):
        assert main(["evaluate", "slopes", *words]) == 2
        assert capsys.readouterr().err.count("\n") == 1
