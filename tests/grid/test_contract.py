"""What callers build on: vmap is a loop, padding changes nothing, one compilation serves all."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from moonteam import grid

CONFIG = grid.EnvConfig(num_agents=3, num_targets=4, width=6, height=5, max_steps=20)
reset_to = jax.jit(grid.reset_to, static_argnums=0)
problem_fields = jax.jit(grid.problem_fields)
distances = jax.jit(grid.distances)
first_step = jax.jit(grid.first_step)
FAMILY = {"num_agents": 3, "num_targets": 4, "size": (6, 5), "max_steps": 20}


@partial(jax.jit, static_argnums=0)
def walk(config, problem, cells, actions):
    """Every step's result of a list of joint actions [T, N]."""
    state, _ = grid.reset_to(config, problem, cells)

    def one(state, joint):
        result = grid.step(config, state, joint)
        return result.state, result

    return jax.lax.scan(one, state, actions)[1]


walks = jax.jit(jax.vmap(walk, in_axes=(None, 0, 0, 0)), static_argnums=0)
resets = jax.jit(jax.vmap(grid.reset, in_axes=(None, 0)), static_argnums=0)


def some_problems(count, **changes):
    return [grid.to_problem(grid.generate(seed, **(FAMILY | changes))) for seed in range(count)]


def some_actions(shape, seed=0):
    return jnp.array(np.random.default_rng(seed).integers(0, 5, shape), jnp.int32)


def test_a_random_walk_keeps_the_invariants():
    states, _ = resets(CONFIG, jax.random.split(jax.random.key(0), 200))
    actions = some_actions((200, 25, 3))
    results = jax.tree.map(np.asarray, walks(CONFIG, states.problem, states.cells, actions))
    cells, solved = results.state.cells, results.state.solved
    assert ((cells >= 0) & (cells < np.array([6, 5]))).all()
    assert (solved[:, 1:] >= solved[:, :-1]).all(), "once solved, solved"
    assert solved.any()
    assert np.array_equal(results.terminated, solved.all(2))
    assert not (results.terminated & results.truncated).any()
    distance = np.abs(np.diff(cells, axis=1)).sum(3)
    assert np.array_equal(distance, results.true_moves[:, 1:])
    assert (results.true_moves <= (np.asarray(actions) != 4)).all()
    for name in ("WC", "SC", "TC"):
        assert (getattr(results.rewards, name) <= 0).all()
    assert (results.rewards.AR >= 0).all()
    assert np.allclose(results.rewards.TR.sum(1), solved[:, -1].sum(1)[:, None] / 4)


def test_vmap_is_a_loop():
    pairs = some_problems(3)
    actions = some_actions((3, 10, 3))
    batch, cells = grid.stack(pairs)
    together = walks(CONFIG, batch, cells, actions)
    for e, (problem, at) in enumerate(pairs):
        alone = walk(CONFIG, problem, at, actions[e])
        jax.tree.map(lambda a, b, e=e: np.testing.assert_allclose(a, b[e], rtol=1e-6),
                     alone, together)


def test_padding_changes_nothing():
    small, large = some_problems(1)[0], some_problems(1, num_agents=5, num_targets=7, size=(9, 9),
                                                      blocked={"legged": 0.2})[0]
    actions = some_actions((12, 5))
    plain = walk(CONFIG, *small, actions[:, :3])
    batch, cells = grid.stack([small, large])
    padded = walk(CONFIG, *jax.tree.map(lambda x: x[0], (batch, cells)), actions)
    np.testing.assert_array_equal(padded.state.cells[:, :3], plain.state.cells)
    np.testing.assert_array_equal(padded.state.solved[:, :4], plain.state.solved)
    np.testing.assert_allclose(padded.reward[:, :3], plain.reward, rtol=1e-6)
    np.testing.assert_array_equal(padded.terminated, plain.terminated)
    assert not np.asarray(padded.reward)[:, 3:].any()


def test_one_compilation_serves_every_problem_of_a_shape():
    traced = []

    def counted(config, state, actions):
        traced.append(config)
        return grid.step(config, state, actions).state

    step = jax.jit(counted, static_argnums=0)
    reset = jax.jit(grid.reset, static_argnums=0)
    for seed, (problem, cells) in enumerate(some_problems(3)):
        given, _ = reset_to(CONFIG, problem, cells)
        drawn, _ = reset(replace(CONFIG), jax.random.key(seed))
        for state in (given, drawn):
            step(replace(CONFIG), step(CONFIG, state, jnp.full(3, seed)), jnp.full(3, 4))
    assert len(traced) == 1, "equal configs and equal shapes compile once"


def test_agents_that_shorten_their_way_arrive():
    """The env, `travel` and the files agree: first steps solve an OR target in its distance."""
    scenario = grid.generate(4, num_agents=1, num_targets=1, num_skills=1, size=(12, 12),
                             blocked={"wheeled": 0.35})
    problem, cells = grid.to_problem(scenario)
    fields = problem_fields(problem)
    steps = int(distances(problem, fields, cells)[0, 0])
    assert steps > 3
    state, _ = reset_to(CONFIG, problem, cells)
    step = jax.jit(grid.step, static_argnums=0)
    for left in range(steps, 0, -1):
        assert int(distances(problem, fields, state.cells)[0, 0]) == left
        ways = first_step(problem, fields, state.cells)[0, 0]
        result = step(CONFIG, state, jnp.argmax(ways, keepdims=True).astype(jnp.int32))
        assert bool(result.true_moves[0])
        assert bool(result.terminated) == (left == 1)
        state = result.state


@pytest.mark.parametrize("name", grid.PRESETS)
def test_the_presets_run(name):
    config = grid.preset_config(name)
    state, observation = jax.eval_shape(lambda k: grid.reset(config, k), jax.random.key(0))
    assert observation.shape == (3, config.obs_dim)
    result = jax.eval_shape(lambda s, a: grid.step(config, s, a), state,
                            jax.ShapeDtypeStruct((3,), jnp.int32))
    assert jax.tree.structure(result.state) == jax.tree.structure(state)
    assert jax.tree.map(lambda x: (x.shape, x.dtype), result.state) == jax.tree.map(
        lambda x: (x.shape, x.dtype), state), "a scan carries the state"
