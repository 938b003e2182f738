"""Imitation: labels are the oracle's, memory is a ring, a resumed run is the same run."""

import dataclasses
import json

import jax
import numpy as np
import pytest

from moonteam.cli import main
from moonteam.errors import InputError
from moonteam.interrupts import Stop
from moonteam.planners.base import Snapshot
from moonteam.planners.exact import ExactPlanner
from moonteam.planners.learned import LearnedPlanner
from moonteam.policies.entity import EntitySpec
from moonteam.policies.policy_file import load_policy
from moonteam.problem.scenario import Agent, Scenario, Target
from tests.killed import kill_when_saved
from training.commands import imitate
from training.run import checkpoints, metrics
from training.run.machine import Diverged, Run
from training.teacher import pupil
from training.teacher.families import TIE_BREAK, Family, begin
from training.teacher.imitation import Dagger, Imitation, label, unlabelled
from training.teacher.pupil import Memory

SMALL = Family(2, 2, sides=(4, 6), max_steps=24)
TINY = Imitation(families=(SMALL,), spec=EntitySpec(width=16, heads=2, layers=1), rounds=30,
                 num_envs=16, capacity=64, batch_size=32, batches=1, lr=5e-3)


def test_labels_point_where_the_exact_planner_goes():
    walk = begin(SMALL, None, jax.random.key(3), 24)
    sample = label(SMALL, None, walk, threads=1)
    problem, cells = sample.states.problem, sample.states.cells
    for e in range(24):
        wish = float(sample.preference[e])
        planner = ExactPlanner("weighted", alpha=1 - wish + TIE_BREAK, beta=wish + TIE_BREAK)
        plan = planner.plan(Snapshot(
            size=(6, 6), cells=cells[e], agent_skills=problem.agent_skills[e],
            agent_kinds=problem.agent_kinds[e], agent_mask=problem.agent_mask[e],
            target_cells=problem.target_cells[e], target_skills=problem.target_skills[e],
            target_and=problem.target_and[e], solved=sample.states.solved[e]))
        first = {}
        for visit in sorted(plan.schedule, key=lambda v: v.step):
            for agent in visit.agents:
                first.setdefault(agent, visit.target)
        pointed = {n: int(t) for n, t in enumerate(sample.pointer[e]) if t < 2}
        # Whoever is pointed at a target is in the plan's schedule at it, first of all.
        assert pointed == first


def test_memory_is_a_ring():
    walk = begin(SMALL, None, jax.random.key(0), 4)
    memory = Memory(8, unlabelled(walk))
    sample = label(SMALL, None, walk, threads=1)
    for value in range(3):
        memory.add(sample._replace(place=np.full(4, value, np.int32)))
    np.testing.assert_array_equal(memory.rows.place, [2] * 4 + [1] * 4)
    drawn = memory.draw(np.random.default_rng(0), 64)
    assert set(np.asarray(drawn.place)) == {1, 2}


def test_learning_lowers_the_loss():
    dagger = Dagger(TINY)
    losses = [float(dagger.round().loss) for _ in range(30)]
    assert np.mean(losses[-5:]) < 0.85 * np.mean(losses[:5])


@pytest.mark.parametrize("family", [SMALL, pytest.param(
    Family(3, 2, sides=(6, 6), max_steps=24, grounds=3), marks=pytest.mark.soak)],
                         ids=["open", "blocked"])
def test_a_resumed_run_is_the_same_run(tmp_path, family, monkeypatch):
    monkeypatch.setattr(pupil, "SCENARIOS", 8)
    config = dataclasses.replace(TINY, families=(family,))
    whole = Run(Dagger(config), tmp_path / "whole", False)
    assert whole.train(Stop())
    begun = Run(Dagger(config), tmp_path / "parts", False)
    assert not begun.train(Stop(), stop_after=2)
    again = Run(Dagger(config), tmp_path / "parts", True)
    assert again.trainee.number == 2
    assert again.train(Stop())
    learners = [jax.tree.leaves(run.trainee.learner) for run in (whole, again)]
    for a, b in zip(*learners, strict=True):
        np.testing.assert_array_equal(a, b)
    report = again.finish()
    assert 0 <= report["families"][0]["success"] <= 1
    planner = LearnedPlanner.load(tmp_path / "parts" / "policy.safetensors", preference=1.0)
    other_size = Scenario(size=(5, 9), agents=(Agent((0, 0), ("A",)),),
                          targets=(Target((4, 8), ("A",), "OR"), Target((2, 2), ("A",), "OR")))
    start = Snapshot.start(other_size)
    planner.reset(start)
    assert planner.act(start).shape == (1,)
    with pytest.raises(InputError, match="already holds a run"):
        Run(Dagger(config), tmp_path / "parts", False)
    other = dataclasses.replace(config, lr=1.0)
    with pytest.raises(InputError, match="other numbers"):
        Run(Dagger(other), tmp_path / "parts", True)


