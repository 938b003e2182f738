"""The tables as a user gets them: from a command line to report, CSV, Markdown and figure."""

import json
from pathlib import Path

import jax
import numpy as np
import pytest

from moonteam.cli import main
from moonteam.evaluation.contenders import Planned
from moonteam.evaluation.speed import env_speed, timing
from moonteam.policies import entity, policy_file, recurrent
from moonteam.policies.entity import EntitySpec
from moonteam.policies.recurrent import RecurrentSpec

GOLDEN = Path("tests/golden/certified_optima.jsonl")
KEYS = {"success", "makespan", "moves", "M_st", "M_tte", "st_ratio", "tte_ratio",
        "makespan_gap", "moves_gap", "decisions"}


def output(capsys, *words):
    assert main(list(words)) == 0
    return json.loads(capsys.readouterr().out)


def without_times(document):
    """What must be the same whenever the same command runs."""
    return {"rows": document["rows"], "notes": document["notes"], "summary": [
        {k: v for k, v in row.items() if "seconds" not in k} for row in document["summary"]]}


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    spec = RecurrentSpec(num_agents=3, num_targets=5, size=(32, 32), width=8)
    shapes = jax.eval_shape(lambda key: recurrent.init(spec, key), jax.random.key(0))
    rng = np.random.default_rng(1)
    params = jax.tree.map(lambda x: rng.normal(0, 0.5, x.shape).astype(np.float32), shapes)
    path = tmp_path_factory.mktemp("policy") / "tiny.safetensors"
    config = {"num_agents": 3, "num_targets": 5, "size": [32, 32], "width": 8}
    policy_file.save_policy(path, policy_file.PolicyFile("recurrent", config, params))
    return str(path)


@pytest.fixture(scope="module")
def any_team(tmp_path_factory):
    """Random weights that seldom stay."""
    spec = EntitySpec(width=8, heads=2, layers=1)
    shapes = jax.eval_shape(lambda key: entity.init(spec, key), jax.random.key(0))
    rng = np.random.default_rng(1)
    params = jax.tree.map(lambda x: rng.normal(0, 0.3, x.shape).astype(np.float32), shapes)
    params["stay"]["bias"] -= 5.0
    path = tmp_path_factory.mktemp("policy") / "any.safetensors"
    config = {"width": 8, "heads": 2, "layers": 1}
    policy_file.save_policy(path, policy_file.PolicyFile("entity", config, params))
    return str(path)


def test_exact_is_optimal_in_both_objectives_and_greedy_never_better(capsys, tmp_path):
    words = ("evaluate", "grid", str(GOLDEN), "--limit", "10", "--planner", "exact", "--planner",
             "greedy", "--objective", "makespan", "--objective", "moves", "--json")
    document = output(capsys, *words, "--out", str(tmp_path / "run"))
    summary = {row["planner"]: row for row in document["summary"]}
    assert list(summary) == ["exact(makespan)", "exact(moves)", "greedy(makespan)",
                             "greedy(moves)"]
    assert summary["exact(makespan)"]["makespan_gap"] == 0.0
    assert summary["exact(moves)"]["moves_gap"] == 0.0
    assert all(row["success"] == 1.0 for row in summary.values())
    assert all(set(row["intervals"]) == KEYS and set(row) >= KEYS for row in summary.values())
    assert len(document["rows"]) == 40
    for row in document["rows"]:
        assert set(row) == {"id", "planner", "success", "makespan", "moves", "optimal"}
        assert row["makespan"] >= row["optimal"]["makespan"]
        assert row["moves"] >= row["optimal"]["moves"]
    assert set(document["meta"]) == {"command", "seed", "commit", "versions", "hardware"}
    files = {p.name for p in (tmp_path / "run").iterdir()}
    assert files == {"report.json", "summary.csv", "rows.csv", "table.md", "gaps.png",
                     "config.json", "rows.jsonl"}
    assert json.loads((tmp_path / "run" / "report.json").read_text()) == document
    assert (tmp_path / "run" / "rows.csv").read_text().count("\n") == 41
    assert (tmp_path / "run" / "gaps.png").read_bytes()[:4] == b"\x89PNG"
    table = (tmp_path / "run" / "table.md").read_text()
    assert table.startswith("`moonteam evaluate grid")
    assert "| exact(makespan) | 1.000 [0.722, 1.000] |" in table
    # The same command, the same report, but for the times.
    assert without_times(output(capsys, *words)) == without_times(document)


