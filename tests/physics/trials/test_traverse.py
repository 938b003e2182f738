"""Traverse evaluation: routes, verdicts, intervals, and one small run through the command."""

import json
import math

import numpy as np
import pytest

from moonteam import cli
from moonteam.errors import InputError
from moonteam.physics.trials import traverse
from moonteam.robots import KINDS
from moonteam.terrain.site import Boulder, Site

PERIOD = 0.04  # s a sample


def site(heights=None, boulders=()):
    heights = np.zeros((121, 121)) if heights is None else heights
    return Site("test", 0, np.asarray(heights, np.float32), 0.25, tuple(boulders))


def log(xy, tilt=0.0):
    """qpos [1, T, 7] of a robot at xy [T, 2] tilted about x."""
    qpos = np.zeros((1, len(xy), 7))
    qpos[0, :, :2] = xy
    qpos[0, :, 3], qpos[0, :, 4] = np.cos(tilt / 2), np.sin(tilt / 2)
    ones = np.ones((1, len(xy), 1))
    return qpos, 10.0 * ones, 0.001 * ones, np.array([False])


def judged(xy, tilt=0.0, diverged=False):
    route = traverse.Route((0.0, 0.0), (10.0, 0.0), 0.0)
    judge = traverse._Judge(KINDS.get("wheeled"), site(), [route])
    qpos, power, propellant, _ = log(np.asarray(xy, float), tilt)
    judge.add(qpos, power, propellant, np.zeros((*power.shape[:2], 0, 3)), np.array([diverged]))
    return judge.verdicts()[0]


def along(metres, seconds, side=0.0):
    x = np.linspace(0.0, metres, round(seconds / PERIOD))
    return np.stack([x, np.full_like(x, side)], axis=1)


def test_a_drive_is_measured():
    row = judged(along(10.0, 20.0, side=0.1))
    assert row.outcome == "arrived"
    assert row.seconds == pytest.approx(19.6, abs=0.2)
    assert row.speed_mps == pytest.approx(0.5, rel=0.02)
    assert row.cross_track_rms_m == pytest.approx(0.1)
    assert row.cross_track_p95_m == pytest.approx(0.1)
    assert row.energy_j_per_m == pytest.approx(20.0, rel=0.02)  # 10 W at 0.5 m/s
    assert row.propellant_g == pytest.approx(row.seconds, rel=0.02)
    assert row.rest_error_m == pytest.approx(0.1, abs=0.01)


@pytest.mark.parametrize(("outcome", "row"), [
    ("late", lambda: judged(along(5.0, 10.0))),
    ("stuck", lambda: judged(along(0.2, 25.0))),
    ("fallen", lambda: judged(along(5.0, 10.0), tilt=math.radians(70.0))),
    ("diverged", lambda: judged(along(5.0, 10.0), diverged=True)),
])
def test_failures_are_told_apart(outcome, row):
    assert row().outcome == outcome
    assert math.isnan(row().rest_error_m)


def test_routes_keep_off_walls_and_boulders():
    heights = np.zeros((121, 121))
    heights[:, 60:] = 3.0  # a wall along x = 0
    rock = Boulder(np.array([-8.0, 0.0, 0.0]), 2.0, np.zeros((0, 3)))
    place = site(heights, [rock])
    kind = KINDS.get("wheeled")
    routes, draws = traverse.draw_routes(kind, place, 10, 8.0, np.random.default_rng(0))
    assert draws > 10
    for route in routes:
        start, goal = np.array(route.start), np.array(route.goal)
        assert math.dist(start, goal) == pytest.approx(8.0)
        assert start[0] * goal[0] > 0.0
        points = start + np.linspace(0, 1, 50)[:, None] * (goal - start)
        clear = np.linalg.norm(points - rock.centre[:2], axis=1).min()
        assert clear > rock.radius + kind.footprint


def test_impossible_routes_are_refused(monkeypatch):
    monkeypatch.setattr(traverse, "BATCHES", 1)
    rng = np.random.default_rng(0)
    with pytest.raises(InputError, match="too small"):
        traverse.draw_routes(KINDS.get("drone"), site(), 1, 60.0, rng)
    steep = np.tile(np.arange(121) * 0.25 * np.tan(np.deg2rad(40.0)), (121, 1))
    with pytest.raises(InputError, match="only 0 of 1"):
        traverse.draw_routes(KINDS.get("drone"), site(steep), 1, 5.0, rng)


def test_command_prints_one_document_and_writes_files(capsys, tmp_path):
    words = ["evaluate", "traverse", "--kind", "drone", "--site", "flat", "--count", "3",
             "--sites", "1", "--length", "5", "--json", "--out", str(tmp_path)]
    assert cli.main(words) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["seeds"] == [0]
    summary, = report["summary"]
    assert summary["arrived"] == summary["count"] == len(report["rows"]) == 3
    assert summary["cross_track_rms_m"] < 0.15
    assert json.loads((tmp_path / "traverse.json").read_text()) == report
    assert len((tmp_path / "traverse.csv").read_text().splitlines()) == 4


def test_bad_options_give_one_line(capsys):
    assert cli.main(["evaluate", "traverse", "--video"]) == 2
    assert cli.main(["evaluate", "traverse", "--count", "0"]) == 2
    assert cli.main(["evaluate", "traverse", "--length", "nan"]) == 2
    assert cli.main(["evaluate", "traverse", "--site", "venus", "--count", "1"]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 4
    assert all(line.startswith("moonteam: ") for line in lines)
