"""`moonteam replay`: the trace, and one clear line for each bad input."""

import io
import json
from pathlib import Path

import numpy as np
import pytest

from moonteam import cli
from moonteam.commands.replay import show

SCENARIO = {
    "id": "two", "size": [5, 5], "max_steps": 10,
    "agents": [{"at": [0, 0], "skills": ["A"]}, {"at": [3, 0], "skills": ["B"]}],
    "targets": [{"at": [1, 0], "skills": ["A", "B"], "type": "AND"},
                {"at": [4, 4], "skills": ["A"], "type": "OR"}],
}
ACTIONS = [["right", "left"], [4, 2], ["down", "stay"]]
CERTIFIED = Path(__file__).parents[1] / "golden" / "certified_optima.jsonl"


@pytest.fixture
def files(tmp_path):
    scenario, actions = tmp_path / "scenario.json", tmp_path / "actions.json"
    scenario.write_text(json.dumps(SCENARIO))
    actions.write_text(json.dumps(ACTIONS))
    return str(scenario), str(actions)


def replay(capsys, *words):
    """Exit code, the JSON document, and standard error."""
    code = cli.main(["replay", *words, "--json"])
    out, err = capsys.readouterr()
    return code, json.loads(out) if out else None, err


def test_the_trace(files, capsys):
    code, document, err = replay(capsys, *files)
    assert (code, err) == (0, "")
    steps = document["steps"]
    assert len(steps) == 4
    assert "rewards" not in steps[0]
    assert "total" not in steps[0]
    assert [s["positions"] for s in steps] == [
        [[0, 0], [3, 0]], [[1, 0], [2, 0]], [[1, 0], [1, 0]], [[1, 0], [1, 0]]]
    assert [s["solved"] for s in steps] == [[False] * 2] * 2 + [[True, False]] * 2
    assert (document["makespan"], document["moves"], document["true_moves"]) == (None, 4, 3)
    assert steps[1]["actions"] == ["right", "left"]
    second = steps[2]["rewards"]
    assert second["TR"] == [0.5, 0.5]
    assert second["TB"] == [0, 0]
    assert second["WC"] == [0, 0]
    np.testing.assert_allclose(second["SC"], [0, -0.1])
    np.testing.assert_allclose(second["TC"], [-0.05, -0.05])
    near = np.exp(-0.0075 * 5) / 20
    np.testing.assert_allclose(second["AR"], [near, 0], rtol=1e-6)
    np.testing.assert_allclose(steps[2]["total"], [near + 0.5 - 0.025, 0.5 - 0.03 - 0.025],
                               rtol=1e-5)
    assert steps[0]["observations"][1] == [0.75, 0, 0, 0, -0.5, 0, 0.25, 1, 2, 1, 3, 1, 1, 0]


def test_phase_preset_and_raw(files, capsys):
    _, document, _ = replay(capsys, *files, "--phase", "bootstrap", "--preset", "pi_7t", "--raw")
    second = document["steps"][2]
    near = np.exp(-0.04 * 5) / 20
    np.testing.assert_allclose(second["total"], [near + 0.5, 0.5], rtol=1e-6)
    np.testing.assert_allclose(second["rewards"]["SC"], [0, -0.1])  # unweighted all the same
    assert document["steps"][0]["observations"][1][:4] == [3, 0, 0, 0]
    _, literal, _ = replay(capsys, *files, "--literal")
    assert literal["steps"][1]["rewards"]["SC"] == [-1, -1]


def test_makespan_is_the_first_step_with_all_solved(files, capsys, tmp_path):
    actions = [["right", "left"], ["stay", "left"], *[["right", "stay"]] * 3,
               *[["up", "stay"]] * 4, ["stay", "up"]]
    path = tmp_path / "long.json"
    path.write_text(json.dumps({"planner": "by hand", "actions": actions}))
    _, document, _ = replay(capsys, files[0], str(path))
    assert len(document["steps"]) == 11
    assert (document["makespan"], document["moves"]) == (9, 11)
    np.testing.assert_allclose(document["steps"][9]["rewards"]["TB"], [1, 1])
    assert document["steps"][10]["rewards"]["TB"] == [0, 0]


