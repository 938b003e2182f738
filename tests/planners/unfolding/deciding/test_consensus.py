"""What the plans for many futures agree on, where targets are hidden."""

from dataclasses import replace

import numpy as np
import pytest

from moonteam import loading, paths
from moonteam.planners.kind import PlannerOptions
from moonteam.planners.seconds import registry as timed_planners
from moonteam.planners.seconds.keeper import HOME, choices, order_of
from moonteam.planners.seconds.local import LocalSearchPlanner
from moonteam.planners.unfolding.deciding.consensus import Consensus, agreed, with_hidden
from moonteam.planners.unfolding.deciding.deciders import play
from moonteam.planners.unfolding.deciding.make import PLACES, decider_of
from moonteam.planners.unfolding.deciding.pointing import Pointing
from moonteam.planners.unfolding.deciding.search import with_looks
from moonteam.planners.unfolding.future import future
from moonteam.planners.unfolding.world import World
from moonteam.problem import timed
from moonteam.problem.timed import Agent, Prospect, Target, Timed


def missions(count):
    return loading.load_set(paths.find("unfolding/hidden", "testsets", ".jsonl"))[:count]


def search(tries=1000):
    return LocalSearchPlanner(iterations=tries)


def test_those_moves_are_made_that_most_plans_share():
    moves = np.array([[0, 5], [1, 4], [0, 4], [2, 4]])
    assert agreed(moves).tolist() == [0, 4]
    assert agreed(moves[:1]).tolist() == [0, 5]


def test_what_is_hidden_is_planned_for_after_somebody_has_looked_there():
    view = with_looks(World(missions(1)[0]).view())
    coming = future(view, np.random.default_rng(3)).coming
    moment, seen_from = with_hidden(view, coming)
    count, known = len(view.moment.solved), len(view.targets)
    assert len(coming) == view.coming
    assert len(moment.solved) == count + len(coming)
    assert seen_from[:count].tolist() == list(range(count))
    for column, target in enumerate(coming, count):
        look = view.looks[seen_from[column] - known]
        assert np.hypot(*(look.unseen - target.at).T).min() == 0.0  # of its part
        assert np.flatnonzero(moment.after[column]).tolist() == [seen_from[column]]
        asked = {view.state.names[k] for k in np.flatnonzero(moment.need[column])}
        assert asked == set(target.skills)
        assert moment.either[column] == (target.type == "OR")
    for name in ("start", "between", "need", "after"):
        old = getattr(view.moment, name)
        new = getattr(moment, name)[tuple(slice(n) for n in old.shape)]
        np.testing.assert_array_equal(new, old)
    served = {service.target: service.start for service in search().plan(moment).services}
    assert all(served[seen_from[k]] <= served[k] for k in range(count, len(moment.solved)))


def test_who_sees_nothing_but_will_be_needed_goes_where_something_will_be_found():
    """Planned for what is known, it would stay behind."""
    problem = timed.check(Timed(
        "seconds", (Agent((0.0, 0.0), ("A",), 1.5, sensor=6.0), Agent((0.0, 0.0), ("B",), 0.3)),
        tuple(Target((30.0, y), ("B",), hidden=True) for y in (2.0, 6.0, 9.0)), max_seconds=600.0,
        expects=Prospect(more=3, area=(20.0, 0.0, 32.0, 12.0))), "test")
    view = with_looks(World(problem).view())
    usual = choices(view.moment, order_of(search().plan(view.moment)))
    (chosen,) = Consensus(search(), 16).choose([view])
    assert usual[1] == HOME
    assert chosen.min() >= len(view.targets)


def test_the_same_seed_decides_alike_and_where_nothing_is_hidden_by_the_plan_alone():
    problem = missions(1)[0]
    ends = []
    for _ in range(2):
        world = World(problem)
        play(world, decider_of(search(300), search=PLACES, futures=4, seed=7))
        assert world.outcome.success
        ends.append((world.outcome.seconds, world.outcome.decisions))
    assert ends[0] == ends[1]
    view = with_looks(World(problem).revealed().view())
    assert not view.looks
    (chosen,) = Consensus(search(), 4).choose([view])
    np.testing.assert_array_equal(
        chosen, choices(view.moment, order_of(search().plan(view.moment))))


def test_a_policy_looks_for_hidden_targets_and_says_where_they_may_be_in_one_call():
    policy = timed_planners.find("policy").make(PlannerOptions(policy=paths.find(
        "any_team", "policies", ".safetensors")))
    calls = []

    def choose(views):
        calls.append([len(view.moment.solved) for view in views])
        assert not any(view.looks for view in views)  # targets like the others
        return Pointing(policy.policy).choose(views)

    problem = missions(1)[0]
    view = with_looks(World(problem).view())
    (chosen,) = Consensus(policy, 8, choose=choose).choose([view])
    assert calls == [[len(view.moment.solved) + view.coming] * 8]
    assert (chosen >= len(view.targets)).any()  # somebody looks
    assert (chosen < len(view.moment.solved)).all()
    world = World(problem)
    world.step(decider_of(policy, search=PLACES, futures=8).act(world.view()))
    assert world.state.now > 0


def test_without_a_plan_it_waits():
    view = with_looks(World(missions(1)[0]).view())
    nobody = np.zeros_like(view.moment.present)
    lost = replace(view, moment=replace(view.moment, present=nobody))
    (chosen,) = Consensus(search(), 2).choose([lost])
    assert (chosen < 0).all()


@pytest.mark.parametrize("futures", [1, 3])
def test_as_many_futures_are_planned_for_as_are_asked_for(futures):
    columns = []

    class Counting(LocalSearchPlanner):
        def plan(self, moment):
            columns.append(len(moment.solved))
            return super().plan(moment)

    view = with_looks(World(missions(1)[0]).view())
    Consensus(Counting(iterations=50), futures).choose([view])
    assert columns == [len(view.moment.solved) + view.coming] * futures
