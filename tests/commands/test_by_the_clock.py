"""plan, rollout and evaluate execution by the clock."""

import json

import jax
import msgspec
import numpy as np
import pytest

from moonteam.cli import main
from moonteam.policies import pointer, policy_file

TINY = """
name: tiny
clock: seconds
max_seconds: 60
map: {size: [8, 8], cell_m: 1.0}
site: {preset: flat, seed: 0}
robots:
  - {name: hopper, kind: drone, skills: [eye], start: [1, 1.5], home: [1, 1.5]}
  - {name: rover, kind: wheeled, skills: [eye, drill], start: [5, 1]}
targets:
  - {name: look, at: [5.5, 6], skills: [eye], service: 2}
  - {name: core, at: [4, 3], skills: [drill], after: [look], service: 1}
"""


def printed(capsys, *words, code=0):
    assert main([*words, "--json"]) == code
    return msgspec.json.decode(capsys.readouterr().out)


@pytest.fixture
def tiny(tmp_path):
    file = tmp_path / "tiny.yaml"
    file.write_text(TINY)
    return str(file)


@pytest.fixture(scope="module")
def pointing(tmp_path_factory):
    """A policy file of the kind that plans by the clock, untrained."""
    sizes = {"width": 8, "heads": 2, "layers": 1, "pairs": 4}
    path = tmp_path_factory.mktemp("policy") / "fresh.safetensors"
    params = jax.device_get(pointer.init(pointer.PointerSpec(**sizes), jax.random.key(0)))
    policy_file.save_policy(path, policy_file.PolicyFile("pointer", sizes, params))
    return str(path)


def test_a_mission_is_planned_on_its_ground(tiny, capsys, tmp_path):
    plan = printed(capsys, "plan", tiny, "--out", str(tmp_path / "out"))
    assert plan["clock"] == "seconds"
    assert plan["status"] == "optimal"
    look, core = sorted(plan["schedule"], key=lambda one: one["target"])
    assert look["end"] - look["start"] == pytest.approx(2)
    assert core["start"] >= look["end"]
    home = plan["ways"][0][-1]
    assert home["target"] is None
    assert plan["makespan"] == pytest.approx(max(home["arrives"], core["end"]))
    way = np.array(plan["ways"][0][0]["points"])
    assert np.allclose(way[0], [-2.5, -2.0])
    assert (tmp_path / "out" / "plan.png").stat().st_size > 10_000
    assert main(["plan", tiny]) == 0
    assert "optimal in seconds on this ground" in capsys.readouterr().out


def test_a_mission_in_steps_is_planned_in_seconds_if_asked(capsys):
    steps = printed(capsys, "plan", "outpost")
    seconds = printed(capsys, "plan", "outpost", "--clock", "seconds")
    assert "clock" not in steps
    assert {one["target"] for one in seconds["schedule"]} == set(range(5))
    assert seconds["makespan"] == seconds["bound"] or seconds["status"] == "optimal"
    greedy = printed(capsys, "plan", "outpost", "--clock", "seconds", "--planner", "greedy")
    assert greedy["makespan"] >= seconds["makespan"]


def test_a_problem_by_the_clock_is_planned(capsys):
    plan = printed(capsys, "plan", "3x5:0", "--clock", "seconds")
    assert plan["makespan"] == printed(capsys, "plan", "3x5:0")["makespan"]


def test_what_is_left_out_is_said(tmp_path, capsys):
    file = tmp_path / "mission.yaml"
    file.write_text("""
clock: seconds
map: {size: [32, 32]}
robots: [{name: rover, kind: wheeled, skills: [drill], start: [6, 4]}]
targets:
  - {name: core, at: [12, 6], skills: [drill]}
  - {name: far, at: [30, 30], skills: [drill], lapses: 15, worth: 3}
  - {name: near, at: [9, 5], skills: [drill], lapses: 40, worth: 1}
""")
    plan = printed(capsys, "plan", str(file))
    assert (plan["left_out"], plan["worth"], plan["offered"]) == ([1], 1.0, 4.0)
    assert {one["target"] for one in plan["schedule"]} == {0, 2}
    assert main(["plan", str(file)]) == 0
    said = capsys.readouterr().out
    assert "serves a worth of 1 of 4; left out: far" in said
    assert "no plan serves more worth" in said


def test_no_robot_is_faster_than_its_kind(tiny, capsys, tmp_path):
    file = tmp_path / "fast.yaml"
    file.write_text(TINY.replace("start: [5, 1]", "start: [5, 1], speed: 3"))
    assert main(["plan", str(file)]) == 2
    assert "robots[1].speed: 3 is not allowed; a wheeled robot travels at up to 0.5 m/s" in (
        capsys.readouterr().err)


@pytest.mark.parametrize(("words", "says"), [
    (["plan", "TINY", "--planner", "policy", "--policy", "any_team_imitated"],
     "one of kind pointer is needed"),
    (["plan", "TINY", "--clock", "steps"], "is by the clock"),
    (["plan", "TINY", "--planner", "exakt"], "did you mean exact"),
    (["rollout", "TINY", "--planner", "policy", "--policy", "any_team_imitated"],
     "one of kind pointer is needed"),
    (["rollout", "TINY", "--mode", "barrier"], "is by the clock"),
    (["rollout", "TINY", "--backend", "fused"], "drives in steps"),
    (["evaluate", "execution", "--mode", "clock", "--lose", "1", "--count", "1"], "at_s")])
