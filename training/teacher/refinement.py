"""Refinement of an imitated policy by MAPPO, with a centralised critic over the same tokens.

Two kinds of reward, one learner, and a control:

- `paper`: the weighted sum of the paper's terms as active in its refinement phase; `bootstrap`:
  those of its first phase, which lead a policy that knows nothing yet.
- `regret`: minus what a step lost against the exact planner. With V*(s) the least weighted
  cost (1 - p) * makespan + p * moves that is still possible from s, and c the cost of the step
  itself, the reward is V*(s) - c - V*(s'): zero for a step that an optimal plan could take,
  negative otherwise. It is the true cost shaped by the potential -V* (Ng et al., ICML 1999), so
  the best policy is the same, and the sum over an episode is exactly its gap to the optimum;
  what is left to the critic is the regret still to come, which is small.
- `none`: the leash below alone, imitation on as many states: what refinement is held against.

A leash keeps the policy near the planner: the cross entropy of imitation on the same states,
whose labels come with V* at no cost.

Legend: E environments of a family, T steps of a rollout, B states of a minibatch, N agents,
M targets.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from moonteam.errors import InputError
from moonteam.grid import env, rewards
from moonteam.grid.config import EnvConfig
from moonteam.grid.types import State
from moonteam.planners.batch import FEASIBLE
from moonteam.policies.entity import EntitySpec, decide
from training.mappo.gae import advantages
from training.sharding import spread
from training.teacher.families import (
    TIE_BREAK,
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
from training.teacher.imitation import imitate_loss
from training.teacher.pupil import Learner, Pupil

Reward = Literal["regret", "paper", "bootstrap", "none"]


@dataclass(frozen=True)
class Refinement:
    """A whole refinement; every round visits each family once."""

    families: tuple[Family, ...]
    """What is practised, each round on all of them."""
    spec: EntitySpec = field(default_factory=EntitySpec)
    """Size of the network."""
    reward: Reward = "regret"
    """What is maximised; see the module."""
    rounds: int = 300
    """Rounds of collection and learning."""
    num_envs: int = 128
    """E, environments of each family."""
    num_steps: int = 16
    """T, steps collected in a round."""
    minibatches: int = 4
    """Gradient steps of each family and epoch."""
    epochs: int = 1
    """Passes over what was collected."""
    lr: float = 3e-4
    """Learning rate; falls linearly to a tenth."""
    gamma: float = 0.95
    """Discount of the reward."""
    gae_lambda: float = 0.9
    """Of generalised advantage estimation."""
    clip_eps: float = 0.2
    """Of the probability ratio."""
    ent_coef: float = 0.0
    """Weight of the entropy."""
    vf_coef: float = 0.5
    """Weight of the critic's squared error."""
    leash: float = 0.1
    """Weight of the cross entropy of imitation."""
    ema: float = 0.995
    """Decay of the running mean of the weights, which is what is kept."""
    seed: int = 0
    """Seed of everything random in the run."""

    def __post_init__(self) -> None:
        if self.num_envs * self.num_steps % self.minibatches:
            raise InputError("refinement", f"{self.minibatches} minibatches do not divide "
                             f"{self.num_envs} environments x {self.num_steps} steps",
                             "minibatches")


class Collected(NamedTuple):
    """What one rollout leaves; states hold one moment more than there were steps."""

    states: State  # [T + 1, E] without their maps
    place: Array  # [T + 1, E]
    preference: Array  # [T + 1, E]
    value: Array  # [T + 1, E]
    action: Array  # [T, E, N]
    log_prob: Array  # [T, E, N]
    reward: Array  # [T, E] of the paper, mean over the team
    terminated: Array  # [T, E] bool
    truncated: Array  # [T, E] bool


class Minibatch(NamedTuple):
    """Moments to learn from, flattened over steps and environments."""

    sample: Sample  # [B]
    action: Array  # [B, N]
    log_prob: Array  # [B, N]
    advantage: Array  # [B]
    target: Array  # [B] of the critic
    weight: Array  # [B] 0 where the step was cut off and its end unknown


def reward_config(family: Family, reward: Reward) -> EnvConfig:
    """The family's env with the weights and the C_AR that the paper had in that phase."""
    few = rewards.preset("pi_7t" if family.num_targets > 6 else "pi_5t")
    return few.apply(family.config, "bootstrap" if reward == "bootstrap" else "refinement")