def test_policies_on_sets_one_row_each(capsys, policy, tmp_path):
    lines = [line for line in GOLDEN.read_text().splitlines() if '"3r5t' in line][:3]
    for name in ("first", "second"):
        (tmp_path / f"{name}.jsonl").write_text("\n".join(lines))
    words = ["evaluate", "sets", str(tmp_path / "first.jsonl"), str(tmp_path / "second.jsonl"),
             "--policy", policy, "--best-of", "2", "--limit", "2"]
    document = output(capsys, *words, "--json", "--out", str(tmp_path / "run"))
    assert [row["planner"] for row in document["summary"]] == ["first", "second"]
    for row in document["summary"]:
        assert row["scenarios"] == 2
        assert {"success", "makespan_gap_best", "tte_ratio_effort"} <= row.keys()
        assert row["makespan_gap_best"] <= row["makespan_gap"] + 5.0
    first, second = document["summary"]
    assert first["success"] == second["success"]
    assert main([*words, "--markdown"]) == 0
    assert "| set | success |" in capsys.readouterr().out
    assert main(["evaluate", "sets", "nowhere", "--policy", policy]) == 2


def test_rows_against_one_planner_scenario_by_scenario(capsys):
    words = ["evaluate", "grid", str(GOLDEN), "--limit", "12", "--planner", "exact", "--planner",
             "greedy", "--objective", "makespan", "--objective", "moves"]
    document = output(capsys, *words, "--against", "exact", "--json")
    rows = {row["planner"]: row for row in document["summary"]}
    assert rows["exact(makespan)"]["against"] is rows["exact(moves)"]["against"] is None
    for objective in ("makespan", "moves"):
        one, other = (rows[f"{name}({objective})"] for name in ("greedy", "exact"))
        assert one["against"] == pytest.approx(one["makespan"] / other["makespan"] - 1.0)
        low, high = one["intervals"]["against"]
        assert low <= one["against"] <= high
    assert rows["greedy(makespan)"]["against"] > 0.0
    assert main([*words, "--against", "exact", "--markdown"]) == 0
    assert "| against |" in capsys.readouterr().out
    assert main([*words, "--markdown"]) == 0
    assert "| against |" not in capsys.readouterr().out
    for bad, said in (([*words, "--against", "lns"], "lns is none of the planners: exact, greedy"),
                      (["evaluate", "grid", "seconds/3x5-7", "--against", "exact"], "in steps")):
        assert main(bad) == 2
        assert said in capsys.readouterr().err


def test_planners_on_sets_beside_a_policy(capsys, tmp_path):
    words = ["evaluate", "sets", "3x5", "2x3", "--limit", "3", "--planner", "exact", "--planner",
             "lns", "--time-limit", "0.05"]
    document = output(capsys, *words, "--json", "--out", str(tmp_path / "run"))
    assert [row["planner"] for row in document["summary"]] == [
        "3x5, exact", "3x5, lns", "2x3, exact", "2x3, lns"]
    exact = document["summary"][0]
    assert exact["makespan_gap"] == exact["moves_gap_effort"] == 0.0
    assert exact["success_best"] is None
    assert (tmp_path / "run" / "summary.csv").read_text().count("\n") == 5
    assert main([*words, "--markdown"]) == 0
    assert "| 2x3, lns | 1.000" in capsys.readouterr().out
    for bad, said in ((["--planner", "exact", "5x20"], "takes up to 12 targets; 5x20 has 20"),
                      (["--planner", "exact", "--policy", "any_team", "3x5"], "has no effect")):
        assert main(["evaluate", "sets", *bad]) == 2
        assert said in capsys.readouterr().err