def test_the_buffer_appears_in_the_slot(files, capsys):
    _, document, _ = replay(capsys, *files, "--buffer", "1")
    steps = document["steps"]
    assert [s["solved"] for s in steps] == [[False]] * 4
    np.testing.assert_allclose(steps[2]["rewards"]["TR"], [0.5, 0.5])
    assert steps[2]["observations"][0][-4:] == [1, 2, 1, 0]  # skills A and B; target A, OR


def test_out_table_and_standard_input(files, capsys, tmp_path, monkeypatch):
    monkeypatch.setattr("sys.stdin", io.StringIO(json.dumps(ACTIONS)))
    assert cli.main(["replay", files[0], "-", "--out", str(tmp_path / "run")]) == 0
    shown = capsys.readouterr().out
    assert "not all solved; 4 moves, 3 of them changed a cell" in shown
    written = json.loads((tmp_path / "run" / "replay.json").read_text())
    assert written == replay(capsys, *files)[1]


def test_a_scenario_of_a_set(files, capsys, tmp_path):
    path = tmp_path / "stay.json"
    path.write_text('[["stay", "stay", "stay"]]')
    code, document, _ = replay(capsys, str(CERTIFIED), str(path), "--id", "3r5t-0001")
    assert code == 0
    assert document["steps"][1]["positions"] == [[19, 11], [10, 4], [6, 24]]
    code, _, err = replay(capsys, str(CERTIFIED), str(path))
    assert code == 2
    assert "choose one with --id" in err
    code, _, err = replay(capsys, str(CERTIFIED), str(path), "--id", "none")
    assert code == 2
    assert "holds no scenario with the id 'none'" in err


BAD = {
    "{": "is not JSON: Expecting property name",
    "": "is not JSON: Expecting value (line 1, column 1)",
    "7": "a list of steps is needed",
    '{"steps": []}': 'an object needs the key "actions"',
    '[["up"]]': "[0]: 1 actions for 2 agents",
    '[["up", "up"], "up"]': "[1]: no list for 2 agents",
    '[["up", "fly"]]': '[0][1]: "fly" is no action; one of up, down, left, right, stay or 0 to 4',
    '[["up", 5]]': "[0][1]: 5 is no action",
    '[["up", -1]]': "[0][1]: -1 is no action",
    '[["up", true]]': "[0][1]: true is no action",
    '[["up", 1.0]]': "[0][1]: 1.0 is no action",
    '[["up", null]]': "[0][1]: null is no action",
    json.dumps([["up", "up"]] * 11): "11 steps; the scenario ends after 10",
}


@pytest.mark.parametrize("text", BAD)
def test_bad_actions_give_one_clear_line(text, files, capsys, tmp_path):
    Path(files[1]).write_text(text)
    code, document, err = replay(capsys, *files, "--out", str(tmp_path / "run"))
    assert (code, document) == (2, None)
    assert f"{files[1]}: {BAD[text]}" in err
    assert err.count("\n") == 1
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(("words", "said"), [
    (("--preset", "pi_9t"), "'pi_9t' is not one of pi_5t, pi_6t, pi_7t, pi_5t5r"),
    (("--buffer", "2"), "num_buffer: 2 is not in 0..1"),
])
def test_bad_options_give_one_clear_line(words, said, files, capsys):
    code, document, err = replay(capsys, *files, *words)
    assert (code, document) == (2, None)
    assert said in err


def test_the_table_fits_its_terminal_however_large_the_team(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    step = {"positions": [[12, 13 + i] for i in range(8)], "solved": [True] * 3 + [False] * 37}
    show({"steps": [step, step | {"actions": ["right"] * 7 + ["stay"], "total": [0.25] * 8}],
          "makespan": None, "moves": 7, "true_moves": 7})
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= 80
    assert "…" not in out
    assert [out.count(word) for word in ("right", "stay", "(12,20)", "xxx.......", "+0.2500")] == [
        7, 1, 2, 2, 8]
    show({"steps": [{"positions": [[0, 0], [1, 0]], "solved": [True, False]}], "makespan": None,
          "moves": 0, "true_moves": 0})
    assert "(0,0) (1,0)" in capsys.readouterr().out, "side by side where that fits"


def test_missing_files(files, capsys):
    assert replay(capsys, "nowhere.json", files[1])[0] == 2
    code, _, err = replay(capsys, files[0], "nowhere.json")
    assert code == 2
    assert err == "moonteam: nowhere.json: no such file\n"
