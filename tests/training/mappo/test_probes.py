"""The learner on tasks whose value and best action are known beforehand."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from moonteam.policies.recurrent import Recurrent
from training.mappo import rollout, update
from training.mappo.hyper import Hyper
from training.mappo.networks import Networks
from training.mappo.task import Outcome

HYPER = Hyper(updates=60, num_minibatches=2, lr=1e-2, ent_coef=0.0, num_steps=8, update_epochs=4,
              gamma=0.5, gae_lambda=0.9, clip_eps=0.2, vf_coef=0.5, max_grad_norm=0.5,
              adam_eps=1e-5, timeout_is_terminal=False)


def nets(memory=True):
    return Networks(Recurrent(5, 16, memory, 0.01), Recurrent(1, 16, memory, 1.0), (1.0, 1.0), 1)


@dataclass(frozen=True)
class Probe:
    """One agent; state [E, 2] int32 is (cue, step); observation (cue or 0, step or 0)."""

    length: int = 1
    blind: bool = False
    """The cue is shown at the first step alone, and the step never."""
    endless: bool = False
    """Ends are truncations."""
    num_agents: int = 1
    max_steps: int = 8

    def reset(self, key, count):
        cue = jax.random.bernoulli(key, shape=(count,)).astype(jnp.int32) * 2 - 1
        return jnp.stack([cue, jnp.zeros_like(cue)], axis=1)

    def observe(self, state):
        if self.blind:
            state = state * (state[:, 1:] == 0) * jnp.array([[1, 0]])
        return state[:, None, :].astype(jnp.int8)

    def step(self, key, state, action):
        cue, step = state[:, 0], state[:, 1] + 1
        last = step >= self.length
        right = action[:, 0] == jnp.where(cue > 0, 3, 1)
        reward = self.reward(last, right)
        over = last & (not self.endless)
        return Outcome(jnp.stack([cue, step], axis=1), reward[:, None].astype(jnp.float32), over,
                       last & ~over, step, step)

    def reward(self, last, right):
        return last & right


@dataclass(frozen=True)
class Always(Probe):
    """Reward 1 each step, whatever is done."""

    def reward(self, last, right):
        return jnp.ones_like(last)


def trained(task, networks=None, hyper=HYPER, seed=0):
    networks = networks or nets()
    learner = update.begin(networks, task, hyper, 64, jax.random.key(seed))
    return update.chunk(networks, task, hyper, learner, hyper.updates)


def values(learner, obs):
    """Values along one episode with the observations [T, 2]."""
    obs = jnp.asarray(obs, jnp.float32)[:, None, None, :]
    reset = jnp.zeros(obs.shape[:2], bool)
    return nets().values(learner.params.critic, nets().empty(1).critic, obs, reset)[1][:, 0, 0]


def test_one_step_best_action_depends_on_the_observation():
    learner, report = trained(Probe())
    assert report.mean_reward[-5:].mean() > 0.97  # chance: 0.2
    for cue in (-1, 1):
        np.testing.assert_allclose(values(learner, [[cue, 0]]), [1.0], atol=0.06)


def test_two_steps_discount():
    learner, _ = trained(Probe(length=2))
    np.testing.assert_allclose(values(learner, [[1, 0], [1, 1]]), [0.5, 1.0], atol=0.08)


def test_termination_ends_the_value_and_truncation_does_not():
    """Reward 1 a step for two steps: 1 + 0.5, or for ever: 1 / (1 - 0.5)."""
    learner, _ = trained(Always(length=2))
    np.testing.assert_allclose(values(learner, [[1, 0], [1, 1]]), [1.5, 1.0], atol=0.1)
    # cut off at the end of each rollout: one truncation an environment and rollout
    learner, _ = trained(Always(length=8, endless=True))
    np.testing.assert_allclose(values(learner, [[1, t] for t in range(8)]), np.full(8, 2.0),
                               atol=0.15)


def test_timeout_is_terminal_takes_the_cut_for_an_end():
    hyper = Hyper(**{**vars(HYPER), "timeout_is_terminal": True})
    learner, _ = trained(Always(length=8, endless=True), hyper=hyper)
    found = values(learner, [[1, t] for t in range(8)])
    np.testing.assert_allclose(found[-2:], [1.5, 1.0], atol=0.2)


@pytest.mark.parametrize("memory", [True, False])
def test_memory_probe(memory):
    """The cue is seen only at step 0 and asked for at step 3; without memory: chance."""
    hyper = Hyper(**{**vars(HYPER), "updates": 90, "gamma": 0.9})
    _, report = trained(Probe(length=4, blind=True), nets(memory), hyper)
    right = float(report.mean_reward[-5:].mean()) * 4
    assert right > 0.95 if memory else 0.3 < right < 0.65


def test_minibatches_hold_each_environment_once():
    order = update.order(jax.random.key(0), 12, 3)
    assert order.shape == (3, 4)
    assert sorted(order.reshape(-1).tolist()) == list(range(12))


def test_a_pool_start_follows_an_end():
    """Where an episode ended, the next observation is a first one and the flag is set."""
    task, networks = Probe(length=3), nets()
    carry = rollout.begin(networks, task, jax.random.key(1), 4)
    params = networks.init(jax.random.key(2))
    _, batch = rollout.collect(networks, task, params, carry, jax.random.key(3), 8)
    steps = batch.steps
    first = np.asarray(steps.obs[:, :, 0, 1]) == 0
    np.testing.assert_array_equal(first, steps.reset_before)
    np.testing.assert_array_equal(steps.reset_before[1:], steps.terminated[:-1])
