"""Nobody waits for ever, whatever a policy says; what jit, vmap and padding must not change."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from moonteam.grid.macro import world
from moonteam.grid.macro.draw import Draw, draw
from moonteam.grid.macro.types import FAR, MacroProblem

PLAIN = Draw(agents=(2, 4), targets=(3, 6), num_skills=3, sides=(8, 16), metric="straight",
             speeds=(1.5, 0.36, 0.47), limit=FAR)
reset, choose, step = jax.jit(world.reset), jax.jit(world.choose), jax.jit(world.step)
AGENTS, TARGETS = PLAIN.agents[1], PLAIN.targets[1]
MOST = TARGETS * (AGENTS + 1) + AGENTS + 1
"""Decisions of an episode at most: each follows an arrival, a service's end or a robot set free."""


@partial(jax.jit, static_argnums=0)
def draws(family, key):
    return jax.vmap(partial(draw, family))(jax.random.split(key, 256))


def richer(problems, seed):
    """The same with services, chains, coalitions by number, homes, robots free later."""
    r = np.random.default_rng(seed)
    count, n, m = problems.start.shape
    order = r.permuted(np.tile(np.arange(m), (count, 1)), axis=1)
    after = (order[:, :, None] > order[:, None]) & (r.random((count, m, m)) < 0.15)
    after &= np.asarray(problems.target_mask)[:, None]
    need, supply = np.array(problems.need), np.asarray(problems.has).sum(1)
    more = (r.random(need.shape) < 0.5) & (need > 0) & ~np.asarray(problems.either)[..., None]
    need = np.where(more & (supply[:, None] > 1), 2, need)
    return replace(
        problems, after=jnp.asarray(after), need=jnp.asarray(need, jnp.int32),
        service=jnp.asarray(r.choice([0.0, 3.0, 20.0], (count, m)), jnp.float32),
        home=jnp.asarray(r.uniform(0, 9, (count, n, m)), jnp.float32),
        free=jnp.asarray(r.choice([0.0, 4.0], (count, n)), jnp.float32))


def logits_of(key, agents, targets, eager):
    """Random wishes; waiting is likelier or less likely."""
    return 3 * jax.random.normal(key, (agents, targets + 1)).at[:, -1].add(eager)


@partial(jax.jit, static_argnames="turning")
def played(problems, key, heat, eager, turning=False):
    """Episodes of random wishes to their end: the last states, decisions, what each step said."""
    agents, targets = problems.start.shape[1:]

    def one(carry, key):
        states, over, count = carry
        keys = jax.random.split(key, len(over))
        logits = jax.vmap(lambda k: logits_of(k, agents, targets, eager))(keys)
        noise = heat * jax.random.gumbel(key, logits.shape)
        choice, options = jax.vmap(world.choose)(states, logits, noise)
        result = jax.vmap(world.step)(states, choice)
        after = result.state
        if turning:
            after = jax.vmap(world.loosen)(after, jnp.ones(choice.shape, bool))
        kept = jax.tree.map(
            lambda a, b: jnp.where(over.reshape(-1, *[1] * (a.ndim - 1)), a, b), states, after)
        picked = jnp.take_along_axis(options, choice[..., None], axis=2)[..., 0]
        ended = result.terminated | result.truncated
        said = (jnp.where(over[:, None], True, picked), ~over & result.truncated,
                jnp.where(over, 0.0, result.seconds), jnp.where(over, 0.0, result.effort))
        return (kept, over | ended, count + ~over), said

    states = jax.vmap(world.reset)(problems)
    start = (states, jnp.all(states.solved, 1), jnp.zeros(len(states.now), jnp.int32))
    (states, _, count), said = jax.lax.scan(one, start, jax.random.split(key, MOST + 1))
    return states, count, said


@pytest.mark.parametrize(("heat", "eager", "turning"), [
    (0.0, 0.0, False), (1.0, 0.0, False), (0.0, 4.0, False), (1.0, -9.0, False),
    (1.0, 0.0, True), (1.0, -9.0, True)])
