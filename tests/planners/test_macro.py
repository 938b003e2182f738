"""Rollouts in the macro world: against one played by hand, padded, drawn, with services."""

import itertools
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from moonteam.errors import InputError
from moonteam.grid import scenarios
from moonteam.grid.macro import world
from moonteam.grid.macro.types import FAR
from moonteam.planners import macro
from moonteam.planners.base import Snapshot
from moonteam.planners.plans.routes import meeting_times
from moonteam.planners.pointing import problem_of
from moonteam.planners.search.task import Task
from moonteam.planners.search.travel import travel_times
from moonteam.policies import pointer
from moonteam.policies.policy import Policy


@pytest.fixture(scope="module")
def policy(pointing):
    return Policy.load(pointing)


def moment(seed=0, agents=3, targets=4):
    return Snapshot.start(scenarios.generate(
        seed, num_agents=agents, num_targets=targets, size=(9, 9), max_steps=90))


def problem(seed=0, agents=3, targets=4):
    now = moment(seed, agents, targets)
    return problem_of(Task.of(now, travel_times(now)))


@pytest.fixture(scope="module")
def many():
    return macro.stacked([problem(seed) for seed in range(5)])


@partial(jax.jit, static_argnames="spec")
def _decide(spec, params, state):
    logits = pointer.point(params, spec, pointer.look(state, jnp.zeros(()))).logits
    choice, _ = world.choose(state, logits, jnp.zeros_like(logits))
    result = world.step(state, choice)
    return choice, result, world.loosen(result.state, jnp.ones(choice.shape, bool))


def by_hand(policy, one):
    """(seconds, order [N, M]) of the likeliest choices, decision by decision, as they are played.

    Those on their way choose again at every event; who turned away did not set out there.
    """
    state = jax.jit(world.reset)(jax.tree.map(jnp.asarray, one))
    agents, targets = one.start.shape
    order = np.full((agents, targets), -1)
    for turn in range(50):
        free = np.asarray(jax.jit(world.free)(state))
        choice, result, after = _decide(policy.brain.spec, policy.params, state)
        for a in np.flatnonzero(free & (np.asarray(choice) < targets)):
            order[a, choice[a]] = turn
        for a in np.flatnonzero(np.asarray(after.goal != result.state.goal)):
            order[a, result.state.goal[a]] = -1
        if result.terminated:
            return float(state.now + result.seconds), order
        state = after
    raise AssertionError("it never ends")


def test_rollouts_are_those_of_the_world_decision_by_decision(policy, many):
    """Who serves what is as it was played; when, as of robots that knew it from the start."""
    found = macro.rollouts(policy, many)
    for b in range(5):
        seconds, order = by_hand(policy, jax.tree.map(lambda x, b=b: x[b], many))
        assert found.solved[b, 0]
        assert found.order[b, 0].tolist() == order.tolist()
        travel = travel_times(moment(b))
        routes = [[t for t in route if t >= 0] for route in found.routes(b).tolist()]
        meets = meeting_times(travel, routes)
        assert found.start[b, 0].tolist() == [meets[t] for t in range(4)]
        assert found.seconds[b, 0] == max(meets.values()) <= seconds + 1e-3
        assert found.effort[b, 0] == sum(_way(travel, a, r) for a, r in enumerate(routes))


def _way(travel, agent, route):
    legs = [travel.between[travel.kinds[agent], x, y] for x, y in itertools.pairwise(route)]
    return sum(legs) + (travel.start[agent, route[0]] if route else 0)


def test_the_first_of_several_tries_is_the_likeliest(policy, many):
    drawn = macro.rollouts(policy, many, tries=4, heat=3.0, seed=2)
    assert drawn.order[:, 0].tolist() == macro.rollouts(policy, many).order[:, 0].tolist()


def test_all_serve_who_set_out_and_the_last_service_ends_the_episode(policy, many):
    found = macro.rollouts(policy, many, tries=8, heat=2.0, seed=1)
    assert found.solved.all()
    assert found.end.max(-1) == pytest.approx(found.seconds, abs=1e-3)
    has = many.has[:, None, None] & found.team[..., None]  # [B, K, M, N, S]
    there = has.sum(3)
    assert (np.where(many.either[:, None, :, None], 0, many.need[:, None]) <= there).all()
    assert ((there * many.need[:, None]).sum(-1) > 0).all()
    assert len({found.order[0, k].tobytes() for k in range(8)}) > 1


