"""`moonteam plan`, from the command line to the files it writes."""

import json
import re

import pytest

from moonteam import cli, files
from moonteam.commands import plan as command
from moonteam.planners import simulate
from moonteam.planners.base import Snapshot
from moonteam.problem.scenario import ACTIONS, Agent, Scenario, Target, save_set

TEAM = Scenario(
    id="pair", size=(8, 6), agents=(Agent((0, 0), ("A",)), Agent((7, 0), ("B",))),
    targets=(Target((3, 0), ("A", "B"), "AND"), Target((3, 5), ("A",), "OR")))
HOPELESS = Scenario(id="none", size=(8, 6), agents=(Agent((0, 0), ("A",)),),
                    targets=(Target((3, 0), ("B",), "OR"),))


@pytest.fixture
def scenario_set(tmp_path):
    path = tmp_path / "set.jsonl"
    save_set(path, [TEAM, HOPELESS])
    return path


def run(capsys, *words):
    code = cli.main(["plan", *map(str, words)])
    return code, *capsys.readouterr()


@pytest.mark.parametrize("planner", ["exact", "greedy", "lns", "guided", "cpsat", "routing",
                                     "exhaustive"])
def test_every_planner_prints_a_document_that_replays(capsys, scenario_set, planner):
    code, out, err = run(capsys, f"{scenario_set}:pair", "--planner", planner, "--json")
    document = json.loads(out)
    assert (code, err) == (0, "")
    assert list(document) == ["planner", "objective", "status", "makespan", "moves", "bound",
                              "seconds", "actions", "schedule"]
    assert (document["makespan"], document["moves"]) == (9, 12)
    assert document["status"] == (
        "feasible" if planner in ("greedy", "lns", "guided", "routing") else "optimal")
    actions = [[ACTIONS.index(name) for name in row] for row in document["actions"]]
    trace = simulate.replay(Snapshot.start(TEAM), actions)
    assert (trace.makespan, trace.moves) == (9, 12)
    assert document["schedule"] == [{"target": 0, "agents": [0, 1], "step": 4},
                                    {"target": 1, "agents": [0], "step": 9}]


def test_the_table_says_who_goes_where_with_whom_and_when(capsys, scenario_set):
    code, out, _ = run(capsys, f"{scenario_set}:0", "--objective", "moves")
    assert code == 0
    assert "R1 (A) with R2 (B)" in out
    assert "A AND B" in out
    assert "makespan 9 steps, 12 moves (R1 8, R2 4)" in out
    assert "optimal: proved that no plan has less moves" in out


@pytest.mark.parametrize("columns", [80, 40])
def test_a_table_fits_its_terminal_however_large_the_plan(capsys, monkeypatch, columns):
    monkeypatch.setenv("COLUMNS", str(columns))
    code, out, _ = run(capsys, "8x40:3", "--planner", "greedy")
    assert code == 0
    table, _, _ = out.partition("makespan ")
    assert max(map(len, table.splitlines())) <= columns
    assert "…" not in out
    for target in range(1, 41):
        assert len(re.findall(rf"\bT{target}\b", out)) == 1


def test_names_of_skills_stand_apart(capsys, tmp_path):
    save_set(tmp_path / "set.jsonl", [Scenario(
        id="named", size=(8, 6), agents=(Agent((0, 0), ("camera", "radio")),
                                         Agent((7, 0), ("A", "B"))),
        targets=(Target((3, 0), ("camera", "B"), "AND"),))])
    code, out, _ = run(capsys, tmp_path / "set.jsonl")
    assert code == 0
    words = " ".join(re.sub(r"[│┃]", " ", out).split())
    assert "camera AND B" in words
    assert "R1 (camera, radio) with R2 (AB)" in words


def test_weighted_and_its_bound(capsys, scenario_set):
    _, out, _ = run(capsys, f"{scenario_set}:0", "--objective", "weighted", "--alpha", "2",
                    "--beta", "0.5", "--json")
    assert json.loads(out)["bound"] == pytest.approx(2 * 9 + 0.5 * 12)


