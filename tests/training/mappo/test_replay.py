"""The update replays what collection did: the ratio of the first minibatch is 1."""

import jax
import jax.numpy as jnp
import numpy as np

from moonteam.grid.config import EnvConfig
from moonteam.policies.recurrent import RecurrentSpec
from training.mappo import networks, rollout, update
from training.mappo.config import preset
from training.mappo.grid_task import GridTask

SPEC = RecurrentSpec(2, 2, (4, 4), width=8)
NETS = networks.for_spec(SPEC)
TASK = GridTask(EnvConfig(2, 2, 4, 4, max_steps=10, normalize_positions=False))
NUM_ENVS, NUM_STEPS = 8, 16


def collected():
    params = NETS.init(jax.random.key(0))
    carry = rollout.begin(NETS, TASK, jax.random.key(1), NUM_ENVS)
    collect = jax.jit(lambda carry, key: rollout.collect(NETS, TASK, params, carry, key, NUM_STEPS))
    carry, _ = collect(carry, jax.random.key(2))
    return params, *collect(carry, jax.random.key(3))


def test_ratio_is_one_and_values_are_the_same():
    params, _, batch = collected()
    steps = batch.steps
    inside = np.asarray(steps.reset_before[1:])
    assert 0 < inside.sum() < inside.size, "the probe needs a reset inside the rollout"
    part = update.minibatch(batch, steps.reward, steps.reward, jnp.array([5, 2, 7, 0]))
    replayed = part.steps
    _, logits = NETS.logits(params.actor, part.memory.actor, replayed.obs, replayed.reset_before)
    ratio = jnp.exp(rollout.log_prob(logits, replayed.action) - replayed.log_prob)
    np.testing.assert_allclose(ratio, 1.0, rtol=0, atol=2e-6)
    _, values = NETS.values(params.critic, part.memory.critic, replayed.obs, replayed.reset_before)
    np.testing.assert_allclose(values, replayed.value, rtol=1e-5, atol=2e-6)


def test_without_the_reset_flags_the_replay_differs():
    params, _, batch = collected()
    steps, never = batch.steps, jnp.zeros_like(batch.steps.reset_before)
    _, values = NETS.values(params.critic, batch.before.critic, steps.obs, never)
    assert float(jnp.abs(values - steps.value).max()) > 1e-3


def test_the_cut_value_is_that_of_the_final_observation():
    params, carry, batch = collected()
    steps = batch.steps
    assert bool(steps.truncated.any())
    last = NETS.values(params.critic, carry.memory.critic, carry.obs[None],
                       carry.reset_before[None])[1][0]
    np.testing.assert_allclose(batch.last_value, last, rtol=1e-5, atol=1e-6)
    cut = steps.truncated.any(axis=0)
    following = np.concatenate([steps.value[1:], batch.last_value[None]])
    at = np.argmax(np.asarray(steps.truncated), axis=0)
    next_first = following[at, np.arange(NUM_ENVS)]
    assert not np.allclose(batch.cut_value[cut], next_first[cut], atol=1e-4)


def test_observations_are_stored_small_and_scaled_by_the_network():
    _, _, batch = collected()
    assert batch.steps.obs.dtype == jnp.int8
    config = preset("small")
    task = GridTask(config.env(config.bootstrap))
    state = task.reset(jax.random.key(0), 3)
    from moonteam.grid.observe import observe

    divided = EnvConfig(3, 3, 8, 8)
    expected = jax.vmap(lambda s: observe(divided, s))(state.world)
    nets = networks.for_spec(config.spec)
    np.testing.assert_allclose(nets.inputs(task.observe(state)), expected, rtol=1e-6)
