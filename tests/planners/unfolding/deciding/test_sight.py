"""A mission with hidden targets in the macro world is the one that the planners' world plays."""

import numpy as np
import pytest

from moonteam import loading, paths
from moonteam.planners import macro
from moonteam.planners.seconds.exact import ExactPlanner
from moonteam.planners.unfolding.deciding.deciders import Replanning
from moonteam.planners.unfolding.deciding.imagined import imagined
from moonteam.planners.unfolding.deciding.make import Choosing
from moonteam.planners.unfolding.deciding.pointing import Pointing
from moonteam.planners.unfolding.deciding.rollouts import rolled_out
from moonteam.planners.unfolding.future import Future
from moonteam.planners.unfolding.world import World
from moonteam.policies.policy import Policy

POLICY = Policy.load(paths.find("any_team", "policies", ".safetensors"))
SIZE = 24


@pytest.mark.parametrize("number", [0, 4, 8, 11])
def test_a_policy_takes_as_long_in_both_worlds(number):
    mission = loading.load_set(paths.find("unfolding/hidden", "testsets", ".jsonl"))[number]
    world, places = World(mission), Replanning(ExactPlanner(), places=True)
    pointing = Pointing(POLICY)
    view = places.shown(world.view())
    known = {target.at for target in view.targets}
    rest = tuple(target for target in mission.targets if target.at not in known)
    assert rest
    first = pointing.choose([view])[0]
    orders = Choosing(pointing.choose, places)
    while not world.over:
        world.step(orders.act(world.view()))
    problem = imagined(view, [Future(rest, (None,) * len(mission.agents), None)], SIZE)
    who = np.where(first >= 0, first, SIZE)[None]
    seconds, _, _ = rolled_out(macro.spec_of(POLICY), POLICY.params, problem, np.zeros(1, int),
                               who, np.full(who.shape, -1, np.int32), np.float32(0))
    # Times of the macro world are float32, and it sees a hair further.
    assert float(seconds[0]) == pytest.approx(world.outcome.seconds, abs=0.05)
