"""`moonteam rollout`: bad missions are refused before anything is written; a real one runs."""

import json

import numpy as np
import pytest

from moonteam.cli import main
from moonteam.physics import backends, stage
from moonteam.physics.backends import NativeBackend
from moonteam.physics.render import RenderingUnavailable
from sim2grid.loop import prepare

GOOD = """
map: {size: [3, 3], cell_m: 1.0}
site: {preset: flat}
robots:
  - {name: hop, kind: drone, skills: [A], start: [0, 0]}
  - {name: roll, kind: wheeled, skills: [B], start: [1, 0]}
targets:
  - {name: both, at: [1, 1], skills: [A, B], type: AND}
"""


def rollout(mission, out, *options):
    return main(["rollout", str(mission), "--out", str(out), "--planner", "exact",
                 "--backend", "native", *(options or ("--no-video",))])


@pytest.mark.parametrize(("old", "new", "named"), [
    ("robots:", "robbots:", "robbots"),
    ("cell_m: 1.0", "cell_m: wide", "map.cell_m"),
    ("at: [1, 1]", "at: [1, 3]", "targets[0].at"),
    ("start: [1, 0]", "start: [-1, 0]", "robots[1].start"),
    ("kind: drone", "kind: submarine", "robots[0].kind"),
    ("skills: [A, B], type", "skills: [A, C], type", "targets[0].skills"),
    ("name: roll", "name: hop", "robots[1].name"),
    ("preset: flat", "preset: cheese", "cheese"),
    ("preset: flat", "seed: 3", "site"),
    ("robots:", "robots: [", "YAML"),
    (GOOD, "", "empty"),
    (GOOD, "- 1\n- 2\n", "mapping"),
], ids=lambda value: str(value)[:18].strip())
def test_bad_missions_one_line_code_two_nothing_written(tmp_path, capsys, old, new, named):
    file, out = tmp_path / "bad.yaml", tmp_path / "out"
    assert old in GOOD
    file.write_text(GOOD.replace(old, new))
    assert rollout(file, out) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1, captured.err
    assert named in captured.err
    assert not out.exists()
    assert [p.name for p in tmp_path.iterdir()] == ["bad.yaml"]


@pytest.mark.parametrize(("options", "named"), [
    (["--seed", "-1"], "--seed"),
    (["--decode", "best-of-many"], "--decode"),
    (["--planner", "policy", "--policy", "nobody"], "nobody"),
    (["--planner", "policy", "--policy", "small"], "made for 3 robots"),
    (["--mission", "3"], "give --from REPORT too"),
    (["--contender", "x"], "give --from REPORT too"),
    (["--size", "641", "360"], "both even"),
    (["--row", "3", "3"], "a row from 0"),
    (["--fps", "0"], "--fps"),
    (["--speed", "-2"], "--speed"),
    (["--camera", "nobody"], "auto, wide, chase, hop, roll"),
    (["--from", "report.json"], "not both"),
])
def test_bad_options_one_line_code_two_nothing_written(tmp_path, capsys, options, named):
    file, out = tmp_path / "good.yaml", tmp_path / "out"
    file.write_text(GOOD)
    assert rollout(file, out, *options) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert named in captured.err
    assert not out.exists()


def test_a_missing_mission_names_the_bundled_ones(tmp_path, capsys):
    assert rollout("nowhere", tmp_path / "out") == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert "demo" in message
    assert "outpost" in message
    assert rollout(tmp_path / "nowhere.yaml", tmp_path / "out") == 2
    assert "no such file" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_out_that_is_a_file_is_refused(tmp_path, capsys):
    file = tmp_path / "good.yaml"
    file.write_text(GOOD)
    assert rollout(file, file) == 2
    assert "is a file" in capsys.readouterr().err
    assert file.read_text() == GOOD


@pytest.mark.parametrize(("kind", "cell", "named"), [
    ("wheeled", (1, 0), "robots[1].start"), ("drone", (1, 1), "targets[0].at")])
def test_ground_that_bars_a_start_or_a_target_is_refused(
        tmp_path, capsys, monkeypatch, kind, cell, named):
    def barred(site, mission, kinds):
        maps = {k: np.ones((3, 3), bool) for k in kinds}
        maps[kind][cell[1], cell[0]] = False
        return maps

    monkeypatch.setattr(prepare, "passable_cells", barred)
    file, out = tmp_path / "steep.yaml", tmp_path / "out"
    file.write_text(GOOD)
    assert rollout(file, out) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert named in message
    assert not out.exists()


