"""MAPPO on macro-decisions: one update, the run machine, the commands."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from moonteam import paths
from moonteam.cli import main
from moonteam.errors import InputError
from moonteam.grid.macro import world
from moonteam.grid.macro.draw import Draw, draw
from moonteam.planners.seconds.exhaustive import ExhaustivePlanner
from moonteam.policies.pointer import PointerSpec, look, point
from moonteam.policies.policy import Policy
from moonteam.policies.policy_file import load_policy
from tests.killed import kill_when_saved
from training.commands import macro
from training.mappo.macro import grounds
from training.mappo.macro.config import PRESETS, MacroConfig, Practice
from training.mappo.macro.held_out import HeldOut, moment_of
from training.mappo.macro.hyper import Hyper, Tries, Vine
from training.mappo.macro.trainee import MacroMappo
from training.mappo.macro.update import Batch, chosen, collect, fresh, loss
from training.run import checkpoints, metrics
from training.run.trainee import Position

SPEC = PointerSpec(width=16, heads=2, layers=1, pairs=8)
SMALL = Draw(agents=(2, 2), targets=(2, 2), sides=(6, 6), limit=60.0)
HYPER = Hyper(num_steps=4, learned=0.5, minibatches=2)
VINE = Vine(episodes=8, num_steps=4, moments=16, minibatches=2)
TRIES = Tries(problems=8, each=3, rows=8)
TINY = MacroConfig("quick", (Practice("small", SMALL, advantages="critic"),), rounds=3, num_envs=8,
                   hyper=HYPER, vine=VINE, tries=TRIES, spec=SPEC, chunk_rounds=1, eval_every=1,
                   eval_scenarios=32)
BOTH = dataclasses.replace(
    TINY, families=(*TINY.families, Practice("closed", SMALL, grounds=8, shrink=2),
                    Practice("tried", SMALL, shrink=2, advantages="tries")), rounds=6,
    hyper=dataclasses.replace(HYPER, spread=True))
SMALLER = ("from training.mappo.macro import config; "
           "from tests.training.mappo.macro.test_macro import BOTH; "
           "config.PRESETS['quick'] = BOTH; ")


@pytest.fixture(scope="module")
def trainee():
    return MacroMappo(TINY)


@pytest.fixture(scope="module")
def played(trainee):
    """Starts [E] and what was decided from them, nobody turning."""
    return rollout(trainee, dataclasses.replace(HYPER, num_steps=12))


def rollout(trainee, hyper, preference=0.0):
    """Starts [E] of TINY's family at one preference, and the rows [T, E] decided from them."""
    params = trainee.learner.params
    walk = jax.jit(lambda k: fresh(SMALL, hyper, None, k, 16))(jax.random.key(4))
    walk = walk._replace(preference=jnp.full(16, preference))
    run = jax.jit(lambda w: collect(SPEC, SMALL, hyper, None, params, w, jax.random.key(5)))
    _, rows, _, lengths = run(walk)
    return walk, rows, lengths


@pytest.fixture(scope="module")
def flat(played):
    """The rows one behind the other [B]."""
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), played[1])


RESET, STEP = jax.jit(world.reset), jax.jit(world.step)
LOOSEN = jax.jit(lambda state: world.loosen(state, jnp.ones(state.goal.shape, bool)))


def test_returns_are_what_an_episode_costs(played):
    """With no discount the rewards of a whole episode are minus its price, in units."""
    walk, rows, lengths = played
    ended, reward = np.asarray(rows.ended), np.asarray(rows.reward)
    assert ended.any(axis=0).all()
    assert not np.asarray(rows.truncated).any()
    for e in range(16):
        first = int(np.argmax(ended[:, e]))
        problem = jax.tree.map(lambda x, e=e: x[e], walk.states.problem)
        state, spent, way = RESET(problem), 0.0, 0.0
        for t in range(first + 1):
            result = STEP(state, rows.choice[t, e])
            state, spent, way = result.state, spent + result.seconds, way + result.effort
        assert bool(jnp.all(state.solved))
        assert float(lengths[first, e]) == pytest.approx(float(spent))
        price = ((1 + HYPER.tie) * spent + HYPER.tie * way) / problem.unit
        assert float(reward[:first + 1, e].sum()) == pytest.approx(-float(price), rel=1e-5)


