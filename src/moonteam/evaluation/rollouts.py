"""A policy on a whole set of scenarios: a pool of episodes under one jit.

The pool has a fixed number of places. It plays some steps at a time; a place whose episode has
ended takes the next one, so that nobody waits for the longest. Of several tries of a scenario,
those that already cost more than a finished one are given up. What an episode does is
independent of the others in the pool: each scenario and try has its own random numbers.
Legend: S scenarios, K tries of each, E places of the pool, N agents, M targets, T steps,
L kinds, F targets shown or still to come.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array

from moonteam import trees
from moonteam.evaluation import world as worlds
from moonteam.evaluation.world import Walk, World
from moonteam.grid.config import EnvConfig
from moonteam.planners import best_of
from moonteam.planners.best_of import cheapest
from moonteam.planners.decode import Decode
from moonteam.planners.learned import masked
from moonteam.planners.search.travel import distance_fields
from moonteam.policies.brain import Brain
from moonteam.policies.policy import Policy
from moonteam.report.progress import say, track

MOST_EPISODES = 256
_PAIRS = 1 << 15  # token pairs of the pool, which is what the attention of a network holds
FASTEST = best_of.prices("makespan")
_STEPS = 8  # between two looks at which episodes have ended

IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Tries:
    """What every try did: [S, K]. One that was given up counts as not solved."""

    success: npt.NDArray[np.bool_]
    steps: IntArray  # T_max where it failed
    moves: IntArray
    rescues: IntArray  # decisions that the deadlock watch had drawn
    seconds: float  # without compiling
    compiling: float


class Given(NamedTuple):
    """What an episode keeps from its start to its end."""

    horizon: Array  # [E] int32 steps; 0 where the place is empty
    scenario: Array  # [E] int32
    attempt: Array  # [E] int32
    spots: Array | None  # [E, F, 2] cells of all targets, where the ground is blocked
    fields: Array | None  # [E, L, F, H, W] steps to each of them


class Watch(NamedTuple):
    """The deadlock watch's memory of where the team has been."""

    history: Array  # [E, T, N] int32, cells as one number
    progress: Array  # [E] int32, targets solved so far
    since: Array  # [E] int32, step at which the last one was solved
    rescues: Array  # [E] int32


class Pool(NamedTuple):
    """The episodes being played."""

    walk: Walk
    memory: Any
    watch: Watch
    given: Given

    @property
    def going(self) -> Array:
        """[E] bool."""
        return ~self.walk.done & (self.walk.state.step < self.given.horizon)


class Source(NamedTuple):
    """Every scenario at its start: [S]."""

    walk: Walk
    horizon: Array
    spots: Array | None
    fields: Array | None


@dataclass(frozen=True)
class Player:
    """What is compiled: a policy with a way of deciding."""

    config: EnvConfig
    brain: Brain
    sample: bool
    watch: bool
    longest: int  # steps of the longest episode

    def fresh(self, source: Source, scenario: Array, attempt: Array) -> Pool:
        """Episodes at their start; a place of attempt -1 stays empty."""
        walk = jax.tree.map(lambda x: x[scenario], source.walk)
        horizon = jnp.where(attempt < 0, 0, source.horizon[scenario])
        spots, fields = jax.tree.map(lambda x: x[scenario], (source.spots, source.fields))
        episodes, agents = walk.state.cells.shape[:2]
        history = jnp.zeros((episodes, self.longest if self.watch else 0, agents), jnp.int32)
        none = jnp.zeros(episodes, jnp.int32)
        return Pool(walk, self.brain.begin(episodes, agents),
                    Watch(history, _progress(walk), none, none),
                    Given(horizon, scenario, attempt, spots, fields))

    def step(self, params: Any, pool: Pool, key: Array, heat: Array, preference: Array) -> Pool:
        """One decision of every episode; those that have ended stand still."""
        walk, given, watch = pool.walk, pool.given, pool.watch
        going, now = pool.going, walk.state.step
        memory, logits = self.brain.logits(
            params, pool.memory, walk.state, _to_slots(given, walk), given.horizon,
            jnp.broadcast_to(preference, now.shape))
        logits = masked(logits, walk.state)
        warmth = jnp.broadcast_to(heat, now.shape)
        stuck = jnp.zeros_like(going)
        if self.watch:
            watch, returns = _look_back(watch, walk)
            stuck = (returns > 0) & going
            watch = watch._replace(rescues=watch.rescues + stuck)
            warmth = warmth * jnp.maximum(returns, 1)
        action = jnp.argmax(logits, axis=-1)
        if self.sample or self.watch:
            keys = jax.vmap(lambda s, k, t: jax.random.fold_in(jax.random.fold_in(
                jax.random.fold_in(key, s), k), t))(given.scenario, given.attempt, now)
            drawn = jax.vmap(jax.random.categorical)(keys, logits / warmth[:, None, None])
            action = drawn if self.sample else jnp.where(stuck[:, None], drawn, action)
        walk = worlds.advance(self.config, walk, given.horizon, action)
        return Pool(walk, memory, watch, given)