def test_infeasible_says_why_and_exits_with_one(capsys, scenario_set):
    code, out, _ = run(capsys, f"{scenario_set}:none")
    assert code == 1
    assert "target 0 at [3, 0]: nobody in the team has skill B" in out
    code, out, _ = run(capsys, f"{scenario_set}:1", "--json")
    document = json.loads(out)
    assert code == 1
    assert (document["status"], document["makespan"], document["actions"]) == (
        "infeasible", None, [])


@pytest.mark.parametrize("which", ["pair", "none"])
def test_out_holds_the_document_and_a_picture(capsys, scenario_set, tmp_path, which):
    run(capsys, f"{scenario_set}:{which}", "--out", tmp_path / "plan")
    document = json.loads((tmp_path / "plan/plan.json").read_text())
    assert document["objective"] == "makespan"
    picture = (tmp_path / "plan/plan.png").read_bytes()
    assert picture.startswith(b"\x89PNG")
    assert len(picture) > 10_000
    assert sorted(p.name for p in (tmp_path / "plan").iterdir()) == ["plan.json", "plan.png"]


def test_missions_are_planned_under_their_own_names(capsys, tmp_path):
    path = tmp_path / "m.yaml"
    files.write_text(path, "map: {size: [8, 6]}\nrobots:\n  - {name: hop, kind: drone, skills: "
                     "[A], start: [0, 0]}\ntargets:\n  - {name: well, at: [2, 0], skills: [A]}\n")
    code, out, _ = run(capsys, path)
    assert code == 0
    assert "well" in out
    assert "hop (A)" in out


def test_bundled_missions_and_sets_are_found(capsys):
    code, out, _ = run(capsys, "outpost", "--json")
    assert (code, json.loads(out)["status"]) == (0, "optimal")
    code, out, _ = run(capsys, "3x5:3x5-0007", "--json")
    assert (code, json.loads(out)["status"]) == (0, "optimal")


@pytest.mark.parametrize(("words", "message"), [
    (["nowhere.json"], "no such file"),
    (["nowhere"], "bundled missions"),
    (["3x5"], "is a set, which holds 1000 scenarios; choose one, such as 3x5:0"),
    (["SET"], "holds 2 scenarios; choose one"),
    (["SET:7"], "has no scenario '7'; a number 0 to 1 or an id"),
    (["SET:pear"], "has no scenario 'pear'"),
    (["SET:0", "--time-limit", "0"], "--time-limit: 0.0 is not allowed"),
    (["SET:0", "--seed", "-1"], "--seed: -1 is not allowed"),
    (["SET:0", "--objective", "weighted", "--beta", "-1"], "are not allowed"),
    (["SET:0", "--planner", "policy", "--policy", "none"], "none"),
    (["SET:0", "--planner", "policy", "--preference", "2"], "--preference: 2.0 is not allowed"),
    (["SET:0", "--planner", "policy", "--decode", "best-of-x"], "--decode"),
])
def test_bad_input_is_one_line_and_exit_code_two(capsys, scenario_set, tmp_path, words, message):
    words = [w.replace("SET", str(scenario_set)) for w in words]
    code, out, err = run(capsys, *words, "--out", tmp_path / "plan")
    assert (code, out) == (2, "")
    assert message in err
    assert err.count("\n") == 1
    assert not (tmp_path / "plan").exists()


def test_too_many_targets_for_the_exact_planner(capsys, tmp_path):
    row = tuple(Target((x, 1), ("A",), "OR") for x in range(13))
    save_set(tmp_path / "wide.jsonl",
             [Scenario(size=(14, 3), agents=(Agent((0, 0), ("A",)),), targets=row)])
    code, _, err = run(capsys, tmp_path / "wide.jsonl")
    assert code == 2
    assert "13 targets are open; the exact planner takes up to 12; use lns" in err


def test_the_cases_the_command_line_names():
    case = command.load_case("3x7:0")
    assert case.title == "3x7-0000"
    assert case.targets[-1] == "T7"
