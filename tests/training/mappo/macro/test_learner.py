"""What makes steps of gradients on macro-decisions."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from moonteam.policies import pointer
from moonteam.policies.pointer import PointerSpec
from training.mappo.macro.hyper import Hyper
from training.mappo.macro.learner import Learner, _optimiser

SPEC = PointerSpec(width=16, heads=2, layers=1, pairs=8)


@pytest.fixture(scope="module")
def params():
    return pointer.init(SPEC, jax.random.key(0))


@pytest.mark.parametrize("name", ["muon", "adam"])
def test_a_step_goes_down_and_keeps_to_the_scale_of_adams(params, name):
    rule = _optimiser(Hyper(optimiser=name))
    slope = jax.tree.map(lambda x: jax.random.normal(jax.random.key(x.size), x.shape), params)
    way, _ = rule.update(slope, Learner.begin(params, Hyper(optimiser=name)).optimiser, params)
    downhill = sum(float(jnp.vdot(w, g)) for w, g in zip(
        jax.tree.leaves(way), jax.tree.leaves(slope), strict=True))
    assert downhill > 0.0  # `descend` takes it off
    for w in jax.tree.leaves(way):
        assert 0.1 < float(jnp.sqrt(jnp.mean(w**2))) < 1.5


def test_muon_learns_all_directions_of_a_matrix_at_one_pace(params):
    slope = jax.tree.map(jnp.zeros_like, params)
    rng = np.random.default_rng(0)
    steep = rng.normal(size=(16, 16)) @ np.diag(np.geomspace(1.0, 1e-2, 16))
    slope["query"]["kernel"] = jnp.asarray(steep, jnp.float32)
    for hyper, wide in ((Hyper(optimiser="muon"), True), (Hyper(optimiser="adam"), False)):
        state = Learner.begin(params, hyper).optimiser
        way: Any = _optimiser(hyper).update(slope, state, params)[0]
        sizes = np.linalg.svd(np.asarray(way["query"]["kernel"]), compute_uv=False)
        assert (sizes[-4] > 0.3 * sizes[0]) == wide
