import json
from importlib.util import find_spec

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from moonteam.cli import main
from moonteam.errors import InputError
from moonteam.grid.macro.draw import Draw
from moonteam.policies.pointer import PointerSpec
from moonteam.policies.recurrent import Recurrent
from training.bench import macro, measure, ours, peer
from training.bench.jaxmarl_task import JaxmarlTask
from training.mappo import rollout
from training.mappo.macro.config import PRESETS, MacroConfig, Practice
from training.mappo.macro.hyper import Hyper, Vine
from training.mappo.networks import Networks

SPREAD = "MPE_simple_spread_v3"
SMALL = MacroConfig(
    "quick", (Practice("small", Draw(agents=(2, 2), targets=(2, 2), sides=(6, 6), limit=60.0)),),
    rounds=1, num_envs=8, hyper=Hyper(num_steps=4, learned=0.5, minibatches=2),
    vine=Vine(episodes=8, num_steps=4, moments=16, minibatches=2),
    spec=PointerSpec(width=16, heads=2, layers=1, pairs=8))
NUMBERS = """
"ENV_NAME": "MPE_simple_spread_v3"
"LR": 2e-3
"NUM_ENVS": 16
"NUM_STEPS": 4
"FC_DIM_SIZE": 8
"GRU_HIDDEN_DIM": 8
"UPDATE_EPOCHS": 2
"NUM_MINIBATCHES": 2
"GAMMA": 0.99
"GAE_LAMBDA": 0.95
"CLIP_EPS": 0.2
"SCALE_CLIP_EPS": False
"ENT_COEF": 0.01
"VF_COEF": 0.5
"MAX_GRAD_NORM": 0.5
"ANNEAL_LR": True
"ACTIVATION": "tanh"
"""
LOOP = """
import distrax
import hydra
import jax
import jax.numpy as jnp
import optax
import wandb
from flax.training.train_state import TrainState
from omegaconf import OmegaConf


def make_train(config):
    count = config["TOTAL_TIMESTEPS"] // config["NUM_STEPS"] // config["NUM_ENVS"]

    def refuse(loss):
        raise AssertionError("logged")

    def train(key):
        def begin(size):
            return TrainState.create(apply_fn=None, params={"kernel": jnp.ones((size, 10))},
                                     tx=optax.sgd(config["LR"]))

        def step(key, _):
            chosen = distrax.Categorical(logits=jnp.zeros((4, 5)))
            loss = chosen.log_prob(chosen.sample(seed=key)).sum() + chosen.entropy().sum()
            jax.experimental.io_callback(refuse, None, loss)
            return jax.random.split(key)[0], loss

        return {"runner_state": ((begin(3), begin(7)), jax.lax.scan(step, key, None, count))}

    return train


@hydra.main(version_base=None)
def run(config):
    wandb.init(config=OmegaConf.to_container(config))
"""


@pytest.fixture
def checkout(tmp_path):
    loop, config = tmp_path / peer.LOOP, tmp_path / peer.CONFIG
    config.parent.mkdir(parents=True)
    loop.write_text(LOOP)
    config.write_text(NUMBERS)
    return tmp_path


@pytest.fixture
def task():
    pytest.importorskip("jaxmarl")
    with jax.numpy_rank_promotion("allow"):  # jaxmarl's envs rely on it
        yield JaxmarlTask(SPREAD)


def test_our_own_rows():
    args = measure.Wanted(num_envs=8, num_minibatches=2, repeats=1)
    found = ours.measure(args, "moonteam bench train")
    for part in ("collection", "update", "total"):
        row = found[part]
        assert row["env_steps_per_s"] * row["seconds"] == pytest.approx(8 * 24)
    assert found["total"]["seconds"] >= found["collection"]["seconds"]
    assert 0.0 < found["share_of_peak"] < 1.0
    assert found["meta"]["command"] == "moonteam bench train"
    titles, rows = ours.table(found)
    assert all(len(row) == len(titles) for row in rows)


def test_a_jaxmarl_env_stepped_by_hand(task):
    """Agents in the env's order; an end by time is a truncation, at the step the env says."""
    env, count, key = task.env, 3, jax.random.key(5)
    assert (task.num_agents, task.num_actions, task.obs_size) == (3, 5, 18)
    state = task.reset(key, count)
    step = jax.jit(task.step)
    for t in range(task.max_steps + 1):
        key = jax.random.fold_in(key, t)
        action = jax.random.randint(key, (count, 3), 0, 5)
        out = step(key, state, action)
        if t in (0, 7, task.max_steps):
            e = t % count
            world = jax.tree.map(lambda x: x[e], state.world)  # noqa: B023
            named = dict(zip(env.agents, action[e], strict=True))
            obs, _, reward, done, _ = env.step_env(jax.random.split(key, count)[e], world, named)
            np.testing.assert_allclose(task.observe(out.state)[e],
                                       jnp.stack([obs[a] for a in env.agents]), rtol=1e-6)
            np.testing.assert_allclose(out.reward[e], [float(reward[a]) for a in env.agents],
                                       rtol=1e-5)
            assert bool(done["__all__"]) == bool(out.truncated[e]) == (t == task.max_steps)
        assert not out.terminated.any()
        state = out.state


def test_ended_episodes_of_a_jaxmarl_env_begin_anew(task):
    nets = Networks(Recurrent(5, 4), Recurrent(1, 4), (1.0,) * 18, 3, shared_value=True)
    carry = rollout.begin(nets, task, jax.random.key(0), 2)
    length = task.max_steps + 1
    _, batch = jax.jit(lambda carry: rollout.collect(
        nets, task, nets.init(jax.random.key(1)), carry, jax.random.key(2), length + 2))(carry)
    steps = batch.steps
    assert np.flatnonzero(steps.reset_before.all(axis=1)).tolist() == [0, length]
    at_rest = np.asarray(steps.obs[:, :, :, :2] == 0).all(axis=(1, 2, 3))  # velocities
    assert np.flatnonzero(at_rest).tolist() == [0, length]


