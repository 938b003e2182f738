"""The shipped scenario sets, and the command that makes them."""

import json

import pytest

from moonteam import cli, loading, paths
from moonteam.commands import testsets_seconds
from moonteam.commands.testsets import ALL, NAMES
from moonteam.planners.base import Snapshot
from moonteam.planners.exact import ExactPlanner
from moonteam.planners.lns import LnsPlanner
from moonteam.planners.search import bounds
from moonteam.planners.search.task import Task
from moonteam.planners.search.travel import travel_times
from moonteam.planners.seconds import base, exact
from moonteam.problem import timed
from moonteam.problem.scenario import Optimal, load_set

FOLDER = paths.assets() / "testsets"
INDEX = json.loads((FOLDER / "index.json").read_text())


def test_the_index_names_every_set():
    assert set(INDEX) == set(ALL)
    assert [INDEX[name]["count"] for name in ("3x5", "3x6", "3x7")] == [1000] * 3


@pytest.mark.parametrize("name", NAMES)
def test_shipped_sets_hold_what_the_index_says(name):
    entry = INDEX[name]
    found = load_set(FOLDER / f"{name}.jsonl")
    assert len(found) == entry["count"]
    assert len({s.id for s in found}) == len(found)
    assert {(len(s.agents), len(s.targets)) for s in found} == {
        (entry["agents"], entry["targets"])}
    assert all((s.blocked is not None) == bool(entry["blocked"]) for s in found)
    assert (FOLDER / f"{name}.jsonl").stat().st_size < 1_000_000
    for s in found[::max(1, len(found) // 4)]:
        snapshot = Snapshot.start(s)
        if entry["optima"] == "exact":
            for objective in ("makespan", "moves"):
                plan = ExactPlanner(objective).plan(snapshot)
                assert getattr(plan, objective) == getattr(s.optimal, objective)
            continue
        low_makespan, low_moves = bounds.lower_bounds(Task.of(snapshot, travel_times(snapshot)))
        assert low_makespan <= s.optimal.bound_makespan <= s.optimal.best_makespan
        assert low_moves <= s.optimal.bound_moves <= s.optimal.best_moves
        quick = LnsPlanner("moves", iterations=200).plan(snapshot)
        assert quick.moves >= s.optimal.bound_moves
        assert quick.makespan >= s.optimal.bound_makespan


@pytest.mark.parametrize("name", testsets_seconds.NAMES)
def test_shipped_sets_by_the_clock_hold_what_the_index_says(name):
    entry, path = INDEX[name], FOLDER / f"{name}.jsonl"
    found = timed.load_set(path)
    assert len(found) == len({one.id for one in found}) == entry["count"] == 1000
    assert {len(one.agents) for one in found} == {entry["agents"]}
    assert {len(one.targets) for one in found} == set(
        range(entry["targets"][0], entry["targets"][1] + 1))
    assert {agent.speed for one in found for agent in one.agents} == set(entry["speeds"])
    assert path.stat().st_size < 1_000_000
    for one in found[::250]:
        plan = exact.ExactPlanner().plan(base.moment(one))
        assert plan.makespan == round(base.MS * one.optimal.makespan)


def test_making_sets_twice_gives_the_same_files(capsys, tmp_path):
    words = ["--seed", "3", "--count", "4", "--json",
             "--sets", "2x3", "3x6-blocked", "seconds/3x5-7"]
    assert cli.main(["testsets", "--out", str(tmp_path / "a"), *words]) == 0
    assert cli.main(["testsets", "--out", str(tmp_path / "b"), *words]) == 0
    index = json.loads(capsys.readouterr().out.splitlines()[0])
    assert sorted(index) == ["2x3", "3x6-blocked", "seconds/3x5-7"]
    for name in index:
        one, two = ((tmp_path / side / f"{name}.jsonl").read_text() for side in "ab")
        assert one == two
        found = loading.load_set(tmp_path / "a" / f"{name}.jsonl")
        assert len(found) == 4
        assert all(isinstance(s.optimal, Optimal | timed.Known) and s.optimal.makespan
                   for s in found)


def test_a_set_is_searched_again_and_keeps_what_was_better(capsys, tmp_path):
    words = ["testsets", "--out", str(tmp_path), "--sets", "8x40"]
    assert cli.main([*words, "--count", "6", "--iterations", "40", "--starts", "1"]) == 0
    first = loading.load_set(tmp_path / "8x40.jsonl")
    assert cli.main([*words, "--better", "--iterations", "2000", "--starts", "1", "--json"]) == 0
    entry = json.loads(capsys.readouterr().out.splitlines()[-1])["8x40"]
    assert entry["optima"] == ("best of 1 x 40 iterations of lns, then makespans of 1 x 2000 "
                               "iterations of guided, with lower bounds")
    found = loading.load_set(tmp_path / "8x40.jsonl")
    spans = [[s.optimal.best_makespan for s in some] for some in (first, found)]
    assert all(b <= a for a, b in zip(*spans, strict=True))
    assert sum(spans[1]) < sum(spans[0])
    assert entry["mean_best_makespan"] == round(sum(spans[1]) / 6, 3)
    for a, b in zip(first, found, strict=True):
        assert (a.agents, a.targets, a.optimal.best_moves) == (
            b.agents, b.targets, b.optimal.best_moves)
    assert cli.main([*words, "--better", "--force"]) == 2
    assert cli.main(["testsets", "--out", str(tmp_path), "--sets", "5x20", "--better"]) == 2
    assert "holds no 5x20.jsonl" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["--sets", "9x9"], ["--count", "0"], ["--seed", "-1"],
                                   ["--speeds", "0"]])
def test_wrong_options_of_testsets(capsys, tmp_path, words):
    assert cli.main(["testsets", "--out", str(tmp_path / "sets"), *words]) == 2
    said = capsys.readouterr().err
    assert "is not allowed" in said or "is not one of" in said
    assert not (tmp_path / "sets").exists()
