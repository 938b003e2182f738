"""Planners by the clock in tables: what is judged, counted, compared and saved."""

import json
from pathlib import Path

import numpy as np
import pytest

from moonteam import cli, loading, paths
from moonteam.errors import InputError
from moonteam.evaluation import peers, timed
from moonteam.evaluation.contenders import Options
from moonteam.planners.kind import PlannerOptions
from moonteam.planners.seconds import base, registry
from moonteam.report.intervals import Bootstrap

FILE = Path(__file__).with_name("nearest.py")
SET = "peers/mrta-benchmark"


@pytest.fixture(scope="module")
def problems():
    return loading.load(SET)


def rows(*names, **options):
    return timed.contenders(Options([f"{FILE}:{name}" for name in names], **options))


def test_a_published_schedule_is_feasible_and_takes_what_they_say(problems):
    """Start times of optimal_schedule_1p_000000.json (MRTA-Benchmark, CC BY 4.0)."""
    now = base.moment(problems[0])
    published = {6: (21.84033, (0,)), 2: (170.52282, (0, 2)), 1: (308.93941, (0,)),
                 4: (467.23872, (0,)), 8: (23.769729, (1, 2)), 7: (109.53946, (1,)),
                 3: (216.8104, (1,)), 5: (312.69273, (2,))}
    services, free, where = [], {}, {}
    for task, (_, team) in sorted(published.items(), key=lambda item: item[1][0]):
        j = task - 1
        start = max(int(now.start[a, j]) if a not in where else free[a] + int(
            now.between[0, where[a], j]) for a in team)
        assert start == pytest.approx(1000 * published[task][0], abs=2)
        for a in team:
            where[a], free[a] = j, start + int(now.service[j])
        services.append(base.Service(j, team, start, start + int(now.service[j])))
    assert base.problems(now, tuple(services)) == []
    assert base.makespan(now, tuple(services)) == pytest.approx(570167.11, abs=2)


def test_the_exact_planner_proves_the_published_optima_again(problems):
    document = timed.evaluate(problems, timed.contenders(Options(["exact", "greedy"])), 0, "", "")
    exact, greedy = document["summary"]
    assert exact["certified"] == 1.0
    for row in document["rows"][:len(problems)]:
        assert row["makespan"] == pytest.approx(row["optimal"]["makespan"], abs=0.005)
    assert greedy["success"] == 1.0
    assert greedy["makespan_gap"] > abs(exact["makespan_gap"])


def test_every_figure_is_in_the_sets_own_unit(problems):
    document = timed.evaluate(problems, rows("Nearest"), 0, "title", "command")
    row, = document["summary"]
    assert row["planner"] == "Nearest(makespan)"
    assert row["success"] == 1.0
    assert row["certified"] == 0.0
    best = [one.optimal.makespan for one in problems]
    mean = np.mean([one["makespan"] for one in document["rows"]])
    assert row["makespan"] == pytest.approx(mean)
    assert row["makespan_gap"] == pytest.approx(mean / np.mean(best) - 1)
    assert row["makespan_gap"] > 0.05
    assert [one["optimal"]["makespan"] for one in document["rows"]] == best
    assert all(one["effort"] > 100 and one["seconds"] > 0 for one in document["rows"])
    assert "interrupted" not in document


def test_what_breaks_the_rules_or_is_no_plan_counts_as_a_failure(problems):
    document = timed.evaluate(problems, rows("Boaster", "Declines"), 0, "", "")
    for row in document["summary"]:
        assert row["success"] == row["certified"] == 0.0
        assert np.isnan(row["makespan"])
    assert all(row["makespan"] is None for row in document["rows"])
    said, = (note for note in document["notes"] if "Boaster" in note)
    assert "5 plans break the rules" in said
    assert "1p_000000: target" in said


def test_an_interrupted_table_has_what_was_done(problems, monkeypatch):
    row, = rows("Quitter")
    monkeypatch.setattr(type(row.planner), "left", 3)
    document = timed.evaluate(problems, [*rows("Nearest"), row, *rows("Boaster")], 0, "", "")
    assert document["interrupted"] == ["Quitter(makespan)", "Boaster(makespan)"]
    assert [row["scenarios"] for row in document["summary"]] == [5, 2]
    assert len(document["rows"]) == 7
    assert document["summary"][1]["success"] == 1.0  # of those that were planned
    monkeypatch.setattr(type(row.planner), "left", 1)
    with pytest.raises(KeyboardInterrupt):
        timed.evaluate(problems, [row], 0, "", "")