def test_who_chooses_again_does_not_pay_twice(trainee):
    """Turning included, the way paid for is the way that was gone."""
    hyper = dataclasses.replace(HYPER, num_steps=14, loose=1.0, tie=0.0)
    walk, rows, _ = rollout(trainee, hyper, preference=1.0)  # all is effort
    ended, reward = np.asarray(rows.ended), np.asarray(rows.reward)
    for e in range(16):
        first = int(np.argmax(ended[:, e]))
        state = RESET(jax.tree.map(lambda x, e=e: x[e], walk.states.problem))
        for t in range(first + 1):
            result = STEP(state, rows.choice[t, e])
            state = LOOSEN(result.state)
        assert bool(result.terminated)
        price = float(result.state.travelled.sum() / state.problem.unit)
        assert float(reward[:first + 1, e].sum()) == pytest.approx(-price, rel=1e-4, abs=1e-5)


POINT = jax.jit(lambda params, view: point(params, SPEC, view))


def test_the_first_gradient_sees_ratios_of_one(trainee, flat):
    said = POINT(trainee.learner.params, flat.view)
    log_prob, entropy = chosen(said.logits, flat.options, flat.choice)
    np.testing.assert_allclose(log_prob, flat.log_prob, atol=1e-5)
    options, choice = np.asarray(flat.options), np.asarray(flat.choice)
    single = options.sum(-1) == 1
    assert single.any()
    np.testing.assert_array_equal(np.asarray(log_prob)[single], 0.0)
    np.testing.assert_array_equal(np.asarray(entropy)[single], 0.0)
    assert np.take_along_axis(options, choice[..., None], -1).all()


def test_a_better_choice_becomes_likelier(trainee, flat):
    """One step against the loss moves an agent with a gain towards what it chose."""
    params = trainee.learner.params
    batch = Batch(flat.view, flat.choice, flat.options, flat.log_prob,
                  jnp.ones(len(flat.value)), flat.value)
    real = np.asarray(flat.options.sum(-1)) > 1
    slope = jax.jit(jax.grad(lambda p: loss(p, SPEC, HYPER, batch, jnp.zeros(()),
                                            jnp.float32(real.sum()), len(flat.value))[0]))(params)
    params = jax.tree.map(lambda p, g: p - 1e-2 * g, params, slope)
    after, _ = chosen(POINT(params, flat.view).logits, flat.options, flat.choice)
    assert np.asarray(after)[real].mean() > np.asarray(flat.log_prob)[real].mean()


@pytest.mark.parametrize("advantages", ["critic", "vine", "tries"])
def test_training_learns(advantages):
    """A minute's worth of a toy: the held-out gap falls."""
    config = dataclasses.replace(
        TINY, families=(Practice("small", SMALL, advantages=advantages),), rounds=40, num_envs=64,
        chunk_rounds=40, lr=3e-3, hyper=dataclasses.replace(HYPER, num_steps=8, minibatches=4),
        vine=Vine(episodes=64, num_steps=6, moments=128, minibatches=4),
        tries=Tries(problems=64, each=8, rows=64))
    trainee = MacroMappo(config)
    before = trainee.evaluate()[0]
    figures = trainee.chunk(Position("macro")).figures
    assert 0.0 < figures["success"] <= 1.0
    assert not figures.keys() & {f.name for f in dataclasses.fields(Position)}  # of the same row
    after = trainee.evaluate()[0]
    assert after["success"] == 1.0
    assert after["makespan_gap"] < before["makespan_gap"]


@pytest.mark.soak
def test_programs_compiled_side_by_side_train_to_the_same_bits():
    """Ahead of time in threads, or one after the other as each is first called."""
    config = dataclasses.replace(TINY, families=(*TINY.families, Practice("open", SMALL)))
    ahead, called = MacroMappo(config), MacroMappo(config)
    ahead.enter("macro")
    assert sorted(ahead._programs) == [0, 1]
    programs = dict(ahead._programs)
    ahead.enter("macro")
    assert ahead._programs == programs
    figures = [trainee.chunk(Position("macro")).figures for trainee in (ahead, called)]
    assert figures[0] == figures[1]
    for one, other in zip(*(jax.tree.leaves(jax.device_get(checkpoints.raw(trainee.state())))
                            for trainee in (ahead, called)), strict=True):
        np.testing.assert_array_equal(one, other)


