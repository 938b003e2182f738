"""Rows made in parts: the report of a run in one process, each result noted once under its name."""

import json
from contextlib import nullcontext

import pytest

from moonteam.cli import main
from moonteam.commands import evaluate_grid

SETS = (("3x5", "exact"), ("seconds/3x5-7", "greedy"))


class Here:
    """A cluster in this process; after so many pieces somebody presses Ctrl-C."""

    name = "here"

    def __init__(self, patience=1000):
        self.patience, self.made = patience, 0

    def size(self, count):
        return 2

    def done(self, work, pieces):
        for number in reversed(range(len(pieces))):
            if self.made == self.patience:
                raise KeyboardInterrupt
            self.made += 1
            yield number, work(*pieces[number])


def plain(value):
    """A report without the times that it states."""
    if isinstance(value, dict):
        return {key: plain(one) for key, one in value.items() if "seconds" not in key}
    return [plain(one) for one in value] if isinstance(value, list) else value


@pytest.mark.parametrize(("name", "planner"), SETS)
def test_on_a_cluster_and_here_are_exchanged(monkeypatch, capsys, tmp_path, name, planner):
    words = ["evaluate", "grid", name, "--limit", "5", "--planner", planner, "--json", "--out"]

    def report(out, workers, *more):
        monkeypatch.setattr(evaluate_grid, "cluster", lambda on: nullcontext(workers))
        capsys.readouterr()
        code = main([*words, str(tmp_path / out), *more])
        text = capsys.readouterr().out
        return code, plain(json.loads(text)) if text else None

    def names(out):
        rows = (tmp_path / out / "rows.jsonl").read_text().splitlines()
        return sorted(json.loads(row)[0] for row in rows)

    whole, there = report("here", None), report("away", Here())
    assert whole[0] == 0
    assert there[1]["summary"] == whole[1]["summary"]
    assert there[1]["rows"] == whole[1]["rows"]
    assert names("away") == names("here")
    assert report("cut", Here(patience=1)) == (130, None)
    assert len(names("cut")) == 1
    again = Here()
    assert report("cut", again, "--resume")[1]["rows"] == whole[1]["rows"]
    assert again.made == 2
    for out, workers in (("away", None), ("here", Here(patience=0))):
        assert report(out, workers, "--resume")[1]["rows"] == whole[1]["rows"]
