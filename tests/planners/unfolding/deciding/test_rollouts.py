"""Rollouts in the macro world, many at a time."""

import numpy as np

from moonteam import loading, paths
from moonteam.planners import macro
from moonteam.planners.unfolding.deciding.imagined import imagined
from moonteam.planners.unfolding.deciding.rollouts import FEW, rolled_out
from moonteam.planners.unfolding.future import future
from moonteam.planners.unfolding.world import World
from moonteam.policies.policy import Policy

POLICY = Policy.load(paths.find("unfolding_further", "policies", ".safetensors"))
SIZE = 12


def test_what_comes_of_a_rollout_does_not_depend_on_how_many_share_the_pool():
    mission = loading.load_set(paths.find("unfolding/following", "testsets", ".jsonl"))[3]
    view = World(mission).view()
    rng = np.random.default_rng(0)
    problems = imagined(view, [future(view, rng) for _ in range(4)], SIZE)
    open_ = len(view.targets)
    firsts = np.array([[j, (j + 1) % open_, SIZE] for j in range(open_)])

    def rolled(order):
        """Rollouts by their numbers: a future, and what is done first."""
        row, first = order % 4, firsts[order // 4 % open_]
        return rolled_out(macro.spec_of(POLICY), POLICY.params, problems, row, first,
                          np.full(first.shape, -1, np.int32), np.float32(0))

    few = np.arange(4 * open_)
    assert len(few) <= FEW
    alone = rolled(few)
    assert len(np.unique(alone[0].round(3))) > open_  # they do differ
    assert np.median(alone[0]) < mission.max_seconds
    many = rng.permutation(np.tile(few, 8))  # more than have a place at once
    assert len(many) > 2 * FEW
    for a, b in zip(alone, rolled(many), strict=True):
        np.testing.assert_allclose(b, a[many], atol=1e-3)
