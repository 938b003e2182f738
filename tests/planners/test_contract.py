"""Every registered planner, and a user's, keeps the contract; broken ones are found out."""

import json
from importlib.util import find_spec

import numpy as np
import pytest

from moonteam.cli import main
from moonteam.errors import InputError
from moonteam.planners import contract, registry
from moonteam.planners.base import Snapshot, WholePlanner
from moonteam.planners.kind import PlannerKind, PlannerOptions
from moonteam.problem.scenario import load_set

NEAREST = "examples/nearest_planner.py:NearestPlanner"


@pytest.fixture(scope="module")
def nearest(request):
    return f"{request.config.rootpath}/{NEAREST}"


@pytest.mark.parametrize(("name", "decode"), [
    *((name, "argmax") for name in registry.names()), ("policy", "sample"),
    ("policy", "best-of-8"), ("nearest", "argmax")])
def test_it_keeps_the_contract(name, decode, nearest):
    if name in ("cpsat", "routing") and find_spec("ortools") is None:
        pytest.skip("the extra ortools is not installed")
    results = contract.check(nearest if name == "nearest" else name,
                             PlannerOptions(decode=decode))
    assert [f"{r.name}: {r.problem}" for r in results if not r.passed] == []
    assert len(results) == len(contract.CHECKS)


@pytest.mark.parametrize("objective", ["moves", "weighted"])
@pytest.mark.parametrize("name", ["exact", "lns", "guided"])
def test_it_keeps_the_contract_with_other_objectives(name, objective):
    results = contract.check(name, PlannerOptions(objective, 0.2, 1.0, seed=3))
    assert [r.problem for r in results if not r.passed] == []


BROKEN = '''
import numpy as np
from pathlib import Path

class Base:
    name = "broken"
    def reset(self, snapshot, seed=0): self.count = 0
    def act(self, snapshot): return np.full(len(snapshot.cells), 4, np.int32)

class Shape(Base):
    def act(self, snapshot): return np.zeros(2, np.int32)

class Range(Base):
    def act(self, snapshot): return np.full(len(snapshot.cells), 7, np.int32)

class Closed(Base):
    def act(self, snapshot):
        return np.where(snapshot.agent_mask, [3, 4, 4], 4).astype(np.int32)

class Lost(Base):
    def act(self, snapshot): return np.zeros(len(snapshot.cells), np.int32)

class Writes(Base):
    def act(self, snapshot):
        snapshot.solved[:] = True
        return super().act(snapshot)

class Remembers(Base):
    count = 0
    def reset(self, snapshot, seed=0): pass
    def act(self, snapshot):
        self.count += 1
        return np.array([4, 4, (self.count > 5) * 3], np.int32)

class Random(Base):
    def act(self, snapshot): return np.random.default_rng().integers(0, 5, 3).astype(np.int32)

class Fails(Base):
    def act(self, snapshot):
        return {}["nothing"] if len(snapshot.target_cells) > 3 else super().act(snapshot)

class Small(Base):
    most_targets = 3

class Claims(Base):
    def plan(self, snapshot):
        from moonteam.planners.greedy import GreedyPlanner
        from dataclasses import replace
        return replace(GreedyPlanner().plan(snapshot), makespan=1)

class Mute:
    name = "mute"
    def reset(self, snapshot, seed=0): pass

NUMBER = 5
'''


@pytest.fixture(scope="module")
def broken(tmp_path_factory):
    path = tmp_path_factory.mktemp("mine") / "broken.py"
    path.write_text(BROKEN)
    return path


@pytest.mark.parametrize(("thing", "check", "says"), [
    ("Shape", "legal joint actions", "act returned \\[0, 0\\]; 3 whole numbers"),
    ("Range", "legal joint actions", "of 0 to 4 are needed"),
    ("Closed", "no move into closed ground", "agent 0 was sent into closed ground at \\[2, 0\\]"),
    ("Lost", "a lost robot stays", "agent 0 is lost and was told 0"),
    ("Writes", "legal joint actions", "changed the snapshot's solved"),
    ("Remembers", "reset forgets", "after a reset it decides otherwise"),
    ("Random", "the same seed, the same decisions", "decides otherwise the second time"),
    ("Fails", "a new target", "KeyError: 'nothing'"),
    ("Small", "refuses what is too large", "takes up to 3 targets and does not refuse 4"),
    ("Claims", "whole plans keep what they claim", "claims makespan 1")])
def test_it_finds_what_is_broken(broken, thing, check, says):
    found = {r.name: r.problem for r in contract.check(f"{broken}:{thing}")}
    with pytest.raises(AssertionError, match=says):
        assert not found[check], found[check]


def test_one_that_stays_breaks_nothing(broken):
    assert all(r.passed for r in contract.check(f"{broken}:Base"))


