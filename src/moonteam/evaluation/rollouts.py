"""A policy on a whole set of scenarios: batches of episodes under one jit.

Episodes are independent of how they are batched: each scenario and try has its own key.
Legend: S scenarios, K tries of each, E episodes of a chunk, N agents, M targets.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array

from moonteam.evaluation import world as worlds
from moonteam.evaluation.actors import Actor, Given, Loaded
from moonteam.evaluation.decode import Decode
from moonteam.evaluation.progress import say, track
from moonteam.evaluation.world import Walk, World
from moonteam.grid.config import EnvConfig
from moonteam.grid.travel import problem_fields
from moonteam.grid.types import Problem
from moonteam.planners.base import Objective

MOST_EPISODES = 2048
_PAIRS = 1 << 18  # token pairs of a chunk, which is what the attention of a network holds


@dataclass(frozen=True)
class Tries:
    """What every try did: [S, K]."""

    success: npt.NDArray[np.bool_]
    steps: npt.NDArray[np.int64]  # T_max where it failed
    moves: npt.NDArray[np.int64]
    seconds: float  # without compiling
    compiling: float


@partial(jax.jit, static_argnames=("config", "actor", "length", "sample"))
def _play(config: EnvConfig, actor: Actor, params: Any, given: Given, walk: Walk, keys: Array,
          temperature: Array, length: int, sample: bool) -> Walk:
    """Episodes [E] from their start to their end."""
    def step(carry: tuple[Walk, Any], t: Array) -> tuple[tuple[Walk, Any], None]:
        walk, memory = carry
        memory, logits = actor.logits(params, memory, walk.state, given)
        if sample:
            now = jax.vmap(lambda k: jax.random.fold_in(k, t))(keys)
            action = jax.vmap(jax.random.categorical)(now, logits / temperature)
        else:
            action = jnp.argmax(logits, axis=-1)
        return (worlds.advance(config, walk, given.horizon, action), memory), None

    memory = actor.begin(keys.shape[0])
    return jax.lax.scan(step, (walk, memory), jnp.arange(length))[0][0]


@jax.jit
def _fields(problems: Problem) -> Array | None:
    """[S, K, M, H, W] travel fields; None on open maps."""
    return jax.vmap(problem_fields)(problems) if problems.passable is not None else None


@partial(jax.jit, static_argnames="tries")
def _keys(seed: Array, count: Array, tries: int) -> Array:
    """[S * K] one key for each try of each scenario, tries of a scenario together."""
    scenario = jax.vmap(lambda i: jax.random.fold_in(seed, i))(count)
    both = jax.vmap(lambda k: jax.vmap(lambda j: jax.random.fold_in(k, j))(jnp.arange(tries)))
    return both(scenario).reshape(-1)


def run(policy: Loaded, world: World, decode: Decode, preference: float, temperature: float,
        seed: int, title: str) -> Tries:
    """Plays every scenario `decode.rollouts` times.

    Raises InputError if the policy was made for scenarios of another size.
    """
    policy.actor.check(world, policy.path)
    problems = world.start.state.problem
    # Replacing targets makes the fields of the start worthless: the actor computes its own.
    fields = _fields(problems) if world.num_buffer == 0 else None
    given = Given(world.horizon, jnp.full(len(world), preference), fields)
    keys = _keys(jax.random.key(seed), jnp.arange(len(world)), decode.rollouts)
    size = _chunk_size(world, decode)
    scenario = np.repeat(np.arange(len(world)), decode.rollouts)
    began = time.perf_counter()
    say(f"compiling {title}")
    first = _pick(given, world.start, keys, scenario[_chunk(0, size, len(scenario))],
                  _chunk(0, size, len(scenario)))
    static = {"length": world.longest, "sample": decode.sample}
    heat = jnp.float32(temperature)
    play = _play.lower(world.config, policy.actor, policy.params, *first, heat,
                       **static).compile()
    compiling = time.perf_counter() - began
    began = time.perf_counter()
    parts = []
    starts = range(0, len(scenario), size)
    for start in track(starts, title, len(starts)):
        index = _chunk(start, size, len(scenario))
        walk = play(policy.params, *_pick(given, world.start, keys, scenario[index], index), heat)
        parts.append([np.asarray(leaf) for leaf in (walk.done, walk.state.step, walk.moves)])
    done, steps, moves = (np.concatenate(p)[:len(scenario)].reshape(len(world), -1)
                          for p in zip(*parts, strict=True))
    seconds = time.perf_counter() - began
    horizon = np.asarray(world.horizon, np.int64)[:, None]
    return Tries(done, np.where(done, steps, horizon), moves.astype(np.int64), seconds, compiling)


def _chunk_size(world: World, decode: Decode) -> int:
    tokens = world.start.state.cells.shape[1] + world.start.state.solved.shape[1]
    return max(1, min(MOST_EPISODES, _PAIRS // tokens**2, len(world) * decode.rollouts))


def _chunk(start: int, size: int, total: int) -> npt.NDArray[np.int64]:
    """Episodes of a chunk; the last one is filled up with repeats, so that all are alike."""
    return np.minimum(np.arange(start, start + size), total - 1)


def _pick(given: Given, walk: Walk, keys: Array, scenario: npt.NDArray[np.int64],
          episode: npt.NDArray[np.int64]) -> tuple[Given, Walk, Array]:
    """The inputs of the episodes of a chunk."""
    given, walk = jax.tree.map(lambda x: x[scenario], (given, walk))
    return given, walk, keys[episode]


def best(tries: Tries, objective: Objective, alpha: float, beta: float) -> npt.NDArray[np.int64]:
    """[S] the try that counts: a solved one if there is one, then the best by the objective."""
    steps, moves = tries.steps.astype(np.float64), tries.moves.astype(np.float64)
    tie = 1.0 / (1.0 + moves.max() + steps.max())
    cost = {"makespan": steps + tie * moves, "moves": moves + tie * steps,
            "weighted": alpha * steps + beta * moves}[objective]
    return np.argmin(np.where(tries.success, cost, cost + cost.max() + 1.0), axis=1)


def picked(values: npt.NDArray, choice: npt.NDArray[np.int64]) -> npt.NDArray:
    """[S] of [S, K], the chosen try of each scenario."""
    return np.take_along_axis(values, choice[:, None], axis=1)[:, 0]

