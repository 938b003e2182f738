"""The JaxMARL face against JaxMARL's own base class and two of its wrappers."""

import inspect
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from moonteam import grid
from moonteam.grid.macro.draw import Draw

CONFIG = grid.EnvConfig(num_agents=2, num_targets=2, width=4, height=4, max_steps=6)
PUBLIC = ("reset", "step", "step_env", "get_obs", "observation_space", "action_space",
          "get_avail_actions", "name", "agent_classes")


@pytest.fixture(scope="module")
def env():
    return grid.MoonGrid(CONFIG)


def actions_of(env, joint):
    return {a: joint[..., i] for i, a in enumerate(env.agents)}


@pytest.mark.parametrize("name", ["MoonGrid", "MoonMacro"])
def test_jaxmarl_is_not_needed_at_run_time(name):
    code = (f"import sys, moonteam.grid as g; g.{name}(); "
            "sys.exit(any(m.split('.')[0] in ('jaxmarl', 'gymnax') for m in sys.modules))")
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("env", [
    grid.MoonGrid(CONFIG), grid.MoonMacro(Draw(agents=(2, 3), targets=(2, 4)))],
    ids=lambda env: env.name)
def test_every_public_method_has_the_base_classs_parameters(jaxmarl, env):
    base = jaxmarl["base"].MultiAgentEnv
    for name in PUBLIC:
        theirs, ours = inspect.getattr_static(base, name), inspect.getattr_static(env, name)
        assert isinstance(theirs, property) == isinstance(ours, property), name
        if not isinstance(theirs, property):
            assert list(inspect.signature(getattr(base, name)).parameters) == list(
                inspect.signature(getattr(type(env), name)).parameters), name
    made = base(num_agents=env.num_agents)
    assert env.agents == made.agents
    assert set(vars(made)) <= set(vars(env)), "attributes that wrappers read"


def test_its_step_is_the_base_classs_step(jaxmarl, env):
    """JaxMARL's own `step`, run on our `step_env` and `reset`, gives what our `step` gives."""
    theirs = jaxmarl["base"].MultiAgentEnv.step
    _, state = env.reset(jax.random.key(0))
    ended = 0
    for t in range(8):
        key = jax.random.key(t)
        actions = actions_of(env, jnp.array([t % 4, 4]))
        ours = env.step(key, state, actions)
        jax.tree.map(np.testing.assert_array_equal, ours, theirs(env, key, state, actions))
        ended += bool(ours[3]["__all__"])
        state = ours[1]
    assert ended >= 1, "the automatic reset was never reached"
    again = env.step(jax.random.key(9), state, actions, env.reset(jax.random.key(3))[1])
    jax.tree.map(np.testing.assert_array_equal, again, theirs(
        env, jax.random.key(9), state, actions, env.reset(jax.random.key(3))[1]))


def test_automatic_reset_begins_a_new_episode(env):
    observations, state = env.reset(jax.random.key(1))
    stay = actions_of(env, jnp.full(2, 4))
    for t in range(CONFIG.max_steps):
        assert int(state.step) == t
        before = state
        observations, state, rewards, dones, infos = env.step(jax.random.key(t), state, stay)
    assert set(dones) == {*env.agents, "__all__"}
    assert all(bool(d) for d in dones.values())
    assert infos["truncated"].tolist() == [True, True]
    assert int(state.step) == 0
    fresh_observations, fresh = env.reset(jax.random.split(jax.random.key(t))[1])
    jax.tree.map(np.testing.assert_array_equal, (observations, state), (fresh_observations, fresh))
    kept, after, *_ = env.step_env(jax.random.key(t), before, stay)
    assert int(after.step) == CONFIG.max_steps, "step_env does not reset"
    assert set(rewards) == set(kept) == set(env.agents)


def test_spaces_and_available_actions(env):
    observations, state = env.reset(jax.random.key(2))
    available = env.get_avail_actions(state)
    for i, agent in enumerate(env.agents):
        assert bool(env.observation_space(agent).contains(observations[agent]))
        assert observations[agent].shape == env.observation_space(agent).shape
        assert not bool(env.observation_space(agent).contains(observations[agent] + 99))
        drawn = env.action_space(agent).sample(jax.random.key(i))
        assert bool(env.action_space(agent).contains(drawn))
        assert not bool(env.action_space(agent).contains(jnp.array(5)))
        assert env.observation_space(agent).sample(jax.random.key(i)).shape == (CONFIG.obs_dim,)
        assert np.array_equal(available[agent], grid.available(state)[i])
    assert (env.num_agents, env.name, env.agent_classes) == (2, "MoonGrid", {"robot": env.agents})


def test_log_wrapper_under_jit_and_vmap(jaxmarl, env):
    wrapped = jaxmarl["wrappers"].LogWrapper(env)

    @jax.jit
    def run(key):
        _, state = jax.vmap(wrapped.reset)(jax.random.split(key, 8))

        def one(state, key):
            actions = actions_of(env, jax.random.randint(key, (8, 2), 0, 5))
            _, state, reward, _, info = jax.vmap(wrapped.step)(
                jax.random.split(key, 8), state, actions)
            return state, (reward["agent_0"], info)

        return jax.lax.scan(one, state, jax.random.split(key, 12))[1]

    rewards, info = jax.tree.map(np.asarray, run(jax.random.key(0)))
    assert info["returned_episode"].sum() >= 16, "every env ended at least once"
    first = info["returned_episode"][:, :, 0].argmax(0)
    for e, t in enumerate(first):
        assert info["returned_episode_lengths"][t, e, 0] == t + 1 <= CONFIG.max_steps
        np.testing.assert_allclose(info["returned_episode_returns"][t, e, 0],
                                   rewards[:t + 1, e].sum(), rtol=1e-5)
