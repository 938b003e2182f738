"""Learning from the policy's own best tries."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from moonteam.grid.macro import world
from moonteam.grid.macro.draw import Draw
from moonteam.policies.pointer import PointerSpec, init, look, point
from training.mappo.macro.best import choices, kept, loss, tried
from training.mappo.macro.hyper import Best, Hyper
from training.mappo.macro.update import chosen, fresh

SPEC = PointerSpec(width=16, heads=2, layers=1, pairs=8)
SMALL = Draw(agents=(3, 3), targets=(2, 4), sides=(9, 9), limit=90.0)
HYPER, BEST = Hyper(spread=True), Best(problems=8, tries=5, num_steps=10, rows=8)
TRY = jax.jit(lambda *x: tried(SPEC, HYPER, BEST, *x))
KEEP = jax.jit(lambda *x: kept(HYPER, BEST, *x))


@pytest.fixture(scope="module")
def params():
    return init(SPEC, jax.random.key(2))


@pytest.fixture(scope="module")
def walk():
    return jax.jit(lambda k: fresh(SMALL, HYPER, None, k, BEST.problems))(jax.random.key(3))


@pytest.fixture(scope="module")
def tries(params, walk):
    return jax.device_get(TRY(params, walk, jax.random.key(4)))


@pytest.fixture(scope="module")
def again(walk, tries):
    """Every try played by hand, one decision after the other: cost, and what was seen."""
    step = jax.jit(world.step)
    see = jax.jit(look)
    loosen = jax.jit(lambda s: world.loosen(s, jnp.ones(s.goal.shape, bool)))
    found = []
    for f in range(BEST.problems * BEST.tries):
        start = jax.tree.map(lambda x, i=f // BEST.tries: x[i], walk.states)
        like, state, seen = walk.preference[f // BEST.tries], start, []
        for turn in range(tries.turns[f]):
            seen.append(see(state, like))
            result = step(state, tries.choice[f, turn])
            state = loosen(result.state)
        assert bool(result.terminated)
        time, way = float(state.now), float(result.state.travelled.sum())
        price = (1 - like + HYPER.tie) * time + (like + HYPER.tie) * way
        found.append((float(price / start.problem.unit), seen))
    return found


def test_what_a_try_costs(tries, again):
    assert tries.solved.all()
    np.testing.assert_allclose(tries.cost, [cost for cost, _ in again], rtol=1e-4, atol=1e-4)


def test_the_first_try_is_the_likeliest(params, walk, tries):
    other = jax.device_get(TRY(params, walk, jax.random.key(5)))
    first = np.arange(BEST.problems) * BEST.tries
    np.testing.assert_array_equal(other.choice[first], tries.choice[first])
    assert (other.choice != tries.choice).any()
    assert len(np.unique(tries.cost)) > 2 * BEST.problems


def test_the_best_is_kept_of_each_problem(walk, tries, again):
    """Whichever try is the cheapest, what is learned is what it saw, chose and came to."""
    for which in (0, 3):
        cost = tries.cost.reshape(BEST.problems, -1).copy()
        cost[:, which] = -1.0
        rows = jax.device_get(KEEP(walk, tries._replace(cost=cost.reshape(-1)), jax.random.key(6)))
        left = {(i, t) for i in range(BEST.problems)
                for t in range(tries.turns[i * BEST.tries + which])}
        for s in np.flatnonzero(np.asarray(choices(rows))):
            ours = [(i, t) for i, t in left if np.allclose(
                again[i * BEST.tries + which][1][t].travel, rows.view.travel[s], atol=1e-4)]
            assert len(ours) == 1
            (i, t), f = ours[0], ours[0][0] * BEST.tries + which
            left.remove((i, t))
            np.testing.assert_array_equal(rows.choice[s], tries.choice[f, t])
            np.testing.assert_array_equal(rows.options[s], tries.options[f, t])
            assert -tries.cost[f] <= rows.value[s] + 1e-4
            if t == 0:
                assert rows.value[s] == pytest.approx(-tries.cost[f], rel=1e-4, abs=1e-4)
        assert len(left) <= BEST.problems * 3


def test_one_step_makes_the_best_likelier(params, walk, tries):
    rows = KEEP(walk, tries, jax.random.key(7))
    hyper = dataclasses.replace(HYPER, vf_coef=0.0)
    count = jnp.sum(choices(rows))
    f = jax.jit(jax.value_and_grad(lambda p: loss(p, SPEC, hyper, rows, count)[0]))
    before, slope = f(params)
    log_prob, _ = chosen(jax.jit(lambda v: point(params, SPEC, v))(rows.view).logits,
                         rows.options, rows.choice)
    real = np.asarray(rows.options.sum(-1) > 1)
    assert -before == pytest.approx(np.asarray(log_prob)[real].mean(), rel=1e-4)
    after, _ = f(jax.tree.map(lambda p, g: p - 1e-2 * g, params, slope))
    assert after < before
