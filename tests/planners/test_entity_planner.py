"""The policy for any team as a planner: blocked ground, few shapes, early endings."""

import dataclasses

import jax
import numpy as np
import pytest

from moonteam.grid import scenarios
from moonteam.planners import learned, simulate
from moonteam.planners.base import Snapshot
from moonteam.planners.learned import LearnedPlanner, Policy, plan_best_of
from moonteam.policies import entity
from moonteam.policies.entity import EntitySpec
from moonteam.policies.policy_file import PolicyFile, save_policy

SPEC = EntitySpec(width=16, heads=2, layers=1)


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    """Random weights, pointing sharply: it walks to targets, in a poor order."""
    params = jax.jit(lambda key: entity.init(SPEC, key))(jax.random.key(2))
    params = jax.tree.map(np.array, jax.device_get(params))
    params["stay"]["bias"] -= 6.0
    path = tmp_path_factory.mktemp("policy") / "any.safetensors"
    save_policy(path, PolicyFile("entity", dataclasses.asdict(SPEC), params))
    return Policy.load(path)


def moment(targets=3, agents=2, seed=0, blocked=None, **more):
    kinds = ["drone", "wheeled", "legged"][:agents] if blocked else None
    return Snapshot.start(scenarios.generate(
        seed, num_agents=agents, num_targets=targets, size=(8, 8), max_steps=60,
        blocked=blocked, kinds=kinds, **more))


WALLED = {"drone": 0.0, "wheeled": 0.3, "legged": 0.2}


def test_ways_over_blocked_ground_are_searched_once_a_problem(policy, monkeypatch):
    calls = []
    search = learned.distance_fields
    monkeypatch.setattr(learned, "distance_fields",
                        lambda *given: calls.append(1) or search(*given))
    now = moment(blocked=WALLED)
    planner = LearnedPlanner(policy)
    planner.reset(now)
    for _ in range(5):
        now = simulate.step(now, planner.act(now))
    assert len(calls) == 1
    moved = dataclasses.replace(now, target_cells=now.target_cells[::-1].copy())
    planner.act(moved)
    assert len(calls) == 2
    opened = dataclasses.replace(moved, passable=np.ones_like(moved.passable))
    planner.act(opened)
    assert len(calls) == 3


def test_blocked_moves_are_never_taken(policy):
    planner = LearnedPlanner(policy, decode="sample", temperature=3.0)
    now = moment(blocked=WALLED, seed=1)
    planner.reset(now, 4)
    for _ in range(30):
        joint = planner.act(now)
        after = simulate.step(now, joint)
        still = (after.cells == now.cells).all(1)
        assert (joint[still] == simulate.STAY).all()
        now = after


def test_target_counts_share_what_is_compiled(policy):
    planner = LearnedPlanner(policy)
    for count in (5, 6, 7, 8):
        now = moment(count, seed=count)
        planner.reset(now)
        planner.act(now)
        if count == 5:
            before = learned._decide._cache_size()
    assert learned._decide._cache_size() == before


@pytest.mark.parametrize("blocked", [None, WALLED])
def test_padding_to_slots_changes_no_decision(policy, blocked):
    now = moment(3, seed=3, blocked=blocked)
    fields = None if blocked is None else learned._fields(now, 3)
    padded = None if blocked is None else learned._fields(now, 4)
    one = (np.int32(60), np.float32(0.3))
    _, exact = learned._decide(policy.brain, policy.params, (), learned.state_of(now), fields, *one)
    _, found = learned._decide(policy.brain, policy.params, (), learned.state_of(now, 4), padded,
                               *one)
    np.testing.assert_allclose(found, exact, atol=1e-4)


def test_rollouts_end_once_the_best_is_known(policy):
    """Ending early changes nothing: the whole of each rollout, then the cheapest by hand."""
    now = moment(3, seed=5)
    solved_any = False
    for objective, key in (("makespan", lambda p: (p.makespan, p.moves)),
                           ("moves", lambda p: (p.moves, p.makespan)),
                           ("weighted", lambda p: (p.makespan + p.moves, p.makespan))):
        few = plan_best_of(policy, now, 4, seed=3, objective=objective)
        many = plan_best_of(policy, now, 32, seed=3, objective=objective)
        assert many.status == "feasible"
        solved_any |= few.status == "feasible"
        trace = simulate.replay(now, many.actions)
        assert (trace.makespan, trace.moves) == (many.makespan, many.moves)
        for other in ("makespan", "moves", "weighted"):
            rival = plan_best_of(policy, now, 32, seed=3, objective=other)
            assert key(many) <= key(rival)
    assert solved_any


def test_a_plan_over_blocked_ground_replays(policy):
    now = moment(3, agents=3, seed=2, blocked=WALLED)
    plan = plan_best_of(policy, now, 32, seed=1)
    assert plan.status == "feasible"
    assert simulate.replay(now, plan.actions).complete