def test_policies_stand_beside_planners(capsys, policy, tmp_path):
    lines = [line for line in GOLDEN.read_text().splitlines() if '"3r5t' in line][:4]
    small = tmp_path / "small.jsonl"
    small.write_text("\n".join(lines))
    document = output(capsys, "evaluate", "grid", str(small), "--planner", "policy", "--policy",
                      policy, "--decode", "argmax", "--decode", "best-of-2", "--json")
    assert [row["planner"] for row in document["summary"]] == [
        "policy(argmax)", "policy(best-of-2)"]
    for row in document["rows"]:
        assert (row["makespan"] is None) == (not row["success"])
    assert any("deadlock watch" in note for note in document["notes"])
    assert main(["evaluate", "grid", str(small), "--markdown"]) == 0
    assert "| exact(makespan) |" in capsys.readouterr().out
    assert main(["evaluate", "grid", "--count", "3", "--targets", "2", "--side", "8"]) == 0
    shown = capsys.readouterr().out
    assert "makespan gap" in shown
    assert "optima solved here" in shown


def test_a_policy_is_swept_from_time_to_effort(capsys, any_team, policy, tmp_path):
    words = ["evaluate", "preference", str(GOLDEN), "--policy", any_team, "--limit", "6",
             "--points", "3", "--decode", "best-of-2@0.5"]
    document = output(capsys, *words, "--json", "--out", str(tmp_path))
    exact = [row for row in document["rows"] if row["planner"] == "exact"]
    assert [row["preference"] for row in exact] == [0.0, 0.5, 1.0]
    assert exact[0]["makespan"] <= exact[1]["makespan"] <= exact[2]["makespan"]
    assert exact[0]["moves"] >= exact[1]["moves"] >= exact[2]["moves"]
    assert exact[0]["makespan"] < exact[2]["makespan"]
    mine = [row for row in document["rows"] if row["planner"] == "policy"]
    assert all(row["makespan"] >= exact[0]["makespan"] for row in mine)
    assert (tmp_path / "preference.png").read_bytes()[:4] == b"\x89PNG"
    assert "| preference | policy: success |" in (tmp_path / "table.md").read_text()
    words[4] = policy
    assert main(words) == 2
    assert "takes no preference" in capsys.readouterr().err
    assert main([*words[:5], "--points", "1"]) == 2


def test_one_scenario_at_a_time_is_said(capsys, any_team):
    words = ("evaluate", "grid", str(GOLDEN), "--limit", "3", "--planner", "policy", "--policy",
             any_team, "--preference", "0.5", "--json")
    batched, alone = output(capsys, *words), output(capsys, *words, "--alone")
    assert batched["rows"] == alone["rows"]
    assert alone["summary"][0]["planner"] == "policy(argmax, preference 0.5)"
    assert "one scenario at a time" in alone["summary"][0]["note"]
    assert "in batches" in batched["summary"][0]["note"]
    assert alone["meta"]["command"].endswith("--alone")


def test_replanning_has_the_oracle_and_both_forms(capsys, tmp_path):
    words = ("evaluate", "replanning", "--count", "4", "--planner", "greedy", "--json")
    document = output(capsys, *words, "--out", str(tmp_path))
    rows = {row["planner"]: row for row in document["summary"]}
    assert list(rows) == ["exact(makespan)", "exact(moves)", "greedy(makespan)"]
    assert rows["exact(makespan)"]["makespan_gap"] == 0.0
    for row in rows.values():
        assert row["M_st"] == pytest.approx(128 - row["makespan"])
        assert row["M_tte"] == pytest.approx(384 - row["moves"])
    assert (tmp_path / "replanning.png").exists()
    assert without_times(output(capsys, *words)) == without_times(document)


def test_interrupted_what_is_done_is_saved(capsys, monkeypatch, tmp_path):
    whole = Planned.run

    def run(self, world, kept):
        if self.kind == "greedy":
            raise KeyboardInterrupt
        return whole(self, world, kept)

    monkeypatch.setattr(Planned, "run", run)
    words = ["evaluate", "grid", str(GOLDEN), "--limit", "3", "--out", str(tmp_path / "out")]
    assert main([*words, "--planner", "exact", "--planner", "greedy"]) == 130
    assert "lacks greedy(makespan)" in capsys.readouterr().err
    saved = json.loads((tmp_path / "out" / "report.json").read_text())
    assert [row["planner"] for row in saved["summary"]] == ["exact(makespan)"]
    assert main([*words[:-1], str(tmp_path / "none"), "--planner", "greedy"]) == 130
    assert not (tmp_path / "none").exists()