def test_real_robots_solve_a_tiny_mission_and_the_same_seed_gives_the_same_report(
        tmp_path, capsys):
    file = tmp_path / "tiny.yaml"
    file.write_text(GOOD)
    assert rollout(file, tmp_path / "one", "--no-video", "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert report["success"]
    assert report["mission"] == "tiny"
    target = report["targets"][0]
    assert target["solved"]
    assert target["robots"] == ["hop", "roll"]
    assert all(distance <= 0.5 for distance in target["distance_m"])
    assert report["grid_plan"]["makespan"] <= target["decision"]
    assert [robot["falls"] for robot in report["robots"]] == [0, 0]
    assert all(robot["distance_m"] > 0.5 for robot in report["robots"])
    assert report["robots"][0]["propellant_kg"] > 0
    one = tmp_path / "one"
    assert {p.name for p in one.iterdir()} == {
        "report.json", "timing.json", "config.json", "paths.png", "report.html"}
    page = (one / "report.html").read_text()
    assert "tiny: " in page
    assert "slip" in page
    assert json.loads((one / "report.json").read_text()) == report

    assert rollout(file, tmp_path / "two") == 0
    assert (tmp_path / "two" / "report.json").read_bytes() == (one / "report.json").read_bytes()
    assert "solved at decision" in capsys.readouterr().out


def test_a_failed_mission_exits_with_one_and_without_opengl_shows_the_map(
        tmp_path, capsys, monkeypatch):
    def nothing(width, height):
        raise RenderingUnavailable("no display")

    monkeypatch.setattr(stage, "open_window", nothing)
    file, out = tmp_path / "hasty.yaml", tmp_path / "out"
    file.write_text("max_steps: 1\n" + GOOD.replace("start: [1, 0]", "start: [2, 2]"))
    assert rollout(file, out, "--size", "320", "180", "--fps", "5", "--seconds", "2") == 1
    report = json.loads((out / "report.json").read_text())
    assert (report["success"], report["cause"], report["decisions"]) == (False, "max_steps", 1)
    captured = capsys.readouterr()
    assert "FAILED" in captured.out
    assert "install" in captured.err
    assert (out / "map.mp4").stat().st_size > 1000
    timing = json.loads((out / "timing.json").read_text())
    assert timing["film_frames"] == pytest.approx(5 * timing["film_seconds"])
    assert timing["film_cpu_s"] > 0
    assert not (out / "video.mp4").exists()


def test_on_a_cpu_the_engine_is_the_faster_one_and_said(tmp_path, capsys, monkeypatch):
    file, out = tmp_path / "tiny.yaml", tmp_path / "out"
    file.write_text(GOOD)
    words = ["rollout", str(file), "--planner", "exact", "--no-video", "--out", str(out)]
    assert main(words) == 0
    captured = capsys.readouterr()
    assert "moonteam: engine native: C MuJoCo, three times as fast" in captured.err
    assert ", native" in captured.out
    report = json.loads((out / "report.json").read_text())
    assert report["backend"] == "native"
    page = (out / "report.html").read_text()
    assert "native (C MuJoCo, three times as fast" in page
    assert "--backend native" in page  # of the command that makes it again
    assert "C MuJoCo" in json.loads((out / "config.json").read_text())["engine"]


def test_the_plan_stands_beside_the_certified_optimum(tmp_path, capsys):
    """Greedy's plan of a mission in which the nearest target first is the longer way."""
    file = tmp_path / "line.yaml"
    file.write_text(GOOD.replace("size: [3, 3]", "size: [6, 3]").replace(
        "start: [1, 0]", "start: [5, 2]").replace("targets:", (
            "targets:\n  - {name: far, at: [4, 0], skills: [A]}")))
    for number, planner in enumerate(("exact", "greedy")):
        out = tmp_path / planner
        assert main(["rollout", str(file), "--planner", planner, "--no-video",
                     "--out", str(out)]) == 0
        report = json.loads((out / "report.json").read_text())
        best, plan = report["optimum"], report["grid_plan"]["makespan"]
        assert best["plan_steps"] == plan
        assert best["optimum_steps"] <= plan
        if not number:
            optimum = plan
            assert best["optimum_steps"] == plan
        assert best["optimum_steps"] == optimum
        said = capsys.readouterr().out
        assert f"plan {plan} steps (" in said
        assert f"certified optimum {optimum} steps (" in said
        assert "certified optimum, steps" in (out / "report.html").read_text()


def test_an_interrupted_rollout_saves_what_is_done(tmp_path, capsys, monkeypatch):
    class Stopped(NativeBackend):
        calls = 0

        def advance(self, state, commands, num_control_steps):
            Stopped.calls += 1
            if Stopped.calls == 3:
                raise KeyboardInterrupt
            return super().advance(state, commands, num_control_steps)

    monkeypatch.setattr(backends, "NativeBackend", Stopped)
    file, out = tmp_path / "tiny.yaml", tmp_path / "out"
    file.write_text(GOOD)
    assert rollout(file, out) == 130
    report = json.loads((out / "report.json").read_text())
    assert (report["success"], report["cause"]) == (False, "interrupted")
    assert report["seconds"] == pytest.approx(0.4)
    assert (out / "paths.png").stat().st_size > 1000
    assert "report.json" in capsys.readouterr().err


def test_new_targets_that_a_planner_cannot_take_are_refused_before_the_start(tmp_path, capsys):
    events = "events:\n" + "".join(
        f"  - {{at_decision: {k + 1}, target: {{at: [2, 2], skills: [A]}}}}\n" for k in range(12))
    file, out = tmp_path / "many.yaml", tmp_path / "out"
    file.write_text(GOOD + events)
    assert rollout(file, out) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert "13 targets, those of events counted" in message
    assert not out.exists()


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory):
    """The report of two small missions, in one of which a robot is lost."""
    out = tmp_path_factory.mktemp("evaluated")
    assert main(["evaluate", "execution", "--site", "flat", "--side", "4", "--targets", "1",
                 "--count", "2", "--planner", "exact", "--mode", "async", "--loop", "closed",
                 "open", "--lose", "0.5", "--out", str(out), "--json"]) == 0
    return out / "report.json"


