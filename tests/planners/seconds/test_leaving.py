"""Which targets to leave out, where not all can be served in time."""

import itertools
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from moonteam.planners.seconds.base import moment, problems
from moonteam.planners.seconds.exact import ExactPlanner
from moonteam.planners.seconds.greedy import GreedyPlanner
from moonteam.planners.seconds.keeper import Keeper
from moonteam.planners.seconds.leaving import better, served
from moonteam.planners.seconds.local import LocalSearchPlanner
from moonteam.problem import timed
from moonteam.problem.timed import Agent, Target, Timed


def drawn(seed, targets=5, needed=0):
    """Three robots, and targets of unlike worth in narrow windows; the first must be served."""
    rng = np.random.default_rng(seed)
    places = rng.integers(0, 20, (targets + 3, 2)).astype(float).tolist()
    opens, stays = rng.uniform(0, 9, targets).round(1), rng.uniform(1, 8, targets).round(1)
    worth = rng.choice([1.0, 2.0, 3.5, 5.0], targets).tolist()
    return Timed("seconds", tuple(
        Agent(tuple(at), skills, speed) for at, skills, speed in zip(
            places[:3], (("A",), ("B",), ("A", "B")), (1.5, 0.5, 1.0), strict=True)), tuple(
        Target(tuple(at), ("A", "B"), ("AND", "OR")[k % 2], appears=float(a),
               lapses=None if k < needed else float(a + b), worth=0.0 if k < needed else w)
        for k, (at, a, b, w) in enumerate(zip(places[3:], opens, stays, worth, strict=True))))


def by_all_sets(now):
    """The most worth, and then the least makespan, of any set that can be served."""
    found = []
    for size in range(len(now.optional) + 1):
        for left in itertools.combinations(now.optional.tolist(), size):
            bare = replace(now.without(np.array(left, int)), worth=None)
            plan = ExactPlanner().plan(bare)
            if plan.status != "infeasible":
                found.append((served(now, plan.services), -plan.makespan))
    return max(found)


@pytest.mark.parametrize("needed", [0, 2])
def test_the_exact_planner_serves_the_most_worth_and_then_is_soonest(needed):
    left = 0
    for seed in range(12):
        now = moment(timed.check(drawn(seed, needed=needed), "test"))
        plan = ExactPlanner().plan(now)
        assert plan.status == "optimal"
        assert not problems(now, plan.services)
        worth, span = by_all_sets(now)
        assert (served(now, plan.services), -plan.makespan) == (pytest.approx(worth), span)
        left += len(now.solved) - len(plan.services)
    assert left > 12, "something had to be left out"


@pytest.mark.parametrize("planner", [GreedyPlanner(), LocalSearchPlanner(iterations=500)],
                         ids=["greedy", "local"])
def test_others_serve_what_has_to_be_served_and_no_more_worth_than_can_be(planner):
    totals = np.zeros(2)
    for seed in range(12):
        now = moment(drawn(seed, targets=6, needed=1))
        plan, best = planner.plan(now), ExactPlanner().plan(now)
        assert plan.status == "feasible"
        assert not problems(now, plan.services)
        totals += served(now, plan.services), served(now, best.services)
        assert served(now, plan.services) <= served(now, best.services) + 1e-9
    assert totals[0] > 0.8 * totals[1]


def test_what_must_be_served_may_not_be_left_out():
    now = moment(drawn(0, needed=2))
    without = [one for one in ExactPlanner().plan(now).services if one.target != 0]
    assert any("serves" in said for said in problems(now, tuple(without)))
    far = replace(now, lapses=np.array([1, *now.lapses[1:]]))
    assert ExactPlanner().plan(far).status == "infeasible"


def test_more_worth_is_better_than_sooner_and_a_kept_plan_yields_to_it():
    problem = Timed("seconds", (Agent((0.0, 0.0), ("A",)),), (
        Target((5.0, 0.0), ("A",), lapses=8.0, worth=1.0),
        Target((-5.0, 0.0), ("A",), lapses=8.0, worth=3.0)))
    now = moment(problem)
    plan = ExactPlanner().plan(now)
    assert [one.target for one in plan.services] == [1]
    poorer = ExactPlanner().plan(now.without(np.array([1]))).services
    assert better(now, plan.services, poorer)
    assert not better(now, poorer, plan.services)
    keeper = Keeper(ExactPlanner(), margin_ms=10**6)
    assert keeper.act(now.without(np.array([1]))).tolist() == [0]
    assert keeper.act(now).tolist() == [1]


@pytest.mark.parametrize(("changes", "key"), [
    ({"worth": -1.0, "lapses": 5.0}, "worth"), ({"worth": 2.0}, "worth")])
def test_worth_is_of_what_may_lapse(changes, key):
    target = msgspec.structs.replace(Target((1.0, 0.0), ("A",)), **changes)
    with pytest.raises(Exception, match=rf"targets\[0\].{key}"):
        timed.check(Timed("seconds", (Agent((0.0, 0.0), ("A",)),), (target,)), "test")
