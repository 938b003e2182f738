"""Ways along x and then y: who turns on one is where it is, and not where it suits."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from moonteam.grid.macro import world
from moonteam.grid.macro.draw import Draw, draw
from moonteam.grid.macro.streets import Streets, middle_now, turned, ways
from moonteam.planners.seconds.base import MS
from moonteam.planners.unfolding.ways import Way

FAMILY = Draw(targets=(6, 6), following=3)


def test_who_turns_is_where_the_way_of_the_planners_world_is():
    rng = np.random.default_rng(0)
    at = rng.integers(0, 32, (5, 2)).astype(np.float32)
    here = rng.integers(0, 32, (3, 2)).astype(np.float32)
    streets = Streets(jnp.asarray(at), jnp.asarray(here), jnp.array([1.0, 0.5, 2.0]),
                      jnp.zeros((0, 2)))
    origin, node = jnp.array([5, 2, 0]), jnp.array([1, 4, 0])  # the last goes nowhere
    for share in (0.0, 0.3, 0.8, 1.0):
        begins = [here[0], at[2], at[0]]
        own = [Way.of(tuple(a.tolist()), tuple(at[int(b)].tolist()), "manhattan", v, 0)
               for a, b, v in zip(begins, node, (1.0, 0.5, 2.0), strict=True)]
        gone = jnp.array([share * way.arrives / MS for way in own])
        after = turned(streets, jnp.array([True, True, True]), origin, node, gone)
        for i, way in enumerate(own):
            np.testing.assert_allclose(after.here[i], way.at(round(share * way.arrives)), atol=1e-2)
        some = turned(streets, jnp.array([False, True, False]), origin, node, gone)
        np.testing.assert_array_equal(some.here[0], here[0])
        np.testing.assert_array_equal(some.here[1], after.here[1])
        far = np.abs(np.asarray(after.here)[:, None] - at).sum(-1) / [[1.0], [0.5], [2.0]]
        np.testing.assert_allclose(ways(after), far, atol=1e-4)


def test_from_there_it_goes_on_as_far_as_that_is():
    """The corner of a way is reached by nobody who is on another."""
    problem = draw(FAMILY, jax.random.key(3))
    state = world.reset(problem)
    logits = jax.random.normal(jax.random.key(4), (3, 7))
    choice, _ = world.choose(state, logits, jnp.zeros_like(logits))
    result = world.step(state, choice)
    going = np.asarray((result.state.goal < 6) & (result.state.busy > 0))
    assert going.any()
    after = world.loosen(result.state, jnp.ones(3, bool)).problem
    streets = after.streets
    assert streets is not None
    passed = float(result.seconds)
    for i in np.flatnonzero(going):
        begin, end = np.asarray(problem.streets.here[i]), np.asarray(streets.at[int(choice[i])])
        way = Way.of(tuple(begin.tolist()), tuple(end.tolist()), "manhattan", 1.0, 0)
        np.testing.assert_allclose(streets.here[i], way.at(round(MS * passed)), atol=1e-2)
        far = np.abs(np.asarray(streets.at) - np.asarray(streets.here[i])).sum(-1)
        np.testing.assert_allclose(after.start[i], far, atol=1e-3)
        spread = np.abs(np.asarray(streets.spread) - np.asarray(streets.here[i])).sum(-1)
        assert float(after.middle_now[i]) == pytest.approx(spread.mean(), abs=1e-3)
    # Stewart's theorem, which is for straight ways, is seconds off here.
    blind = replace(result.state, problem=replace(result.state.problem, streets=None))
    guess = np.asarray(world.loosen(blind, jnp.ones(3, bool)).problem.start)[going]
    assert np.abs(guess - np.asarray(after.start)[going]).max() > 1.0


def test_only_where_ways_are_of_that_kind_and_things_unfold_is_it_asked():
    def of(**how):
        return draw(replace(FAMILY, **how), jax.random.key(0)).streets

    assert of(following=0) is None
    assert of(metric="straight") is None
    streets = of()
    np.testing.assert_allclose(middle_now(streets), draw(FAMILY, jax.random.key(0)).middle_now,
                               rtol=1e-5)
    nobody = replace(streets, spread=jnp.zeros((0, 2)))
    assert not np.asarray(middle_now(nobody)).any()