def test_any_mission_of_an_evaluation_is_made_again_to_the_bit(evaluated, tmp_path, capsys):
    document = json.loads(evaluated.read_text())
    for row in document["rows"]:
        if row["number"] == 0:
            continue
        out = tmp_path / row["contender"]
        code = main(["rollout", "--from", str(evaluated), "--mission", str(row["number"]),
                     "--contender", row["contender"], "--no-video", "--out", str(out)])
        assert code == (0 if row["report"]["success"] else 1)
        report = json.loads((out / "report.json").read_text())
        for key in ("success", "decisions", "seconds", "cause"):
            assert report[key] == row["report"][key], key
        assert report == row["report"]
        assert "not as in" not in capsys.readouterr().err
        assert f"--contender {row['contender']!r}" in (out / "report.html").read_text().replace(
            "&#x27;", "'")


@pytest.mark.parametrize(("options", "named"), [
    (["--mission", "7"], "holds no mission 7"),
    (["--mission", "1", "--contender", "nobody"], "has no contender 'nobody'"),
    (["--mission", "1", "--seed", "3"], "--seed: not with --from"),
    ([], "--mission N"),
])
def test_missions_that_a_report_does_not_hold_are_refused(
        evaluated, tmp_path, capsys, options, named):
    out = tmp_path / "out"
    assert main(["rollout", "--from", str(evaluated), "--out", str(out), *options]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert named in message
    assert not out.exists()


@pytest.mark.parametrize(("text", "named"), [
    ("{", "not JSON"), ("[]", "is no report.json"), ('{"kind": "grid"}', "is no report.json")])
def test_what_is_no_report_is_refused(tmp_path, capsys, text, named):
    file = tmp_path / "report.json"
    file.write_text(text)
    assert main(["rollout", "--from", str(file), "--mission", "0"]) == 2
    assert named in capsys.readouterr().err


SUNNY = """
name: sunny
map: {size: [4, 4]}
site: {preset: polar, seed: 13}
sun: {azimuth: 45, elevation: 4, dark: 3}
clock: seconds
robots:
  - {name: roll, kind: wheeled, skills: [A], start: [0, 0],
     battery: {capacity_wh: 1, panel_w: 0, idle_w: 36}}
targets:
  - {at: [2, 1], skills: [A]}
"""


def test_a_robots_power_is_told(tmp_path, capsys):
    file, out = tmp_path / "sunny.yaml", tmp_path / "out"
    file.write_text(SUNNY)
    assert rollout(file, out) == 0
    assert "battery 1.00 Wh at the start" in capsys.readouterr().out
    report = json.loads((out / "report.json").read_text())
    battery = report["robots"][0]["battery"]
    hours = report["seconds"] / 3600
    moved = report["robots"][0]["energy_j"] / 0.7 / 3600
    assert battery["used_wh"] == pytest.approx(36 * hours + moved, abs=2e-4)
    assert battery["end_wh"] == pytest.approx(1 - battery["used_wh"], abs=2e-4)
    assert moved > 0
    assert "<h2>Power</h2>" in (out / "report.html").read_text()
    file.write_text(SUNNY.replace("capacity_wh: 1", "capacity_wh: 0.02"))
    assert rollout(file, tmp_path / "dark") == 1
    assert "LOST: battery at 1." in (told := capsys.readouterr().out)
    assert "roll (battery)" in told