def test_rows_for_objectives_and_limits_and_what_is_refused(problems):
    names = [row.name for row in rows("Nearest", objectives=("makespan", "effort"),
                                      time_limits=(1.0, 0.5))]
    assert names == ["Nearest(makespan, 1 s)", "Nearest(makespan, 0.5 s)",
                     "Nearest(effort, 1 s)", "Nearest(effort, 0.5 s)"]
    for options, said in (({"objectives": ("speed",)}, "--objective"),
                          ({"time_limits": (-1.0,)}, "--time-limit"),
                          ({"decodes": ("sample",)}, "--decode"), ({"alone": True}, "--alone"),
                          ({"preferences": (0.5,)}, "--preference")):
        with pytest.raises(InputError, match=said):
            rows("Nearest", **options)
    with pytest.raises(InputError, match="same name"):
        timed.contenders(Options([f"{FILE}:Nearest", f"{FILE.parent}/./{FILE.name}:Nearest"]))


def test_the_registry_says_what_is_no_planner():
    assert registry.names()[:5] == ("exact", "greedy", "lns", "cpsat", "routing")
    kind = registry.find(f"{FILE}:Quitter")
    assert (kind.name, kind.most_targets, kind.anytime) == ("Quitter", 8, True)
    assert kind.make(PlannerOptions(objective="moves")).objective == "effort"
    with pytest.raises(InputError, match="no such planner by the clock; did you mean exact"):
        registry.find("exat")
    with pytest.raises(InputError, match="a int is no planner by the clock"):
        registry.find(f"{FILE}:NOT_A_PLANNER")
    with pytest.raises(InputError, match="which has no plan"):
        registry.find(f"{FILE}:makes_nothing").make(PlannerOptions())


@pytest.mark.parametrize("name", ["exact", "greedy", "lns", "exhaustive"])
def test_planners_of_ours_are_found_and_take_their_options(name):
    planner = registry.find(name).make(PlannerOptions(time_limit=0.2, seed=3))
    now = base.moment(base.TRIAL)
    plan = planner.plan(now)
    assert base.problems(now, plan.services) == []
    assert plan.makespan == base.makespan(now, plan.services)


def test_small_sets_are_planned_by_exact_too_where_no_planner_is_named(problems):
    assert [row.name for row in peers.contenders(problems, Options(()))] == ["exact", "lns"]
    large = loading.load("peers/heteromrta")
    assert [row.name for row in peers.contenders(large, Options((), time_limits=(0.5, 2.0)))] == [
        "lns(0.5 s)", "lns(2 s)"]


def test_differences_are_paired_and_counted():
    ours = np.array([9.0, 10.005, 12.0, np.nan, 5.0])
    theirs = np.array([10.0, 10.0, 10.0, 10.0, np.nan])
    found = peers.compared("ours", ours, "theirs", theirs, Bootstrap(5, 0))
    assert [found[key] for key in ("problems", "shorter", "equal", "longer")] == [3, 1, 1, 1]
    assert found["difference"]["mean"] == pytest.approx(1.005 / 3)
    assert found["share"]["mean"] == pytest.approx(31.005 / 30 - 1)
    assert found["difference"]["low"] < 0 < found["difference"]["high"]


def output(capsys, *words):
    code = cli.main(list(words))
    return code, json.loads(capsys.readouterr().out)


def test_evaluate_grid_takes_a_set_by_the_clock(capsys, tmp_path):
    code, document = output(capsys, "evaluate", "grid", SET, "--planner", f"{FILE}:Nearest",
                            "--limit", "3", "--out", str(tmp_path), "--json")
    assert code == 0
    assert [row["id"] for row in document["rows"]] == ["1p_000000", "1p_000001", "1p_000002"]
    assert set(document["rows"][0]) >= {"id", "planner", "success", "makespan", "effort",
                                        "seconds", "optimal"}
    assert {p.name for p in tmp_path.iterdir()} == {
        "report.json", "summary.csv", "rows.csv", "table.md", "gaps.png", "config.json",
        "rows.jsonl"}
    header, first, *_ = (tmp_path / "rows.csv").read_text().splitlines()
    assert header == "id,planner,success,makespan,effort,seconds,status,optimal_makespan"
    assert first.startswith("1p_000000,Nearest(makespan),1,")
    assert document["meta"]["command"] == (
        f"moonteam evaluate grid {SET} --limit 3 --planner {FILE}:Nearest")