@partial(jax.jit, static_argnames="player")
def begin(player: Player, source: Source, scenario: Array, attempt: Array) -> Pool:
    """A pool of fresh episodes [E]."""
    return player.fresh(source, scenario, attempt)


@partial(jax.jit, static_argnames="player")
def _refill(player: Player, source: Source, pool: Pool, taken: Array, scenario: Array,
            attempt: Array) -> Pool:
    """The pool with fresh episodes in the places that are `taken` [E] bool."""
    return trees.where(taken, player.fresh(source, scenario, attempt), pool)


@partial(jax.jit, static_argnames="player")
def play(player: Player, params: Any, pool: Pool, seed: Array, heat: Array,
          preference: Array) -> Pool:
    """Some steps of the pool, fewer if all episodes end."""
    key = jax.random.key(seed)

    def step(carry: tuple[Array, Pool]) -> tuple[Array, Pool]:
        count, pool = carry
        return count + 1, player.step(params, pool, key, heat, preference)

    return jax.lax.while_loop(lambda c: (c[0] < _STEPS) & jnp.any(c[1].going), step,
                              (jnp.zeros((), jnp.int32), pool))[1]


def _progress(walk: Walk) -> Array:
    """[E] targets solved, replaced ones included."""
    solved = jnp.sum(walk.state.solved, axis=1, dtype=jnp.int32)
    buffer = walk.state.problem.buffer
    return solved if buffer is None else solved + buffer.used


def _look_back(watch: Watch, walk: Walk) -> tuple[Watch, Array]:
    """Remembers this step; returns [E] how often its cells were met since a target was solved."""
    cells, now = walk.state.cells, walk.state.step
    here = cells[..., 0] + 4096 * cells[..., 1]  # [E, N]
    progress = _progress(walk)
    since = jnp.where(progress > watch.progress, now, watch.since)
    same = jnp.all(watch.history == here[:, None], axis=2)  # [E, T]
    steps = jnp.arange(watch.history.shape[1])[None]
    met = same & (steps >= since[:, None]) & (steps < now[:, None])
    history = watch.history.at[jnp.arange(len(now)), now].set(here, mode="drop")
    return Watch(history, progress, since, watch.rescues), jnp.sum(met, 1, dtype=jnp.int32)


def _to_slots(given: Given, walk: Walk) -> Array | None:
    """[E, L, M, H, W] travel fields of the targets now in the slots."""
    if given.fields is None or given.spots is None or walk.state.problem.buffer is None:
        return given.fields
    shown = walk.state.problem.target_cells
    same = jnp.all(given.spots[:, None, :, :] == shown[:, :, None, :], axis=3)  # [E, M, F]
    return jax.vmap(lambda fields, which: fields[:, which])(given.fields, jnp.argmax(same, 2))


def survey(world: World) -> tuple[Array | None, Array | None]:
    """Cells [S, F, 2] of all targets and the steps [S, L, F, H, W] to them; None on open maps.

    Searched once for each scenario, the targets that appear later included.
    """
    problem = jax.device_get(world.start.state.problem)
    if problem.passable is None:
        return None, None
    spots = problem.target_cells
    if problem.buffer is not None:
        spots = np.concatenate([spots, problem.buffer.cells], axis=1)
    height, width = problem.passable.shape[2:]
    on_map = ((np.arange(width) < problem.size[:, 0, None])[:, None, :]
              & (np.arange(height) < problem.size[:, 1, None])[:, :, None])  # [S, H, W]
    free = problem.passable & on_map[:, None]
    fields = np.stack([distance_fields(free[i], spots[i]) for i in range(len(free))])
    return jnp.asarray(spots), jnp.asarray(fields)


def source_of(world: World, brain: Brain) -> Source:
    """The scenarios with what the network must know of their ground."""
    return Source(world.start, world.horizon,
                  *(survey(world) if brain.travels else (None, None)))


