"""A pointing policy as a planner of whole plans in steps."""

from dataclasses import replace

import numpy as np
import pytest

from moonteam.grid import scenarios
from moonteam.planners import contract, registry, simulate
from moonteam.planners.base import Snapshot
from moonteam.planners.kind import PlannerOptions
from moonteam.planners.pointing import Batch, PointingPlanner


def moment(seed=0, blocked=None, **more):
    kinds = ["drone", "wheeled", "legged"] if blocked else None
    return Snapshot.start(scenarios.generate(
        seed, num_agents=3, num_targets=4, size=(9, 9), max_steps=90, blocked=blocked,
        kinds=kinds, **more))


@pytest.fixture
def make(pointing):
    def planner(decode="argmax", **options):
        made = registry.make("policy", PlannerOptions(policy=pointing, decode=decode, **options))
        assert isinstance(made, PointingPlanner)
        return made

    return planner


def test_a_plan_is_what_its_replay_does(make):
    now = moment()
    plan = make().plan(now)
    trace = simulate.replay(now, plan.actions)
    assert (plan.status, plan.bound) == ("feasible", None)
    assert (trace.makespan, trace.moves) == (plan.makespan, plan.moves)
    assert make("plain-argmax").plan(now).actions.tolist() == plan.actions.tolist()


def test_the_plan_is_followed_and_made_anew_off_it(make):
    now, planner = moment(), make()
    planner.reset(now)
    plan = planner.plan(now)
    for joint in plan.actions[:3]:
        assert planner.act(now).tolist() == joint.tolist()
        now = simulate.step(now, joint)
    assert planner.replans == 1
    pushed = replace(now, cells=now.cells[:, ::-1].copy())
    planner.act(pushed)
    assert planner.replans == 2


def test_a_lost_robot_stays_and_the_others_go_on(make):
    now = moment(1)
    now = replace(now, agent_mask=np.array([True, False, True]),
                  agent_skills=np.array([3, 3, 3], np.int32))
    plan = make().plan(now)
    assert plan.status == "feasible"
    assert (plan.actions[:, 1] == simulate.STAY).all()


def test_the_best_of_many_is_no_worse_than_any(make):
    now = moment(2)
    drawn = [make("best-of-8@2", seed=3, objective=what).plan(now) for what in (
        "makespan", "moves", None)]
    one = make("sample@2", seed=3).plan(now)
    assert drawn[0].makespan <= one.makespan
    assert drawn[1].moves <= drawn[0].moves
    assert [plan.objective for plan in drawn] == ["makespan", "moves", "makespan"]
    assert make("sample@2", seed=3).plan(now).actions.tolist() == one.actions.tolist()
    assert make("best-of-8", preference=0.4).objective == "weighted"


def test_ways_go_round_blocked_ground(make):
    now = moment(4, blocked={"drone": 0.0, "wheeled": 0.3, "legged": 0.2})
    plan = make().plan(now)
    assert plan.status == "feasible"
    cells = simulate.replay(now, plan.actions).cells
    moved = (cells[1:] != cells[:-1]).any(-1)
    assert (moved == (plan.actions != simulate.STAY)).all()


def test_what_nobody_can_do_is_said_and_the_rest_is_done(make):
    now = moment(5)
    need = now.target_skills.copy()
    need[1], now = 1 << 6, replace(now, target_skills=need)
    planner = make()
    plan = planner.plan(now)
    assert plan.status == "infeasible"
    assert "target 1" in plan.reason
    planner.reset(now)
    while now.step < now.max_steps:
        now = simulate.step(now, planner.act(now))
    assert now.solved.tolist() == [True, False, True, True]


def test_what_saves_way_and_comes_too_late_is_not_planned():
    """Where no course of the preference is in time, one that saves less way is taken."""
    planner = registry.make("policy", PlannerOptions(policy="any_team_mappo", preference=1.0))
    moments = [Snapshot.start(scenarios.generate(
        seed, num_agents=4, num_targets=10, size=(16, 16), max_steps=256)) for seed in range(8)]
    free = Batch(planner, moments).actions()
    tight = [replace(now, max_steps=len(actions) - 1)
             for now, actions in zip(moments, free, strict=True)]
    plans = [planner.plan(now) for now in tight]
    sped = [plan for plan in plans if plan.status == "feasible"]
    assert len(sped) >= 4
    assert all(plan.makespan < len(actions)
               for plan, actions in zip(plans, free, strict=True) if plan in sped)
    batch = Batch(planner, tight).actions()
    assert [simulate.replay(now, actions).makespan for now, actions, plan
            in zip(tight, batch, plans, strict=True) if plan in sped] == [
                plan.makespan for plan in sped]


def test_too_few_steps_are_no_plan(make):
    assert make().plan(replace(moment(), max_steps=2)).status == "infeasible"


def test_a_batch_plans_as_one_by_one(make):
    moments = [moment(seed) for seed in range(3)]
    moments.append(replace(moments[0], solved=np.ones(4, bool)))
    planner = make()
    plans = Batch(planner, moments).actions()
    for now, actions in zip(moments, plans, strict=True):
        trace = simulate.replay(now, planner.plan(now).actions)
        assert simulate.replay(now, actions).actions.tolist() == trace.actions.tolist()
    assert plans[3].shape == (0, 3)


def test_it_keeps_every_promise_of_a_planner(pointing):
    results = contract.check("policy", PlannerOptions(policy=pointing))
    assert [result for result in results if not result.passed] == []
