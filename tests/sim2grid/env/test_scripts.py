"""Every face with the shapes, wrappers and world states of JaxMARL's own baseline scripts.

The loops are ours; what they hand over is as in `mappo_rnn_mpe`, `ippo_ff_mpe` and the generic
`mappo_rnn` (actions of shape [1]), `ippo_rnn_*` and `mappo_rnn_smax` (squeezed, with available
actions), and the Q-learning scripts (`CTRolloutManager` over a log wrapper).
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from moonteam import grid
from moonteam.grid.macro.draw import Draw

ENVS, STEPS = 3, 4
FACES = ("grid", "macro", "mission")


@pytest.fixture
def face(request, on_points, drones):
    """Makes the environment of that name."""
    def made(name, **options):
        if name == "grid":
            return grid.MoonGrid(grid.EnvConfig(num_agents=2, num_targets=3, width=4, height=4,
                                                max_steps=3), **options)
        if name == "macro":
            return grid.MoonMacro(Draw(agents=(2, 3), targets=(2, 3)), **options)
        return on_points(drones, max_decisions=3, **options)

    return made


def world_state(jaxmarl, env, kind):
    """What the MPE and SMAX scripts wrap the environment in, for a critic that sees it all."""
    class Whole(jaxmarl["wrappers"].JaxMARLWrapper):
        """mpe: everybody's observations; smax: the environment's own state, and who asks."""

        def reset(self, key):
            observations, state = self._env.reset(key)
            return observations | {"world_state": self.whole(observations)}, state

        def step(self, key, state, actions):
            observations, *rest = self._env.step(key, state, actions)
            return observations | {"world_state": self.whole(observations)}, *rest

        def whole(self, observations):
            count = self._env.num_allies
            if kind == "mpe":
                seen = jnp.concatenate([observations[a] for a in self._env.agents])
                return jnp.tile(seen, (count, 1))
            told = jnp.tile(observations["world_state"], (count, 1))
            return jnp.concatenate([told, jnp.eye(count)], axis=1)

        def world_state_size(self):
            if kind == "mpe":
                return sum(self._env.observation_space(a).shape[-1] for a in self._env.agents)
            return self._env.state_size + self._env.num_allies

    return Whole(env)


def play(env, *, squeeze, masked):
    """STEPS of ENVS environments as the scripts step them, compiled; the last of all."""
    agents, actors = env.agents, ENVS * env.num_agents
    numbers = env.action_space(agents[0]).n
    length = env.observation_space(agents[0]).shape[0]

    def rows(by_agent):
        return jnp.stack([by_agent[a] for a in agents]).reshape(actors, -1)

    def step(carry, key):
        seen, state = carry
        assert rows(seen).shape == (actors, length)
        logits = jnp.zeros((actors, numbers))
        if masked:
            may = rows(jax.vmap(env.get_avail_actions)(state.env_state))
            assert may.shape == logits.shape
            logits = logits - 1e10 * (1 - may)
        action = jax.random.categorical(key, logits)  # [actors]
        acts = dict(zip(agents, action.reshape(env.num_agents, ENVS, -1), strict=True))
        if squeeze:
            acts = {a: x.squeeze() for a, x in acts.items()}
        seen, state, reward, done, info = jax.vmap(env.step)(
            jax.random.split(key, ENVS), state, acts)
        told = {name: value.reshape(actors) for name, value in info.items()}
        return (seen, state), (rows(reward).squeeze(), rows(done).squeeze(), done["__all__"], told)

    @jax.jit
    def run(key):
        start = jax.vmap(env.reset)(jax.random.split(key, ENVS))
        return jax.lax.scan(step, start, jax.random.split(key, STEPS))

    (seen, _), (reward, done, ended, told) = run(jax.random.key(0))
    assert reward.shape == done.shape == (STEPS, actors)
    assert ended.shape == (STEPS, ENVS)
    assert bool(ended.any()), "an episode ended and another began"
    assert told["returned_episode"].shape == (STEPS, actors)
    assert np.isfinite(reward).all()
    return seen


@pytest.mark.parametrize("name", FACES)
def test_actions_of_one_entry_and_the_mpe_world_state(jaxmarl, face, name):
    env = world_state(jaxmarl, face(name), "mpe")
    seen = play(jaxmarl["wrappers"].MPELogWrapper(env), squeeze=False, masked=False)
    assert seen["world_state"].shape == (ENVS, env.num_agents, env.world_state_size())


@pytest.mark.parametrize("name", FACES)
def test_masked_actions_and_the_smax_world_state(jaxmarl, face, name):
    env = world_state(jaxmarl, face(name, world_state=True), "smax")
    seen = play(jaxmarl["wrappers"].SMAXLogWrapper(env), squeeze=True, masked=True)
    assert seen["world_state"].shape == (ENVS, env.num_agents, env.world_state_size())
    first = seen["world_state"][:, 0, :env.observation_space("agent_0").shape[0]]
    np.testing.assert_array_equal(first, seen["agent_0"])


@pytest.mark.parametrize("name", FACES)
def test_the_rollout_manager_of_the_q_learners(jaxmarl, face, name):
    env = face(name, spaces=jaxmarl["spaces"])
    manager = jaxmarl["wrappers"].CTRolloutManager(
        jaxmarl["wrappers"].LogWrapper(env), batch_size=ENVS)
    observations, state = manager.batch_reset(jax.random.key(0))
    length = env.observation_space("agent_0").shape[0]
    assert observations["__all__"].shape == (ENVS, env.num_agents * length)
    assert observations["agent_0"].shape == (ENVS, length + env.num_agents)
    actions = {a: manager.batch_sample(jax.random.key(i), a) for i, a in enumerate(env.agents)}
    valid = manager.get_valid_actions(state.env_state)
    assert valid["agent_0"].shape == (ENVS, env.action_space("agent_0").n)
    _, _, rewards, dones, infos = manager.batch_step(jax.random.key(2), state, actions)
    np.testing.assert_allclose(rewards["__all__"], sum(rewards[a] for a in env.agents), rtol=1e-6)
    assert dones["__all__"].shape == (ENVS,)
    assert infos["returned_episode_returns"].shape == (ENVS, env.num_agents)
