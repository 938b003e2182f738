"""The discrete world's data.

Legend of shapes: N agents, M targets (slots), B buffered targets, K kinds, W columns (x),
H rows (y), D observation length; any leading batch axes come from vmap. Cells are int32
(x, y). Skills are int32 bitmasks, A=1, B=2. Arrays may be padded: `agent_mask` and
`target_mask` are True where an entry is real.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
from jax import Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Problem:
    """What does not change within an episode, except when a target is replaced."""

    size: Array  # [2] int32 cells, (W, H)
    agent_skills: Array  # [N] int32 bitmask
    agent_kinds: Array  # [N] int32, index into `passable`; 0 on an open map
    agent_mask: Array  # [N] bool
    target_cells: Array  # [M, 2] int32 cells
    target_skills: Array  # [M] int32 bitmask
    target_and: Array  # [M] bool, True for AND
    target_mask: Array  # [M] bool
    passable: Array | None = None  # [K, H, W] bool, indexed [kind, y, x]; None: open map
    buffer: Buffer | None = None  # targets still to come (replanning); None: there are none


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Buffer:
    """Targets that appear one by one, each in the slot of one that was solved.

    They are drawn with the problem, so that one problem asks the same of every planner;
    nothing of them is observed before they appear.
    """

    cells: Array  # [B, 2] int32 cells
    skills: Array  # [B] int32 bitmask
    both: Array  # [B] bool, True for AND
    used: Array  # [] int32, how many have appeared


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class State:
    """A moment of one episode."""

    problem: Problem
    cells: Array  # [N, 2] int32 cells
    solved: Array  # [M] bool; padded targets count as solved
    step: Array  # [] int32, moves made so far


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Rewards:
    """Reward terms of one step, unweighted, with the sign they carry into the sum."""

    AR: Array  # [N] approach
    TR: Array  # [N] target solved
    WC: Array  # [N] wrong cell, <= 0
    SC: Array  # [N] step cost, <= 0
    TC: Array  # [N] time cost, <= 0
    TB: Array  # [N] team bonus


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class StepResult:
    """All that one joint action brings about. Nothing is reset: see `env.renew` for that."""

    state: State
    observation: Array  # [N, D] float32, of `state`
    rewards: Rewards
    reward: Array  # [N] float32, the weighted sum
    terminated: Array  # [] bool, every target is solved
    truncated: Array  # [] bool, the horizon was reached and the episode is not terminated
    true_moves: Array  # [N] bool, the agent's cell changed
    newly_solved: Array  # [M] bool, solved in this step (the slot may hold a new target now)
