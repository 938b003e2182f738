"""MAPPO where not everything is known: what the network sees, and how it is judged."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from moonteam.grid.macro import world
from moonteam.grid.macro.draw import Draw
from moonteam.policies import pointer
from moonteam.policies.pointer import PointerSpec, look
from training.mappo.macro.config import PRESETS, MacroConfig, Practice
from training.mappo.macro.held_out import HeldOut, played
from training.mappo.macro.hyper import Hyper, Vine
from training.mappo.macro.trainee import MacroMappo
from training.mappo.macro.update import fresh
from training.run.trainee import Position

BLIND = PointerSpec(width=16, heads=2, layers=1, pairs=8)
SPEC = dataclasses.replace(BLIND, unfolds=True)
FAMILY = Draw(agents=(2, 2), targets=(4, 4), sides=(8, 8), following=2, limit=100.0)
ARRIVING = dataclasses.replace(FAMILY, following=0, arriving=2, every=3.0)
LAPSING = dataclasses.replace(ARRIVING, worth=(1.0, 5.0), stays=(1.0, 6.0))
WORTHS = dataclasses.replace(SPEC, worths=True)
TINY = MacroConfig(
    "unfolding", (Practice("follow", FAMILY),), rounds=2, spec=SPEC, chunk_rounds=1, eval_every=1,
    hyper=Hyper(num_steps=4, learned=0.5, minibatches=2), eval_scenarios=16,
    vine=Vine(episodes=8, num_steps=4, moments=16, minibatches=2))


@pytest.fixture(scope="module")
def moments():
    states = fresh(FAMILY, Hyper(), None, jax.random.key(0), 16).states
    return jax.vmap(look)(states, jnp.zeros(16))


def test_a_network_that_comes_to_see_what_is_ahead_begins_as_the_same(moments):
    params = pointer.init(BLIND, jax.random.key(1))
    seeing = pointer.grafted(SPEC, params)
    before = pointer.point(params, BLIND, moments)
    after = pointer.point(seeing, SPEC, moments)
    np.testing.assert_array_equal(before.logits, after.logits)
    changed = jax.tree.map(lambda x: jax.random.normal(jax.random.key(3), x.shape),
                           seeing["ahead"])
    other = pointer.point({**seeing, "ahead": changed}, SPEC, moments)
    assert np.abs(np.asarray(other.logits - after.logits)).max() > 1e-3


def test_what_is_ahead_is_how_many_come_and_how_far_from_where(moments):
    count, far, both = np.moveaxis(np.asarray(moments.ahead), -1, 0)
    np.testing.assert_allclose(count, np.log(3.0), rtol=1e-6)
    assert (far > 0).all()
    np.testing.assert_allclose(both, count * far, rtol=1e-5)


def test_nothing_is_ahead_where_everything_is_known():
    states = fresh(dataclasses.replace(FAMILY, following=0), Hyper(), None, jax.random.key(0),
                   8).states
    assert not np.asarray(jax.vmap(look)(states, jnp.zeros(8)).ahead).any()


@pytest.mark.parametrize("family", [FAMILY, ARRIVING], ids=["following", "arriving"])
def test_it_is_judged_as_it_is_played_and_not_by_plans_that_know(family):
    held = HeldOut(Practice("one", family), 32)
    params = pointer.init(SPEC, jax.random.key(2))
    solved, seconds, missed = jax.device_get(played(SPEC, params, held.problems))
    assert not missed.any()
    assert solved.all()
    assert (seconds >= held.best - 2e-2).all(), "nobody is faster than hindsight"
    shown = held.problems.shown.max(1)
    assert (seconds >= shown).all()


def test_where_targets_lapse_it_is_judged_by_the_worth_that_it_serves():
    held = HeldOut(Practice("one", LAPSING), 32)
    p = held.problems
    assert ((p.worth >= 1) & (p.worth <= 5)).all()
    stays = p.lapses - p.shown
    assert (stays.min(), stays.max()) == (pytest.approx(1, abs=0.5), pytest.approx(6, abs=0.5))
    params = pointer.init(WORTHS, jax.random.key(2))
    solved, _, missed = jax.device_get(played(WORTHS, params, p))
    assert solved.all(), "to miss a target is no failure"
    served = p.worth.sum(1) - missed
    assert 0 < missed.mean() < p.worth.sum(1).mean()
    assert (served <= held.best + 1e-3).all(), "nobody serves more than hindsight"
    trainee = MacroMappo(dataclasses.replace(TINY, families=(Practice("one", LAPSING),),
                                             spec=WORTHS))
    score = {"family": "one", "success": 1.0, "makespan_gap": 0.25, "worth_served": 0.6}
    said = trainee.lines({"families": [score], "env_steps": 1, "seconds": 1.0})[0]
    assert said == "one: success 1.000, 60.0% of the worth served, hindsight 25.0% more"


def test_a_network_that_comes_to_see_worth_begins_as_the_same_and_learns_by_it():
    states = fresh(LAPSING, Hyper(), None, jax.random.key(0), 16).states
    view = jax.vmap(look)(states, jnp.zeros(16))
    params = pointer.init(SPEC, jax.random.key(1))
    seeing = pointer.grafted(WORTHS, params)
    np.testing.assert_array_equal(pointer.point(params, SPEC, view).logits,
                                  pointer.point(seeing, WORTHS, view).logits)
    trainee = MacroMappo(dataclasses.replace(TINY, families=(Practice("lapse", LAPSING),),
                                             spec=WORTHS))
    trainee.enter("macro")
    before = jax.device_get(trainee.learner.params)
    trainee.chunk(Position("macro"))
    after = jax.device_get(trainee.learner.params)
    assert np.abs(after["worth"]["kernel"] - before["worth"]["kernel"]).max() > 0


def test_a_round_moves_the_policy_and_what_it_sees_ahead():
    trainee = MacroMappo(TINY)
    trainee.enter("macro")
    before = jax.device_get(trainee.learner.params)
    trainee.chunk(Position("macro"))
    after = jax.device_get(trainee.learner.params)
    assert np.abs(after["ahead"]["kernel"] - before["ahead"]["kernel"]).max() > 0


def test_the_preset_sees_what_is_ahead_in_every_family():
    preset = PRESETS["unfolding"]
    assert preset.spec.unfolds
    assert all(one.draw.unfolds for one in preset.families)
    states = fresh(preset.families[1].draw, Hyper(), None, jax.random.key(0), 2).states
    assert np.asarray(jax.vmap(world.coming)(states)).tolist() == [5, 5]
