"""The sampler draws from exactly the uniform distribution over valid problems."""

import itertools
from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from moonteam import grid

DRAWS = 40_000


def union(sets):
    return int(np.bitwise_or.reduce(np.array(sets)))


def skill_outcomes(num_agents, num_targets, num_skills):
    """Probability of each (agents' sets, targets' sets, types), by enumeration."""
    subsets = range(1, 2**num_skills)
    valid = [(team, need) for team in itertools.product(subsets, repeat=num_agents)
             for need in itertools.product(subsets, repeat=num_targets)
             if not union(need) & ~union(team)]
    chances = {}
    for team, need in valid:
        kinds = [(False, True) if s.bit_count() > 1 else (False,) for s in need]
        for both in itertools.product(*kinds):
            share = np.prod([1 / len(k) for k in kinds])
            chances[team, need, both] = share / len(valid)
    return chances


def place_outcomes(num_cells, num_agents, num_targets, num_buffer):
    """Cells (as numbers) of distinct targets and buffer; agents on none of the targets."""
    outcomes = [
        (picks, agents)
        for picks in itertools.permutations(range(num_cells), num_targets + num_buffer)
        for agents in itertools.product(
            [c for c in range(num_cells) if c not in picks[:num_targets]], repeat=num_agents)]
    return {outcome: 1 / len(outcomes) for outcome in outcomes}


def assert_follows(drawn, chances):
    """Chi-square: nothing impossible, and a statistic within five sigma of its mean."""
    assert set(drawn) <= set(chances)
    count = sum(drawn.values())
    expected = np.array([chances[k] * count for k in chances])
    assert expected.min() > 3, "too few draws for the test"
    seen = np.array([drawn[k] for k in chances])
    freedom = len(chances) - 1
    assert abs(((seen - expected) ** 2 / expected).sum() - freedom) <= 5 * np.sqrt(2 * freedom)


def draw(config, count=DRAWS, **counts):
    sample = jax.jit(jax.vmap(lambda key: grid.sample(config, key, **counts)))
    return jax.tree.map(np.asarray, sample(jax.random.split(jax.random.key(1), count)))


def rows(array):
    return [tuple(row) for row in array.tolist()]


@pytest.mark.parametrize(("n", "m", "s"), [(2, 2, 2), (3, 1, 2), (2, 1, 3)])
def test_skills_and_types(n, m, s):
    problem, _ = draw(grid.EnvConfig(num_agents=n, num_targets=m, num_skills=s, width=3, height=3))
    drawn = Counter(zip(rows(problem.agent_skills), rows(problem.target_skills),
                        rows(problem.target_and), strict=True))
    assert_follows(drawn, skill_outcomes(n, m, s))


@pytest.mark.parametrize(("size", "n", "m", "b"), [
    ((3, 2), 2, 2, 0), ((3, 2), 1, 2, 1)])
def test_cells(size, n, m, b):
    config = grid.EnvConfig(num_agents=n, num_targets=m, num_buffer=b, width=size[0],
                            height=size[1])
    problem, cells = draw(config)
    places = problem.target_cells
    if b:
        places = np.concatenate([places, problem.buffer.cells], axis=1)
    number = lambda xy: xy[..., 0] + size[0] * xy[..., 1]
    drawn = Counter(zip(rows(number(places)), rows(number(cells)), strict=True))
    assert_follows(drawn, place_outcomes(size[0] * size[1], n, m, b))


def test_cells_and_skills_are_independent():
    config = grid.EnvConfig(num_agents=1, num_targets=1, width=3, height=1)
    problem, cells = draw(config)
    drawn = Counter(zip(rows(problem.target_cells[:, 0]), rows(cells[:, 0]),
                        problem.agent_skills[:, 0].tolist(), problem.target_skills[:, 0].tolist(),
                        problem.target_and[:, 0].tolist(), strict=True))
    places = [((a, 0), (b, 0)) for a, b in itertools.permutations(range(3), 2)]
    skills = skill_outcomes(1, 1, 2)
    assert_follows(drawn, {(*at, team[0], need[0], both[0]): chance / len(places)
                           for at in places for (team, need, both), chance in skills.items()})


def test_traced_counts_and_size_draw_the_smaller_family():
    config = grid.EnvConfig(num_agents=4, num_targets=3, num_skills=2, width=9, height=9)
    problem, cells = draw(config, num_agents=jnp.int32(2), num_targets=jnp.int32(2),
                          size=jnp.array([3, 2], jnp.int32))
    assert rows(problem.agent_mask[:1]) == [(True, True, False, False)]
    assert not problem.agent_skills[:, 2:].any()
    assert not problem.target_skills[:, 2:].any()
    assert not cells[:, 2:].any()
    drawn = Counter(zip(rows(problem.agent_skills[:, :2]), rows(problem.target_skills[:, :2]),
                        rows(problem.target_and[:, :2]), strict=True))
    assert_follows(drawn, skill_outcomes(2, 2, 2))
    number = lambda xy: xy[..., 0] + 3 * xy[..., 1]
    drawn = Counter(zip(rows(number(problem.target_cells[:, :2])), rows(number(cells[:, :2])),
                        strict=True))
    assert_follows(drawn, place_outcomes(6, 2, 2, 0))


def test_buffered_targets_are_covered_too():
    config = grid.EnvConfig(num_agents=2, num_targets=1, num_buffer=1, width=3, height=3)
    problem, _ = draw(config)
    need = np.stack([problem.target_skills[:, 0], problem.buffer.skills[:, 0]], axis=1)
    both = np.stack([problem.target_and[:, 0], problem.buffer.both[:, 0]], axis=1)
    drawn = Counter(zip(rows(problem.agent_skills), rows(need), rows(both), strict=True))
    assert_follows(drawn, skill_outcomes(2, 2, 2))


def test_large_families_stay_valid():
    config = grid.EnvConfig(num_agents=6, num_targets=24, num_skills=8, width=12, height=12)
    problem, cells = draw(config, count=64)
    team = np.bitwise_or.reduce(problem.agent_skills, axis=1)
    assert not (problem.target_skills & ~team[:, None]).any()
    assert (problem.target_skills > 0).all()
    assert all(len(set(rows(places))) == 24 for places in problem.target_cells)
    taken = (cells[:, :, None] == problem.target_cells[:, None]).all(-1)
    assert not taken.any()


def test_renewal_replaces_the_ended_and_only_them():
    config = grid.EnvConfig(num_agents=2, num_targets=3, width=6, height=6)
    resets = jax.jit(jax.vmap(lambda key: grid.reset(config, key)[0]))
    states = resets(jax.random.split(jax.random.key(0), 64))
    renew = jax.jit(grid.renew, static_argnums=0)
    for ended in (np.arange(64) % 40 == 3, np.ones(64, bool), np.zeros(64, bool)):
        after = renew(config, jax.random.key(5), states, jnp.array(ended))
        kept = (np.asarray(after.cells) == np.asarray(states.cells)).all((1, 2))
        assert kept[~ended].all()
        fresh = {tuple(np.ravel(c)) for c in np.asarray(after.problem.target_cells)[ended]}
        assert len(fresh) == ended.sum(), "each ended episode gets a problem of its own"
        old = np.asarray(states.problem.target_cells)[ended]
        new = np.asarray(after.problem.target_cells)[ended]
        assert (old != new).any((1, 2)).all()
        assert not np.asarray(after.step)[ended].any()