def resumed(tmp_path, words, keep):
    """Files of a command's whole run, and of one whose rows were cut off behind the first `keep`
    and half a line, and that was gone on with.
    """
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert main([*words, "--out", str(whole)]) == 0
    parts.mkdir()
    (parts / "config.json").write_bytes((whole / "config.json").read_bytes())
    lines = (whole / "rows.jsonl").read_text().splitlines(keepends=True)
    assert len(lines) > keep
    (parts / "rows.jsonl").write_text("".join(lines[:keep]) + lines[keep][:10])
    assert main([*words, "--resume", "--out", str(parts)]) == 0
    again = (parts / "rows.jsonl").read_text().splitlines(keepends=True)
    assert again[:keep] == lines[:keep]
    assert [json.loads(line)[0] for line in again] == [json.loads(line)[0] for line in lines]
    return whole, parts


@pytest.mark.parametrize("more", [
    ("grid", str(GOLDEN), "--limit", "4", "--planner", "exact", "--planner", "greedy"),
    ("grid", "seconds/3x5-7", "--limit", "4", "--planner", "exact", "--planner", "greedy"),
    ("sets", "2x3", "3x5", "--limit", "3", "--planner", "exact"),
    ("replanning", "--count", "2", "--planner", "greedy")])
def test_rows_that_are_done_are_not_done_again(tmp_path, capsys, more):
    whole, parts = (json.loads((folder / "report.json").read_text())
                    for folder in resumed(tmp_path, ["evaluate", *more], 5))
    plain = [[{k: v for k, v in row.items() if "seconds" not in k and k != "intervals"}
              for row in document["summary"]] for document in (whole, parts)]
    assert plain[0] == plain[1]
    assert [{k: v for k, v in row.items() if k != "seconds"} for row in parts["rows"]] == [
        {k: v for k, v in row.items() if k != "seconds"} for row in whole["rows"]]


def test_a_policys_batch_is_kept_as_a_whole(tmp_path, capsys, any_team):
    words = ["evaluate", "grid", "2x3", "--limit", "3", "--planner", "policy", "--policy",
             any_team, "--planner", "greedy"]
    whole, parts = (json.loads((folder / "report.json").read_text())
                    for folder in resumed(tmp_path, words, 1))
    assert parts["summary"][0] == whole["summary"][0]  # its seconds too
    assert parts["rows"] == whole["rows"]


def test_peers_go_on_too(tmp_path, capsys):
    words = ["evaluate", "peers", "peers/mrta-benchmark", "--limit", "3", "--planner", "exact"]
    whole, parts = (json.loads((folder / "peers.json").read_text())
                    for folder in resumed(tmp_path, words, 2))
    assert parts["rows"] == whole["rows"]
    assert parts["sets"][0]["against"] == whole["sets"][0]["against"]


def test_going_on_needs_the_folder_and_the_same_options(tmp_path, capsys):
    words = ["evaluate", "grid", str(GOLDEN), "--limit", "3", "--planner", "greedy"]
    assert main([*words, "--resume"]) == 2
    assert "--resume: needs the folder" in capsys.readouterr().err
    out = ["--out", str(tmp_path / "out")]
    assert main([*words, "--resume", *out]) == 2
    assert "holds no run to go on with" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert main([*words, *out]) == 0
    assert main([*words, *out, "--resume", "--seed", "1"]) == 2
    assert "made with other options: seed" in capsys.readouterr().err


def broken(tmp_path, text):
    path = tmp_path / "broken.jsonl"
    path.write_text(text)
    return str(path)


def test_a_broken_line_is_named(capsys, tmp_path):
    good = GOLDEN.read_text().splitlines()
    lines = (good * 3)[:400]
    lines[311] = lines[311][:50]
    out = tmp_path / "out"
    path = broken(tmp_path, "\n".join(lines))
    assert main(["evaluate", "grid", path, "--out", str(out)]) == 2
    message = capsys.readouterr().err
    assert "line 312" in message
    assert message.count("\n") == 1
    assert not out.exists()


