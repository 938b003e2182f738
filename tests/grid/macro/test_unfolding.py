"""The macro world in which targets follow or arrive, beside the planners' world."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
import pytest

from moonteam import loading, paths
from moonteam.grid.macro import draw, world
from moonteam.planners.macro import stacked
from moonteam.planners.seconds.base import MS, moment
from moonteam.planners.seconds.macro import problem_of
from moonteam.planners.unfolding.world import World

FOLLOWING = draw.Draw(targets=(8, 10), following=5)
ARRIVING = draw.Draw(targets=(8, 8), metric="straight", speeds=(1.5, 0.36), arriving=5, limit=300.0)


@jax.jit
def decided(state, logits):
    """What is chosen, and the state after it; choices are held, for half-way along the lattice both
    worlds part: this one takes the way as straight.
    """
    choice, _ = world.choose(state, logits, jnp.zeros_like(logits))
    result = world.step(state, choice)
    over = result.terminated | result.truncated
    return choice, result.state, over, world.known(state), world.coming(state)


def test_both_worlds_go_alike_event_by_event():
    """Random choices in missions of which the half follows: when what is solved and known of.

    Without coalitions: there this world waits for all who are bound, the other for enough of them.
    """
    held = loading.load_set(paths.find("unfolding/following", "testsets", ".jsonl"))[:12]
    rng = np.random.default_rng(0)
    for held_one in held:
        alone = tuple(msgspec.structs.replace(t, type="OR") for t in held_one.targets)
        mission = msgspec.structs.replace(held_one, targets=alone)
        whole = problem_of(moment(mission))
        following = np.array([target.following for target in mission.targets], np.int32)
        problem = jax.tree.map(lambda x: x[0], stacked([replace(whole, following=following)]))
        state, own = world.reset(problem), World(mission)
        for _ in range(40):
            logits = rng.normal(0, 2, (3, problem.start.shape[1] + 1)).astype(np.float32)
            free = np.asarray(world.free(state))
            choice, after, over, known, coming = jax.device_get(decided(state, logits))
            assert own.state.now / MS == pytest.approx(float(state.now), abs=2e-3)
            real = known & np.asarray(problem.target_mask)
            assert sorted(own.state.numbers) == np.flatnonzero(real).tolist()
            assert own.view().coming == coming
            orders = [
                body.goal if not is_free else own.state.numbers.index(int(pick))
                if pick < problem.start.shape[1] else -1
                for body, is_free, pick in zip(own.state.bodies, free, choice, strict=True)]
            own.step(orders)
            state = after
            if over:
                break
        assert own.over
        assert own.outcome.success == bool(np.asarray(state.solved).all())


def test_both_worlds_let_the_same_lapse():
    """Random choices in missions whose targets arrive, are worth something and lapse."""
    held = loading.load_set(paths.find("unfolding/lapsing", "testsets", ".jsonl"))[:12]
    rng, missed = np.random.default_rng(1), 0.0
    for held_one in held:
        alone = tuple(msgspec.structs.replace(t, type="OR") for t in held_one.targets)
        mission = msgspec.structs.replace(held_one, targets=alone)
        whole = problem_of(moment(mission))
        problem = jax.tree.map(lambda x: x[0], stacked([replace(whole, shown=whole.appears)]))
        state, own, lost = world.reset(problem), World(mission), 0.0
        for _ in range(80):
            logits = rng.normal(0, 2, (3, problem.start.shape[1] + 1)).astype(np.float32)
            free = np.asarray(world.free(state))
            choice, after, over, *_ = jax.device_get(decided(state, logits))
            while own.state.now / MS < float(state.now) - 3e-3:  # nobody could choose anything
                own.step([body.goal for body in own.state.bodies])
            assert own.state.now / MS == pytest.approx(float(state.now), abs=3e-3)
            assert {own.state.numbers[j] for j in own.state.lapsed} >= set(
                np.flatnonzero(state.lapsed & np.asarray(world.known(state))).tolist())
            orders = [
                own.state.numbers.index(int(pick)) if is_free and pick < 12 else
                body.goal if not is_free else -1
                for body, is_free, pick in zip(own.state.bodies, free, choice, strict=True)]
            own.step(orders)
            lost = float((after.lapsed * problem.worth).sum())
            state = after
            if over:
                break
        while not own.over:
            own.step([body.goal for body in own.state.bodies])
        assert own.outcome.success
        assert own.outcome.missed == pytest.approx(lost, abs=1e-3)
        missed += lost
    assert missed > 0


@pytest.mark.parametrize("family", [FOLLOWING, ARRIVING], ids=["following", "arriving"])
def test_the_last_targets_are_not_known_at_the_start(family):
    made = jax.vmap(partial(draw.draw, family))(jax.random.split(jax.random.key(0), 64))
    states = jax.jit(jax.vmap(world.reset))(made)
    known = np.asarray(jax.vmap(world.known)(states)) & np.asarray(made.target_mask)
    count = np.asarray(made.target_mask).sum(1)
    assert (known.sum(1) == count - 5).all()
    assert (np.asarray(jax.vmap(world.coming)(states)) == 5).all()
    options = jax.vmap(world.allowed)(states, states.goal)
    assert not (np.asarray(options) & ~known[:, None]).any()


def test_times_between_arrivals_have_the_mean_that_is_asked_for():
    made = jax.vmap(partial(draw.draw, ARRIVING))(jax.random.split(jax.random.key(1), 2000))
    shown = np.asarray(made.shown)[:, 3:]
    assert np.diff(shown, axis=1).mean() == pytest.approx(ARRIVING.every, rel=0.05)
    np.testing.assert_array_equal(made.shown, made.appears)


def test_the_mean_way_to_what_comes_is_the_same_in_both_worlds():
    mission = loading.load_set(paths.find("unfolding/arrivals", "testsets", ".jsonl"))[0]
    now = World(mission).view().moment
    agents = jnp.array([agent.at for agent in mission.agents])
    spots = draw.places(jnp.zeros(2), jnp.array([31.0, 31.0]))
    fastest = max(agent.speed for agent in mission.agents)
    mean = jnp.mean(draw.apart(agents, spots, "straight"), axis=1) / fastest
    np.testing.assert_allclose(now.middle_now / MS, mean, atol=2e-3)
    assert now.coming == 5
    np.testing.assert_allclose(problem_of(now).middle_now, mean, atol=2e-3)
    # Where nothing is to come, nothing is said of it.
    assert problem_of(moment(mission)).middle_now.tolist() == [0.0, 0.0, 0.0]


POSTS = draw.Draw(agents=(2, 3), targets=(6, 6), metric="straight", arriving=4, every=6.0,
                  limit=300.0, worth=(1.0, 5.0), posts=True)


def test_whatever_is_chosen_missions_with_posts_end_and_posts_are_never_served():
    made = jax.vmap(partial(draw.draw, POSTS))(jax.random.split(jax.random.key(0), 64))
    post = np.asarray(jax.vmap(world.posts)(made))
    assert (post.sum(1) == draw.POSTS).all()
    assert not np.asarray(made.worth)[post].any()

    @jax.jit
    def turn(states, over, key):
        logits = jax.random.normal(key, (64, 3, POSTS.entries + 1))
        logits = logits.at[..., 6:POSTS.entries].add(2.0)  # rather to posts
        choice, options = jax.vmap(world.choose)(states, logits, jnp.zeros_like(logits))
        result = jax.vmap(world.step)(states, choice)
        after = jax.vmap(world.loosen)(result.state, jnp.ones(choice.shape, bool))
        return jax.tree.map(lambda a, b: jnp.where(over.reshape(-1, *[1] * (a.ndim - 1)), a, b),
                            (states, over), (after, result.terminated)), (
            choice, options, result.truncated & ~over)

    states, over = jax.vmap(world.reset)(made), jnp.zeros(64, bool)
    went = 0
    for k in range(120):
        before = states
        (states, over), (choice, options, truncated) = turn(states, over, jax.random.key(k))
        assert not truncated.any()
        posts = options[..., 6:POSTS.entries].any((1, 2)) & ~over
        assert (np.asarray(jax.vmap(world.coming)(before))[np.asarray(posts)] > 0).all()
        went += int((np.asarray(choice) >= 6).sum() - (np.asarray(choice) == POSTS.entries).sum())
    assert np.asarray(over).all()
    assert went > 200
    assert not np.asarray(states.solved)[post].any()


def test_who_waits_at_a_post_is_free_on_the_way_and_there():
    made = draw.draw(POSTS, jax.random.key(3))
    state = world.reset(made)
    post = int(np.argmax(np.asarray(world.posts(made))))
    far = np.asarray(world.legs(made, state.node))[:, post]
    other = POSTS.entries
    goal = np.full(len(far), other, np.int32)
    goal[0] = post
    after = world.step(state, goal).state
    passed = float(after.now - state.now)
    if passed < far[0] - 1e-3:  # something happened on its way
        assert not bool(world.free(after)[0])
        after = world.loosen(after, jnp.ones(len(far), bool))
        left = np.asarray(world.legs(after.problem, after.node))[0, post]
        np.testing.assert_allclose(left, far[0] - passed, atol=2e-3)
    assert bool(world.free(after)[0])
    assert not bool(after.solved[post])
