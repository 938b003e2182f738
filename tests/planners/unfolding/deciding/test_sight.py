"""A mission with hidden targets in the macro world is the one that the planners' world plays."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from moonteam import loading, paths
from moonteam.grid.macro import world as macro_world
from moonteam.grid.macro.sight import INSIDE, Sight
from moonteam.planners.seconds.exact import ExactPlanner
from moonteam.planners.unfolding.deciding.deciders import Replanning
from moonteam.planners.unfolding.deciding.imagined import imagined
from moonteam.planners.unfolding.deciding.pointing import problem_in
from moonteam.planners.unfolding.future import Future
from moonteam.planners.unfolding.world import World
from moonteam.policies.policy import Policy
from tests.planners.unfolding.deciding.both_worlds import took

POLICY = Policy.load(paths.find("any_team", "policies", ".safetensors"))
SIZE = 24
PLACES = Replanning(ExactPlanner(), places=True)


def beginning(number):
    """A mission, what is shown of its start with the places to look from, and as a problem in
    which the rest comes as it will.
    """
    mission = loading.load_set(paths.find("unfolding/hidden", "testsets", ".jsonl"))[number]
    world = World(mission)
    view = PLACES.shown(world.view())
    known = {target.at for target in view.targets}
    rest = tuple(target for target in mission.targets if target.at not in known)
    assert rest
    problem = imagined(view, [Future(rest, (None,) * len(view.agents), None)], SIZE)
    return world, view, replace(problem, sight=jax.tree.map(
        lambda x: np.asarray(x)[None], sight_of(view, [target.at for target in rest])))


def sight_of(view, rest):
    """What robots see in the mission from now on, the targets that are not known yet at `rest`."""
    reach = [agent.sensor for agent in view.agents]
    known = [*(t.at for t in view.targets), *(look.at for look in view.looks)]
    at = np.zeros((SIZE, 2), np.float32)
    at[:len(known) + len(rest)] = [*known, *rest]
    column = np.arange(SIZE)
    first, own = len(view.targets), range(len(view.looks))
    rows, columns = view.ground.cuts(INSIDE * min(reach))
    shape = len(rows) * len(columns), len(rows[0]) * len(columns[0])
    points, seen = np.zeros((*shape, 2), np.float32), np.ones(shape, bool)
    for k, look in zip(own, view.looks, strict=True):
        points[k, :len(look.unseen)], seen[k, :len(look.unseen)] = look.unseen, False
    here = view.places.astype(np.float32)
    return Sight(
        at=at, hidden=(column >= len(known)) & (column < len(known) + len(rest)),
        speed=np.array([agent.speed for agent in view.agents], np.float32),
        reach=np.array(reach, np.float32), points=points, seen=seen,
        part=first + np.arange(shape[0])[:, None] == np.where(column < len(known), column, -1),
        size=np.full(shape[0], shape[1]), found=np.zeros(SIZE, bool), here=here, aim=here)


def test_a_policy_sees_the_same_of_places_to_look_from_in_both_worlds():
    _, view, problem = beginning(4)
    shown = problem_in(view)
    own = macro_world.reset(jax.tree.map(lambda x: x[0], problem)).problem
    count = len(view.targets) + len(view.looks)
    assert 0.0 < shown.unseen[shown.looks].min() < shown.unseen.max() == 1.0
    np.testing.assert_allclose(own.unseen[:count], shown.unseen, atol=1e-6)
    np.testing.assert_array_equal(own.looks[:count], shown.looks)
    near = {"rtol": 0, "atol": 1.1e-3}  # those are whole milliseconds
    np.testing.assert_allclose(own.start[:, :count], shown.start, **near)
    np.testing.assert_allclose(own.between[:, :count, :count], shown.between, **near)
    assert int(macro_world.coming(macro_world.reset(
        jax.tree.map(lambda x: x[0], problem)))) == view.coming


@pytest.mark.parametrize("number", [0, 4, 8, 11])
def test_a_policy_takes_as_long_in_both_worlds(number):
    here, there = took(POLICY, *beginning(number), PLACES)
    # Times of the macro world are float32, and it sees a hair further.
    assert there == pytest.approx(here, abs=0.05)
