"""Hidden targets in the macro world: what is seen on the way, and where to look next."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from moonteam.grid.macro import draw, sight, world

FAMILY = draw.Draw(targets=(4, 4), metric="straight", looks=4, limit=600.0)


@pytest.fixture
def state():
    return world.reset(draw.draw(FAMILY, jax.random.key(5)))


def apart(a, b):
    return np.hypot(*np.moveaxis(np.asarray(a)[:, None] - np.asarray(b)[None], -1, 0))


def sent(state, agent, target):
    """One agent sets out, the others wait."""
    nobody = np.full(len(state.goal), len(state.solved), np.int32)
    nobody[agent] = target
    return world.step(state, jnp.asarray(nobody))


def test_what_is_in_reach_at_the_start_is_known_and_the_rest_is_hidden(state):
    seen, hidden = state.problem.sight, np.asarray(state.problem.sight.hidden)
    assert hidden.sum() == 4
    near = (apart(seen.here, seen.at) <= FAMILY.sensor).any(0)
    known = np.asarray(world.known(state))
    np.testing.assert_array_equal(known[hidden], near[hidden])
    assert known[~hidden].all()
    assert int(world.coming(state)) == (hidden & ~near).sum() >= 2
    points = np.asarray(seen.points).reshape(-1, 2)
    assert sorted(map(tuple, points.tolist())) == [(x, y) for x in range(32) for y in range(32)]
    np.testing.assert_array_equal(np.asarray(seen.seen).reshape(-1),
                                  (apart(seen.here, points) <= FAMILY.sensor).any(0))
    share = 1 - np.asarray(seen.seen).mean(1)
    np.testing.assert_allclose(np.asarray(state.problem.unseen)[~hidden], share, atol=1e-6)


def test_who_passes_a_hidden_target_finds_it_as_soon_as_it_is_in_reach_and_all_are_asked(state):
    seen, known = state.problem.sight, np.asarray(world.known(state))
    place = np.asarray(seen.at)
    looks = np.flatnonzero(np.asarray(state.problem.looks & ~state.solved))
    times = {}
    for look in looks:
        aim = np.asarray(sight.aimed(seen, jnp.full(3, look)))[0]
        way = np.linspace(np.asarray(seen.here)[0], aim, 20001)
        close = apart(way, place[~known]) <= FAMILY.sensor
        if close.any():
            times[look] = close.any(1).argmax() / 20000 * np.hypot(*(aim - way[0]))
    assert len(times) >= 3
    for look, due in times.items():  # a cell a second
        after = sent(state, 0, look).state
        assert float(after.now) == pytest.approx(due, abs=5e-3)
        assert int(world.coming(after)) < int(world.coming(state))
        assert np.asarray(world.free(after)).all()
        where = np.asarray(after.problem.sight.here)
        far = np.hypot(*(where[0] - np.asarray(seen.here)[0]))
        assert far == pytest.approx(due, abs=5e-3)
        np.testing.assert_allclose(np.asarray(after.problem.start),
                                   apart(where, after.problem.sight.at), rtol=1e-5, atol=1e-4)


def test_who_goes_to_look_stops_where_all_that_is_left_of_the_part_is_in_reach(state):
    problem = state.problem  # nothing is hidden there, so nothing stops it on the way
    state = replace(state, problem=replace(problem, sight=replace(
        problem.sight, at=problem.sight.at.at[:4].set(-100.0))))
    for look in np.flatnonzero(np.asarray(problem.looks & ~state.solved)):
        after = sent(state, 1, look).state
        part = np.asarray(problem.sight.part)[:, look].argmax()
        left = np.asarray(problem.sight.points)[part][~np.asarray(problem.sight.seen)[part]]
        reach = sight.INSIDE * FAMILY.sensor
        here, to = np.asarray(problem.sight.here)[1], np.asarray(problem.sight.at)[look]
        way = np.linspace(here, to, 2001)
        stop = way[(apart(way, left) <= reach).all(1).argmax()]
        assert np.hypot(*(np.asarray(after.problem.sight.here)[1] - stop)) < 0.03
        assert bool(after.solved[look])
        assert float(after.problem.unseen[look]) == 0.0
        assert bool(world.free(after)[1])


def test_a_place_to_look_from_is_the_middle_of_what_is_left_and_of_no_use_when_all_is_found(state):
    problem = state.problem
    looks = np.asarray(problem.looks & ~state.solved)
    for part, column in enumerate(np.asarray(problem.sight.part).argmax(1)):
        hides = ~np.asarray(problem.sight.seen)[part]
        if hides.any():
            left = np.asarray(problem.sight.points)[part][hides]
            np.testing.assert_allclose(np.asarray(problem.sight.at)[column],
                                       (left.min(0) + left.max(0)) / 2)
    assert np.asarray(world.open_targets(state))[looks].all()
    every = replace(state, problem=replace(problem, sight=replace(
        problem.sight, found=problem.sight.hidden)))
    assert int(world.coming(every)) == 0
    assert not np.asarray(world.open_targets(every))[looks].any()
    assert bool(world.finished(replace(every, solved=~problem.looks)))


def test_parts_of_a_side_that_they_do_not_divide_are_padded():
    points, padding = sight.parts(10, 4)  # 3, 3, 2 and 2
    assert points.shape == (16, 9, 2)
    assert sorted(map(tuple, points[~padding].tolist())) == [
        (x, y) for x in range(10) for y in range(10)]
