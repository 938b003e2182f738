"""Rollouts in the macro world, many at a time."""

from dataclasses import replace

import numpy as np
import pytest

from moonteam import loading, paths
from moonteam.planners import macro
from moonteam.planners.seconds.exact import ExactPlanner
from moonteam.planners.unfolding.deciding.deciders import Replanning
from moonteam.planners.unfolding.deciding.imagined import imagined
from moonteam.planners.unfolding.deciding.rollouts import FEW, rolled_out
from moonteam.planners.unfolding.future import Future, future
from moonteam.planners.unfolding.world import World
from moonteam.policies.policy import Policy
from tests.planners.unfolding.deciding.both_worlds import took

POLICY = Policy.load(paths.find("unfolding_further", "policies", ".safetensors"))
SIZE = 12


def futures(mission, count):
    """The mission's first moment in so many futures, and whom each target would ask first."""
    view = World(mission).view()
    rng = np.random.default_rng(0)
    problems = imagined(view, [future(view, rng) for _ in range(count)], SIZE)
    open_ = len(view.targets)
    return problems, np.array([[j, (j + 1) % open_, SIZE] for j in range(open_)])


def test_what_comes_of_a_rollout_does_not_depend_on_how_many_share_the_pool():
    mission = loading.load_set(paths.find("unfolding/following", "testsets", ".jsonl"))[7]
    problems, firsts = futures(mission, 4)
    open_ = len(firsts)

    def rolled(order):
        """Rollouts by their numbers: a future, and what is done first."""
        row, first = order % 4, firsts[order // 4 % open_]
        return rolled_out(macro.spec_of(POLICY), POLICY.params, problems, row, first,
                          np.full(first.shape, -1, np.int32), np.float32(0))

    few = np.arange(4 * open_)
    assert len(few) <= FEW
    alone = rolled(few)
    assert len(np.unique(alone[0].round(3))) > open_  # they do differ
    assert (alone[0] < mission.max_seconds).all()
    many = np.random.default_rng(0).permutation(np.tile(few, 8))  # more than have a place at once
    assert len(many) > 2 * FEW
    for a, b in zip(alone, rolled(many), strict=True):
        np.testing.assert_allclose(b, a[many], atol=1e-3)


@pytest.mark.parametrize("service", [0.0, 3.0])
def test_a_plan_of_what_is_left_is_never_later_than_the_policy(service):
    mission = loading.load_set(paths.find("unfolding/following", "testsets", ".jsonl"))[3]
    problems, firsts = futures(mission, 8)
    targets = problems.target_mask
    problems = replace(problems, service=np.where(targets, np.float32(service), problems.service),
                       limit=problems.limit + np.float32(100))
    row = np.repeat(np.arange(8), len(firsts))
    first = np.tile(firsts, (8, 1))

    def spans(some, finish):
        return rolled_out(macro.spec_of(POLICY), POLICY.params, some, row, first,
                          np.full(first.shape, -1, np.int32), np.float32(0), finish)[0]

    alone, planned = spans(problems, False), spans(problems, True)
    assert (planned <= alone + 2e-2).all()
    assert (planned < alone - 0.5).any()
    late = replace(problems, limit=np.sort(planned)[:8].astype(np.float32) - 1)
    over = spans(late, True) > late.limit[row]
    assert over.any(), "what is not done in time counts as not done"
    # Where robots have homes, nobody plans, and nothing is else than without.
    homely = replace(problems, home=problems.home + np.float32(1) * targets[:, None])
    np.testing.assert_array_equal(spans(homely, True), spans(homely, False))


@pytest.mark.parametrize("number", [1, 2, 5, 9])
def test_a_policy_takes_as_long_in_both_worlds(number):
    mission = loading.load_set(paths.find("unfolding/following", "testsets", ".jsonl"))[number]
    world = World(mission)
    view = world.view()
    rest = mission.targets[len(view.targets):]
    assert rest
    problem = imagined(view, [Future(rest, (None,) * len(view.agents), None)], SIZE)
    here, there = took(POLICY, world, view, problem, Replanning(ExactPlanner()))
    assert there == pytest.approx(here, abs=0.05)
