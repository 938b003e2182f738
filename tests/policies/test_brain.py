"""A pointing network read step by step, all robots free at every moment."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from moonteam.grid import scenarios
from moonteam.planners.base import Snapshot
from moonteam.planners.learned import LearnedPlanner, fields_of, state_of
from moonteam.policies.policy import Policy
from moonteam.problem.rules import STAY


@pytest.fixture(scope="module")
def policy(pointing):
    return Policy.load(pointing)


def moment(seed=0, blocked=None):
    kinds = ["drone", "wheeled", "legged"] if blocked else None
    return Snapshot.start(scenarios.generate(
        seed, num_agents=3, num_targets=4, size=(9, 9), max_steps=90, blocked=blocked,
        kinds=kinds))


def read(policy, now, slots=4):
    fields = None if now.passable is None else fields_of(now, slots)
    batch = jax.tree.map(lambda x: np.asarray(x)[None], (state_of(now, slots), fields))
    decide = jax.jit(policy.brain.logits)
    memory, logits = decide(policy.params, policy.brain.begin(1, 3), *batch,
                            jnp.full(1, 90), jnp.zeros(1))
    assert memory == ()
    return np.asarray(logits[0])


@pytest.mark.parametrize("blocked", [None, {"drone": 0.0, "wheeled": 0.3, "legged": 0.2}])
def test_each_robot_shares_itself_among_moves_that_bring_it_nearer(policy, blocked):
    now = moment(3, blocked)
    chance = np.exp(read(policy, now))
    assert chance.shape == (3, 5)
    assert chance.sum(-1) == pytest.approx(1.0, abs=1e-4)
    assert np.exp(read(policy, now, 8)) == pytest.approx(chance, abs=1e-4)


def test_who_is_lost_stays_and_who_has_nothing_to_do_too(policy):
    now = moment()
    lost = replace(now, agent_mask=np.array([True, False, True]))
    assert read(policy, lost)[1].argmax() == STAY
    over = replace(now, solved=np.ones(4, bool))
    assert read(policy, over).argmax(-1).tolist() == [STAY] * 3


def test_it_serves_whatever_decides_step_by_step(policy):
    now = moment(2)
    plan = LearnedPlanner(policy).plan(now)
    assert plan.status == "feasible"
    assert policy.brain.prefers
