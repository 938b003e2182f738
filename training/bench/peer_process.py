"""What each process of `peer` does: build a loop, compile it, run it when asked to."""

from __future__ import annotations

import importlib.util
import os
import sys
import types
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import msgspec

from moonteam.errors import InputError

LOOP = Path("baselines/MAPPO/mappo_rnn_mpe.py")


class Recipe(msgspec.Struct, frozen=True, rename="upper", kw_only=True):
    """The numbers of JaxMARL's config that both loops go by, under its names."""

    env_name: str
    num_envs: int
    num_steps: int
    update_epochs: int
    num_minibatches: int
    fc_dim_size: int
    gru_hidden_dim: int
    lr: float
    anneal_lr: bool
    gamma: float
    gae_lambda: float
    clip_eps: float
    scale_clip_eps: bool
    ent_coef: float
    vf_coef: float
    max_grad_norm: float


@dataclass(frozen=True)
class Load:
    """The work of both sides."""

    checkout: Path
    recipe: Recipe
    updates: int
    """In one run."""
    preset: str = ""
    """Of macro-decisions, which then is our side."""


Built = tuple[Callable[[], Any], dict[str, Any]]
"""A run of `updates` updates, and the side's row of the table so far."""


def serve(pipe: Any, build: Callable[[Load], Built], load: Load) -> None:
    """Answers begin, run and end until the other end of the pipe is closed."""
    from training.bench.measure import peak_bytes, seconds

    with open(os.devnull, "wb") as nowhere:  # jaxmarl prints when it is imported
        os.dup2(nowhere.fileno(), 1)
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # two share an accelerator
    sys.path.insert(0, str(load.checkout))  # the env of the same checkout
    run: Callable[[], Any] | None = None
    try:
        while True:
            word = pipe.recv()
            if word == "begin":
                run, row = build(load)
                seconds(run)
                pipe.send(("row", row))
            elif word == "run" and run is not None:
                pipe.send(("seconds", seconds(run)))
            else:
                pipe.send(("peak", peak_bytes()))
    except EOFError:
        return
    except InputError as error:
        pipe.send(("problem", (error.source, error.problem, error.key)))


