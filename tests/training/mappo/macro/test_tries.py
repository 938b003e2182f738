"""Advantages from whole tries: each is played to its end and held against the others."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from moonteam.grid.macro import world
from moonteam.grid.macro.draw import Draw
from moonteam.policies.pointer import PointerSpec, init, look, point
from training.mappo.macro.hyper import Hyper, Tries
from training.mappo.macro.tries import choices, loss, met, over_others, tried
from training.mappo.macro.update import chosen, fresh

SPEC = PointerSpec(width=16, heads=2, layers=1, pairs=8)
SMALL = Draw(agents=(3, 3), targets=(2, 4), sides=(9, 9), limit=90.0)
HYPER = Hyper(spread=True)
TRIES = Tries(problems=8, each=5, num_steps=10, learned=0.3, rows=32)


@pytest.fixture(scope="module")
def params():
    return init(SPEC, jax.random.key(2))


@pytest.fixture(scope="module")
def walk():
    return jax.jit(lambda k: fresh(SMALL, HYPER, None, k, TRIES.problems))(jax.random.key(3))


@pytest.fixture(scope="module")
def played(params, walk):
    run = jax.jit(lambda *x: tried(SPEC, HYPER, TRIES, *x))
    return jax.device_get(run(params, walk, jax.random.key(4)))


@pytest.fixture(scope="module")
def rows(walk, played):
    better = over_others(played.cost.reshape(-1, TRIES.each)).reshape(-1)
    return jax.jit(lambda *x: met(HYPER, TRIES, *x))(walk, played, better, jax.random.key(6))


@pytest.fixture(scope="module")
def again(walk, played):
    """Every try played by hand, one decision after the other: its cost, and what was seen."""
    step, see = jax.jit(world.step), jax.jit(look)
    loosen = jax.jit(lambda s: world.loosen(s, jnp.ones(s.goal.shape, bool)))
    found = []
    for f in range(TRIES.problems * TRIES.each):
        start = jax.tree.map(lambda x, i=f // TRIES.each: x[i], walk.states)
        like, state, seen = walk.preference[f // TRIES.each], start, []
        for turn in range(played.turns[f]):
            seen.append(see(state, like))
            result = step(state, played.choice[f, turn])
            state = loosen(result.state)
        assert bool(result.terminated)
        time, way = float(state.now), float(result.state.travelled.sum())
        price = (1 - like + HYPER.tie) * time + (like + HYPER.tie) * way
        found.append((float(price / start.problem.unit), seen))
    return found


def test_what_a_try_costs(played, again):
    assert played.solved.all()
    np.testing.assert_allclose(played.cost, [cost for cost, _ in again], rtol=1e-4, atol=1e-4)
    assert len(np.unique(played.cost)) > 2 * TRIES.problems


def test_the_others_are_the_baseline():
    cost = np.array([[3.0, 1.0, 2.0, 6.0], [5.0, 5.0, 5.0, 5.0]])
    found = np.asarray(over_others(jnp.asarray(cost)))
    for i, k in np.ndindex(cost.shape):
        assert found[i, k] == pytest.approx(np.delete(cost[i], k).mean() - cost[i, k])


def test_moments_are_what_the_tries_saw_chose_and_came_to(played, again, rows):
    rows, seen = jax.device_get(rows), 0
    gain = np.asarray(over_others(played.cost.reshape(-1, TRIES.each))).reshape(-1)
    for s in np.flatnonzero(np.asarray(choices(rows))):
        ours = [(f, t) for f, (_, views) in enumerate(again) for t, view in enumerate(views)
                if np.isclose(gain[f], rows.advantage[s], atol=1e-5)
                and np.array_equal(played.choice[f, t], rows.choice[s])
                and np.array_equal(played.options[f, t], rows.options[s])
                and all(np.allclose(getattr(view, name), getattr(rows.view, name)[s], atol=1e-4)
                        for name in ("travel", "spare", "targets", "goal"))]
        assert ours
        assert abs(rows.advantage[s]) > 0
        if all(t == 0 for _, t in ours):
            cost = played.cost[ours[0][0]]
            assert rows.value[s] == pytest.approx(-cost, rel=1e-4, abs=1e-4)
            seen += 1
    assert seen > 3


def test_the_policy_that_learns_is_the_one_that_tried(params, rows):
    """Ratios of one at first, at the temperature of the tries."""
    said = jax.jit(lambda v: point(params, SPEC, v))(rows.view)
    log_prob, _ = chosen(said.logits / TRIES.heat, rows.options, rows.choice)
    real = np.asarray(rows.options.sum(-1) > 1)
    np.testing.assert_allclose(np.asarray(log_prob)[real], rows.log_prob[real], atol=1e-4)


def test_one_step_makes_better_tries_likelier(params, rows):
    hyper = dataclasses.replace(HYPER, vf_coef=0.0)
    count = jnp.sum(choices(rows))
    f = jax.jit(jax.value_and_grad(lambda p: loss(p, SPEC, hyper, TRIES, rows, count)[0]))
    before, slope = f(params)
    after, _ = f(jax.tree.map(lambda p, g: p - 1e-2 * g, params, slope))
    assert after < before