def test_every_episode_ends_with_all_solved(heat, eager, turning):
    """Also where those on their way choose again, and may turn away, at every event."""
    for seed in range(3):
        problems = draws(PLAIN, jax.random.key(seed))
        problems = richer(problems, seed) if seed else problems
        states, count, (picked, truncated, seconds, effort) = jax.tree.map(
            np.asarray, played(problems, jax.random.key(seed), heat, eager, turning))
        assert picked.all(), "chose what was not to be chosen"
        assert not truncated.any()
        assert states.solved.all()
        assert count.max() <= MOST
        assert (seconds >= 0).all()
        assert (effort >= 0).all()
        if not seed and not turning:
            np.testing.assert_allclose(seconds.sum(0), states.now, rtol=1e-5)
            np.testing.assert_allclose(effort.sum(0), states.travelled.sum(1), rtol=1e-5)


def test_who_turns_away_starts_where_it_is():
    """On straight ways the times after `loosen` are those from the point that was reached."""
    r = np.random.default_rng(0)
    for _ in range(5):
        start, spots = r.uniform(0, 20, (2, 2)), r.uniform(0, 20, (4, 2))
        apart = lambda a, b: np.linalg.norm(a[:, None] - b[None], axis=-1)
        base, free = r.uniform(0, 20, (1, 2)), np.array([1.0, 0.0])  # the second need not return
        home = free[:, None] * apart(base, spots)
        problem = team([[1, 0], [1, 0]], [[1, 0]] * 4, apart(start, spots), apart(spots, spots),
                       home=home.astype(np.float32),
                       home_now=(free * apart(start, base)[:, 0]).astype(np.float32))
        state = step(reset(problem), jnp.array([0, 1])).state
        late = int(np.argmax(np.asarray(state.busy)))
        assert state.goal[late] == late
        gone = float(state.now) / np.linalg.norm(spots[late] - start[late])
        point = start[late] + gone * (spots[late] - start[late])
        after = world.loosen(state, jnp.ones(2, bool))
        assert (after.goal[late], after.node[late], after.busy[late]) == (4, 4, 0.0)
        assert after.since[late] == state.now
        np.testing.assert_allclose(after.problem.start[late], apart(point[None], spots)[0],
                                   atol=2e-3)
        np.testing.assert_allclose(after.problem.home_now[late],
                                   free[late] * apart(point[None], base)[0, 0], atol=2e-3)
        np.testing.assert_allclose(after.travelled[late], state.now, rtol=1e-5)
        same = world.loosen(state, jnp.zeros(2, bool))
        jax.tree.map(np.testing.assert_array_equal, same, state)


def team(has, need, start, between, **changes):
    """A small problem from lists; two dimensions of skills."""
    has, need = np.array(has, bool), np.array(need, np.int32)
    n, m = len(has), len(need)
    zero = np.zeros(m, np.float32)
    return replace(MacroProblem(
        start=np.array(start, np.float32),
        between=np.tile(np.array(between, np.float32), (n, 1, 1)),
        home=np.zeros((n, m), np.float32), home_now=np.zeros(n, np.float32), has=has, need=need,
        either=zero > 0, service=zero, after=np.zeros((m, m), bool), appears=zero, shown=zero,
        following=np.zeros(m, np.int32), looks=zero > 0, unseen=zero,
        coming=np.int32(0), middle=zero, worth=zero,
        middle_now=np.zeros(n, np.float32),
        lapses=zero + FAR, free=np.zeros(n, np.float32),
        lost=np.full(n, FAR, np.float32), effort=np.ones(n, np.float32),
        limit=np.float32(FAR), agent_mask=np.ones(n, bool), target_mask=np.ones(m, bool),
        unit=np.float32(1.0)), **changes)


BOTH = team([[1, 0], [0, 1]], [[1, 1], [1, 1]], [[1, 5], [5, 1]], [[0, 4], [4, 0]])


