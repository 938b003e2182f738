"""Greedy and local search by the clock."""

import time
from dataclasses import replace

import numpy as np
import pytest

from moonteam.planners.seconds import local
from moonteam.planners.seconds.exact import ExactPlanner
from moonteam.planners.seconds.greedy import GreedyPlanner
from moonteam.planners.seconds.local import LocalSearchPlanner
from moonteam.planners.seconds.search.goal import value
from moonteam.planners.seconds.search.work import compact


def test_what_is_found_is_a_plan_and_mostly_the_best_one(instances):
    """Every combination of options; the exact planner says what is best."""
    found = missed = best = 0
    for seed in range(60):
        now = instances.instance(seed)
        for objective in instances.OBJECTIVES:
            goal = (objective, 1.0, 0.3)
            wanted = ExactPlanner(*goal).plan(now)
            got = LocalSearchPlanner(*goal, iterations=2000).plan(now)
            if got.status == "infeasible":
                missed += wanted.status != "infeasible"
                continue
            found += 1
            cost = value(*goal, instances.judged(now, got).makespan, got.effort)
            assert cost >= wanted.bound - 1e-6
            best += cost <= wanted.bound * 1.001 + 1e-6
    assert found > 100
    assert missed <= 0.03 * found
    assert best >= 0.85 * found


def test_greedy_is_a_plan_and_the_floor(instances):
    floor = better = 0
    for seed in range(6):
        now = instances.large(seed, 10, 30, skills=2, most=3)
        greedy = instances.judged(now, GreedyPlanner().plan(now))
        local = instances.judged(now, LocalSearchPlanner(iterations=5000).plan(now))
        floor, better = floor + greedy.makespan, better + local.makespan
    assert better < 0.9 * floor


@pytest.mark.parametrize("planner", [GreedyPlanner(), LocalSearchPlanner(iterations=100)])
def test_nothing_open_or_nobody_left(instances, planner):
    """As between the last target and one that an event has yet to bring; no warnings either."""
    now = instances.large(0, 2, 3, skills=2, most=1)
    done = replace(now, solved=np.ones(3, bool), ends=np.array([5, 9, 2]))
    plan = instances.judged(done, planner.plan(done))
    assert (plan.services, plan.makespan) == ((), 9)
    nobody = np.zeros(2, bool)
    assert planner.plan(replace(done, present=nobody)).services == ()
    assert planner.plan(replace(now, present=nobody)).status == "infeasible"


def test_a_budget_of_iterations_makes_it_repeatable(instances):
    now = instances.large(1, 6, 20, most=2)
    one, two = (LocalSearchPlanner(iterations=3000, seed=5).plan(now) for _ in range(2))
    assert one.services == two.services
    other = LocalSearchPlanner(iterations=3000, seed=6).plan(now)
    assert other.services != one.services


def test_threads_search_each_for_itself_and_the_best_counts(instances):
    now = instances.large(4, 8, 24, skills=2, most=2)

    def plan(**options):
        planner = LocalSearchPlanner(iterations=1000, **options)
        return instances.judged(now, planner.plan(now)), planner.curve

    each = [plan(seed=5 + k * local._APART**2)[0].makespan for k in range(3)]
    (three, curve), (again, _) = plan(seed=5, threads=3), plan(seed=5, threads=3)
    assert three.services == again.services
    assert three.makespan == min(each) < max(each)
    assert [cost for _, cost in curve] == sorted({cost for _, cost in curve}, reverse=True)
    assert curve[-1][1] == three.makespan


def test_runs_begin_anew_and_the_last_goes_on_from_the_best(instances, monkeypatch):
    now = instances.large(5, 6, 20, most=2)
    opened = compact(now)
    monkeypatch.setattr(local, "_RUN", 5)
    first, second = (local.search(opened, 1.0, 0.0, iterations=2000, seed=k * local._APART)
                     for k in range(2))
    several = local.search(opened, 1.0, 0.0, iterations=7000)
    assert several.iterations == 7000
    assert several.cost <= min(first.cost, second.cost)
    costs = [cost for _, cost in several.curve]
    assert min(first.cost, second.cost) in costs
    assert costs[-1] == several.cost


@pytest.mark.parametrize("limit", [0.01, 0.1, 1.0])
def test_a_time_limit_is_kept_and_the_curve_falls(instances, limit):
    now = instances.large(2, 20, 50)
    LocalSearchPlanner(iterations=10).plan(now)  # compiled
    planner = LocalSearchPlanner(time_limit=limit)
    began = time.perf_counter()
    plan = instances.judged(now, planner.plan(now))
    assert time.perf_counter() - began < limit + 0.2
    seconds, costs = zip(*planner.curve, strict=True)
    assert list(seconds) == sorted(seconds)
    assert list(costs) == sorted(costs, reverse=True)
    assert costs[-1] == plan.makespan
    if limit == 1.0:
        assert costs[-1] < 0.9 * costs[0]


def test_fifty_agents_and_five_hundred_targets(instances):
    now = instances.large(3, 50, 500)
    LocalSearchPlanner(iterations=10).plan(now)
    began = time.perf_counter()
    plan = instances.judged(now, LocalSearchPlanner(time_limit=1.0).plan(now))
    assert time.perf_counter() - began < 1.5
    assert plan.makespan <= GreedyPlanner().plan(now).makespan