def test_evaluate_peers_holds_ours_against_every_published_column(capsys, tmp_path):
    code, document = output(capsys, "evaluate", "peers", "--planner", f"{FILE}:Nearest",
                            "--limit", "2", "--out", str(tmp_path), "--json")
    assert code == 0
    assert [one["set"] for one in document["sets"]] == ["dcmrta", "heteromrta", "mrta-benchmark"]
    first = document["sets"][0]
    assert [row["name"] for row in first["planners"]] == ["Nearest"]
    assert {row["published"] for row in first["against"]} == {
        "CTAS-D 300s", "OR-Tools", "REINFORCE IA", "REINFORCE LF"}
    for one in document["sets"]:
        assert one["problems"] == 2
        for row in one["against"]:
            assert row["shorter"] + row["equal"] + row["longer"] == 2
            assert row["difference"]["low"] <= row["difference"]["mean"]
    row = document["rows"][-1]
    assert (row["set"], row["id"], row["published"]) == (
        "mrta-benchmark", "1p_000001", {"MILP": 541.91373})
    assert {p.name for p in tmp_path.iterdir()} == {
        "peers.json", "table.md", "rows.csv", "rows.jsonl", "config.json"}
    assert len((tmp_path / "rows.csv").read_text().splitlines()) == 1 + 2 * (5 + 2 + 2)


def test_one_optimum_of_two_hundred_is_none(capsys):
    """What is published for 1p_000080 takes 15 units longer than the exact planner's proof."""
    with_limit = ("--limit", "81", "--planner", "exact", "--json")
    code, document = output(capsys, "evaluate", "peers", "optima/mrta-benchmark", *with_limit)
    assert code == 0
    row, = document["sets"][0]["against"]
    assert (row["shorter"], row["equal"], row["longer"]) == (1, 80, 0)
    last = document["rows"][80]
    assert (last["id"], last["published"]) == ("1p_000080", {"MILP": 653.82295})
    assert last["makespan"] == {"exact": 638.741}


def test_an_interrupted_comparison_is_saved(capsys, tmp_path, monkeypatch):
    row, = rows("Quitter")
    monkeypatch.setattr(type(row.planner), "left", 3)
    code = cli.main(["evaluate", "peers", SET, "peers/heteromrta", "--planner",
                     f"{FILE}:Nearest", "--planner", f"{FILE}:Quitter", "--json"])
    said = capsys.readouterr()
    assert code == 2
    assert "--planner Quitter(makespan): takes at most 8 targets; env_0 has 20" in said.err
    code = cli.main(["evaluate", "peers", SET, "--planner", f"{FILE}:Nearest", "--planner",
                     f"{FILE}:Quitter", "--out", str(tmp_path), "--json"])
    said = capsys.readouterr()
    assert code == 130
    assert "lacks mrta-benchmark: Quitter" in said.err
    document = json.loads(said.out)
    assert document["interrupted"] == ["mrta-benchmark: Quitter"]
    assert [row["problems"] for row in document["sets"][0]["planners"]] == [5, 2]
    assert json.loads((tmp_path / "peers.json").read_text()) == document


@pytest.mark.parametrize(("words", "said"), [
    (["peers", "3x5"], "3x5: is in steps"), (["peers", "nowhere.jsonl"], "nowhere.jsonl: no such"),
    (["peers", "--limit", "0"], "--limit: 0 is not allowed"),
    (["peers", "--planner", "best"], "no such planner by the clock"),
    (["grid", SET, "--planner", "best"], "no such planner by the clock"),
    (["grid", SET, "--policy", "any_team"], "--policy: has no effect"),
    (["grid", SET, "--threads", "2"], "--threads: has no effect without a planner that takes"),
    (["grid", SET, "--planner", "lns", "--threads", "0"], "--threads: 0 is not allowed"),
    (["grid", "3x5", "--planner", "exact", "--threads", "2"], "--threads: has no effect without"),
    (["replanning", SET, "--planner", "greedy"], "is by the clock"),
])
def test_what_cannot_be_is_one_line(capsys, words, said):
    assert cli.main(["evaluate", *words]) == 2
    captured = capsys.readouterr()
    assert said in captured.err
    assert captured.err.count("\n") == 1
    assert captured.out == ""


def test_nothing_published_is_nothing_to_compare_with(capsys, tmp_path):
    line = (paths.assets() / "testsets/peers/mrta-benchmark.jsonl").read_text().splitlines()[0]
    bare = json.loads(line)
    del bare["optimal"]
    (tmp_path / "bare.jsonl").write_text(json.dumps(bare))
    assert cli.main(["evaluate", "peers", str(tmp_path / "bare.jsonl")]) == 2
    assert "holds nothing published" in capsys.readouterr().err
