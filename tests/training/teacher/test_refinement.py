"""Refinement: regret is the exact gap, learning lowers it, a resumed run is the same run."""

import dataclasses

import jax
import numpy as np
import pytest

from moonteam.cli import main
from moonteam.errors import InputError
from moonteam.interrupts import Stop
from moonteam.policies import entity
from moonteam.policies.entity import EntitySpec
from moonteam.policies.policy_file import PolicyFile, load_policy, save_policy
from tests.killed import kill_when_saved
from training.commands import refine
from training.run import metrics
from training.run.machine import Run
from training.teacher import presets, pupil
from training.teacher.families import TIE_BREAK, Family
from training.teacher.imitation import Imitation
from training.teacher.refinement import Refinement, Refiner, collect, judge, regrets

SMALL = Family(2, 2, sides=(3, 4), max_steps=24)
SPEC = EntitySpec(width=16, heads=2, layers=1)
TINY = Refinement(families=(SMALL,), spec=SPEC, rounds=40, num_envs=16, num_steps=8,
                  minibatches=2, lr=1e-2)
PARAMS = entity.init(SPEC, jax.random.key(0))


def rollout():
    """A rollout on the host with what the planner says of it."""
    refiner = Refiner(dataclasses.replace(TINY, num_envs=64), PARAMS)
    _, got = collect(SPEC, SMALL, "paper", 40, PARAMS, None, refiner.walks[0])
    got = jax.device_get(got)
    return got, judge(SMALL, None, got.states, got.place, got.preference)


def test_regrets_of_an_episode_add_up_to_its_gap():
    got, judged = rollout()
    regret = regrets(TINY, got, judged)
    assert regret[~got.truncated].max() <= 1e-4  # no step is better than the best
    ended = got.terminated | got.truncated
    checked = 0
    for e in range(regret.shape[1]):
        stops = np.flatnonzero(ended[:, e])
        if not len(stops) or not got.terminated[stops[0], e]:
            continue
        last, wish = int(stops[0]), got.preference[0, e]
        steps = last + 1
        moves = (got.action[:steps, e] != 4).sum()
        cost = (1 - wish + TIE_BREAK) * steps + (wish + TIE_BREAK) * moves
        gap = cost - judged.cost[0, e]
        np.testing.assert_allclose(-regret[:steps, e].sum(), gap, atol=1e-3)
        checked += 1
    assert checked > 5


def test_a_team_that_stands_still_loses_the_step():
    got, judged = rollout()
    regret = regrets(TINY, got, judged)
    still = (got.action == 4).all(-1) & ~got.truncated & ~got.terminated
    assert still.any()
    wish = got.preference[:-1]
    # Nothing has changed but the clock: exactly one step's cost.
    np.testing.assert_allclose(regret[still], -(1 - wish + TIE_BREAK)[still], atol=1e-4)


@pytest.mark.parametrize("reward", ["regret", "paper", "none"])
def test_learning_lowers_the_regret(reward):
    refiner = Refiner(dataclasses.replace(TINY, reward=reward), PARAMS)
    lost = [refiner.round().regret for _ in range(TINY.rounds)]
    assert refiner.number == TINY.rounds
    assert np.isfinite(lost).all()
    if reward != "paper":
        assert np.mean(lost[-8:]) < 0.9 * np.mean(lost[:8])


def test_a_resumed_run_is_the_same_run(tmp_path, monkeypatch):
    monkeypatch.setattr(pupil, "SCENARIOS", 8)
    config = dataclasses.replace(TINY, rounds=4)
    whole = Run(Refiner(config, PARAMS, source="here"), tmp_path / "whole", False)
    assert whole.train(Stop())
    begun = Run(Refiner(config, PARAMS, source="here"), tmp_path / "parts", False)
    assert not begun.train(Stop(), stop_after=1)
    again = Run(Refiner(config, PARAMS, source="here"), tmp_path / "parts", True)
    assert again.trainee.number == 1
    assert again.train(Stop())
    learners = [jax.tree.leaves(run.trainee.learner) for run in (whole, again)]
    for a, b in zip(*learners, strict=True):
        np.testing.assert_array_equal(a, b)
    assert again.finish()["method"] == "MAPPO from imitation, reward regret, leash 0.1"


SMALLER = ("from training.teacher import pupil; pupil.SCENARIOS = 8; "
           "from tests.training.teacher.test_refinement import PRACTISED; "
           "from training.teacher.presets import PRESETS; PRESETS['quick'] = PRACTISED; ")
PRACTISED = Imitation(families=(SMALL, Family(3, 2, sides=(4, 4), max_steps=24, grounds=3)))


@pytest.mark.soak
def test_killed_and_resumed_is_bit_identical(tmp_path, monkeypatch):
    monkeypatch.setattr(pupil, "SCENARIOS", 8)
    monkeypatch.setitem(presets.PRESETS, "quick", PRACTISED)
    begun = tmp_path / "begun.safetensors"
    save_policy(begun, PolicyFile("entity", dataclasses.asdict(SPEC), jax.device_get(PARAMS), {},
                                  "none"))
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    words = ["train", "refine", str(begun), "--families", "quick", "--rounds", "5",
             "--checkpoint-seconds", "0", "--out"]
    assert main([*words, str(whole)]) == 0
    kill_when_saved(parts, [*words, str(parts)], SMALLER, kills=3)
    assert main([*words, str(parts), "--resume", "--beside", str(whole)]) == 0
    before, after = (load_policy(out / "policy.safetensors").params for out in (whole, parts))
    for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
        np.testing.assert_array_equal(a, b)
    rows = [metrics.read(out / "metrics.jsonl") for out in (whole, parts)]
    assert [row["total_updates"] for row in rows[1]] == list(range(6))
    for key in ("regret", "families", "labelled"):
        assert [row.get(key) for row in rows[0]] == [row.get(key) for row in rows[1]]
    assert (parts / "beside.png").stat().st_size > 0


def test_impossible_numbers(tmp_path):
    with pytest.raises(InputError, match="minibatches"):
        Refinement(families=(SMALL,), num_envs=3, num_steps=5, minibatches=2)
    with pytest.raises(InputError, match="holds no run"):
        refine.run(refine.Args("any_team_imitated", beside=(tmp_path,)))
    with pytest.raises(InputError, match="only entity policies"):
        refine.run(refine.Args("small", out=tmp_path / "new"))