def test_held_out_optima_are_optima():
    held = HeldOut(Practice("small", SMALL), 12)
    for i in range(12):
        problem = jax.tree.map(lambda x, i=i: x[i], held.problems)
        plan = ExhaustivePlanner().plan(moment_of(problem))
        assert plan.makespan == round(held.best[i] * 1000)


def test_closed_ground_is_a_detour():
    """Ways over blocked maps are no shorter than on open ones, and some are longer."""
    made = jax.device_get(grounds.make(Draw(targets=(3, 3), sides=(12, 12)), 6, 0))
    finite = made.start < 1e8
    assert finite.any()
    there = made.between[:, 0]  # the first kind crosses everything
    assert (made.between[:, 1:] >= there[:, None] - 1e-6).all()
    assert (made.between[:, 1:] > there[:, None] + 1e-6).any()


@pytest.mark.parametrize("family", PRESETS["any_team"].families[1:4], ids=lambda f: f.name)
def test_every_family_draws_problems_that_can_be_solved(family):
    """By random choices, whatever it asks for; and what is seen of them is finite."""
    count, turns = 4, 3 * (family.draw.agents[1] + 2 * family.draw.targets[1])
    small = dataclasses.replace(family.draw, agents=(2, min(4, family.draw.agents[1])),
                                targets=(1, min(6, family.draw.targets[1])))
    ground = grounds.make(small, 4, 1) if family.grounds else None

    @jax.jit
    def play(key):
        walk = fresh(small, Hyper(spread=True), ground, key, count)

        def step(state, key):
            wishes = jax.random.normal(key, (count, small.agents[1], small.targets[1] + 1))
            choice, _ = jax.vmap(world.choose)(state, wishes, jnp.zeros_like(wishes))
            return jax.vmap(world.step)(state, choice).state, None

        end, _ = jax.lax.scan(step, walk.states, jax.random.split(key, turns))
        return jax.vmap(look)(walk.states, walk.preference), end

    view, state = play(jax.random.key(5))
    assert np.asarray(state.solved).all() or ground is not None
    assert all(np.isfinite(np.asarray(x, np.float32)).all() for x in jax.tree.leaves(view))