@dataclass
class _Ledger:
    """Which episodes are in the pool, and what those that ended did; ids are s * K + k."""

    horizon: IntArray  # [S]
    rollouts: int  # K
    price: tuple[float, float]  # of a step and a move, for giving up
    success: npt.NDArray[np.bool_] = field(init=False)  # [S * K], as those below
    steps: IntArray = field(init=False)
    moves: IntArray = field(init=False)
    rescues: IntArray = field(init=False)

    def __post_init__(self) -> None:
        total = len(self.horizon) * self.rollouts
        self.success = np.zeros(total, bool)
        self.steps, self.moves, self.rescues = np.zeros((3, total), np.int64)
        self.best = np.full(len(self.horizon), np.inf)

    def note(self, places: IntArray, pool: Pool) -> npt.NDArray[np.bool_]:
        """Writes down where the pool stands; returns [E] bool, places whose episode is over."""
        walk = pool.walk
        used = places >= 0
        rows = places[used]
        done, steps, moves, rescues = (np.asarray(x)[used] for x in jax.device_get(
            (walk.done, walk.state.step, walk.moves, pool.watch.rescues)))
        self.success[rows], self.rescues[rows] = done, rescues
        self.steps[rows], self.moves[rows] = steps, moves
        scenario = rows // self.rollouts
        cost = self.price[0] * steps + self.price[1] * moves
        np.minimum.at(self.best, scenario[done], cost[done])
        over = np.zeros(len(places), bool)
        over[used] = done | (steps >= self.horizon[scenario]) | (cost > self.best[scenario])
        return over

    def tries(self, seconds: float, compiling: float) -> Tries:
        """Everything, by scenario and try."""
        shape = (len(self.horizon), self.rollouts)
        steps = np.where(self.success, self.steps, np.repeat(self.horizon, self.rollouts))
        return Tries(self.success.reshape(shape), steps.reshape(shape),
                     self.moves.reshape(shape), self.rescues.reshape(shape), seconds, compiling)


def run(policy: Policy, world: World, decode: Decode, preference: float, seed: int, title: str,
        prices: tuple[float, float] = FASTEST, alone: bool = False) -> Tries:
    """Plays every scenario `decode.rollouts` times.

    Args:
      policy: plays; `world` must be of a size that it takes.
      world: the scenarios.
      decode: how actions are read from its probabilities.
      preference: 0 time .. 1 effort.
      seed: of the random numbers.
      title: for the progress bar.
      prices: of a step and a move; a try that costs more than a finished one is given up.
      alone: one scenario after the other, as a single mission would be planned.
    """
    rollouts, count = decode.rollouts, len(world)
    size = rollouts if alone else _places(world, count * rollouts)
    player = Player(world.config, policy.brain, decode.sample, decode.watch, world.longest)
    began = time.perf_counter()
    source = source_of(world, policy.brain)
    seconds = time.perf_counter() - began
    say(f"compiling {title}")
    began = time.perf_counter()
    blank = jnp.zeros(size, jnp.int32)
    given = (np.uint32(seed % 2**32), np.float32(decode.temperature), np.float32(preference))
    pool = begin(player, source, blank, blank - 1)
    playing = play.lower(player, policy.params, pool, *given).compile()
    filling = _refill.lower(player, source, pool, blank > 0, blank, blank).compile()
    compiling = time.perf_counter() - began

    def refill(pool: Pool, taken: Any, ids: IntArray) -> Pool:
        scenario, attempt = (np.where(ids < 0, fill, part).astype(np.int32) for part, fill in (
            (ids // rollouts, 0), (ids % rollouts, -1)))
        return filling(source, pool, taken, scenario, attempt)

    began = time.perf_counter()
    ledger = _Ledger(np.asarray(world.horizon, np.int64), rollouts, prices)
    sets = np.arange(count * rollouts).reshape(-1, rollouts) if alone else [
        np.arange(count * rollouts)]
    drain = partial(_drain, ledger, pool, refill,
                    lambda pool: playing(policy.params, pool, *given))
    for _ in track((one for ids in sets for one in drain(ids)), title, count * rollouts):
        pass
    return ledger.tries(seconds + time.perf_counter() - began, compiling)


def _drain(ledger: _Ledger, pool: Pool, refill: Callable[[Pool, Any, IntArray], Pool],
           play: Callable[[Pool], Pool], ids: IntArray) -> Iterator[None]:
    """Plays the episodes `ids` to their end, those in front first; yields once for each."""
    size = len(pool.given.horizon)
    places = np.full(size, -1, np.int64)
    free, following = np.ones(size, bool), 0
    while True:
        new = ids[following:following + int(free.sum())]
        following += len(new)
        places[free] = np.concatenate([new, np.full(int(free.sum()) - len(new), -1, np.int64)])
        if (places < 0).all():
            return
        if free.any():
            pool = refill(pool, free, places)
        pool = play(pool)
        over = ledger.note(places, pool)
        yield from [None] * int(over.sum())
        free = over


def _places(world: World, episodes: int) -> int:
    """Episodes that are played at a time."""
    tokens = world.start.state.cells.shape[1] + world.start.state.solved.shape[1]
    return max(1, min(MOST_EPISODES, _PAIRS // tokens**2, episodes))


def best(tries: Tries, prices: tuple[float, float]) -> IntArray:
    """[S] the try that counts, see `planners.best_of`."""
    return cheapest(tries.success, tries.steps, tries.moves, prices)


def picked(values: npt.NDArray, choice: IntArray) -> npt.NDArray:
    """[S] of [S, K], the chosen try of each scenario."""
    return np.take_along_axis(values, choice[:, None], axis=1)[:, 0]
