"""The policy for any team as a planner: blocked ground, few shapes, early endings."""

import dataclasses
from typing import NamedTuple

import jax
import numpy as np
import pytest

from moonteam.errors import InputError
from moonteam.evaluation.rollouts import Tries, best
from moonteam.grid import scenarios
from moonteam.planners import learned, simulate
from moonteam.planners.base import Snapshot
from moonteam.planners.best_of import plan_best_of, prices, rollouts_of
from moonteam.planners.learned import LearnedPlanner
from moonteam.policies import entity
from moonteam.policies.entity import EntitySpec
from moonteam.policies.policy import Policy
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
    fields = None if blocked is None else learned.fields_of(now, 3)
    padded = None if blocked is None else learned.fields_of(now, 4)
    one = (np.int32(60), np.float32(0.3))
    _, exact = learned._decide(policy.brain, policy.params, (), learned.state_of(now), fields, *one)
    _, found = learned._decide(policy.brain, policy.params, (), learned.state_of(now, 4), padded,
                               *one)
    np.testing.assert_allclose(found, exact, atol=1e-4)


PRICES = {
    "makespan": (("makespan",), lambda p: (p.makespan, p.moves)),
    "moves": (("moves",), lambda p: (p.moves, p.makespan)),
    "weighted": (("weighted", 1.0, 0.05), lambda p: p.makespan + 0.05 * p.moves),
    "effort": (("weighted", 0.05, 1.0), lambda p: 0.05 * p.makespan + p.moves),
    "preference": ((None, 1.0, 0.05, 0.75), lambda p: 0.25 * p.makespan + 0.75 * p.moves)}
"""How the best of K is asked for, and its price by hand."""


def best_of(policy, now, count, given):
    objective, alpha, beta, preference = (*given, *(1.0, 0.05, 0.0)[len(given) - 1:])
    return plan_best_of(policy, now, count, 3, objective, 1.0, preference, alpha, beta)


@pytest.mark.parametrize("asked", PRICES)
def test_the_best_of_k_is_the_cheapest_of_them_and_ending_early_changes_nothing(policy, asked):
    """Every rollout to its end, none given up, and the cheapest by hand."""
    now, (given, price) = moment(3, seed=5), PRICES[asked]
    preference = given[3] if len(given) > 3 else 0.0
    whole = rollouts_of(policy, now, 32, 3, 1.0, preference)
    solved = whole.solved
    assert solved.sum() > 1
    assert len({*zip(whole.steps[solved].tolist(), whole.moves[solved].tolist(),
                     strict=True)}) > 3
    played = [Tried(int(s), int(m)) for s, m in zip(whole.steps[solved], whole.moves[solved],
                                                    strict=True)]
    plan = best_of(policy, now, 32, given)
    assert price(plan) == min(map(price, played))
    trace = simulate.replay(now, plan.actions)
    assert (trace.makespan, trace.moves) == (plan.makespan, plan.moves)


def test_weights_decide_which_rollout_is_best(policy):
    now = moment(3, seed=15)  # where the quickest of them is not the one of fewest moves
    fast, thrifty = (best_of(policy, now, 256, PRICES[k][0]) for k in ("makespan", "effort"))
    assert fast.makespan < thrifty.makespan
    assert fast.moves > thrifty.moves
    with pytest.raises(InputError, match="alpha"):
        plan_best_of(policy, now, 2, objective="weighted", alpha=-1.0)


def test_the_pool_and_the_single_mission_choose_by_one_price(policy):
    """The same rollouts as the tries of a pool: its choice is that of the single call."""
    now = moment(3, seed=5)
    for given, price in PRICES.values():
        preference = given[3] if len(given) > 3 else 0.0
        whole = rollouts_of(policy, now, 32, 3, 1.0, preference)
        tries = Tries(whole.solved[None], whole.steps[None], whole.moves[None],
                      np.zeros((1, 32), int), 0.0, 0.0)
        chosen = int(best(tries, prices(*given))[0])
        plan = best_of(policy, now, 32, given)
        assert (plan.makespan, plan.moves) == (whole.steps[chosen], whole.moves[chosen])
        assert price(plan) == price(Tried(int(whole.steps[chosen]), int(whole.moves[chosen])))


class Tried(NamedTuple):
    makespan: int
    moves: int


def test_a_plan_over_blocked_ground_replays(policy):
    now = moment(3, agents=3, seed=2, blocked=WALLED)
    plan = plan_best_of(policy, now, 32, seed=1)
    assert plan.status == "feasible"
    assert simulate.replay(now, plan.actions).complete
