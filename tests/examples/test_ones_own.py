"""Robot, planner, mission and ground of one's own, as docs/ shows them, in `evaluate execution`."""

import json
import re
import shlex
from pathlib import Path

import msgspec
import numpy as np
import pytest

from moonteam import loading
from moonteam.cli import main
from moonteam.commands import clocked
from moonteam.planners.kind import PlannerOptions
from moonteam.planners.seconds import base
from moonteam.planners.seconds import registry as timed_planners
from moonteam.problem.timed import Agent, Target, Timed
from moonteam.terrain.site import import_dem
from sim2grid.loop.prepare import prepare
from sim2grid.study.restage import load_report, restage

TOP = Path(__file__).parents[2]
GROUND = TOP / "examples" / "ground"
SOONEST = f"{TOP}/examples/soonest_planner.py:SoonestPlanner"


def shown(page, words):
    """The words of the command on a page of docs/ that has these in it."""
    text = (TOP / "docs" / page).read_text(encoding="utf-8")
    lines = [line.partition("  #")[0] for block in re.findall(r"```sh\n(.*?)```", text, re.DOTALL)
             for line in block.splitlines()]
    (line,) = [line for line in lines if words in line]
    return shlex.split(line)[1:]


def run(words, capsys, code=0):
    assert main([*words, "--json"]) == code
    return json.loads(capsys.readouterr().out)


@pytest.fixture
def top(monkeypatch):
    monkeypatch.chdir(TOP)


def test_robot_planners_and_ground_from_outside_in_one_command(top, capsys, tmp_path):
    """In steps and by the clock; the report's mission can be driven again."""
    report = run([*shown("planners.md", "evaluate execution"), "--out", str(tmp_path)], capsys)
    assert [row["contender"] for row in report["rows"]] == [
        "closed NearestPlanner barrier", "closed SoonestPlanner clock"]
    for row in report["rows"]:
        assert row["report"]["success"]
        assert row["site"] == "rim"
        (robot,) = row["report"]["robots"]
        assert (robot["name"], robot["kind"]) == ("scout", "scout")
        assert robot["distance_m"] > 0.5
    (entry,) = report["missions"]
    its = msgspec.convert(entry["mission"], loading.Mission)
    assert its.site.dem == str(GROUND / "rim.tif")
    assert its.site.centre == (-89.5136, 125.34)
    assert its.robots[0].kind == str(TOP / "examples/scout/scout.py:SCOUT")
    for row in report["rows"]:  # as `moonteam rollout --from` does
        staged = restage(load_report(tmp_path / "report.json"), 0, "report.json", row["contender"])
        assert staged.prepared.mission.robots[0].kind == "scout"
        assert staged.execution.planner.name in ("nearest", "soonest")


def test_a_team_with_a_robot_from_outside(top, capsys):
    report = run(shown("robots.md", "--team"), capsys)
    assert len(report["rows"]) == 2
    for row in report["rows"]:
        assert row["report"]["success"]
        assert [(r["name"], r["kind"]) for r in row["report"]["robots"]] == [
            ("scout", "scout"), ("rover", "wheeled")]
    assert {skill for entry in report["missions"] for target in entry["mission"]["targets"]
            for skill in target["skills"]} <= {"A", "B"}


def test_missions_of_ones_own_stand_in_one_table(top, capsys):
    names = [str(GROUND / "mission.yaml"), "examples/scout/mission.yaml", "demo"]
    report = run(["evaluate", "execution", "--mission", *names, "--loop", "grid", "--planner",
                  "exact", "greedy"], capsys)
    assert [(row["number"], row["report"]["mission"], row["site"]) for row in report["rows"]] == [
        (number, name, "missions") for number, name in enumerate(("rim", "scouting", "demo"))
        for _ in range(2)]
    assert all(row["report"]["success"] for row in report["rows"])
    assert [line["missions"] for line in report["summary"]] == [3, 3]
    assert report["missions"][1]["mission"]["robots"][0]["kind"] == str(
        TOP / "examples/scout/scout.py:SCOUT")
    assert main(["evaluate", "execution", "--mission", "demo", "--loop", "grid", "--planner",
                 "exact", "--markdown"]) == 0
    assert "| 0 demo | grid exact | solved |" in capsys.readouterr().out


def test_the_mission_on_the_model_stands_where_it_says():
    source = str(GROUND / "mission.yaml")
    its = prepare(loading.read_mission(source)[0], source)
    assert its.site.meta["made_up_m"] == 0.0
    # The centre is about the middle of pixel (20, 20), half a pixel from the model's centre.
    np.testing.assert_allclose(its.site.meta["centre_m"], (0.75, -0.75), atol=1.5)
    assert not its.mission.events
    assert set(its.passable) == {"scout", "drone"}


def test_the_model_is_what_its_script_makes(tmp_path):
    scope = {"__name__": "make_model"}
    exec(compile((GROUND / "make_model.py").read_text(), "make_model.py", "exec"), scope)
    scope["main"](tmp_path / "rim.tif")
    made, held = (import_dem(path, detail=False).heights
                  for path in (tmp_path / "rim.tif", GROUND / "rim.tif"))
    np.testing.assert_allclose(made, held, atol=0.02)


def test_the_planner_by_the_clock_keeps_to_the_rules():
    planner = timed_planners.find(SOONEST).make(PlannerOptions())
    now = clocked.case_of(loading.load_mission("sampling")).now
    cases = [now, base.moment(base.TRIAL), base.moment(Timed("seconds", (
        Agent((0.0, 0.0), ("A",)), Agent((9.0, 0.0), ("A", "B"))), (
        Target((1.0, 0.0), ("A",)), Target((8.0, 0.0), ("A", "B"), "AND", service=2.0))))]
    for case in cases:
        plan = planner.plan(case)
        assert plan.status == "feasible"
        assert base.problems(case, plan.services) == []
        assert plan.makespan == base.makespan(case, plan.services)
    nobody = planner.plan(base.moment(Timed("seconds", (Agent((0.0, 0.0), ("A",)),), (
        Target((5.0, 0.0), ("A",), lapses=1.0),))))
    assert nobody.status == "infeasible"
    assert nobody.reason
