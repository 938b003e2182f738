"""Whatever a file holds, what comes out is a right value or one line."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from moonteam import files, loading, paths
from moonteam.grid.scenarios import to_problem
from moonteam.planners.base import Snapshot
from moonteam.planners.seconds import base
from moonteam.problem.mission import Mission
from moonteam.problem.scenario import Scenario
from moonteam.problem.timed import Timed
from tests.fuzz import elevations, policies, states
from tests.fuzz.mutation import Pairs, changes, harm, harmed, mutated, put, tree_of, written
from tests.fuzz.watch import answer

FEW, ROUND, MANY = 60, 2500, 100_000
MOST_YAML = 1 << 14
"""Bytes: PyYAML reads some 60,000 a second, and a second is what an input has."""
EVENTS = [
    {"at_decision": 3, "lost": "rover"},
    {"at_decision": 4, "slow": {"robot": "hopper", "factor": 0.5}},
    {"at_decision": 5, "silent": {"robot": "hopper", "decisions": 2}},
    {"at_decision": 6, "impassable": {"kind": "legged", "at": [0, 0]}},
    {"at_decision": 7, "target": {"at": [1, 1], "skills": ["A"]}}]

BLOCKED = {
    "size": [6, 5], "id": "b", "max_steps": 64, "blocked": {"*": [[1, 1]], "drone": [[2, 1]]},
    "agents": [{"at": [0, 0], "skills": ["A", "drill"], "kind": "drone"}],
    "targets": [{"at": [3, 3], "skills": ["drill"], "type": "OR"}],
    "optimal": {"makespan": 6, "moves": 6, "bound_moves": 6}}


@dataclass
class Kind:
    """A kind of file: what right ones hold, how one is written, and who reads it."""

    name: str
    seeds: list[Any]
    write: Callable[[Path, Any, int], Path]
    read: Callable[[Path], object]
    share: int
    """Of a hundred inputs."""
    make: Callable[[Path], list[Any]] | None = None
    """What makes the right ones, where they are not at hand."""
    said: Counter = field(default_factory=Counter)


    def ready(self, folder: Path) -> None:
        if self.make and not self.seeds:
            self.seeds = self.make(folder)


def text_file(suffix: str) -> Callable[[Path, Any, int], Path]:
    def write(folder: Path, tree: Any, harm: int) -> Path:
        lines = tree if suffix == ".jsonl" and not isinstance(tree, Pairs) else [tree]
        text = tree if isinstance(tree, str) else "\n".join(map(written, lines))
        data = text.encode("utf-8", "surrogatepass")
        return put(folder / f"input{suffix}",
                   harmed(data[:MOST_YAML] if suffix == ".yaml" else data, harm))

    return write


def missions() -> list[Any]:
    texts = [paths.find(name, "missions", ".yaml").read_text()
             for name in ("demo", "outpost", "sampling")]
    return [*texts, *(tree_of(yaml.safe_load(text)) for text in texts),
            tree_of(yaml.safe_load(texts[1]) | {"events": EVENTS})]


def lines(name: str, count: int) -> list[Any]:
    path = paths.find(name, "testsets", ".jsonl")
    return [tree_of(json.loads(line)) for line in path.read_text().splitlines()[:count]]


def read_mission(path: Path) -> None:
    found = loading.load_mission(str(path))
    again = path.with_name("again.yaml")
    put(again, files.dump_json(found).encode())
    assert loading.load_mission(str(again)) == found
    used(found.scenario())


def read_problems(path: Path) -> None:
    found: Any = loading.load(path)
    several = found if isinstance(found, list) else [found]
    again = path.with_name("again.jsonl")
    put(again, "\n".join(map(files.dump_json, several)).encode())
    assert loading.load(again) == several
    for one in several:
        used(one)


def used(one: Mission | Scenario | Timed) -> None:
    """As the planners take it."""
    if isinstance(one, Timed):
        moment = base.moment(one)
        assert (moment.start >= 0).all()
        assert (moment.between >= 0).all()
        return
    snapshot = Snapshot.start(one)
    assert (snapshot.agent_skills > 0).all()
    problem, cells = to_problem(one)
    assert np.array_equal(np.asarray(cells), snapshot.cells)
    assert np.array_equal(np.asarray(problem.target_skills), snapshot.target_skills)


PLAIN = [
    Kind("missions", missions(), text_file(".yaml"), read_mission, 15),
    Kind("scenarios", [*lines("3x5", 3), *lines("4x6-3skills", 1), tree_of(BLOCKED)],
         text_file(".json"), read_problems, 25),
    Kind("test sets", [lines("2x3", 3), lines("5x5", 2), [*lines("2x3", 1), *lines("3x5", 1)]],
         text_file(".jsonl"), read_problems, 10),
    Kind("timed problems", [*lines("seconds/3x5-7", 4), *lines("peers/mrta-benchmark", 2)],
         text_file(".json"), read_problems, 20),
]


MADE = [Kind("policies", [], policies.write, policies.read, 10, policies.seeds),
        Kind("elevation models", [], elevations.write, elevations.read, 15, elevations.seeds),
        Kind("checkpoints", [], states.write, states.read, 5, states.seeds)]
KINDS = [*PLAIN, *MADE]


def attack(kind: Kind, folder: Path, number: int, count: int) -> None:
    kind.ready(folder)
    for tree in kind.seeds:  # read once, unwatched: what is imported and traced counts for nobody
        kind.read(kind.write(folder, tree, 0))

    @seed(number)
    @settings(max_examples=count, deadline=None, database=None,
              phases=(Phase.generate, Phase.shrink),
              suppress_health_check=list(HealthCheck))
    @given(st.sampled_from(range(len(kind.seeds))), changes, harm)
    def one(which: int, bits: list, harms: int) -> None:
        tree = kind.seeds[which]
        tree = tree if isinstance(tree, str) else mutated(tree, bits)
        path = kind.write(folder, tree, harms)
        kind.said[answer(lambda: kind.read(path))] += 1

    one()


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_a_few(kind, tmp_path):
    attack(kind, tmp_path, 0, FEW)
    assert min(kind.said["read"], kind.said["refused"]) > 5
    assert kind.said.total() >= FEW


@pytest.mark.soak
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_a_hundred_thousand(kind, tmp_path, capsys):
    """In rounds, lest hypothesis remembers too much; says how many came out how."""
    kind.said.clear()
    count = MANY * kind.share // 100
    for number in range(1, count // ROUND + 1):
        attack(kind, tmp_path, number, ROUND)
    assert kind.said.total() >= count
    with capsys.disabled():
        print(f"\n{kind.name}: {kind.said['read']:,} read, {kind.said['refused']:,} refused")