@pytest.mark.soak
def test_killed_and_resumed_is_bit_identical(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(PRESETS, "quick", BOTH)
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    words = ["train", "quick", "--checkpoint-seconds", "0", "--out"]
    assert main([*words, str(whole)]) == 0
    kill_when_saved(parts, [*words, str(parts)], SMALLER, kills=3)
    assert main([*words, str(parts), "--resume"]) == 0
    before, after = (load_policy(out / "policy.safetensors").params for out in (whole, parts))
    for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
        np.testing.assert_array_equal(a, b)
    ends = [checkpoints.load(out / "checkpoints")[1] for out in (whole, parts)]
    for name, array in ends[0].items():
        np.testing.assert_array_equal(array, ends[1][name], err_msg=name)
    rows = [[{k: v for k, v in row.items() if k not in ("seconds", "rate")}
             for row in metrics.read(out / "metrics.jsonl")] for out in (whole, parts)]
    assert rows[0] == rows[1]
    capsys.readouterr()
    assert main(["train", "compare", str(whole), "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["summary"]
    shown = rows[0][-1]["families"]
    assert row["makespan_gap"] == pytest.approx(np.mean([f["makespan_gap"] for f in shown]))
    assert Policy.load(whole / "policy.safetensors").source.kind == "pointer"


@pytest.mark.soak
def test_several_seeds_in_one_command(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(PRESETS, "quick", dataclasses.replace(TINY, rounds=1))
    assert main(["train", "quick", "--seeds", "3", "4", "--out", str(tmp_path)]) == 0
    assert "quick" in capsys.readouterr().out
    document = json.loads((tmp_path / "compare.json").read_text())
    assert document["summary"][0]["seeds"] == 2
    assert (tmp_path / "curves.png").stat().st_size > 0
    first, second = (load_policy(tmp_path / seed / "policy.safetensors").params for seed in "34")
    assert any((a != b).any() for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second),
                                              strict=True))
    assert main(["train", "quick", "--seeds", "3", "3", "--out", str(tmp_path / "x")]) == 2


def test_impossible_numbers(tmp_path, capsys):
    with pytest.raises(InputError, match="do not divide"):
        dataclasses.replace(TINY, num_envs=7, hyper=dataclasses.replace(HYPER, minibatches=8))
    with pytest.raises(InputError, match="at least 1"):
        dataclasses.replace(TINY, rounds=0)
    with pytest.raises(InputError, match="8 moments of closed are not divided by 5"):
        dataclasses.replace(BOTH, vine=dataclasses.replace(VINE, minibatches=10))
    with pytest.raises(InputError, match="0 moments of closed"):
        dataclasses.replace(BOTH, vine=dataclasses.replace(VINE, moments=1))
    for key, value in (("tau", 0.0), ("minibatches", 0), ("episodes", 0)):
        with pytest.raises(InputError, match=rf"vine\.{key}: 0 is not allowed"):
            dataclasses.replace(BOTH, vine=dataclasses.replace(VINE, **{key: value}))
    for key, value in (("heat", 0.0), ("learned", 0.0), ("problems", 0), ("rows", 0)):
        with pytest.raises(InputError, match=rf"tries\.{key}: 0 is not allowed"):
            dataclasses.replace(BOTH, tries=dataclasses.replace(TRIES, **{key: value}))
    with pytest.raises(InputError, match="1 problems of tried"):
        dataclasses.replace(BOTH, tries=dataclasses.replace(TRIES, problems=2, learned=0.05))
    with pytest.raises(InputError, match=r"vine\.options: 1 is not allowed; at least 2"):
        dataclasses.replace(BOTH, vine=dataclasses.replace(VINE, options=1))
    with pytest.raises(InputError, match=r"tries\.each: 1 is not allowed; at least 2"):
        dataclasses.replace(BOTH, tries=dataclasses.replace(TRIES, each=1))
    assert main(["train", "quick", "--policy", "small", "--out", str(tmp_path / "x")]) == 2
    assert "only pointer policies" in capsys.readouterr().err


def test_it_goes_on_from_the_mean_of_policies_with_more_blocks_and_the_same_words(capsys):
    several = macro.parse(["any_team", "--policy", "paper_team", "any_team_mappo",
                           "--spec.layers", "5"])
    config, params, source = macro._numbers(several)
    assert (config.spec.layers, source) == (5, "paper_team any_team_mappo")
    one, other = (Policy.load(paths.find(name, "policies", ".safetensors")).source.params
                  for name in several.policy)
    mean = jax.tree.map(lambda a, b: (a + b) / 2, one, other)
    state = jax.vmap(world.reset)(jax.vmap(lambda k: draw(Draw(), k))(
        jax.random.split(jax.random.key(0), 16)))
    view = jax.vmap(look)(state, jnp.zeros(16))
    said, as_before = (point(p, spec, view) for p, spec in (
        (params, config.spec), (mean, PointerSpec())))
    np.testing.assert_allclose(said.logits, as_before.logits, atol=1e-4)
    np.testing.assert_allclose(said.value, as_before.value, atol=1e-4)
    assert main(["train", "quick", "--policy", "paper_team", "unfolding", "--dry-run"]) == 2
    assert "unfolding: policy: is of another size than paper_team" in capsys.readouterr().err


def test_problems_are_drawn_as_the_grid_draws_them():
    """The macro world's problem is the grid's, by the clock: the same tables."""
    family = Draw()
    problem = jax.device_get(draw(family, jax.random.key(3)))
    assert problem.start.shape == (3, 7)
    assert problem.has.shape == (3, 2)
    real = problem.target_mask
    assert (problem.start[:, real] > 0).all()
    assert (problem.start[:, real] % 1 == 0).all()
    np.testing.assert_array_equal(problem.between[0], problem.between[0].T)
