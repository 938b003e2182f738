"""A policy by the clock: what it plans is a plan, whatever its weights are."""

from dataclasses import replace

import numpy as np
import pytest

from moonteam.errors import InputError
from moonteam.evaluation import timed
from moonteam.evaluation.contenders import Options
from moonteam.planners.kind import PlannerOptions
from moonteam.planners.seconds import registry
from moonteam.planners.seconds.base import NEVER
from moonteam.planners.seconds.exact import ExactPlanner
from moonteam.policies.policy import Policy


@pytest.fixture(scope="module")
def policy(pointing):
    return Policy.load(pointing)


@pytest.mark.parametrize(("decode", "heat", "cooling"), [
    ("argmax", 0.0, False), ("best-of-4", 1.0, True), ("best-of-4@0.5", 0.5, False),
    ("best-of-1", 1.0, False), ("sample", 1.0, False), ("sample@2", 2.0, False)])
def test_the_temperatures_asked_for_reach_the_planner(pointing, decode, heat, cooling):
    """Of several tries each is cooler than the one before, unless a temperature is asked for."""
    rows = timed.contenders(Options(["policy"], policies=[pointing], decodes=(decode,)))
    assert [(row.planner.heat, row.planner.cooling) for row in rows] == [(heat, cooling)]


def planner(policy, **options):
    return registry.find("policy").make(PlannerOptions(policy=policy, **options))


@pytest.mark.parametrize("decode", ["argmax", "best-of-8@1"])
def test_what_it_plans_is_a_plan_and_no_better_than_the_best(policy, instances, decode):
    moments = [instances.instance(seed) for seed in range(120)]
    plans = planner(policy, decode=decode).plans(moments)
    found = 0
    for now, plan in zip(moments, plans, strict=True):
        best = ExactPlanner().plan(now)
        if best.status == "infeasible":
            assert plan.status == "infeasible"
            assert plan.reason
        elif plan.status == "feasible":
            instances.judged(now, plan)
            assert plan.makespan >= best.makespan
            found += 1
        else:  # it ran into a window, a limit or a closed way
            assert (now.lapses < NEVER).any() or now.limit < NEVER or (now.start >= NEVER).any() \
                or (now.between >= NEVER).any()
    assert found > 60


def test_alone_and_together_and_again_are_the_same(policy, instances):
    moments = [instances.large(seed, 3, 5, skills=2, most=1) for seed in (1, 2)]
    asked = planner(policy)
    together = asked.plans(moments)
    for now, plan in zip(moments, together, strict=True):
        assert replace(asked.plan(now), seconds=0.0) == replace(plan, seconds=0.0)
    drawn = [planner(policy, decode="sample@1", seed=seed).plan(moments[1]).services
             for seed in (3, 3, 4, 5, 6, 7)]
    assert drawn[0] == drawn[1]
    assert len(set(drawn)) > 1


def test_more_tries_are_no_worse_and_the_objective_says_what_is_best(policy, instances):
    now = instances.large(3, 3, 5, skills=2, most=1)
    few, many = (planner(policy, decode=how).plan(now) for how in ("sample@1", "best-of-64@1"))
    assert many.makespan <= few.makespan
    lazy = planner(policy, decode="best-of-64@1", objective="moves").plan(now)
    assert lazy.objective == "effort"
    assert lazy.effort <= many.effort


def test_nothing_to_do_and_nobody_to_do_it(policy, instances):
    now = instances.large(3, 3, 5, skills=2, most=1)
    done = planner(policy).plan(replace(now, solved=np.ones(5, bool)))
    assert (done.status, done.services, done.makespan) == ("feasible", (), 0)
    lost = planner(policy).plan(replace(now, present=np.zeros(3, bool)))
    assert lost.status == "infeasible"
    assert lost.reason


def test_a_policy_of_another_kind_is_refused():
    with pytest.raises(InputError, match="one of kind pointer is needed"):
        registry.find("policy").make(PlannerOptions(policy="any_team_imitated"))
    assert not registry.find("policy").anytime