@partial(jax.jit, static_argnums=(0, 1, 2, 3))
def collect(spec: EntitySpec, family: Family, reward: Reward, steps: int, params: Any,
            ground: Ground | None, walk: Walk) -> tuple[Walk, Collected]:
    """The policy's own samples for `steps` steps; ended episodes give way to new ones."""
    config = reward_config(family, reward)

    def step(walk: Walk, _: None) -> tuple[Walk, tuple]:
        act_key, new_key, key = jax.random.split(walk.key, 3)
        view = views(family, ground, walk.states, walk.place, walk.preference)
        decision = decide(params, spec, view, together=False)
        actions = jax.random.categorical(act_key, decision.log_probs)
        whole = on_ground(ground, walk.states, walk.place)
        result = jax.vmap(lambda s, a: env.step(config, s, a))(whole, actions)
        team = jnp.maximum(jnp.sum(walk.states.problem.agent_mask, axis=-1), 1)
        row = (walk.states, walk.place, walk.preference, decision.value, actions,
               taken(decision.log_probs, actions), jnp.sum(result.reward, axis=-1) / team,
               result.terminated, result.truncated)
        ended = result.terminated | result.truncated
        after = walk._replace(states=bare(result.state), key=key)
        return renew(family, ground, new_key, after, ended), row

    walk, rows = jax.lax.scan(step, walk, None, steps)
    view = views(family, ground, walk.states, walk.place, walk.preference)
    last = decide(params, spec, view, together=False)
    final = (walk.states, walk.place, walk.preference, last.value)
    longer = jax.tree.map(lambda x, y: jnp.concatenate([x, y[None]]), rows[:4], final)
    return walk, Collected(*longer, *rows[4:])


def taken(log_probs: Array, actions: Array) -> Array:
    """Log-probability [..., N] of each agent's action."""
    return jnp.take_along_axis(log_probs, actions[..., None], axis=-1)[..., 0]


class Judged(NamedTuple):
    """What the exact planner says of every moment of a rollout."""

    pointer: np.ndarray  # [T + 1, E, N] next targets, M for stay
    cost: np.ndarray  # [T + 1, E] least weighted cost still possible
    known: np.ndarray  # [T + 1, E] bool, the planner found a plan


def judge(family: Family, ground: Ground | None, states: State, place: np.ndarray,
          preference: np.ndarray) -> Judged:
    """Asks the exact planner of states [T, E] (host arrays)."""
    lead = preference.shape
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[len(lead):]),
                        (states, place, preference))
    plans = solve(family, ground, *flat)
    num_targets = states.problem.target_skills.shape[-1]
    pointer = np.where(plans.next_target < 0, num_targets, plans.next_target).astype(np.int32)
    alpha, beta = 1.0 - flat[2] + TIE_BREAK, flat[2] + TIE_BREAK
    cost = alpha * np.maximum(plans.makespan, 0) + beta * np.maximum(plans.moves, 0)
    return Judged(pointer.reshape(*lead, -1), cost.reshape(lead).astype(np.float32),
                  (plans.status <= FEASIBLE).reshape(lead))


def regrets(config: Refinement, rollout: Collected, judged: Judged) -> np.ndarray:
    """[T, E] reward of each step: the least cost before, less the step's own and the rest."""
    wish = rollout.preference[:-1]
    moves = (np.asarray(rollout.action) != env.STAY).sum(-1)
    spent = (1.0 - wish + TIE_BREAK) + (wish + TIE_BREAK) * moves
    left = np.where(rollout.terminated, 0.0, judged.cost[1:])
    return np.asarray(judged.cost[:-1] - spent - left, np.float32)


@partial(jax.jit, static_argnums=(0, 1), donate_argnums=(3,))
def learn(config: Refinement, family: Family, ground: Ground | None, learner: Learner,
          batch: Minibatch) -> tuple[Learner, Array]:
    """One gradient step; returns the learner and [loss, entropy, share clipped]."""
    (_, report), gradient = jax.value_and_grad(loss, has_aux=True)(
        learner.params, config, family, ground, batch)
    update, state = optimiser(config).update(gradient, learner.optimiser, learner.params)
    params = optax.apply_updates(learner.params, update)
    mean = jax.tree.map(lambda m, p: config.ema * m + (1 - config.ema) * p, learner.mean, params)
    return Learner(params, mean, state), report


def loss(params: Any, config: Refinement, family: Family, ground: Ground | None,
         batch: Minibatch) -> tuple[Array, Array]:
    """Clipped PPO of every agent with the team's advantage, critic, entropy, leash."""
    sample = batch.sample
    view = views(family, ground, sample.states, sample.place, sample.preference)
    decision = decide(params, config.spec, view, together=False)
    ratio = jnp.exp(taken(decision.log_probs, batch.action) - batch.log_prob)
    real = view.agent_mask * batch.weight[:, None]
    count = jnp.maximum(jnp.sum(real), 1.0)
    gain = batch.advantage[:, None]
    limited = jnp.clip(ratio, 1.0 - config.clip_eps, 1.0 + config.clip_eps)
    policy = -jnp.sum(jnp.minimum(ratio * gain, limited * gain) * real) / count
    entropy = -jnp.sum(jnp.sum(jnp.exp(decision.log_probs) * decision.log_probs, -1) * real
                       ) / count
    error = (decision.value - batch.target) ** 2 * batch.weight
    critic = 0.5 * jnp.sum(error) / jnp.maximum(jnp.sum(batch.weight), 1.0)
    near = imitate_loss(decision, view, sample.pointer)
    clipped = jnp.sum((jnp.abs(ratio - 1.0) > config.clip_eps) * real) / count
    if config.reward == "none":
        total = near
    else:
        total = (policy + config.vf_coef * critic - config.ent_coef * entropy
                 + config.leash * near)
    return total, jnp.stack([total, entropy, clipped, critic, near])