def test_a_shared_value_is_that_of_the_critic_on_observations_in_order():
    own = Networks(Recurrent(5, 4), Recurrent(1, 4), (1.0, 0.5), 3)
    shared = Networks(own.actor, own.critic, own.scale, 3, shared_value=True)
    params = jax.jit(own.init)(jax.random.key(0)).critic
    obs = jax.random.normal(jax.random.key(1), (5, 2, 3, 2))
    reset = jnp.zeros((5, 2), bool).at[3].set(True)
    _, each = jax.jit(own.values)(params, own.empty(2).critic, obs, reset)
    memory, once = jax.jit(shared.values)(params, shared.empty(2).critic, obs, reset)
    assert memory.shape == (2, 1, 4)
    np.testing.assert_allclose(once, jnp.broadcast_to(each[..., :1], once.shape), rtol=1e-5)


@pytest.mark.skipif(find_spec("jaxmarl") is None, reason="importing it here would end capsys")
def test_both_sides_in_turns(checkout, tmp_path, capsys):
    words = ["bench", "train", "--jaxmarl", str(checkout), "--num-envs", "4", "--updates", "1",
             "--repeats", "2", "--json", "--out", str(tmp_path / "out")]
    assert main(words) == 0
    found = json.loads(capsys.readouterr().out)
    assert found == json.loads((tmp_path / "out" / "bench_train.json").read_text())
    ours, theirs = found["rows"]
    assert theirs["kernel_parameters"] == {"actor": 30, "critic": 70}
    assert theirs["flops_per_env_step"] == 2 * 7 * 3 * 100
    assert ours["flops_per_env_step"] == 2 * 7 * sum(
        ours["kernel_parameters"][name] * times for name, times in (("actor", 3), ("critic", 1)))
    assert len(ours["seconds_of_each"]) == len(theirs["seconds_of_each"]) == 2
    assert found["ratio"] == pytest.approx(ours["env_steps_per_s"] / theirs["env_steps_per_s"])
    assert (found["shape"]["NUM_ENVS"], found["shape"]["LR"]) == (4, 0.002)


def test_a_checkout_without_the_loop(tmp_path, capsys):
    assert main(["bench", "train", "--jaxmarl", str(tmp_path)]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "not a checkout of JaxMARL: baselines/MAPPO/mappo_rnn_mpe.py is missing" in err


@pytest.mark.parametrize(("more", "problem"), [
    (["--num-envs", "5"], "5 environments do not divide into 2 minibatches"),
    (["--preset", "pi_5t"], "has no meaning beside JaxMARL"),
    (["--updates", "0"], "0 is not allowed"),
])
def test_what_cannot_be_compared(checkout, capsys, more, problem):
    words = more[1:] if more[0] == "--preset" else more
    assert main(["bench", "train", *words, "--jaxmarl", str(checkout)]) == 2
    assert problem in capsys.readouterr().err


def test_a_config_that_does_not_fit(checkout):
    path = checkout / peer.CONFIG
    path.write_text(NUMBERS.replace('"FC_DIM_SIZE": 8', '"FC_DIM_SIZE": 9'))
    with pytest.raises(InputError, match="layers of one width"):
        peer.recipe(checkout, None, None)
    path.write_text(NUMBERS.replace('"GAMMA": 0.99', '"GAMMA": high'))
    with pytest.raises(InputError, match="float"):
        peer.recipe(checkout, None, None)


def test_products_are_counted_by_hand():
    """A matrix product of 2 x 3 and 3 x 5, five times in a scan, and one batched of 4."""
    def work(a, b):
        looped, _ = jax.lax.scan(lambda x, _: (x + (a @ b).sum(), None), 0.0, None, 5)
        return looped, jnp.einsum("kij,kjl->kil", jnp.ones((4, 2, 3)), jnp.ones((4, 3, 5)))

    assert macro.products(jax.jit(work), jnp.ones((2, 3)), jnp.ones((3, 5))) == (5 + 4) * 2 * 30


def test_macro_decisions_on_the_bench(monkeypatch):
    monkeypatch.setitem(PRESETS, "quick", SMALL)
    found = macro.measure(measure.Wanted("quick", repeats=1), "moonteam bench train quick")
    vine, critic = found["rows"]
    assert vine["decisions"] == SMALL.vine.moments
    assert vine["branches_per_s"] * vine["seconds"] >= vine["decisions"]
    assert critic["decisions"] == SMALL.num_envs * SMALL.hyper.num_steps
    assert critic["decisions_per_s"] * critic["seconds"] == pytest.approx(critic["decisions"])
    titles, rows = macro.table(found)
    assert all(len(row) == len(titles) for row in rows)
    with pytest.raises(InputError, match="has no meaning for quick"):
        macro.measure(measure.Wanted("quick", num_envs=4), "")


@pytest.mark.soak
@pytest.mark.skipif(find_spec("jaxmarl") is None, reason="importing it here would end capsys")
def test_macro_decisions_beside_the_loop(checkout, capsys):
    """The process of our side has the presets as they ship, so this compiles quick."""
    words = ["bench", "train", "quick", "--jaxmarl", str(checkout), "--num-envs", "4", "--updates",
             "1", "--repeats", "1", "--json"]
    assert main(words) == 0
    found = json.loads(capsys.readouterr().out)
    ours, theirs = found["rows"]
    assert ours["flops_per_env_step"] > theirs["flops_per_env_step"]
    assert found["ratio"] == pytest.approx(ours["achieved_gflops"] / theirs["achieved_gflops"])