@pytest.mark.parametrize(("name", "says"), [
    ("gredy", "--planner: gredy: no such planner; did you mean greedy\\? registered: exact, "),
    ("FILE:NUMBER", "NUMBER is a int; a planner is a class, or a function that makes one"),
    ("FILE:Smal", "holds no 'Smal'; did you mean Small\\?"),
    ("FILE:Mute", "makes a Mute, which has no act; a planner has reset and act"),
    ("nowhere.py:Mine", "no such file")])
def test_what_is_no_planner(broken, name, says):
    with pytest.raises(InputError, match=says):
        registry.make(name.replace("FILE", str(broken)))


@pytest.mark.parametrize(("options", "says"), [
    ({"objective": "speed"}, "--objective: 'speed' is not one of makespan, moves, weighted"),
    ({"objective": "weighted", "alpha": -1.0}, "alpha -1.0 and beta 0.05 are not allowed"),
    ({"time_limit": 0.0}, "--time-limit: 0.0 is not allowed; seconds above 0"),
    ({"seed": -1}, "--seed: -1 is not allowed; at least 0"),
    ({"preference": 1.5}, "--preference: 1.5 is not allowed"),
    ({"decode": "beam"}, "--decode: 'beam' is not one of")])
def test_options_are_checked_when_they_are_built(options, says):
    with pytest.raises(InputError, match=says):
        PlannerOptions(**options)


def test_every_option_reaches_its_planner():
    options = PlannerOptions("weighted", 2.0, 3.0, 0.25, 7, "any_team_imitated", "best-of-8@0.25",
                             0.5)
    for name in ("exact", "greedy", "lns", "guided", "exhaustive"):
        planner = registry.make(name, options)
        assert (planner.objective, planner.alpha, planner.beta) == ("weighted", 2.0, 3.0)
        if registry.find(name).anytime:
            assert planner.time_limit == 0.25
    assert registry.make("lns", options).seed == 7
    best = registry.make("policy", options)
    assert (best.objective, best.alpha, best.beta, best.preference, best.seed, best.rollouts,
            best.temperature) == ("weighted", 2.0, 3.0, 0.5, 7, 8, 0.25)
    drawn = registry.make("policy", PlannerOptions(
        policy="any_team_imitated", seed=7, decode="sample", preference=0.5))
    assert (drawn.decode, drawn.seed, drawn.preference) == ("sample", 7, 0.5)


def test_one_maker_loads_a_policy_once():
    make = registry.maker("policy", PlannerOptions())
    assert make().policy is make().policy


def test_an_own_planner_is_given_the_options_if_it_takes_them(tmp_path):
    path = tmp_path / "own.py"
    path.write_text(BROKEN + '''
class Named(Base):
    def __init__(self, options=None): self.given = options

class Needs(Base):
    def __init__(self, what): self.given = what

class Usual(Base):
    def __init__(self, speed=3): self.given = speed

class Anytime(Base):
    anytime, most_targets = True, 9
''')
    options = PlannerOptions(seed=5)
    for thing, given in (("Named", options), ("Needs", options), ("Usual", 3)):
        made = registry.make(f"{path}:{thing}", options)
        assert isinstance(made, WholePlanner)
        assert made.planner.given == given
    kind = registry.find(f"{path}:Anytime")
    assert (kind.name, kind.anytime, kind.most_targets) == ("Anytime", True, 9)


def test_registering_one(broken):
    made = registry.make(f"{broken}:Base").planner
    registry.register("mine", PlannerKind("mine", lambda options: made))
    assert registry.names()[-1] == "mine"
    assert registry.make("mine").planner is made
    with pytest.raises(InputError, match="exact: is already the name of a planner"):
        registry.register("exact", type(made))


def test_the_command_says_what_failed(nearest, broken, capsys):
    assert main(["check", "planner", nearest]) == 0
    assert "10 of 10" in capsys.readouterr().out
    assert main(["check", "planner", f"{broken}:Closed", "--json"]) == 1
    document = json.loads(capsys.readouterr().out)
    assert not document["passed"]
    failed = [c["name"] for c in document["checks"] if not c["passed"]]
    assert failed == ["no move into closed ground"]
    assert main(["check", "planner", "exakt"]) == 2
    assert "did you mean exact" in capsys.readouterr().err


def test_best_of_asks_for_what_the_preference_wants(request):
    now = Snapshot.start(load_set(request.config.rootpath / "assets/testsets/3x7.jsonl")[0])
    fast, thrifty = (registry.make("policy", PlannerOptions(
        decode="best-of-64@1", preference=p)).plan(now) for p in (0.0, 1.0))
    assert (fast.objective, thrifty.objective) == ("makespan", "moves")
    assert fast.makespan < thrifty.makespan
    assert thrifty.moves < fast.moves
    assert np.array_equal(fast.actions, registry.make("policy", PlannerOptions(
        "makespan", decode="best-of-64@1")).plan(now).actions)
