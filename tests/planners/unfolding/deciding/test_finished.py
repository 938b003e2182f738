"""How soon what is known can be done, of many missions at once."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from moonteam.grid.macro.draw import Draw, draw
from moonteam.grid.macro.types import FAR
from moonteam.planners.seconds.base import MS
from moonteam.planners.seconds.exact import ExactPlanner
from moonteam.planners.unfolding.deciding.finished import ends, fits
from training.mappo.macro.held_out import moment_of

COUNT = 24


def drawn(**how):
    family = Draw(**{"targets": (1, 5), "limit": 1000.0} | how)
    keys = jax.random.split(jax.random.key(0), COUNT)
    return jax.device_get(jax.jit(jax.vmap(lambda key: draw(family, key)))(keys))


@pytest.mark.parametrize("how", [
    {}, {"metric": "straight", "unlike": 1.0}, {"agents": (2, 4), "num_skills": 3},
    {"metric": "straight", "service": 1.0, "unlike": 0.5}], ids=str)
def test_it_is_as_soon_as_the_exact_planner_has_it(how):
    problems = drawn(**how)
    assert fits(problems).all()
    row = np.random.default_rng(1).permutation(COUNT)
    open_ = problems.target_mask[row] & (np.random.default_rng(2).random((COUNT, 5)) < 0.8)
    found = ends(problems, row, problems.start[row], open_)
    assert (found > 0).any()
    for r, b in enumerate(row.tolist()):
        problem = jax.tree.map(lambda x, b=b: x[b], problems)
        moment = moment_of(problem)
        plan = ExactPlanner().plan(replace(moment, solved=~open_[r]))
        assert plan.makespan is not None
        assert found[r] == pytest.approx(plan.makespan / MS, abs=5e-3), (r, b)


def test_what_nobody_can_serve_is_never_done():
    problems = drawn(targets=(3, 3))
    alone = replace(problems, has=np.zeros_like(problems.has))
    row, open_ = np.arange(COUNT), np.ones((COUNT, 3), bool)
    assert np.isinf(ends(alone, row, problems.start, open_)).all()
    away = np.full_like(problems.start, FAR)
    assert np.isinf(ends(problems, row, away, open_)).all()
    assert (ends(problems, row, away, np.zeros_like(open_)) == 0).all(), "nothing is left"


def test_it_says_which_problems_it_can_take():
    problems = drawn(targets=(3, 3))

    def with_first(name, value):
        own = getattr(problems, name).copy()
        own[0] = value
        return replace(problems, **{name: own})

    for name, value in (("home", 5.0), ("home_now", 5.0), ("need", 2), ("worth", 1.0),
                        ("after", True), ("lapses", 50.0), ("lost", 50.0), ("looks", True),
                        ("appears", 9.0)):
        assert fits(with_first(name, value)).tolist() == [False] + [True] * (COUNT - 1), name
