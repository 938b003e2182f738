"""`moonteam testsets import`: from a folder as others have it to a set that is evaluated."""

import json
import math

import pytest

from moonteam import cli
from moonteam.problem import timed

AT = [[0, 0], [3, 4], [6, 8], [6, 0]]


@pytest.fixture
def folder(tmp_path):
    for n in (0, 10, 2):
        problem = {"Q": [[1]], "R": [[0], [1], [1], [0]], "T_e": [0, 1, 2, 0],
                   "T_t": [[math.dist(a, b) for b in AT] for a in AT], "task_locations": AT}
        for kind, name, value in (("problem_instances", "problem_instance", problem),
                                  ("solutions", "optimal_schedule", {"makespan": 21.0 + n})):
            path = tmp_path / "raw" / kind / f"{name}_{n}.json"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps(value))
    return tmp_path / "raw"


def imported(folder, out, *words):
    return cli.main(["testsets", "import", str(folder), "--format", "mrta-benchmark",
                     "--out", str(out), *words])


def test_a_folder_becomes_a_set(capsys, tmp_path, folder):
    out = tmp_path / "new" / "set.jsonl"
    assert imported(folder, out) == 0
    said = capsys.readouterr().out
    assert "3 problems, 1 agents, 2 targets, 1 skills; 3 optima" in said
    assert "published, MILP: 3 problems, mean makespan 25.000" in said
    assert [one.id for one in timed.load_set(out)] == ["0", "2", "10"]
    assert imported(folder, out, "--limit", "2", "--json", "--force") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["published"] == {"MILP": {"problems": 2, "mean": 22.0}}
    assert len(timed.load_set(out)) == 2


def test_a_set_is_written_whole_or_not_at_all(capsys, tmp_path, folder):
    out = tmp_path / "set.jsonl"
    out.write_text("what was there\n")
    broken = folder / "problem_instances" / "problem_instance_10.json"
    broken.write_text('{"Q": [[1]]}')
    assert imported(folder, out, "--force") == 2
    assert "problem_instance_10.json" in capsys.readouterr().err
    assert out.read_text() == "what was there\n"


@pytest.mark.parametrize(("words", "said"), [
    (["--format", "mrta"], "--format: mrta: no such format of instances"),
    (["--out", "set.json"], "a set ends in .jsonl"),
    (["--limit", "0"], "--limit: 0 is not allowed"),
])
def test_wrong_options(capsys, tmp_path, folder, words, said):
    assert imported(folder, tmp_path / "set.jsonl", *words) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "set.jsonl").exists()


def test_a_format_of_ones_own(capsys, tmp_path):
    (tmp_path / "mine.py").write_text(
        "from moonteam.problem.importers import Importer\n"
        "from moonteam.problem.timed import Agent, Target, Timed\n"
        "MINE = Importer('mine', 'nowhere', lambda folder: [Timed('seconds', "
        "(Agent((0.0, 0.0), ('A',)),), (Target((1.0, 0.0), ('A',)),), id=folder.name)])\n")
    words = ["testsets", "import", str(tmp_path), "--out", str(tmp_path / "set.jsonl")]
    assert cli.main([*words, "--format", f"{tmp_path / 'mine.py'}:MINE"]) == 0
    assert timed.load_set(tmp_path / "set.jsonl")[0].id == tmp_path.name
