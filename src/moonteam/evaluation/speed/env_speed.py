"""Environment steps per second, ours beside JaxMARL's, in one run.

Both step the same number of environments and agents with the same random actions for the same
number of steps, in one jitted scan, with their own renewal of ended episodes. Observations and
rewards of every step are summed up, so that neither can be left out by the compiler. Runs are
interleaved, so that what else the machine does falls on both.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from moonteam.grid import env
from moonteam.grid.rewards import preset_config
from moonteam.report.progress import track

PEER = "MPE_simple_spread_v3"
NUM_ACTIONS = 5


@dataclass(frozen=True)
class Load:
    """The same work for both."""

    num_envs: int = 1024
    num_agents: int = 3
    num_steps: int = 128
    repeats: int = 10
    seed: int = 0

    @property
    def env_steps(self) -> int:
        """Environment steps of one run."""
        return self.num_envs * self.num_steps


def _actions(load: Load, key: Array) -> Array:
    """[E, N] uniform."""
    return jax.random.randint(key, (load.num_envs, load.num_agents), 0, NUM_ACTIONS)


def ours(load: Load, num_targets: int) -> tuple[Callable, Any]:
    """A jitted run of the grid env and its start."""
    config = replace(preset_config("pi_5t"), num_agents=load.num_agents, num_targets=num_targets)

    def step(carry: tuple[Any, Array], key: Array) -> tuple[tuple[Any, Array], None]:
        states, total = carry
        act_key, new_key = jax.random.split(key)
        out = jax.vmap(lambda s, a: env.step(config, s, a))(states, _actions(load, act_key))
        states = env.renew(config, new_key, out.state, out.terminated | out.truncated)
        return (states, total + jnp.sum(out.observation) + jnp.sum(out.reward)), None

    @jax.jit
    def run(states: Any, key: Array) -> tuple[Any, Array]:
        keys = jax.random.split(key, load.num_steps)
        return jax.lax.scan(step, (states, jnp.zeros(())), keys)[0]

    keys = jax.random.split(jax.random.key(load.seed), load.num_envs)
    return run, jax.jit(jax.vmap(lambda k: env.reset(config, k)[0]))(keys)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Nothing reaches standard output: jaxmarl prints when it is imported, and what it imports
    puts the process's own standard output back, so the descriptor itself is turned away.
    """
    sys.stdout.flush()
    stream, kept = sys.stdout, os.dup(1)
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        try:
            yield
        finally:
            sys.stdout.flush()
            sys.stdout = stream
            os.dup2(kept, 1)
            os.close(kept)


def peer(load: Load) -> tuple[Callable, Any] | None:
    """The same of JaxMARL's env; None where jaxmarl is not installed."""
    try:
        with _quiet():
            from jaxmarl import make
    except ImportError:
        return None
    other: Any = make(PEER, num_agents=load.num_agents, num_landmarks=load.num_agents)

    def step(carry: tuple[Any, Array], key: Array) -> tuple[tuple[Any, Array], None]:
        states, total = carry
        act_key, new_key = jax.random.split(key)
        actions = _actions(load, act_key)
        named = {name: actions[:, i] for i, name in enumerate(other.agents)}
        keys = jax.random.split(new_key, load.num_envs)
        seen, states, rewards, _, _ = jax.vmap(other.step)(keys, states, named)
        sums = [jnp.sum(x) for x in jax.tree.leaves((seen, {a: rewards[a] for a in named}))]
        return (states, total + sum(sums)), None

    @jax.jit
    def run(states: Any, key: Array) -> tuple[Any, Array]:
        keys = jax.random.split(key, load.num_steps)
        return jax.lax.scan(step, (states, jnp.zeros(())), keys)[0]

    keys = jax.random.split(jax.random.PRNGKey(load.seed), load.num_envs)
    return run, jax.jit(jax.vmap(other.reset))(keys)[1]


def measure(load: Load, num_targets: int) -> dict:
    """Steps per second of both, and their ratio run by run."""
    contenders: dict[str, tuple[Callable, Any]] = {"moonteam": ours(load, num_targets)}
    beside = peer(load)
    if beside is not None:
        contenders[PEER] = beside
    key = jax.random.key(load.seed)
    compiling, seconds = {}, {name: [] for name in contenders}
    states: dict[str, Any] = {}
    for name, (run, start) in contenders.items():
        began = time.perf_counter()
        states[name], _ = jax.block_until_ready(run(start, key))
        compiling[name] = time.perf_counter() - began
    for i in track(range(load.repeats), "environments", load.repeats):
        # Who goes first alternates.
        for name in sorted(contenders, reverse=bool(i % 2)):
            began = time.perf_counter()
            states[name], _ = jax.block_until_ready(
                contenders[name][0](states[name], jax.random.fold_in(key, i)))
            seconds[name].append(time.perf_counter() - began)
    rates = {name: load.env_steps / np.array(spent) for name, spent in seconds.items()}
    document: dict = {
        "num_envs": load.num_envs, "num_agents": load.num_agents, "num_steps": load.num_steps,
        "repeats": load.repeats, "num_targets": num_targets,
        "env_steps_per_second": {name: _spread(rate) for name, rate in rates.items()},
        "first_call_seconds": compiling, "jaxmarl": None, "ratio": None}
    if beside is not None:
        document["jaxmarl"] = importlib.metadata.version("jaxmarl")
        document["ratio"] = _spread(rates["moonteam"] / rates[PEER])
    return document


def _spread(values: np.ndarray) -> dict:
    low, median, high = np.percentile(values, [10, 50, 90])
    return {"median": float(median), "p10": float(low), "p90": float(high)}
