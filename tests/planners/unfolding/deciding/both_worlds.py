"""A mission that a policy plays, in the planners' world and in the macro world."""

import numpy as np

from moonteam.planners import macro
from moonteam.planners.unfolding.deciding.make import Choosing
from moonteam.planners.unfolding.deciding.pointing import Pointing
from moonteam.planners.unfolding.deciding.rollouts import rolled_out


def took(policy, world, view, problem, rest):
    """s in either: of a `world` at its start, of which `view` is shown; and of `problem`, in which
    what comes is what will come. Who has nothing to do does as `rest` has it.
    """
    pointing = Pointing(policy)
    first = pointing.choose([view])[0]
    orders = Choosing(pointing.choose, rest)
    while not world.over:
        world.step(orders.act(world.view()))
    who = np.where(first >= 0, first, problem.service.shape[1])[None]
    seconds, _, _ = rolled_out(macro.spec_of(policy), policy.params, problem, np.zeros(1, int),
                               who, np.full(who.shape, -1, np.int32), np.float32(0))
    return world.outcome.seconds, float(seconds[0])
