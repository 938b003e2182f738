"""Bootstrap by imitation: DAgger against the exact planner (Ross et al., AISTATS 2011).

The policy acts; the states it comes to are labelled by the oracle with each agent's next
target; the network learns to point there. So it learns on the states that it itself visits,
its own mistakes included. Labels depend on the state's preference p between time and effort:
the oracle minimises (1 - p) * makespan + p * moves, plus a little of both to settle ties.

Legend: E environments of a family, B states of a batch, N agents, M targets.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from moonteam.errors import InputError
from moonteam.grid import env
from moonteam.policies.entity import Decision, Entities, EntitySpec, decide
from training.sharding import spread
from training.teacher.families import (
    Family,
    Ground,
    Sample,
    Walk,
    bare,
    on_ground,
    renew,
    solve,
    views,
)
from training.teacher.pupil import Learner, Memory, Pupil


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


def label(family: Family, ground: Ground | None, walk: Walk,
          threads: int | None = None) -> Sample:
    """The walk's states with the planner's next target for each agent."""
    states, place, wish = jax.device_get((walk.states, walk.place, walk.preference))
    plans = solve(family, ground, states, place, wish, threads)
    num_targets = states.problem.target_skills.shape[1]
    pointer = np.where(plans.next_target < 0, num_targets, plans.next_target).astype(np.int32)
    return Sample(states, place, wish, pointer)


def unlabelled(walk: Walk) -> Sample:
    """The walk's states as a sample that points nowhere; for its shapes."""
    agents = walk.states.cells.shape[1]
    return Sample(*walk[:3], pointer=np.zeros((len(walk.place), agents), np.int32))


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


class Round(NamedTuple):
    """What a round reports; still on the devices, not to keep them waiting."""

    loss: Array


class Dagger(Pupil):
    """An imitation in progress."""

    method = "imitation (DAgger)"
    phase = "imitation"
    config: Imitation

    def __init__(self, config: Imitation, params: Any = None, name: str = "imitation",
                 source: str = ""):
        """Makes grounds and environments from the config's seed, parameters too if not given."""
        from moonteam.policies import entity

        keys = jax.random.split(jax.random.key(config.seed), len(config.families) + 1)
        params = entity.init(config.spec, keys[0]) if params is None else params
        envs = [config.num_envs // f.shrink for f in config.families]
        rows = [*envs, *(config.batch_size // f.shrink for f in config.families)]
        super().__init__(config, name, source, Learner.begin(params, optimiser(config)),
                         keys[1:], envs, rows)
        self.memories = [Memory(config.capacity // f.shrink, unlabelled(walk))
                         for f, walk in zip(config.families, self.walks, strict=True)]

    @property
    def states_a_round(self) -> int:
        """States labelled in a round."""
        return sum(self.config.num_envs // f.shrink for f in self.config.families)

    @property
    def steps_a_round(self) -> int:
        """Env steps; several lie between two labelled states."""
        return self.states_a_round * self.config.steps_between

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
        return Round(jnp.mean(jnp.stack(losses)))
