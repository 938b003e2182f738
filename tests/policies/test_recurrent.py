import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn

from moonteam.errors import InputError
from moonteam.policies import recurrent
from moonteam.policies.policy_file import PolicyFile, check_shapes, load_policy, save_policy
from moonteam.policies.recurrent import Gru, RecurrentSpec

PAPER = RecurrentSpec(num_agents=3, num_targets=5, size=(32, 32))
TINY = RecurrentSpec(num_agents=2, num_targets=1, size=(4, 5), width=8)


def test_kernel_parameters_are_the_papers():
    params = jax.eval_shape(lambda: recurrent.init(PAPER, jax.random.key(0)))
    counts = {name: recurrent.kernel_count(tree) for name, tree in params.items()}
    assert counts == {"actor": 119_040, "critic": 125_952}
    assert sum(counts.values()) == 244_992


def test_gru_is_the_flax_cell():
    width, batch = 4, 3
    keys = jax.random.split(jax.random.key(1), 4)
    gru = Gru(width)
    inputs = jax.random.normal(keys[0], (5, batch, width))
    hidden = jax.random.normal(keys[1], (batch, width))
    never = jnp.zeros((5, batch), bool)
    params = gru.init(keys[2], hidden, inputs, never)["params"]
    params = jax.tree.map(lambda x: x + 0.1 * jax.random.normal(keys[3], x.shape), params)
    parts = {}
    for at, gate in enumerate("rzn"):
        cut = slice(at * width, (at + 1) * width)
        parts["i" + gate] = {"kernel": params["input"]["kernel"][:, cut],
                             "bias": params["input"]["bias"][cut]}
        parts["h" + gate] = {"kernel": params["recurrent"][:, cut]}
    parts["hn"]["bias"] = params["candidate_bias"]
    expected, carry = [], hidden
    for x in inputs:
        carry, out = nn.GRUCell(width).apply({"params": parts}, carry, x)
        expected.append(out)
    last, got = gru.apply({"params": params}, hidden, inputs, never)
    np.testing.assert_allclose(got, jnp.stack(expected), rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(last, got[-1])


def test_gru_gradient_is_that_of_its_definition():
    """Against the same recurrence differentiated step by step without any scan."""
    width, batch, steps = 3, 2, 4
    keys = jax.random.split(jax.random.key(2), 3)
    gru = Gru(width)
    inputs = jax.random.normal(keys[0], (steps, batch, width))
    hidden = jax.random.normal(keys[1], (batch, width))
    reset = jnp.zeros((steps, batch), bool).at[2, 0].set(True)
    params = gru.init(keys[2], hidden, inputs, reset)["params"]

    def whole(params, hidden, inputs):
        return jnp.sum(gru.apply({"params": params}, hidden, inputs, reset)[1] ** 2)

    def stepwise(params, hidden, inputs):
        total = 0.0
        for t in range(steps):
            hidden, out = gru.apply({"params": params}, hidden, inputs[t:t + 1], reset[t:t + 1])
            total = total + jnp.sum(out**2)
        return total

    got = jax.grad(whole, argnums=(0, 1, 2))(params, hidden, inputs)
    expected = jax.grad(stepwise, argnums=(0, 1, 2))(params, hidden, inputs)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-5, atol=1e-6), got, expected)


@pytest.mark.parametrize("memory", [True, False])
def test_a_reset_in_the_middle_clears_the_memory(memory):
    spec = RecurrentSpec(2, 1, (4, 4), width=8, memory=memory)
    net, params = recurrent.actor(spec), recurrent.init(spec, jax.random.key(0))["actor"]
    obs = jax.random.normal(jax.random.key(3), (6, 2, spec.obs_size))
    reset = jnp.zeros((6, 2), bool).at[3].set(True)
    hidden = jnp.ones_like(recurrent.zeros(spec, 2))
    _, whole = net.apply({"params": params}, hidden, obs, reset)
    _, fresh = net.apply({"params": params}, recurrent.zeros(spec, 2), obs[3:], reset[3:] & False)
    np.testing.assert_allclose(whole[3:], fresh, rtol=1e-5, atol=1e-6)
    _, kept = net.apply({"params": params}, hidden, obs, reset & False)
    assert np.allclose(kept[3:], fresh, atol=1e-6) != memory


def test_own_observation_comes_first():
    obs = jnp.arange(3)[:, None] * 10 + jnp.arange(2)[None, :]
    assert recurrent.own_first(obs).tolist() == [
        [0, 1, 10, 11, 20, 21], [10, 11, 0, 1, 20, 21], [20, 21, 0, 1, 10, 11]]


def test_positions_alone_are_scaled():
    scale = TINY.obs_scale()
    np.testing.assert_allclose(scale[:6], [1 / 3, 1 / 4] * 3)
    assert (scale[6:] == 1).all()
    assert scale.shape == (TINY.obs_size,) == (10,)


def test_a_policy_file_gives_back_what_was_saved(tmp_path):
    params = jax.device_get(recurrent.init(TINY, jax.random.key(0)))
    stored = PolicyFile("recurrent", {"width": 8}, params, {"seed": 3}, "abc")
    save_policy(tmp_path / "p.safetensors", stored)
    found = load_policy(tmp_path / "p.safetensors")
    assert (found.kind, found.config, found.recipe, found.commit) == (
        "recurrent", {"width": 8}, {"seed": 3}, "abc")
    jax.tree.map(np.testing.assert_array_equal, found.params, params)


def test_files_that_are_no_policy(tmp_path):
    from safetensors.numpy import save_file

    with pytest.raises(InputError, match="no such file"):
        load_policy(tmp_path / "none.safetensors")
    (tmp_path / "text").write_text("hello there, this is long enough")
    with pytest.raises(InputError, match="not a policy file"):
        load_policy(tmp_path / "text")
    save_file({"x": np.zeros(2, np.float32)}, tmp_path / "other")
    with pytest.raises(InputError, match="but not a policy"):
        load_policy(tmp_path / "other")
    with pytest.raises(InputError, match="is a folder"):
        load_policy(tmp_path)


def test_a_torn_policy_file(tmp_path):
    path = tmp_path / "p.safetensors"
    save_policy(path, PolicyFile("recurrent", {}, {"a": np.zeros(100, np.float32)}))
    path.write_bytes(path.read_bytes()[:-50])
    with pytest.raises(InputError, match="not a policy file"):
        load_policy(path)


def test_shapes_of_another_network():
    have = {"a": {"kernel": np.zeros((2, 3))}}
    check_shapes("f", have, {"a": {"kernel": np.zeros((2, 3))}})
    with pytest.raises(InputError, match=r"f: parameter a/kernel has shape \[2, 3\].*\[2, 4\]"):
        check_shapes("f", have, {"a": {"kernel": np.zeros((2, 4))}})
    with pytest.raises(InputError, match="b/kernel is missing"):
        check_shapes("f", have, have | {"b": {"kernel": np.zeros(1)}})
    with pytest.raises(InputError, match="a/kernel does not belong"):
        check_shapes("f", have, {"b": {"kernel": np.zeros(1)}})
