"""The macro world's JaxMARL face against JaxMARL's base class and one of its wrappers."""


import jax
import jax.numpy as jnp
import numpy as np
import pytest

from moonteam import grid
from moonteam.grid.macro import world
from moonteam.grid.macro.draw import Draw

FAMILY = Draw(agents=(2, 3), targets=(2, 4), sides=(6, 8), speeds=(1.0, 0.5), limit=60.0)


@pytest.fixture(scope="module")
def env():
    return grid.MoonMacro(FAMILY)


def random_actions(env, state, key):
    """Of each agent one that it may take by itself."""
    may = env.get_avail_actions(state)
    return {a: jnp.argmax(jax.random.gumbel(jax.random.fold_in(key, i), may[a].shape)
                          + jnp.where(may[a], 0.0, -1e9)) for i, a in enumerate(env.agents)}


def test_episodes_end_and_begin_again(env):
    """Choices made at once, each allowed by itself: whose is not when its turn comes, waits."""
    observations, state = env.reset(jax.random.key(0))
    step, step_env = jax.jit(env.step), jax.jit(env.step_env)
    allowed = jax.jit(world.allowed)
    ended, spent = 0, 0.0
    for t in range(40):
        for i, agent in enumerate(env.agents):
            space = env.observation_space(agent)
            assert observations[agent].shape == space.shape
            assert bool(space.contains(observations[agent]))
            own = env.get_avail_actions(state)[agent]
            assert own.shape == (FAMILY.targets[1] + 1,)
            assert own[:-1].tolist() == allowed(state, state.goal)[i].tolist()
            assert bool(own.any())
        actions = random_actions(env, state, jax.random.key(t))
        before = state
        observations, state, rewards, dones, infos = step(jax.random.key(t), state, actions)
        assert set(dones) == {*env.agents, "__all__"}
        assert len({float(r) for r in rewards.values()}) == 1
        np.testing.assert_allclose(
            rewards["agent_0"], -infos["seconds"][0] / before.problem.unit, rtol=1e-6)
        spent += float(infos["seconds"][0])
        if bool(dones["__all__"]):
            assert all(map(bool, dones.values()))
            kept, after, *_ = step_env(jax.random.key(t), before, actions)
            assert set(kept) == set(env.agents)
            assert bool(after.solved.all()) == bool(infos["terminated"][0])
            np.testing.assert_allclose(after.now, spent, rtol=1e-5)
            _, fresh = env.reset(jax.random.split(jax.random.key(t))[1])
            jax.tree.map(np.testing.assert_array_equal, state, fresh)
            ended, spent = ended + 1, float(state.now)
    assert ended >= 3


def test_log_wrapper_under_jit_and_vmap(jaxmarl, env):
    wrapped = jaxmarl["wrappers"].LogWrapper(env)

    @jax.jit
    def run(key):
        _, state = jax.vmap(wrapped.reset)(jax.random.split(key, 8))

        def one(state, key):
            actions = {a: jax.random.randint(jax.random.fold_in(key, i), (8,), 0, 5)
                       for i, a in enumerate(env.agents)}
            _, state, reward, _, info = jax.vmap(wrapped.step)(
                jax.random.split(key, 8), state, actions)
            return state, (reward["agent_0"], info)

        return jax.lax.scan(one, state, jax.random.split(key, 30))[1]

    rewards, info = jax.tree.map(np.asarray, run(jax.random.key(0)))
    assert (rewards <= 0).all()
    assert info["returned_episode"].sum() >= 8
    assert info["terminated"].sum() == info["returned_episode"].sum(), "no episode is cut off"
