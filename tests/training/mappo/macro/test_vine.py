"""Advantages from branches played out: each is what its choice really led to."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from moonteam.grid.macro import world
from moonteam.grid.macro.draw import Draw
from moonteam.policies.pointer import PointerSpec, init, look, point
from training.mappo.macro.hyper import Hyper, Vine
from training.mappo.macro.vine import aim, grow, loss, met, tried

SPEC = PointerSpec(width=16, heads=2, layers=1, pairs=8)
SMALL = Draw(agents=(3, 3), targets=(2, 4), sides=(9, 9), limit=90.0)
HYPER, VINE = Hyper(), Vine(episodes=8, num_steps=6, moments=24, minibatches=2, options=5)


@pytest.fixture(scope="module")
def params():
    return init(SPEC, jax.random.key(2))


@pytest.fixture(scope="module")
def moments(params):
    return jax.jit(lambda p, k: met(SPEC, SMALL, HYPER, VINE, None, p, k))(params,
                                                                        jax.random.key(3))


@pytest.fixture(scope="module")
def played(params, moments):
    """Every option of every moment: returns [S, M + 1], solved, and which there are."""
    width = moments.options.shape[1]
    option = jnp.broadcast_to(jnp.arange(width), moments.options.shape)
    valid = moments.options & moments.real[:, None]
    value, solved = jax.jit(lambda *x: tried(SPEC, HYPER, VINE, *x))(params, moments, option, valid)
    return np.asarray(value), np.asarray(solved), np.asarray(valid)


def test_moments_are_those_at_which_somebody_has_a_choice(moments):
    real, options = np.asarray(moments.real), np.asarray(moments.options)
    assert real.sum() > 12
    assert (options[real].sum(1) > 1).all()
    assert np.take_along_axis(options, np.asarray(moments.choice)[:, None], 1).all()
    free = np.asarray(jax.vmap(world.free)(moments.states))
    assert free[np.arange(len(real)), moments.who][real].all()


def test_a_branch_is_what_its_choice_leads_to(params, moments, played):
    """Played again by hand, one decision after the other."""
    value, solved, valid = played
    say = jax.jit(lambda s, like: point(params, SPEC, look(s, like)).logits)
    choose, step = jax.jit(world.choose), jax.jit(world.step)
    loosen = jax.jit(lambda s: world.loosen(s, jnp.ones(s.goal.shape, bool)))
    rows, columns = np.nonzero(valid)
    checked = 0
    for s, option in list(zip(rows.tolist(), columns.tolist(), strict=True))[::4]:
        state = jax.tree.map(lambda x, s=s: x[s], moments.states)
        liking, unit = moments.preference[s], float(state.problem.unit)
        noise = jnp.zeros(valid.shape[1])[None].repeat(3, 0).at[moments.who[s], option].set(1e8)
        begun, way, now = float(state.now), float(state.travelled.sum()), None
        for _ in range(50):
            choice, _ = choose(state, say(state, liking), noise)
            if now is None:
                assert int(choice[moments.who[s]]) == option
            result = step(state, choice)
            now, noise = float(state.now + result.seconds), jnp.zeros_like(noise)
            if bool(result.terminated | result.truncated):
                break
            state = loosen(result.state)
        assert bool(result.terminated) == solved[s, option]
        if not solved[s, option]:
            continue
        gone = float(result.state.travelled.sum()) - way
        price = ((1 + HYPER.tie) * (now - begun) + HYPER.tie * gone) / unit
        assert value[s, option] == pytest.approx(-price, rel=1e-4, abs=1e-4)
        checked += 1
    assert checked > 5


def test_what_was_not_tried_is_not_judged(params, moments):
    nobody = jnp.zeros(moments.options.shape, bool)
    option = jnp.broadcast_to(jnp.arange(nobody.shape[1]), nobody.shape)
    value, solved = tried(SPEC, HYPER, VINE, params, moments, option, nobody)
    assert not np.asarray(value).any()
    assert not np.asarray(solved).any()


def test_the_aim_is_the_maximiser_of_the_penalised_return():
    """No other distribution over the options tried has more return less tau times divergence."""
    rng = np.random.default_rng(0)
    old = rng.dirichlet(np.ones(5), size=6)
    option = np.array([[0, 2, 4]] * 6)
    valid = np.array([[True, True, True]] * 3 + [[True, True, False]] * 3)
    value = rng.normal(size=(6, 3)) * 0.2
    goal = np.asarray(aim(VINE, jnp.log(old), jnp.asarray(option), jnp.asarray(valid),
                          jnp.asarray(value)))
    np.testing.assert_allclose(goal.sum(1), 1.0, rtol=1e-5)

    def worth(row, new):
        spots = option[row][valid[row]]
        gain = (new[spots] * value[row][valid[row]]).sum()
        return gain - VINE.tau * (new[spots] * np.log(new[spots] / old[row, spots])).sum()

    for row in range(6):
        tried_ = option[row][valid[row]]
        rest = np.setdiff1d(np.arange(5), tried_)
        np.testing.assert_allclose(goal[row, rest], old[row, rest], rtol=1e-5)
        for _ in range(20):
            other = goal[row].copy()
            other[tried_] = rng.dirichlet(np.ones(len(tried_))) * goal[row, tried_].sum()
            assert worth(row, other) <= worth(row, goal[row]) + 1e-6


def test_one_step_goes_where_it_aims(params):
    rows, _ = jax.jit(lambda p: grow(SPEC, SMALL, HYPER, VINE, None, p, jax.random.key(9)))(params)
    hyper = dataclasses.replace(HYPER, vf_coef=0.0)
    count = jnp.sum(rows.real)
    f = jax.jit(jax.value_and_grad(lambda p: loss(p, SPEC, hyper, rows, count)[0]))
    before, slope = f(params)
    after, _ = f(jax.tree.map(lambda p, g: p - 1e-2 * g, params, slope))
    assert after < before