def test_what_cannot_be_is_one_line(words, says, tiny, capsys):
    assert main([tiny if word == "TINY" else word for word in words]) == 2
    message = capsys.readouterr().err
    assert says in message
    assert message.count("\n") == 1


def test_a_policy_that_points_plans_and_drives(tiny, pointing, tmp_path, capsys):
    words = [tiny, "--planner", "policy", "--policy", pointing]
    plan = printed(capsys, "plan", *words)
    assert (plan["planner"], plan["status"], plan["bound"]) == ("policy", "feasible", None)
    look, core = sorted(plan["schedule"], key=lambda one: one["target"])
    assert core["start"] >= look["end"]
    report = printed(capsys, "rollout", *words, "--backend", "native", "--no-video",
                     "--out", str(tmp_path / "out"))
    assert report["success"]
    assert report["planner"] == "policy"
    assert report["expected_s"] == pytest.approx(plan["makespan"], abs=6)


def test_a_policy_stands_beside_planners_by_the_clock(pointing, capsys):
    document = printed(capsys, "evaluate", "grid", "seconds/3x5-7", "--limit", "2", "--planner",
                       "exact", "--planner", "policy", "--policy", pointing, "--decode", "argmax",
                       "--decode", "best-of-4")
    exact, argmax, best = document["summary"]
    assert [argmax["planner"], best["planner"]] == ["policy(argmax)", "policy(best-of-4)"]
    assert exact["makespan_gap"] == pytest.approx(0.0, abs=1e-6)
    assert min(argmax["makespan_gap"], best["makespan_gap"]) >= 0
    assert argmax["success"] == best["success"] == 1
    peers = printed(capsys, "evaluate", "peers", "peers/mrta-benchmark", "--limit", "1",
                    "--planner", "policy", "--policy", pointing)
    assert [row["name"] for row in peers["sets"][0]["planners"]] == ["policy(argmax)"]
    assert peers["sets"][0]["planners"][0]["problems"] == 1


def test_a_policy_drives_by_the_clock_and_in_steps(pointing, capsys):
    words = ["evaluate", "execution", "--count", "1", "--targets", "2", "--side", "10", "--site",
             "flat", "--mode", "clock"]
    document = printed(capsys, *words, "--policy", pointing)
    assert [row["contender"] for row in document["rows"]] == ["closed fresh clock"]
    other = printed(capsys, *words)
    assert [row["contender"] for row in other["rows"]] == ["closed any_team clock"]


def test_real_robots_do_it_as_planned(tiny, capsys, tmp_path):
    plan = printed(capsys, "plan", tiny)
    out = tmp_path / "out"
    report = printed(capsys, "rollout", tiny, "--backend", "native", "--no-video", "--out",
                     str(out))
    assert report["success"]
    assert report["mode"] == "clock"
    assert report["expected_s"] == pytest.approx(plan["makespan"], abs=6)  # ways home beside it
    assert report["optimum"]["plan_s"] == report["optimum"]["optimum_s"] == pytest.approx(
        plan["makespan"], abs=0.5)  # from the poses on the ground, not from the cells' centres
    assert report["seconds"] == pytest.approx(plan["makespan"], rel=0.35)
    hopper, rover = report["robots"]
    assert hopper["service_s"] + rover["service_s"] == 3
    assert 0 < hopper["driving_s"] + hopper["service_s"] <= report["seconds"]
    look, core = report["targets"]
    assert look["time_s"] < core["time_s"]
    assert look["expected_s"] == pytest.approx(plan["schedule"][0]["end"])
    again = printed(capsys, "rollout", tiny, "--backend", "native", "--no-video", "--force",
                    "--out", str(out))
    assert again == report


def test_missions_by_the_clock_stand_beside_those_in_steps_and_are_made_again(capsys, tmp_path):
    out = tmp_path / "out"
    document = printed(capsys, "evaluate", "execution", "--count", "1", "--targets", "2", "--side",
                       "10", "--site", "flat", "--planner", "exact", "--mode", "async", "clock",
                       "--out", str(out))
    steps, clock = document["rows"]
    assert clock["contender"] == "closed exact clock"
    assert clock["report"]["success"]
    assert clock["nominal_s"] < clock["report"]["expected_s"]
    assert clock["report"]["seconds"] < steps["report"]["seconds"]
    assert document["comparisons"][0]["over"] == "closed exact async"
    report = printed(capsys, "rollout", "--from", str(out / "report.json"), "--mission", "0",
                     "--contender", "closed exact clock", "--no-video", "--out",
                     str(tmp_path / "again"))
    assert report == clock["report"]
    assert json.loads((out / "report.json").read_text())["summary"][1]["optimum"] > 0


def test_a_mission_of_which_nothing_is_known_is_not_planned(capsys):
    assert main(["plan", "search"]) == 2
    out, err = capsys.readouterr()
    assert not out
    assert "search: targets: nothing to plan" in err
    assert err.count("\n") == 1
