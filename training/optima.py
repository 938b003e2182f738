"""Exact plans for states of the grid world, as training asks for them."""

from __future__ import annotations

from typing import Any

import numpy as np

from moonteam.grid.types import State
from moonteam.planners.batch import BatchPlans, solve_batch

LONG = 1024
"""Steps that a plan may take: more than any needs, since episodes may be cut off earlier."""


def plans(states: State, passable: np.ndarray | None = None, **options: Any) -> BatchPlans:
    """Plans of states [B], host arrays, by `solve_batch` and its options.

    `passable` [B, K, H, W] is the ground of each; None: open.
    """
    problem = states.problem
    return solve_batch(states.cells, problem.agent_skills, problem.target_cells,
                       problem.target_skills, problem.target_and, solved=states.solved,
                       agent_mask=problem.agent_mask, steps_left=LONG, passable=passable,
                       agent_kinds=None if passable is None else problem.agent_kinds, **options)