def optimiser(config: Refinement) -> optax.GradientTransformation:
    """Adam, its rate falling linearly to a tenth over the whole run."""
    total = config.rounds * config.epochs * config.minibatches * len(config.families)
    rate = optax.linear_schedule(config.lr, 0.1 * config.lr, total)
    return optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate, eps=1e-5))


class Round(NamedTuple):
    """What a round reports."""

    loss: float
    regret: float  # mean weighted cost lost a step
    entropy: float
    clipped: float  # share of probability ratios
    critic: float  # half its squared error
    imitation: float  # cross entropy of the leash


class Refiner(Pupil):
    """A refinement in progress; nothing older than a round is learned from."""

    phase = "refinement"
    config: Refinement

    def __init__(self, config: Refinement, params: Any, name: str = "refine", source: str = ""):
        """`params`: of the imitated policy."""
        envs = [config.num_envs // f.shrink for f in config.families]
        keys = jax.random.split(jax.random.key(config.seed + 1_000_003), len(config.families))
        super().__init__(config, name, source, Learner.begin(params, optimiser(config)), keys, envs,
                         [*envs, *(e * config.num_steps // config.minibatches for e in envs)])
        begun = "from imitation" if source else "from scratch, a step a decision"
        self.method = f"MAPPO {begun}, reward {config.reward}, leash {config.leash:g}"

    @property
    def states_a_round(self) -> int:
        """States visited and labelled in a round."""
        config = self.config
        return sum(config.num_envs // f.shrink * config.num_steps for f in config.families)

    @property
    def steps_a_round(self) -> int:
        """Every state is labelled."""
        return self.states_a_round

    def round(self) -> Round:
        """Collects, asks the planner and learns, each family once."""
        losses, lost = [], []
        for i, family in enumerate(self.config.families):
            self.walks[i], batch, regret = self._experience(i)
            lost.append(regret)
            rng = np.random.default_rng([self.config.seed, self.number, i])
            size = len(batch.advantage) // self.config.minibatches
            for _ in range(self.config.epochs):
                order = rng.permutation(len(batch.advantage)).reshape(-1, size)
                for index in order:
                    part = spread(self.mesh, jax.tree.map(lambda x, at=index: x[at], batch))
                    self.learner, report = learn(self.config, family, self.grounds[i],
                                                 self.learner, part)
                    losses.append(report)
        self.number += 1
        total, entropy, clipped, critic, near = np.mean(jax.device_get(losses), axis=0).tolist()
        return Round(total, float(np.mean(lost)), entropy, clipped, critic, near)

    def _experience(self, i: int) -> tuple[Walk, Minibatch, float]:
        """One rollout of a family, with advantages and labels."""
        config, ground = self.config, self.grounds[i]
        walk, rollout = collect(config.spec, config.families[i], config.reward, config.num_steps,
                                self.learner.params, ground, self.walks[i])
        rollout = jax.device_get(rollout)
        judged = judge(config.families[i], ground, rollout.states, rollout.place,
                       rollout.preference)
        regret = regrets(config, rollout, judged)
        gain = regret if config.reward == "regret" else rollout.reward
        # A cut-off episode's last state is gone: its step is not learned from.
        known = judged.known[:-1] & (judged.known[1:] | rollout.terminated) & ~rollout.truncated
        gain = np.where(known, gain, 0.0)
        following = np.where(rollout.truncated, rollout.value[:-1], rollout.value[1:])
        advantage = np.asarray(advantages(
            *map(jnp.asarray, (gain, rollout.value[:-1], following, rollout.terminated,
                               rollout.truncated)),
            gamma=config.gamma, gae_lambda=config.gae_lambda))
        target = advantage + rollout.value[:-1]
        advantage = (advantage - advantage[known].mean()) / (advantage[known].std() + 1e-6)
        sample = Sample(jax.tree.map(lambda x: x[:-1], rollout.states), rollout.place[:-1],
                        rollout.preference[:-1], judged.pointer[:-1])
        batch = Minibatch(sample, rollout.action, rollout.log_prob, advantage, target,
                          known.astype(np.float32))
        flat = jax.tree.map(lambda x: np.asarray(x).reshape(-1, *x.shape[2:]), batch)
        return walk, flat, float(-regret[known].mean())
