"""OR-Tools' routing library by the clock, against the exact planner and the judge."""

import sys
import time

import numpy as np
import pytest

from moonteam.errors import InputError
from moonteam.planners.base import Snapshot
from moonteam.planners.routing import RoutingPlanner as InSteps
from moonteam.planners.seconds.exact import ExactPlanner
from moonteam.planners.seconds.routing import RoutingPlanner, Visits
from moonteam.planners.seconds.search.goal import value
from moonteam.planners.seconds.search.work import compact
from moonteam.problem.scenario import load_set

pytest.importorskip("ortools")


def test_what_it_plans_is_valid_and_seldom_far_from_the_best(instances):
    """Services, windows, precedence, coalitions by number, homes: whatever an instance asks."""
    gaps, found = [], 0
    for seed in range(40, 76):
        now = instances.instance(seed, 4)
        goal = (instances.OBJECTIVES[seed % 3], 1.0, 0.3)
        wanted = ExactPlanner(*goal).plan(now)
        got = RoutingPlanner(*goal, time_limit=0.2).plan(now)
        if wanted.status == "infeasible":
            assert got.status == "infeasible", seed
        if got.status == "feasible":
            found += 1
            cost = value(*goal, instances.judged(now, got).makespan, got.effort or 0.0)
            assert wanted.bound is not None
            assert cost >= wanted.bound - 1e-6, seed
            gaps.append(cost / max(wanted.bound, 1.0) - 1)
    assert found > 20
    assert np.median(gaps) < 0.02


def test_two_of_a_skill_are_two_agents(instances):
    now = next(now for now in map(instances.instance, range(200)) if now.need.max() == 2
               and not compact(now).reason)
    visits = Visits.of(compact(now).work)
    assert len(visits.target) == sum(1 if now.either[t] else int(now.need[t].sum())
                                     for t in np.flatnonzero(~now.solved))


def test_a_large_team_gets_a_better_plan_the_longer_it_searches(instances):
    now = instances.large(0, 8, 24)
    RoutingPlanner(time_limit=0.1).plan(now)
    plans = []
    for limit in (1.0, 4.0):  # a second even of a busy machine is enough for a first plan
        began = time.process_time()
        plans.append(instances.judged(now, RoutingPlanner(time_limit=limit).plan(now)))
        assert time.process_time() - began < limit + 0.3
    assert plans[1].makespan < plans[0].makespan


def test_where_a_plan_cannot_be_had_in_time_it_says_so(instances):
    plan = RoutingPlanner(time_limit=0.001).plan(instances.large(0, 20, 100))
    assert plan.status == "infeasible"
    assert "no plan was found in 0.001 s; there may be one" in plan.reason


@pytest.mark.parametrize("objective", ["makespan", "moves", "weighted"])
def test_in_steps_it_plans_the_same_world(objective, request):
    root = request.config.rootpath
    for number, scenario in enumerate(load_set(f"{root}/assets/testsets/3x5.jsonl")[:4]):
        plan = InSteps(objective, time_limit=0.2).plan(Snapshot.start(scenario))
        assert plan.status == "feasible", number
        if objective == "makespan":
            assert plan.makespan
            assert scenario.optimal
            assert scenario.optimal.makespan
            assert 1.0 <= plan.makespan / scenario.optimal.makespan <= 1.25


def test_without_ortools_it_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "ortools.constraint_solver.pywrapcp", None)
    for make in (RoutingPlanner, InSteps):
        with pytest.raises(InputError, match=r"pip install moonteam\[ortools\]"):
            make()
