"""The discrete world's data.

Legend of shapes: N agents, M targets, K kinds, W columns (x), H rows (y); any leading
batch axes come from vmap. Cells are int32 (x, y). Skills are int32 bitmasks, A=1, B=2.
Arrays may be padded: `agent_mask` and `target_mask` are True where an entry is real.
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
