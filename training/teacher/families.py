"""What is practised: kinds of problem, their maps, and environments that walk through them.

Legend: E environments of a family, B states of a batch, N agents, M targets, P grounds,
K kinds, H rows, W columns.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh

from moonteam import trees
from moonteam.grid import env, scenarios, travel
from moonteam.grid.config import EnvConfig
from moonteam.grid.types import State
from moonteam.planners.batch import BatchPlans
from moonteam.planners.exact import MAX_TARGETS
from moonteam.policies.entity import Entities, look
from training.mappo.macro.grounds import blocked
from training.optima import plans
from training.sharding import everywhere, spread

TIE_BREAK = 0.05
"""Weight that makespan and moves both keep at either end of the preference."""


@dataclass(frozen=True)
class Family:
    """Problems of one team and target count; maps of all sizes between two."""

    num_agents: int
    """N."""
    num_targets: int
    """M; up to `exact_to` open ones the planner's plans are optimal, beyond they are good."""
    num_skills: int = 2
    """Skills that exist."""
    sides: tuple[int, int] = (32, 32)
    """Smallest and largest side of the square map, cells."""
    max_steps: int = 128
    """Horizon of an episode."""
    grounds: int = 0
    """P, maps with blocked cells that are drawn from; 0: open maps."""
    exact_to: int = MAX_TARGETS
    """Open targets up to which the planner is exact."""
    iterations: int = 0
    """Of its large-neighbourhood search beyond them."""
    shrink: int = 1
    """Environments and batches are this many times smaller: large problems cost more."""

    @property
    def config(self) -> EnvConfig:
        """The grid env at the family's largest map."""
        return EnvConfig(num_agents=self.num_agents, num_targets=self.num_targets,
                         num_skills=self.num_skills, width=self.sides[1], height=self.sides[1],
                         max_steps=self.max_steps)


class Ground(NamedTuple):
    """Problems on maps with blocked cells, made beforehand; empty arrays for open maps."""

    states: State  # [P] at the start, without their maps
    passable: Array  # [P, K, H, W] bool
    fields: Array  # [P, K, M, H, W] int16 steps to each target


class Walk(NamedTuple):
    """The environments of one family between two rounds."""

    states: State  # [E]
    place: Array  # [E] int32, which of the grounds; 0 on open maps
    preference: Array  # [E]
    temperature: Array  # [E] of the acting policy; near 0 follows its first choice
    key: Array


class Sample(NamedTuple):
    """Labelled states; `pointer` is each agent's next target, M for stay."""

    states: State  # [B]
    place: Array | np.ndarray  # [B] int32
    preference: Array | np.ndarray  # [B]
    pointer: Array | np.ndarray  # [B, N] int32


def make_ground(family: Family, seed: int) -> Ground | None:
    """The family's maps with blocked cells (`blocked`), from a seed; None for open maps."""
    if not family.grounds:
        return None
    rng = np.random.default_rng(seed)
    problems = [blocked(rng, family.num_agents, family.num_targets, family.num_skills,
                        family.sides[1], family.max_steps) for _ in range(family.grounds)]
    problem, cells = scenarios.stack(problems)
    states = jax.vmap(lambda p, c: env.reset_to(family.config, p, c)[0])(problem, cells)
    fields = jax.lax.map(lambda p: travel.distance_fields(p.passable, p.target_cells, p.size),
                         problem, batch_size=32)
    assert problem.passable is not None
    bare = replace(states, problem=replace(states.problem, passable=None))
    return Ground(bare, problem.passable, jnp.minimum(fields, 20_000).astype(jnp.int16))


def fresh_episodes(family: Family, ground: Ground | None, key: Array,
                   count: int) -> tuple[State, Array, Array]:
    """[count] problems at their start, their grounds, and a preference for each."""
    size_key, reset_key, wish_key = jax.random.split(key, 3)
    # A quarter each at the two ends of the preference, the rest in between.
    wish = jnp.clip(jax.random.uniform(wish_key, (count,), minval=-0.5, maxval=1.5), 0.0, 1.0)
    if ground is not None:
        place = jax.random.randint(size_key, (count,), 0, ground.passable.shape[0])
        return jax.tree.map(lambda x: x[place], ground.states), place, wish
    low, high = family.sides
    sides = jax.random.randint(size_key, (count,), low, high + 1)
    sizes = jnp.stack([sides, sides], axis=-1)
    keys = jax.random.split(reset_key, count)
    states, _ = jax.vmap(lambda k, s: env.reset(family.config, k, size=s))(keys, sizes)
    return states, jnp.zeros(count, jnp.int32), wish


def begin(family: Family, ground: Ground | None, key: Array, count: int) -> Walk:
    """Environments at the start of their episodes; odd ones will act greedily."""
    first, key = jax.random.split(key)
    states, place, wish = fresh_episodes(family, ground, first, count)
    return Walk(states, place, wish, jnp.where(jnp.arange(count) % 2 == 0, 1.0, 0.05), key)


def spread_walk(mesh: Mesh, walk: Walk) -> Walk:
    """The environments shared out over the devices; the key on each of them."""
    return Walk(*spread(mesh, walk[:-1]), key=everywhere(mesh, walk.key))


def on_ground(ground: Ground | None, states: State, place: Array | np.ndarray) -> State:
    """The states with their maps."""
    if ground is None:
        return states
    return replace(states, problem=replace(states.problem, passable=ground.passable[place]))


def views(family: Family, ground: Ground | None, states: State, place: Array | np.ndarray,
          preference: Array | np.ndarray) -> Entities:
    """[B] what the network sees."""
    whole = on_ground(ground, states, place)
    if ground is None:
        return jax.vmap(lambda s, p: look(s, family.max_steps, p))(whole, preference)
    fields = ground.fields[place].astype(jnp.int32)
    fields = jnp.where(fields >= 20_000, travel.UNREACHABLE, fields)
    return jax.vmap(lambda s, p, f: look(s, family.max_steps, p, f))(whole, preference, fields)


def bare(states: State) -> State:
    """The states without their maps, which `Ground` holds once."""
    return replace(states, problem=replace(states.problem, passable=None))


def renew(family: Family, ground: Ground | None, key: Array, walk: Walk, ended: Array) -> Walk:
    """New episodes where they ended [E]."""
    fresh = fresh_episodes(family, ground, key, ended.shape[0])

    old = (walk.states, walk.place, walk.preference)
    states, place, wish = trees.where(ended, fresh, old)
    return walk._replace(states=states, place=place, preference=wish)


def solve(family: Family, ground: Ground | None, states: State, place: np.ndarray,
          preference: np.ndarray, threads: int | None = None) -> BatchPlans:
    """Exact or good plans of states [B], host arrays, at their preference."""
    return plans(
        states, None if ground is None else np.asarray(ground.passable)[place],
        objective="weighted", alpha=1.0 - preference + TIE_BREAK, beta=preference + TIE_BREAK,
        threads=threads, exact_to=family.exact_to, iterations=family.iterations)