@pytest.mark.parametrize(("words", "says"), [
    (["--planner", "clever"], "clever: no such planner; registered: exact"),
    (["--objective", "fun"], "'fun' is not one of makespan"),
    (["--planner", "policy", "--policy", "POLICY"], "made for 3 robots and 5 targets"),
    (["--planner", "policy", "--policy", "POLICY", "--decode", "best-of-0"], "best-of-K needs"),
    (["--planner", "policy", "--policy", "POLICY", "--decode", "beam"], "'beam' is not one of"),
    (["--planner", "policy", "--policy", "POLICY", "--preference", "2"], "0 (time) to 1"),
    (["--planner", "policy", "--policy", "POLICY", "--decode", "sample@0"], "above 0"),
    (["--planner", "policy", "--policy", "nowhere"], "no such file"),
    (["--planner", "exact", "--policy", "POLICY"], "no effect"),
    (["--limit", "0"], "at least 1"),
])
def test_bad_wishes_get_one_line(words, says, capsys, policy, tmp_path):
    out = tmp_path / "out"
    words = [policy if word == "POLICY" else word for word in words]
    assert main(["evaluate", "grid", str(GOLDEN), *words, "--out", str(out)]) == 2
    message = capsys.readouterr().err
    assert says in message
    assert message.count("\n") == 1
    assert not out.exists()


@pytest.mark.parametrize(("words", "says"), [
    (["--new", "0"], "at least 1"),
    (["--count", "0"], "at least 1"),
    ([str(GOLDEN), "--new", "9"], "appear later"),
    (["--decode", "best-of-4"], "looks ahead"),
])
def test_bad_wishes_of_replanning_get_one_line(words, says, capsys, tmp_path):
    out = tmp_path / "out"
    assert main(["evaluate", "replanning", *words, "--out", str(out)]) == 2
    message = capsys.readouterr().err
    assert says in message
    assert message.count("\n") == 1
    assert not out.exists()


def timed(name, targets, seconds):
    return {"planner": name, "targets": targets, "seconds": seconds}


def test_the_text_under_the_timing_follows_from_the_measurements():
    rows = [timed(timing.EXACT, 5, 1e-4), timed(timing.EXACT, 10, 2e-2),
            timed(timing.DECISION, 5, 1e-3), timed(timing.DECISION, 10, 1e-3),
            timed(timing.PLAN, 5, 3e-2), timed(timing.PLAN, 10, 3e-2),
            timed("exhaustive(makespan)", 5, 1e-2)]
    said = timing.findings(rows)
    assert "sooner than the policy makes one decision at 5 targets (at 5: 100 us" in said[0]
    assert "longer than the policy makes one decision at 10 targets (at 10: 20 ms" in said[1]
    assert "sooner than the policy rolls out a whole plan at 5 and 10 targets" in said[2]
    assert "100 times as long" in said[3]
    assert len(said) == 4


def test_timing_measures_all_of_them(capsys, tmp_path):
    document = output(capsys, "evaluate", "timing", "--targets", "3", "--count", "2", "--budget",
                      "0.2", "--side", "8", "--best-of", "2", "--json", "--out", str(tmp_path))
    names = [row["planner"] for row in document["rows"]]
    assert names == ["exact(makespan)", "exact(moves)", "exact(weighted)", "greedy(makespan)",
                     "exhaustive(makespan)", "policy, one decision", "policy, whole plan",
                     "policy, best of 2 plans"]
    assert all(0 < row["p10"] <= row["seconds"] <= row["p90"] for row in document["rows"])
    assert (tmp_path / "timing.png").exists()
    assert main(["evaluate", "timing", "--targets", "0"]) == 2


def test_bench_measures_planner_and_env(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(env_speed, "peer", lambda load: None)
    document = output(capsys, "bench", "grid", "--targets", "3", "--count", "2", "--envs", "4",
                      "--agents", "2", "--env-targets", "2", "--steps", "4", "--repeats", "2",
                      "--json", "--out", str(tmp_path))
    assert {(r["objective"], r["what"]) for r in document["planner"]} == {
        (o, w) for o in ("moves", "makespan", "weighted") for w in ("search", "plan")}
    assert document["env"]["env_steps_per_second"]["moonteam"]["median"] > 0
    assert document["env"]["ratio"] is None
    assert any("not installed" in note for note in document["notes"])
    assert main(["bench", "grid", "--targets", "13"]) == 2


def test_without_a_name_all_bundled_sets_in_steps_are_evaluated(capsys):
    assert main(["evaluate", "sets", "--planner", "greedy", "--limit", "1", "--json"]) == 0
    found = [row["planner"] for row in json.loads(capsys.readouterr().out)["summary"]]
    assert len(found) == 16
    assert (found[0], found[-1]) == ("2x3", "8x40")
