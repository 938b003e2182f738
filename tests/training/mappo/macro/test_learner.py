"""What makes steps of gradients on macro-decisions."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from moonteam.policies import pointer
from moonteam.policies.pointer import PointerSpec
from training.mappo.macro.hyper import Hyper
from training.mappo.macro.learner import Learner, _between_features, _optimiser

SPEC = PointerSpec(width=16, heads=2, layers=1, pairs=8)
MUON, ADAM = Hyper(optimiser="muon"), Hyper(optimiser="adam")


@pytest.fixture(scope="module")
def params():
    return pointer.init(SPEC, jax.random.key(0))


@pytest.mark.parametrize("hyper", [MUON, ADAM])
def test_a_step_goes_down_and_keeps_to_the_scale_of_adams(params, hyper):
    slope = jax.tree.map(lambda x: jax.random.normal(jax.random.key(x.size), x.shape), params)
    way, _ = _optimiser(hyper).update(slope, Learner.begin(params, hyper).optimiser, params)
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
    for hyper, wide in ((MUON, True), (ADAM, False)):
        state = Learner.begin(params, hyper).optimiser
        way: Any = _optimiser(hyper).update(slope, state, params)[0]
        sizes = np.linalg.svd(np.asarray(way["query"]["kernel"]), compute_uv=False)
        assert (sizes[-4] > 0.3 * sizes[0]) == wide


def test_inputs_outputs_and_all_that_is_no_matrix_are_adams(params):
    kinds = _between_features(params)
    assert kinds["block0"]["qkv"]["kernel"] is not None
    assert kinds["query"]["kernel"] is not None
    for one in (kinds["agent"]["kernel"], kinds["value"]["kernel"], kinds["block0"]["out"]["bias"],
                kinds["block0"]["LayerNorm_0"]["scale"]):
        assert one is None
