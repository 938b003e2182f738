"""The six reward terms of the paper and the presets of its policies.

Rubio, Richter, Kolvenbach, Hutter, "Collaborative Task and Path Planning for Heterogeneous
Robotic Teams using Multi-Agent PPO", reward functions and their table of weights; where the
paper is silent, the reading is stated at the term. N agents, M targets.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import jax.numpy as jnp
from jax import Array

from moonteam.errors import InputError, not_one_of
from moonteam.grid.config import EnvConfig, Phase, RewardWeights
from moonteam.grid.types import Problem, Rewards, State

TERMS = tuple(f.name for f in fields(Rewards))


@dataclass(frozen=True)
class RewardPreset:
    """What a trained policy of the paper was rewarded with."""

    num_targets: int
    c_ar: float
    num_buffer: int = 0
    weights: RewardWeights = field(default_factory=RewardWeights)

    def apply(self, config: EnvConfig, phase: Phase = "refinement") -> EnvConfig:
        """`config` with this preset's weights, as active in `phase`, and C_AR; sizes are kept."""
        return replace(config, weights=self.weights.phase(phase), c_ar=self.c_ar)


PRESETS = {
    "pi_5t": RewardPreset(num_targets=5, c_ar=0.0075),
    "pi_6t": RewardPreset(num_targets=6, c_ar=0.0075),
    "pi_7t": RewardPreset(num_targets=7, c_ar=0.04),
    "pi_5t5r": RewardPreset(num_targets=5, c_ar=0.0075, num_buffer=5),
}


def preset(name: str) -> RewardPreset:
    """A preset by name. Raises InputError naming those there are."""
    if name not in PRESETS:
        raise InputError("preset", not_one_of(name, PRESETS))
    return PRESETS[name]


def preset_config(name: str, phase: Phase = "refinement") -> EnvConfig:
    """The whole environment of one of the paper's policies: 3 agents on a map of 32 x 32."""
    chosen = preset(name)
    config = EnvConfig(num_targets=chosen.num_targets, num_buffer=chosen.num_buffer)
    return chosen.apply(config, phase)


def total_targets(problem: Problem) -> Array:
    """Targets of the whole episode, those still to come included: the M of the normalisers."""
    slots = jnp.sum(problem.target_mask, dtype=jnp.float32)
    return slots if problem.buffer is None else slots + problem.buffer.skills.shape[0]


def compute(config: EnvConfig, state: State, actions: Array, newly_solved: Array,
            finished: Array) -> Rewards:
    """The terms of one step, unweighted.

    Args:
      config: T_max, C_AR and the step cost's reading.
      state: after the step, replaced targets included; AR, WC and TC look at it.
      actions: [N] the joint action taken.
      newly_solved: [M] bool, targets solved in this step.
      finished: [] bool, this step solved the last target.
    """
    problem = state.problem
    real = problem.agent_mask
    open_targets = ~state.solved
    scale = 1.0 / (total_targets(problem) * config.max_steps)
    offset = problem.target_cells[None, :, :] - state.cells[:, None, :]  # [N, M, 2] cells
    shares = (problem.agent_skills[:, None] & problem.target_skills[None, :]) != 0
    counted = open_targets[None, :] & real[:, None]
    squared = offset[..., 0] ** 2 + offset[..., 1] ** 2
    near = jnp.exp(-config.c_ar * jnp.sqrt(squared.astype(jnp.float32)))
    approach = jnp.sum(jnp.where(shares & counted, near, 0.0), axis=1) * scale
    wrong = jnp.sum(counted & ~shares & (squared == 0), axis=1, dtype=jnp.float32)
    moved = (actions != 4).astype(jnp.float32)
    step_cost = moved if config.literal_step_cost else moved / config.max_steps
    solved_share = jnp.sum(newly_solved, dtype=jnp.float32) / total_targets(problem)
    time_cost = jnp.sum(open_targets, dtype=jnp.float32) * scale
    zero = jnp.zeros_like(approach)
    return Rewards(
        AR=approach,
        TR=jnp.where(real, solved_share, zero),
        WC=-wrong,
        SC=jnp.where(real, -step_cost, zero),
        TC=jnp.where(real, -time_cost, zero),
        TB=jnp.where(real, finished.astype(jnp.float32), zero))


def weighted(weights: RewardWeights, rewards: Rewards) -> Array:
    """[N] the weighted sum of the terms; a term of weight zero is not computed."""
    total = jnp.zeros_like(rewards.AR)
    for name in TERMS:
        weight = getattr(weights, name)
        if weight:
            total = total + weight * getattr(rewards, name)
    return total