def ours(load: Load) -> Built:
    """Our learner on JaxMARL's env, spread over all devices."""
    import jax

    from moonteam.compilation import enable_cache
    from moonteam.policies.recurrent import Recurrent, kernel_count
    from training import sharding
    from training.bench import measure
    from training.bench.jaxmarl_task import JaxmarlTask
    from training.mappo import update
    from training.mappo.hyper import Hyper
    from training.mappo.networks import Networks

    enable_cache()
    sharding.use_all_cores()
    recipe, task = load.recipe, JaxmarlTask(load.recipe.env_name)
    width, agents = recipe.gru_hidden_dim, task.num_agents
    nets = Networks(Recurrent(task.num_actions, width), Recurrent(1, width, head_gain=1.0),
                    (1.0,) * task.obs_size, agents, shared_value=True)
    hyper = Hyper(load.updates, recipe.num_minibatches, recipe.lr, recipe.ent_coef,
                  recipe.num_steps, recipe.update_epochs, recipe.gamma, recipe.gae_lambda,
                  recipe.clip_eps / (agents if recipe.scale_clip_eps else 1), recipe.vf_coef,
                  recipe.max_grad_norm, adam_eps=1e-5, timeout_is_terminal=True)
    mesh = sharding.mesh_for([recipe.num_envs // recipe.num_minibatches])
    learner = update.shared(
        mesh, update.begin(nets, task, hyper, recipe.num_envs, jax.random.key(0)))
    program, compile_s, bytes_ = measure.compiled(
        lambda held: update.several(nets, task, hyper, held, load.updates), learner,
        learner.carry.reset_before)
    kernels = {name: kernel_count(tree) for name, tree in learner.params._asdict().items()}
    row = {"device": sharding.describe_device(), "compile_s": compile_s, "compiled_bytes": bytes_,
           "begin_s": 0.0, "kernel_parameters": kernels, "num_agents": agents,
           "obs_size": task.obs_size, "num_actions": task.num_actions,
           "networks_per_env_step": {"actor": agents, "critic": 1}, "notes": []}
    return lambda: program(learner), row


def macro(load: Load) -> Built:
    """Our learner on macro-decisions, by the critic, spread over all devices."""
    from training import sharding
    from training.bench import macro as bench

    chosen = bench.config(load.preset, "critic")
    once, first = bench.build(chosen)
    row = {"device": sharding.describe_device(), "compile_s": first, "compiled_bytes": 0,
           "begin_s": 0.0, "steps": chosen.decisions, "flops": bench.flops(chosen), "notes": [
               f"{chosen.families[0].name}; {chosen.num_envs} environments x "
               f"{chosen.hyper.num_steps} decisions, {chosen.hyper.epochs} epochs, "
               f"{chosen.hyper.minibatches} minibatches; pointer network, {chosen.spec}; compiled "
               "in: with the first update"]}
    return lambda: [once() for _ in range(load.updates)], row


def theirs(load: Load) -> Built:
    """The checkout's loop on one device, which on a CPU has all cores to work with."""
    os.environ["JAX_NUM_CPU_DEVICES"] = "1"
    import jax
    import jax.experimental

    from moonteam.compilation import enable_cache
    from moonteam.report.provenance import git
    from training import sharding
    from training.bench import measure

    enable_cache()
    module, notes = _loaded(load.checkout)
    found = git(load.checkout, "rev-parse", "--short=12", "HEAD")
    notes.append(f"commit {found or 'unknown'}")
    key = jax.random.PRNGKey(0)
    try:
        # What it logs is sent to the host after every update; here nobody looks at it.
        with mock.patch.object(jax.experimental, "io_callback", return_value=None):
            begin, _, _ = measure.compiled(_train(module, load, 0), key)
            program, compile_s, bytes_ = measure.compiled(_train(module, load, load.updates), key)
            learned = jax.eval_shape(_train(module, load, load.updates), key)
    except (TypeError, ValueError, AttributeError, KeyError) as error:
        problem = f"does not run with JAX {jax.__version__}: {type(error).__name__}: {error}"
        raise InputError(load.checkout / LOOP, problem) from error
    measure.seconds(lambda: begin(key))
    row = {"device": sharding.describe_device(), "compile_s": compile_s, "compiled_bytes": bytes_,
           "begin_s": min(measure.seconds(lambda: begin(key)) for _ in range(3)),
           "notes": notes, "commit": found, **_counts(learned, load)}
    return lambda: program(key), row


def _train(module: Any, load: Load, updates: int) -> Callable[[Any], Any]:
    """Their function of a key that trains for so many updates."""
    recipe = load.recipe
    return module.make_train(msgspec.to_builtins(recipe) | {
        "ENV_KWARGS": {}, "TOTAL_TIMESTEPS": updates * recipe.num_steps * recipe.num_envs})


def _counts(learned: Any, load: Load) -> dict[str, Any]:
    """Kernel parameters of their actor and critic; both run once for each agent."""
    import jax
    from flax.training.train_state import TrainState

    from moonteam.policies.recurrent import kernel_count
    from training.bench.jaxmarl_task import JaxmarlTask

    states = [leaf for leaf in jax.tree.leaves(learned, is_leaf=_is_state) if _is_state(leaf)]
    assert all(isinstance(state, TrainState) for state in states)
    agents = JaxmarlTask(load.recipe.env_name).num_agents
    return {"kernel_parameters": {name: kernel_count(state.params) for name, state in
                                  zip(("actor", "critic"), states, strict=True)},
            "networks_per_env_step": {"actor": agents, "critic": agents}}


def _is_state(leaf: Any) -> bool:
    from flax.training.train_state import TrainState

    return isinstance(leaf, TrainState)


def _loaded(checkout: Path) -> tuple[Any, list[str]]:
    """Their module, and what was stood in for. Raises InputError if it cannot be imported."""
    notes = ["logging to the host left out"]
    for name in ("hydra", "omegaconf", "wandb"):  # read options and log; not called here
        if importlib.util.find_spec(name) is None:
            sys.modules[name] = _Decoration(name)
    if importlib.util.find_spec("distrax") is None:
        standing = types.ModuleType("distrax")
        standing.__dict__["Categorical"] = Categorical
        sys.modules["distrax"] = standing
        notes.append("distrax is not installed: its Categorical was stood in for by one of the "
                     "same formulas")
    else:
        notes.append("with the installed distrax")
    spec = importlib.util.spec_from_file_location("jaxmarl_mappo_rnn_mpe", checkout / LOOP)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise InputError(checkout / LOOP, f"cannot be imported: {error}; pip install jaxmarl six "
                         "brings what it needs") from error
    return module, notes


class _Decoration(types.ModuleType):
    """A module whose every name is a decorator factory that changes nothing."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return lambda *_, **__: lambda function: function


class Categorical:
    """The three things that their loop asks of a distribution over actions."""

    def __init__(self, logits: Any):
        import jax

        self.log_probs = jax.nn.log_softmax(logits)

    def sample(self, seed: Any) -> Any:
        """Actions [...]."""
        import jax

        return jax.random.categorical(seed, self.log_probs)

    def log_prob(self, value: Any) -> Any:
        """Of the actions `value` [...]."""
        import jax

        chosen = jax.nn.one_hot(value, self.log_probs.shape[-1], dtype=self.log_probs.dtype)
        return (self.log_probs * chosen).sum(axis=-1)

    def entropy(self) -> Any:
        """-sum p log p, [...]."""
        import jax.numpy as jnp

        return -(jnp.exp(self.log_probs) * self.log_probs).sum(axis=-1)
