"""Bootstrap by imitation: DAgger against the exact planner (Ross et al., AISTATS 2011).

The policy acts; the states it comes to are labelled by the oracle with each agent's next
target; the network learns to point there. So it learns on the states that it itself visits,
its own mistakes included. Labels depend on the state's preference p between time and effort:
the oracle minimises (1 - p) * makespan + p * moves, plus a little of both to settle ties.

Legend: E environments of a family, B states of a batch, N agents, M targets, P grounds,
K kinds, H rows, W columns.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from jax.sharding import Mesh

from moonteam import trees
from moonteam.errors import InputError
from moonteam.grid import env, scenarios, travel
from moonteam.grid.config import EnvConfig
from moonteam.grid.types import State
from moonteam.planners.batch import BatchPlans, solve_batch
from moonteam.planners.exact import MAX_TARGETS
from moonteam.policies.entity import Decision, Entities, EntitySpec, decide, look
from training.sharding import everywhere, mesh_for, spread

TIE_BREAK = 0.05
"""Weight that makespan and moves both keep at either end of the preference."""

KINDS = ("a", "b", "c")
"""Labels of kinds on the grid, from the one that crosses everything on."""


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


@dataclass(frozen=True)
class Imitation:
    """A whole imitation run; every round visits each family once."""

    families: tuple[Family, ...]
    """What is practised, each round on all of them."""
    spec: EntitySpec = field(default_factory=EntitySpec)
    """Size of the network."""
    rounds: int = 1500
    """Rounds of visiting, labelling and learning."""
    num_envs: int = 256
    """E, environments of each family; as many states are labelled a round."""
    steps_between: int = 6
    """Steps that the policy takes between two labelled states."""
    capacity: int = 65_536
    """Labelled states kept of each family; the oldest make room."""
    batch_size: int = 512
    """States in a gradient step."""
    batches: int = 2
    """Gradient steps of each family in a round."""
    lr: float = 1.5e-3
    """Learning rate after warm-up; falls to 0 as a cosine."""
    ema: float = 0.998
    """Decay of the running mean of the weights, which is what is kept."""
    seed: int = 0
    """Seed of everything random in the run."""

    def __post_init__(self) -> None:
        for i, family in enumerate(self.families):
            most = family.exact_to if not family.iterations else 60
            if not 1 <= family.num_targets <= most:
                raise InputError("imitation", f"{family.num_targets} targets; the planner takes 1 "
                                 f"to {most}", f"families[{i}].num_targets")
        if self.capacity % self.num_envs:
            raise InputError("imitation", f"{self.num_envs} environments do not divide "
                             f"{self.capacity}", "capacity")
        self.spec.check("imitation")


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


class Learner(NamedTuple):
    """What learning changes."""

    params: Any
    mean: Any  # running mean of the parameters
    optimiser: optax.OptState


def make_ground(family: Family, seed: int) -> Ground | None:
    """The family's maps with blocked cells, from a seed; None for open maps.

    The first kind crosses everything; the second is refused up to a fifth of the cells, the third
    more.
    """
    if not family.grounds:
        return None
    rng = np.random.default_rng(seed)
    problems = []
    for _ in range(family.grounds):
        some = float(rng.uniform(0.02, 0.2))
        more = some + float(rng.uniform(0.02, 0.15))
        blocked: dict[str, float] = dict(zip(KINDS, (0.0, some, more), strict=True))
        kinds = [KINDS[i % 3] for i in range(family.num_agents)]
        made = scenarios.generate(
            rng, num_agents=family.num_agents, num_targets=family.num_targets,
            num_skills=family.num_skills, size=(family.sides[1], family.sides[1]),
            max_steps=family.max_steps, blocked=blocked, kinds=kinds)
        problems.append(scenarios.to_problem(made))
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


@partial(jax.jit, static_argnums=(0, 1, 2))
def walk_on(spec: EntitySpec, family: Family, steps: int, params: Any, ground: Ground | None,
            walk: Walk) -> Walk:
    """The policy takes `steps` steps; ended episodes give way to new ones."""

    def step(walk: Walk, _: None) -> tuple[Walk, None]:
        act_key, new_key, key = jax.random.split(walk.key, 3)
        view = views(family, ground, walk.states, walk.place, walk.preference)
        logits = decide(params, spec, view).log_probs / walk.temperature[:, None, None]
        actions = jax.random.categorical(act_key, logits)
        whole = on_ground(ground, walk.states, walk.place)
        result = jax.vmap(lambda s, a: env.step(family.config, s, a))(whole, actions)
        ended = result.terminated | result.truncated
        after = walk._replace(states=bare(result.state), key=key)
        return renew(family, ground, new_key, after, ended), None

    return jax.lax.scan(step, walk, None, steps)[0]


def solve(family: Family, ground: Ground | None, states: State, place: np.ndarray,
          preference: np.ndarray, threads: int | None = None) -> BatchPlans:
    """Exact or good plans of states [B], host arrays, at their preference."""
    problem = states.problem
    passable = None if ground is None else np.asarray(ground.passable)[place]
    return solve_batch(
        states.cells, problem.agent_skills, problem.target_cells, problem.target_skills,
        problem.target_and, solved=states.solved, agent_mask=problem.agent_mask, steps_left=1024,
        agent_kinds=problem.agent_kinds if ground is not None else None, passable=passable,
        objective="weighted", alpha=1.0 - preference + TIE_BREAK, beta=preference + TIE_BREAK,
        threads=threads, exact_to=family.exact_to, iterations=family.iterations)


def label(family: Family, ground: Ground | None, walk: Walk,
          threads: int | None = None) -> Sample:
    """The walk's states with the planner's next target for each agent."""
    states, place, wish = jax.device_get((walk.states, walk.place, walk.preference))
    plans = solve(family, ground, states, place, wish, threads)
    num_targets = states.problem.target_skills.shape[1]
    pointer = np.where(plans.next_target < 0, num_targets, plans.next_target).astype(np.int32)
    return Sample(states, place, wish, pointer)


def loss(params: Any, spec: EntitySpec, family: Family, ground: Ground | None,
         batch: Sample) -> Array:
    """Cross entropy of the pointer, and of the moves that lead where the label points."""
    view = views(family, ground, batch.states, batch.place, batch.preference)
    return imitate_loss(decide(params, spec, view, together=False), view, batch.pointer)


def imitate_loss(decision: Decision, view: Entities, pointer: Array | np.ndarray) -> Array:
    """The loss of a batch; `pointer` [B, N] the planner's next targets, M for stay."""
    num_targets = view.target_skills.shape[-1]
    pick = jax.nn.one_hot(pointer, num_targets + 1)
    pointing = -jnp.sum(jax.nn.log_softmax(decision.pointer) * pick, axis=-1)
    index = jnp.clip(pointer, 0, num_targets - 1)[..., None, None]
    ways = jnp.take_along_axis(view.toward, index, axis=-2)[..., 0, :]
    ways = ways & (pointer < num_targets)[..., None]
    good = jnp.concatenate([ways, ~jnp.any(ways, axis=-1, keepdims=True)], axis=-1)
    moving = -jnp.log(jnp.sum(jnp.exp(decision.log_probs) * good, axis=-1))
    real = view.agent_mask
    return jnp.sum((pointing + 0.5 * moving) * real) / jnp.maximum(jnp.sum(real), 1)


