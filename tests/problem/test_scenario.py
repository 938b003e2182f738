"""Scenario files and sets."""

import json
from pathlib import Path

import numpy as np
import pytest

from moonteam.errors import InputError
from moonteam.planners.base import Snapshot
from moonteam.problem import scenario

GOLDEN = Path(__file__).parents[1] / "golden" / "certified_optima.jsonl"


def test_the_golden_set_reads_and_survives_a_round_trip(tmp_path):
    first = scenario.load_set(GOLDEN)
    assert len(first) == 160
    scenario.save_set(tmp_path / "again.jsonl", first)
    assert scenario.load_set(tmp_path / "again.jsonl") == first


@pytest.mark.parametrize(("change", "expected"), [
    (lambda row: row | {"colour": "red"}, "line 12: unknown key `colour`; allowed: size, agents"),
    (lambda row: row | {"targets": []}, "line 12.targets: at least one target"),
    (lambda row: row | {"targets": [row["targets"][0]] * 2}, "line 12.targets[1].at: "),
    (lambda row: row | {"size": [4, 4]}, "off the map; x in 0..3"),
    (lambda row: row | {"agents": [{"at": [1, 1], "skills": []}]}, "line 12.agents[0].skills"),
])
def test_a_bad_row_is_named_by_its_line(tmp_path, change, expected):
    lines = GOLDEN.read_text().splitlines()[:20]
    lines[11] = json.dumps(change(json.loads(lines[11])))
    path = tmp_path / "set.jsonl"
    path.write_text("\n".join(lines))
    with pytest.raises(InputError) as caught:
        scenario.load_set(path)
    assert expected in str(caught.value)


def test_broken_json_and_empty_sets(tmp_path):
    path = tmp_path / "set.jsonl"
    path.write_text(GOLDEN.read_text().splitlines()[0] + "\n{\n")
    with pytest.raises(InputError, match="line 2: is not JSON"):
        scenario.load_set(path)
    path.write_text("\n\n")
    with pytest.raises(InputError, match="holds no scenario"):
        scenario.load_set(path)


def test_a_snapshot_knows_what_holds_at_reset():
    s = scenario.Scenario(
        size=(4, 4),
        agents=(scenario.Agent((1, 2), ("B",)), scenario.Agent((1, 2), ("A",)),
                scenario.Agent((0, 0), ("B",))),
        targets=(scenario.Target((1, 2), ("A", "B"), "AND"), scenario.Target((0, 0), ("A",), "OR"),
                 scenario.Target((3, 3), ("B",), "AND")),
    )
    start = Snapshot.start(s)
    np.testing.assert_array_equal(start.solved, [True, False, False])
    np.testing.assert_array_equal(start.agent_skills, [2, 1, 2])
    # One required skill makes AND and OR the same thing.
    np.testing.assert_array_equal(start.target_and, [True, False, False])


def test_missing_skills_are_named():
    s = scenario.Scenario(
        size=(4, 4), agents=(scenario.Agent((0, 0), ("A",)),),
        targets=(scenario.Target((1, 1), ("A", "B"), "OR"),
                 scenario.Target((2, 2), ("A", "B"), "AND"), scenario.Target((3, 3), ("C",), "OR")),
    )
    assert scenario.missing_skills(s) == {1: ["B"], 2: ["C"]}
