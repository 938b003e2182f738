"""The entity network: any size, padding without effect, equivariance, moves that make sense."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from moonteam.grid import env, scenarios
from moonteam.grid.config import EnvConfig
from moonteam.grid.travel import problem_fields
from moonteam.grid.types import Problem, State
from moonteam.policies.entity import STAY, EntitySpec, agree, decide, init, look, usable

SPEC = EntitySpec(width=16, heads=2, layers=2)


@jax.jit
def noisy_params():
    """Biases start at zero; random ones show what they touch."""
    return jax.tree.map(lambda x: x + 0.3 * jax.random.normal(jax.random.key(x.size), x.shape),
                        init(SPEC, jax.random.key(0)))


PARAMS = noisy_params()


@partial(jax.jit, static_argnums=(0, 1, 2))
def sampled(agents=3, targets=5, seed=0, **counts):
    config = EnvConfig(num_agents=agents, num_targets=targets, width=12, height=10)
    return env.reset(config, jax.random.key(seed), **counts)[0]


@jax.jit
def act(state, preference=0.0, fields=None):
    return decide(PARAMS, SPEC, look(state, 128, jnp.asarray(preference), fields))


see = jax.jit(lambda state, fields=None: look(state, 128, jnp.zeros(()), fields))


@pytest.mark.parametrize(("agents", "targets"), [(1, 1), (3, 5), (8, 40)])
def test_one_set_of_weights_takes_any_team(agents, targets):
    decision = act(sampled(agents, targets))
    assert decision.log_probs.shape == (agents, 5)
    np.testing.assert_allclose(jnp.exp(decision.log_probs).sum(-1), 1.0, atol=1e-4)


def test_padding_changes_nothing():
    small = sampled(3, 5)
    padded = sampled(5, 9, num_agents=3, num_targets=5)
    problem = replace(
        padded.problem,
        agent_skills=padded.problem.agent_skills.at[:3].set(small.problem.agent_skills),
        target_cells=padded.problem.target_cells.at[:5].set(small.problem.target_cells),
        target_skills=padded.problem.target_skills.at[:5].set(small.problem.target_skills),
        target_and=padded.problem.target_and.at[:5].set(small.problem.target_and))
    padded = replace(padded, problem=problem, cells=padded.cells.at[:3].set(small.cells),
                     solved=padded.solved.at[:5].set(small.solved))
    np.testing.assert_allclose(act(padded).log_probs[:3], act(small).log_probs, atol=1e-4)


def test_order_of_agents_and_targets_does_not_matter():
    state = sampled(4, 6)
    agents, targets = np.array([2, 0, 3, 1]), np.array([5, 3, 1, 0, 2, 4])
    p = state.problem
    shuffled = replace(
        state, cells=state.cells[agents], solved=state.solved[targets],
        problem=replace(p, agent_skills=p.agent_skills[agents],
                        target_cells=p.target_cells[targets],
                        target_skills=p.target_skills[targets],
                        target_and=p.target_and[targets]))
    np.testing.assert_allclose(act(shuffled).log_probs, act(state).log_probs[agents], atol=1e-4)


def test_only_open_targets_of_shared_skill_are_pointed_at():
    state = sampled(3, 5, seed=4)
    state = replace(state, solved=state.solved.at[1].set(True))
    view, pointer = see(state), act(state).pointer
    share = (state.problem.agent_skills[:, None] & state.problem.target_skills[None, :]) != 0
    wanted = share & ~state.solved[None, :]
    np.testing.assert_array_equal(usable(view), wanted)
    np.testing.assert_array_equal(pointer[:, :-1] > -1e8, wanted)


def test_moves_shorten_the_way_or_are_rare():
    state = sampled(3, 5, seed=2)
    view, probs = see(state), np.exp(act(state).log_probs)
    helpful = np.asarray((view.toward & usable(view)[..., None]).any(1))  # [N, 4]
    assert (probs[:, :STAY][~helpful] <= SPEC.free + 1e-6).all()


def test_preference_and_travel_times_reach_the_decision():
    state = sampled(3, 5)
    assert not np.allclose(act(state, 0.0).pointer, act(state, 1.0).pointer)
    made = scenarios.generate(3, num_agents=3, num_targets=4, size=(12, 12),
                              blocked={"drone": 0.0, "legged": 0.2, "wheeled": 0.3},
                              kinds=["drone", "legged", "wheeled"])
    problem, cells = scenarios.to_problem(made)
    walled = env.reset_to(scenarios.config_for(made), problem, cells)[0]
    fields = problem_fields(problem)
    view = see(walled, fields)
    assert (np.asarray(view.travel) >= np.abs(
        np.asarray(problem.target_cells)[None] - np.asarray(cells)[:, None]).sum(-1)).all()
    # A move that the ground turns back never shortens a way.
    assert not (np.asarray(view.toward) & ~np.asarray(view.allowed)[:, None]).any()
    assert np.isfinite(act(walled, 0.0, fields).log_probs).all()


def test_open_map_read_by_fields_is_the_same_map():
    state = sampled(3, 5)
    free = jnp.ones((1, 10, 12), bool)
    walled = replace(state, problem=replace(state.problem, passable=free))
    by_fields = act(walled, fields=problem_fields(walled.problem))
    np.testing.assert_allclose(by_fields.log_probs, act(state).log_probs, atol=1e-4)


def claims(pointer, skills, target_skills, both):
    """`agree` for a team at one place before targets side by side."""
    agents, targets = len(skills), len(target_skills)
    problem = Problem(
        size=jnp.array([8, 8]), agent_skills=jnp.array(skills),
        agent_kinds=jnp.zeros(agents, jnp.int32), agent_mask=jnp.ones(agents, bool),
        target_cells=jnp.array([[x, 5] for x in range(targets)]),
        target_skills=jnp.array(target_skills), target_and=jnp.array(both),
        target_mask=jnp.ones(targets, bool))
    state = State(problem, jnp.zeros((agents, 2), jnp.int32), jnp.zeros(targets, bool),
                  jnp.zeros((), jnp.int32))
    view = look(state, 128, jnp.zeros(()))
    got = agree(jnp.array(pointer, jnp.float32), view)
    return np.asarray(jnp.argmax(got, axis=-1))


def test_the_surest_takes_an_or_target_and_the_others_the_next():
    logits = [[5.0, 1.0, 0.0], [9.0, 1.0, 0.0], [4.0, 0.0, 2.0]]
    np.testing.assert_array_equal(claims(logits, [1, 1, 1], [1, 1], [False, False]), [1, 0, 2])


def test_an_and_target_is_open_to_whoever_brings_what_is_missing():
    logits = [[9.0, 1.0, 0.0], [8.0, 1.0, 0.0], [7.0, 1.0, 0.0]]
    np.testing.assert_array_equal(claims(logits, [1, 1, 2], [3, 3], [True, False]), [0, 1, 0])
