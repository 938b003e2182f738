"""A policy on a whole set of scenarios: batches of episodes under one jit.

Episodes are independent of how they are batched: each scenario and try has its own key.
Legend: S scenarios, K tries of each, E episodes of a chunk, N agents, T steps.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array

from moonteam.evaluation import world as worlds
from moonteam.evaluation.decode import Decode
from moonteam.evaluation.progress import say, track
from moonteam.evaluation.world import Walk, World
from moonteam.grid.config import EnvConfig
from moonteam.grid.types import State
from moonteam.planners.base import Objective
from moonteam.planners.learned import Brain, Policy, masked

MOST_EPISODES = 2048
_PAIRS = 1 << 18  # token pairs of a chunk, which is what the attention of a network holds


@dataclass(frozen=True)
class Tries:
    """What every try did: [S, K]."""

    success: npt.NDArray[np.bool_]
    steps: npt.NDArray[np.int64]  # T_max where it failed
    moves: npt.NDArray[np.int64]
    rescues: npt.NDArray[np.int64]  # decisions that the deadlock watch had drawn
    seconds: float  # without compiling
    compiling: float


class Given(NamedTuple):
    """What differs between episodes besides their state."""

    horizon: Array  # [E] steps
    preference: Array  # [E] 0 time .. 1 effort
    keys: Array  # [E]


class Watch(NamedTuple):
    """The deadlock watch's memory of where the team has been."""

    history: Array  # [T, E, N] int32, cells as one number
    progress: Array  # [E] int32, targets solved so far
    since: Array  # [E] int32, step at which the last one was solved
    rescues: Array  # [E] int32


class _Carry(NamedTuple):
    walk: Walk
    memory: Any
    watch: Watch


@partial(jax.jit, static_argnames=("config", "brain", "length", "decode"))
def _play(config: EnvConfig, brain: Brain, params: Any, given: Given, walk: Walk, heat: Array,
          length: int, decode: Decode) -> tuple[Walk, Array]:
    """Episodes [E] from their start to their end, and the rescues of each [E]."""
    episodes, agents = walk.state.cells.shape[:2]

    def think(memory: Any, state: State, horizon: Array, preference: Array) -> tuple[Any, Array]:
        memory, logits = brain.logits(params, memory, state, horizon, preference)
        return memory, masked(logits, state)

    def step(carry: _Carry, t: Array) -> tuple[_Carry, None]:
        walk, watch = carry.walk, carry.watch
        memory, logits = jax.vmap(think)(carry.memory, walk.state, given.horizon,
                                         given.preference)
        keys = jax.vmap(lambda k: jax.random.fold_in(k, t))(given.keys)
        if decode.sample:
            action = jax.vmap(jax.random.categorical)(keys, logits / heat)
        else:
            action = jnp.argmax(logits, axis=-1)
        if decode.watch:
            watch, returns = _look_back(watch, walk, t)
            warmth = jnp.maximum(returns, 1).astype(jnp.float32)
            drawn = jax.vmap(jax.random.categorical)(keys, logits / warmth[:, None, None])
            stuck = (returns > 0) & ~walk.done & (walk.state.step < given.horizon)
            action = jnp.where(stuck[:, None], drawn, action)
            watch = watch._replace(rescues=watch.rescues + stuck)
        return _Carry(worlds.advance(config, walk, given.horizon, action), memory, watch), None

    empty = brain.begin(agents)
    memory = jax.tree.map(lambda x: jnp.broadcast_to(x[None], (episodes, *x.shape)), empty)
    none = jnp.zeros(episodes, jnp.int32)
    before = jnp.zeros((length if decode.watch else 0, episodes, agents), jnp.int32)
    carry = _Carry(walk, memory, Watch(before, _progress(walk), none, none))
    carry, _ = jax.lax.scan(step, carry, jnp.arange(length))
    return carry.walk, carry.watch.rescues


def _progress(walk: Walk) -> Array:
    """[E] targets solved, replaced ones included."""
    solved = jnp.sum(walk.state.solved, axis=1, dtype=jnp.int32)
    buffer = walk.state.problem.buffer
    return solved if buffer is None else solved + buffer.used


def _look_back(watch: Watch, walk: Walk, t: Array) -> tuple[Watch, Array]:
    """Remembers step t; returns [E] how often its cells were met since a target was solved."""
    cells = walk.state.cells
    here = cells[..., 0] + 4096 * cells[..., 1]  # [E, N]
    progress = _progress(walk)
    since = jnp.where(progress > watch.progress, t, watch.since)
    same = jnp.all(watch.history == here[None], axis=2)  # [T, E]
    steps = jnp.arange(watch.history.shape[0])[:, None]
    returns = jnp.sum(same & (steps >= since[None]) & (steps < t), axis=0, dtype=jnp.int32)
    return Watch(watch.history.at[t].set(here), progress, since, watch.rescues), returns


@partial(jax.jit, static_argnames="tries")
def _keys(seed: Array, scenarios: Array, tries: int) -> Array:
    """[S * K] one key for each try of each scenario, tries of a scenario together."""
    each = jax.vmap(lambda i: jax.random.fold_in(seed, i))(scenarios)
    both = jax.vmap(lambda k: jax.vmap(lambda j: jax.random.fold_in(k, j))(jnp.arange(tries)))
    return both(each).reshape(-1)


def run(policy: Policy, world: World, decode: Decode, preference: float, temperature: float,
        seed: int, title: str) -> Tries:
    """Plays every scenario `decode.rollouts` times.

    Raises InputError if the policy was made for scenarios of another size.
    """
    size = _chunk_size(world, decode)
    keys = _keys(jax.random.key(seed), jnp.arange(len(world)), decode.rollouts)
    scenario = np.repeat(np.arange(len(world)), decode.rollouts)
    total = len(scenario)

    def inputs(start: int) -> tuple[Given, Walk, Array]:
        """The episodes of a chunk; the last is filled up, so that all have one shape."""
        index = np.minimum(np.arange(start, start + size), total - 1)
        horizon, walk = jax.tree.map(lambda x: x[scenario[index]], (world.horizon, world.start))
        liking = jnp.full(size, preference, jnp.float32)
        return Given(horizon, liking, keys[index]), walk, jnp.float32(temperature)

    began = time.perf_counter()
    say(f"compiling {title}")
    play = _play.lower(world.config, policy.brain, policy.params, *inputs(0),
                       length=world.longest, decode=decode).compile()
    compiling = time.perf_counter() - began
    began = time.perf_counter()
    parts = []
    starts = range(0, total, size)
    for start in track(starts, title, len(starts)):
        walk, rescues = play(policy.params, *inputs(start))
        parts.append([np.asarray(x) for x in (walk.done, walk.state.step, walk.moves, rescues)])
    done, steps, moves, rescues = (np.concatenate(p)[:total].reshape(len(world), -1)
                                   for p in zip(*parts, strict=True))
    seconds = time.perf_counter() - began
    horizon = np.asarray(world.horizon, np.int64)[:, None]
    return Tries(done, np.where(done, steps, horizon), moves.astype(np.int64),
                 rescues.astype(np.int64), seconds, compiling)


def _chunk_size(world: World, decode: Decode) -> int:
    tokens = world.start.state.cells.shape[1] + world.start.state.solved.shape[1]
    return max(1, min(MOST_EPISODES, _PAIRS // tokens**2, len(world) * decode.rollouts))


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

