"""The shipped scenario sets, and the command that makes them."""

import json

import pytest

from moonteam import cli, paths
from moonteam.commands.testsets import NAMES
from moonteam.planners.base import Snapshot
from moonteam.planners.exact import ExactPlanner
from moonteam.planners.lns import LnsPlanner
from moonteam.planners.search import bounds
from moonteam.planners.search.task import Task
from moonteam.planners.search.travel import travel_times
from moonteam.problem.scenario import Optimal, load_set

FOLDER = paths.assets() / "testsets"
INDEX = json.loads((FOLDER / "index.json").read_text())


def test_the_index_names_every_set():
    assert set(INDEX) == set(NAMES)
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


def test_making_sets_twice_gives_the_same_files(capsys, tmp_path):
    words = ["--seed", "3", "--sets", "2x3", "3x6-blocked", "--count", "4", "--json"]
    assert cli.main(["testsets", "--out", str(tmp_path / "a"), *words]) == 0
    assert cli.main(["testsets", "--out", str(tmp_path / "b"), *words]) == 0
    index = json.loads(capsys.readouterr().out.splitlines()[0])
    assert sorted(index) == ["2x3", "3x6-blocked"]
    for name in index:
        one, two = ((tmp_path / side / f"{name}.jsonl").read_text() for side in "ab")
        assert one == two
        found = load_set(tmp_path / "a" / f"{name}.jsonl")
        assert len(found) == 4
        assert all(isinstance(s.optimal, Optimal) and s.optimal.makespan for s in found)


@pytest.mark.parametrize("words", [["--sets", "9x9"], ["--count", "0"], ["--seed", "-1"]])
def test_wrong_options_of_testsets(capsys, tmp_path, words):
    assert cli.main(["testsets", "--out", str(tmp_path / "sets"), *words]) == 2
    assert "is not allowed" in capsys.readouterr().err
    assert not (tmp_path / "sets").exists()