def optimiser(config: Imitation) -> optax.GradientTransformation:
    """AdamW with warm-up and a cosine to zero over the whole run."""
    total = max(2, config.rounds * config.batches * len(config.families))
    rate = optax.warmup_cosine_decay_schedule(0.0, config.lr, min(200, total // 10 + 1), total)
    return optax.chain(optax.clip_by_global_norm(1.0), optax.adamw(rate, weight_decay=1e-4))


@partial(jax.jit, static_argnums=(0, 1), donate_argnums=(3,))
def learn(config: Imitation, family: Family, ground: Ground | None, learner: Learner,
          batch: Sample) -> tuple[Learner, Array]:
    """One gradient step on a batch of one family."""
    value, gradient = jax.value_and_grad(loss)(learner.params, config.spec, family, ground, batch)
    update, state = optimiser(config).update(gradient, learner.optimiser, learner.params)
    params = optax.apply_updates(learner.params, update)
    mean = jax.tree.map(lambda m, p: config.ema * m + (1 - config.ema) * p, learner.mean, params)
    return Learner(params, mean, state), value


class Memory:
    """The labelled states of one family: a ring, the oldest make room."""

    def __init__(self, capacity: int):
        """`capacity`: states kept; whole batches of additions must divide it."""
        self.capacity = capacity
        self.count = 0
        self.rows: Sample | None = None

    def add(self, batch: Sample) -> None:
        """Puts a labelled batch in."""
        size = len(batch.place)
        if self.rows is None:
            self.rows = jax.tree.map(
                lambda x: np.zeros((self.capacity, *x.shape[1:]), x.dtype), batch)
        at = self.count % self.capacity
        for kept, new in zip(jax.tree.leaves(self.rows), jax.tree.leaves(batch), strict=True):
            kept[at : at + size] = new
        self.count += size

    def draw(self, rng: np.random.Generator, size: int) -> Sample:
        """`size` states at random, with replacement."""
        index = rng.integers(0, min(self.count, self.capacity), size)
        return jax.tree.map(lambda x: x[index], self.rows)


class Round(NamedTuple):
    """What a round reports; still on the devices, not to keep them waiting."""

    number: int
    loss: Array


class Dagger:
    """An imitation run in progress; `round()` until `done`, `learner.mean` is the policy."""

    def __init__(self, config: Imitation, params: Any = None):
        """Makes grounds and environments from the config's seed, parameters too if not given."""
        from moonteam.policies import entity

        self.config = config
        self.mesh = mesh_for(size // f.shrink for f in config.families
                             for size in (config.num_envs, config.batch_size))
        self.number = 0
        keys = jax.random.split(jax.random.key(config.seed), len(config.families) + 1)
        params = entity.init(config.spec, keys[0]) if params is None else params
        mean = jax.tree.map(jnp.copy, params)
        self.learner = everywhere(self.mesh, Learner(params, mean, optimiser(config).init(params)))
        self.grounds = [everywhere(self.mesh, make_ground(f, config.seed + i))
                        for i, f in enumerate(config.families)]
        self.walks = [spread_walk(self.mesh, begin(f, g, k, config.num_envs // f.shrink))
                      for f, g, k in
                      zip(config.families, self.grounds, keys[1:], strict=True)]
        self.memories = [Memory(config.capacity // f.shrink) for f in config.families]

    @property
    def done(self) -> bool:
        """All rounds are made."""
        return self.number >= self.config.rounds

    @property
    def states_a_round(self) -> int:
        """States labelled in a round."""
        return sum(self.config.num_envs // f.shrink for f in self.config.families)

    def round(self) -> Round:
        """Visits, labels and learns, each family once.

        The devices are given all walks at once, then one gradient step after the other; they
        work while the planner labels on the host. So all walks of a round follow the policy as
        it was when the round began.
        """
        config = self.config
        losses = []
        for i, family in enumerate(config.families):
            self.walks[i] = walk_on(config.spec, family, config.steps_between,
                                    self.learner.params, self.grounds[i], self.walks[i])
        for i, family in enumerate(config.families):
            ground = self.grounds[i]
            self.memories[i].add(label(family, ground, self.walks[i]))
            rng = np.random.default_rng([config.seed, self.number, i])
            for _ in range(config.batches):
                rows = self.memories[i].draw(rng, config.batch_size // family.shrink)
                self.learner, value = learn(config, family, ground, self.learner,
                                            spread(self.mesh, rows))
                losses.append(value)
        self.number += 1
        return Round(self.number, jnp.mean(jnp.stack(losses)))
