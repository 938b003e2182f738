"""Problems of crews: robots of few kinds that start together and are needed several at once."""

from functools import partial

import jax
import numpy as np
import pytest

from moonteam.grid.macro.draw import Draw, draw

CREW = Draw(agents=(6, 9), targets=(4, 7), num_skills=3, metric="straight", numbers=3, service=1.5,
            homes=1.0, crews=(1, 3))


@pytest.fixture(scope="module")
def problems():
    keys = jax.random.split(jax.random.key(0), 64)
    return jax.device_get(jax.jit(jax.vmap(partial(draw, CREW)))(keys))


def each(problems):
    for k in range(64):
        one = jax.tree.map(lambda x, k=k: x[k], problems)
        yield one, one.agent_mask, one.target_mask


def test_a_kind_has_its_own_skill_and_its_own_place(problems):
    many = set()
    for one, agents, targets in each(problems):
        assert (one.has[agents].sum(1) == 1).all()
        kind = one.has[agents].argmax(1)
        many.add(len(set(kind)))
        for same in set(kind):
            own = one.start[agents][kind == same][:, targets]
            assert (own == own[0]).all()
        sizes = np.bincount(kind)
        assert sizes.max() - sizes[sizes > 0].min() <= 1
    assert many == {1, 2, 3}


def test_there_are_robots_enough_and_numbers_only_of_one_kind(problems):
    wanted = set()
    for one, agents, targets in each(problems):
        need = one.need[targets]
        assert (need <= one.has[agents].sum(0)).all()
        assert (need.sum(1) > 0).all()
        several = (need > 0).sum(1) > 1
        assert (need[several] <= 1).all()
        wanted |= set(need[~several].sum(1).tolist())
        assert not one.either[targets & (one.need.sum(1) > 1)].any()
    assert wanted == {1, 2, 3}


def test_all_have_services_and_go_home(problems):
    for one, agents, targets in each(problems):
        assert (one.service[targets] > 0).all()
        assert np.allclose(one.home[agents][:, targets], one.start[agents][:, targets])