def test_two_robots_that_would_wait_for_each_other_do_not():
    apart = np.array([0, 1], np.int32)
    stuck = step(reset(BOTH), apart)
    assert bool(stuck.truncated), "each waits at a target for the other"
    wishes = jnp.array([[9.0, 0.0, -9.0], [0.0, 9.0, -9.0]])
    state, plan = reset(BOTH), []
    for _ in range(2):
        choice, options = choose(state, wishes, jnp.zeros((2, 3)))
        assert len(set(choice.tolist())) == 1, "the second goes where the first went"
        assert options.sum(1).tolist() in ([3, 2], [2, 2], [2, 1])
        result = step(state, choice)
        plan.append((result.state.solved.tolist(), float(result.seconds), float(result.effort)))
        state = result.state
    assert bool(result.terminated)
    assert plan == [([True, False], 5.0, 6.0), ([True, True], 4.0, 8.0)]


def test_who_is_bound_to_a_target_is_waited_for():
    """The one who comes first could do it alone: its service starts with the other, not before."""
    problem = team([[1, 0], [1, 1]], [[1, 1]], [[6.0], [2.0]], [[0.0]],
                   service=np.array([3.0], np.float32))
    result = step(reset(problem), np.array([0, 0], np.int32))
    assert bool(result.terminated)
    assert float(result.seconds) == 9.0
    assert result.state.since.tolist() == [9.0, 9.0]


def test_who_arrives_serves_before_others_decide():
    """Else the other, who waits, would be sent off: nobody would seem to be on the way."""
    problem = team([[1, 0], [1, 0]], [[1, 0], [1, 0]], [[2.0, 9.0], [5.0, 9.0]],
                   [[0.0, 3.0], [3.0, 0.0]])
    state = step(reset(problem), np.array([0, 2], np.int32)).state
    assert (float(state.now), state.solved.tolist()) == (2.0, [True, False])
    assert world.free(state).tolist() == [True, True]


def test_news_wakes_who_is_free_and_what_lapses_ends_it():
    window = {"appears": np.array([0, 7], np.float32), "shown": np.array([0, 4], np.float32),
              "lapses": np.array([FAR, 8], np.float32)}
    problem = team([[1, 0]], [[1, 0], [1, 0]], [[2.0, 9.0]], [[0.0, 3.0], [3.0, 0.0]], **window)
    state = reset(problem)
    assert world.allowed(state, state.goal).tolist() == [[True, False]]
    state = step(state, np.array([0], np.int32)).state
    assert (float(state.now), bool(world.free(state)[0])) == (4.0, True)
    state = step(state, np.array([1], np.int32)).state
    assert (float(state.now), state.solved.tolist()) == (7.0, [True, True])
    late = step(reset(replace(problem, start=problem.start + 4)),
                      np.array([0], np.int32)).state
    assert not bool(world.allowed(late, late.goal).any())
    assert bool(step(late, np.array([2], np.int32)).truncated)


def test_vmap_is_a_loop_and_the_same_key_the_same_episode():
    problems = draws(PLAIN, jax.random.key(5))
    some = richer(jax.tree.map(lambda x: x[:4], problems), 5)
    key = jax.random.key(1)
    states, _, _ = played(some, key, 0.0, 0.0)
    again, _, _ = played(some, key, 0.0, 0.0)
    jax.tree.map(np.testing.assert_array_equal, states, again)
    resets = jax.jit(jax.vmap(world.reset))(some)
    logits = jnp.stack([logits_of(jax.random.key(i), AGENTS, TARGETS, 0.0) for i in range(4)])
    choice, _ = jax.jit(jax.vmap(world.choose))(resets, logits, jnp.zeros_like(logits))
    result = jax.jit(jax.vmap(world.step))(resets, choice)
    for i in range(4):
        state = reset(jax.tree.map(lambda x, i=i: x[i], some))
        alone, _ = choose(state, logits[i], jnp.zeros_like(logits[i]))
        assert alone.tolist() == choice[i].tolist()
        jax.tree.map(lambda a, b, i=i: np.testing.assert_allclose(a, b[i], rtol=1e-6, atol=1e-6),
                     step(state, alone), result)


def test_families_are_hashable_and_one_compilation_serves_all():
    assert hash(Draw()) == hash(Draw())
    assert Draw(agents=(2, 4)) != Draw()
    traces = []

    @jax.jit
    def first(problem):
        traces.append(1)
        return world.reset(problem).now

    for seed in range(3):
        first(jax.tree.map(lambda x, s=seed: x[s], draws(PLAIN, jax.random.key(0))))
    assert len(traces) == 1