def test_each_of_several_tries_is_cooler_where_targets_are_many(policy, many, monkeypatch):
    """The hottest and the coolest are those of a call at their temperature alone."""
    alone = {heat: macro.rollouts(policy, many, tries=6, heat=heat).order for heat in (4.0, 1.0)}
    few = macro.rollouts(policy, many, tries=6, heat=4.0, cooling=True).order
    np.testing.assert_array_equal(few, alone[4.0])
    monkeypatch.setattr(macro, "coolest", lambda mask: jnp.full(mask.shape[:-1], 0.25))
    macro._play.clear_cache()
    row = macro.rollouts(policy, many, tries=6, heat=4.0, cooling=True).order
    macro._play.clear_cache()
    for heat, attempt in ((4.0, 0), (4.0, 1), (1.0, 5)):
        np.testing.assert_array_equal(row[:, attempt], alone[heat][:, attempt])
    assert (row[:, 5] != alone[4.0][:, 5]).any()


@pytest.mark.parametrize(("count", "share"), [(0, 1.0), (8, 1.0), (16, 0.25), (40, 0.05)])
def test_the_more_targets_the_cooler(count, share):
    assert macro.coolest(jnp.arange(50) < count) == pytest.approx(share)


def test_a_seed_draws_the_same_whatever_the_pool(policy, many, monkeypatch):
    whole = macro.rollouts(policy, many, tries=8, heat=2.0, seed=1)
    monkeypatch.setattr(macro, "_PLACES", 3)
    monkeypatch.setattr(macro, "_CHUNK", 16)
    ticks = []
    parts = macro.rollouts(policy, many, tries=8, heat=2.0, seed=1, tick=ticks.append)
    assert ticks == [16, 16, 8]
    assert np.array_equal(whole.order, parts.order)
    assert np.array_equal(whole.seconds, parts.seconds)


def test_padding_changes_no_choice(policy, many):
    alone = macro.stacked([problem(0)])
    other = macro.stacked([problem(0), problem(9, agents=4, targets=5)])
    assert other.start.shape == (2, 4, 6)
    small, large = macro.rollouts(policy, alone), macro.rollouts(policy, other)
    assert large.routes(0)[:3, :4].tolist() == small.routes(0).tolist()
    assert (large.routes(0)[3:] == -1).all()


def test_sizes_are_few():
    assert [macro.padded(n) for n in (0, 1, 3, 5, 6, 7, 9, 13, 17, 25)] == [
        1, 1, 3, 6, 6, 8, 12, 16, 24, 32]


def test_services_wait_for_what_comes_before_them_and_for_their_hour(policy):
    one = problem(3)
    after = np.zeros((4, 4), bool)
    after[1, 0] = after[2, 1] = True  # 0, then 1, then 2
    appears = np.array([0.0, 0.0, 0.0, 40.0], np.float32)
    timed = macro.stacked([replace(one, after=after, appears=appears,
                                   service=np.full(4, 2.5, np.float32))] * 5)
    found = macro.rollouts(policy, timed, tries=8, heat=1.0)
    assert found.solved.all()
    assert (found.start[..., 1] >= found.end[..., 0] - 1e-3).all()
    assert (found.start[..., 2] >= found.end[..., 1] - 1e-3).all()
    assert (found.start[..., 3] >= 40.0).all()
    assert found.end - found.start == pytest.approx(2.5)
    assert found.end.max(-1) == pytest.approx(found.seconds, abs=1e-2)


def test_nothing_to_do_and_nothing_that_can_be_done(policy, many):
    hopeless = problem(4)
    hopeless = replace(hopeless, start=np.full_like(hopeless.start, FAR))
    idle = problem(5)
    idle = replace(idle, target_mask=np.zeros(4, bool), need=np.zeros_like(idle.need))
    found = macro.rollouts(policy, macro.stacked([hopeless, idle] + [problem(0)] * 3))
    assert found.solved[:, 0].tolist() == [False, True, True, True, True]
    assert found.seconds[1, 0] == 0.0
    assert (found.routes(0) == -1).all()
    assert not found.team[0].any()


def test_only_pointing_policies_and_numbers_that_can_be(policy, many):
    with pytest.raises(InputError, match="4097 is not allowed"):
        macro.rollouts(policy, many, tries=4097)
    other = replace(policy, brain=object(), source=replace(policy.source, kind="entity"))
    with pytest.raises(InputError, match="one of kind pointer"):
        macro.rollouts(other, many)