SMALLER = ("from training.teacher import pupil; pupil.SCENARIOS = 8; "
           "from tests.training.teacher.test_imitation import BOTH; "
           "from training.teacher.presets import PRESETS; PRESETS['quick'] = BOTH; ")
BOTH = dataclasses.replace(
    TINY, families=(SMALL, Family(3, 2, sides=(6, 6), max_steps=24, grounds=3)), rounds=12)
"""Open maps and blocked ones."""


def figures(out):
    """The metrics without what depends on the clock."""
    return [{key: value for key, value in row.items() if key not in ("seconds", "rate")}
            for row in metrics.read(out / "metrics.jsonl")]


@pytest.mark.soak
def test_killed_and_resumed_is_bit_identical(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(pupil, "SCENARIOS", 8)
    monkeypatch.setitem(imitate.PRESETS, "quick", BOTH)
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    words = ["train", "imitate", "quick", "--checkpoint-seconds", "0", "--out"]
    assert main([*words, str(whole)]) == 0
    kill_when_saved(parts, [*words, str(parts)], SMALLER, kills=3)
    assert main([*words, str(parts), "--resume", "--tensorboard"]) == 0
    before, after = (load_policy(out / "policy.safetensors").params for out in (whole, parts))
    for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
        np.testing.assert_array_equal(a, b)
    ends = [checkpoints.load(out / "checkpoints")[1] for out in (whole, parts)]
    assert ends[0].keys() == ends[1].keys()
    for name, array in ends[0].items():
        np.testing.assert_array_equal(array, ends[1][name], err_msg=name)
    assert figures(whole) == figures(parts)
    assert [row["round"] for row in figures(parts) if "families" in row] == list(range(13))
    for name in ("config.json", "report.json", "curve.png"):
        assert (parts / name).stat().st_size > 0
    assert list(parts.glob("events.out.tfevents.*"))
    capsys.readouterr()
    assert main(["train", "compare", str(whole), "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["summary"]
    shown = figures(whole)[-1]["families"]
    assert row["planner"] == "quick"
    assert row["moves_gap"] == pytest.approx(np.mean([f["moves_gap"] for f in shown]))


def test_an_interrupted_command_saves_and_returns_130(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(pupil, "SCENARIOS", 4)
    monkeypatch.setitem(imitate.PRESETS, "quick", TINY)
    monkeypatch.setattr(Run, "train", lambda self, stop: False)
    assert main(["train", "imitate", "quick", "--out", str(tmp_path)]) == 130
    line = capsys.readouterr().err
    assert f"interrupted after round 0, saved; go on with --out {tmp_path} --resume" in line


def test_not_a_number_names_the_last_good_checkpoint(tmp_path, monkeypatch):
    monkeypatch.setattr(pupil, "SCENARIOS", 4)
    run = Run(Dagger(TINY), tmp_path, False)
    run.train(Stop(), stop_after=2)
    learner = run.trainee.learner
    poisoned = jax.tree.map(lambda x: x * np.nan, learner.params)
    run.trainee.learner = learner._replace(params=poisoned)
    with pytest.raises(Diverged, match=r"after round 2 \(imitation\): .*checkpoints/00000002"):
        run.train(Stop())


def test_impossible_numbers():
    with pytest.raises(InputError, match="the planner takes 1 to 12"):
        Imitation(families=(Family(3, 20),))
    Imitation(families=(Family(3, 20, iterations=50),))
    with pytest.raises(InputError, match="capacity"):
        dataclasses.replace(TINY, capacity=50)


def test_a_run_begins_with_another_ones_policy(tmp_path, monkeypatch):
    monkeypatch.setattr(pupil, "SCENARIOS", 4)
    monkeypatch.setitem(imitate.PRESETS, "quick", TINY)
    first = Run(Dagger(dataclasses.replace(TINY, rounds=1)), tmp_path / "a", False)
    assert first.train(Stop())
    first.finish()
    policy = tmp_path / "a" / "policy.safetensors"
    words = ["quick", "--begin", str(policy), "--rounds", "1", "--lr", "1e-9", "--json"]
    assert imitate.run(imitate.parse([*words, "--out", str(tmp_path / "b")])) == 0
    before, after = (load_policy(tmp_path / name / "policy.safetensors") for name in "ab")
    for a, b in zip(jax.tree.leaves(before.params), jax.tree.leaves(after.params), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-7)
    assert after.recipe["source"] == str(policy)
    with pytest.raises(InputError, match="only entity policies"):
        imitate.run(imitate.parse(["quick", "--begin", "small"]))
    with pytest.raises(InputError, match="above 0"):
        imitate.run(imitate.parse(["quick", "--lr", "0"]))
