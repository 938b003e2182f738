"""Sets by the clock beside sets in steps: which is which, and what is said of a mixed one."""

import json

import pytest

from moonteam import loading
from moonteam.errors import InputError
from moonteam.problem import scenario, timed
from moonteam.problem.timed import Timed

CLOCKED = {"clock": "seconds", "id": "one", "agents": [{"at": [0, 0], "skills": ["A"]}],
           "targets": [{"at": [3.5, 0], "skills": ["A"], "service": 2}]}
STEPS = {"size": [4, 4], "agents": [{"at": [0, 0], "skills": ["A"]}],
         "targets": [{"at": [3, 0], "skills": ["A"], "type": "OR"}]}


def lines(path, *values):
    path.write_text("\n".join(v if isinstance(v, str) else json.dumps(v) for v in values) + "\n")
    return path


def test_a_set_is_written_and_read_back(tmp_path):
    path = lines(tmp_path / "set.jsonl", CLOCKED, "",
                 {**CLOCKED, "id": "two", "metric": "manhattan"})
    found = timed.load_set(path)
    assert [one.id for one in found] == ["one", "two"]
    timed.save_set(tmp_path / "again.jsonl", found)
    assert timed.load_set(tmp_path / "again.jsonl") == found
    assert loading.load(path) == found
    assert loading.load(f"{path}:1") == loading.load(f"{path}:two") == found[1]


def test_load_tells_the_clock_from_steps(tmp_path):
    one = tmp_path / "one.json"
    one.write_text(json.dumps(CLOCKED))
    assert isinstance(loading.load(one), Timed)
    assert loading.load_set(one) == [loading.load(one)]
    one.write_text(json.dumps({**STEPS, "id": "the \"clock\" in a name"}))
    assert isinstance(loading.load(one), scenario.Scenario)
    steps = lines(tmp_path / "steps.jsonl", STEPS, STEPS)
    assert loading.load(steps) == scenario.load_set(steps)
    bundled = loading.load("peers/mrta-benchmark")
    assert isinstance(bundled, list)
    assert all(isinstance(problem, Timed) for problem in bundled)


@pytest.mark.parametrize(("values", "said"), [
    ((CLOCKED, CLOCKED, STEPS), "line 3: is in steps, the first by the clock"),
    ((STEPS, "", CLOCKED), "line 3: is by the clock, the first in steps"),
    ((CLOCKED, {**CLOCKED, "speed": 1}), "line 2: unknown key `speed`"),
    ((CLOCKED, {**CLOCKED, "targets": []}), "line 2.targets: at least one"),
    ((CLOCKED, '{"clock": "seconds", '), "line 2: is not JSON"),
    (({**CLOCKED, "clock": "minutes"},), "line 1.clock"),
])
def test_a_wrong_line_is_named(tmp_path, values, said):
    path = lines(tmp_path / "set.jsonl", *values)
    with pytest.raises(InputError) as caught:
        loading.load(path)
    assert said in str(caught.value)


def test_an_empty_set_holds_no_problem(tmp_path):
    with pytest.raises(InputError, match="holds no problem"):
        timed.load_set(lines(tmp_path / "set.jsonl", ""))
    with pytest.raises(InputError, match="holds no scenario"):
        loading.load(tmp_path / "set.jsonl")


def test_where_steps_are_needed_the_clock_is_refused(tmp_path):
    path = lines(tmp_path / "set.jsonl", CLOCKED)
    with pytest.raises(InputError, match="is by the clock"):
        loading.load_one(path)
    with pytest.raises(InputError, match="holds 2 scenarios; choose one"):
        loading.load_one(lines(tmp_path / "two.jsonl", STEPS, STEPS))
    assert loading.load_one(lines(tmp_path / "just_one.jsonl", STEPS)).size == (4, 4)
