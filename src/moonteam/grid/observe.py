"""What each agent observes: the paper's flat vector.

Layout for agent i, length D = 2N + 2M + N + M + M: own position, the other agents'
positions in index order, g(r) of each target with r = target - own position and [0, 0]
when solved, skill numbers f(S) of the agents in the same order, skill numbers of the
targets, types of the targets (AND 1, OR 0). f is the bitmask: A=1, B=2, AB=3. Positions
are divided by (size - 1), or raw cells. What is padded is observed as zeros.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from moonteam.grid.config import EnvConfig
from moonteam.grid.types import State


def observe(config: EnvConfig, state: State) -> Array:
    """[N, D] float32, every agent's observation of a state."""
    problem = state.problem
    num_agents, num_targets = state.cells.shape[0], state.solved.shape[0]
    real = problem.agent_mask
    if config.normalize_positions:
        span = jnp.maximum(problem.size - 1, 1).astype(jnp.float32)  # [2] cells
    else:
        span = jnp.ones((2,), jnp.float32)
    scaled = state.cells.astype(jnp.float32) / span[None, :]
    positions = jnp.where(real[:, None], scaled, 0.0)  # [N, 2]
    others = _others(positions, num_agents).reshape(num_agents, -1)
    offset = problem.target_cells[None, :, :] - state.cells[:, None, :]
    wanted = ~state.solved[None, :, None] & real[:, None, None]
    relative = jnp.where(wanted, offset.astype(jnp.float32) / span[None, None, :], 0.0)
    skills = jnp.where(real, problem.agent_skills, 0).astype(jnp.float32)
    target_mask = problem.target_mask
    numbers = jnp.where(target_mask, problem.target_skills, 0).astype(jnp.float32)
    types = (problem.target_and & target_mask).astype(jnp.float32)
    shared = jnp.concatenate([numbers, types])
    return jnp.concatenate([
        positions,
        others,
        relative.reshape(num_agents, 2 * num_targets),
        skills[:, None],
        _others(skills, num_agents),
        jnp.broadcast_to(shared[None, :], (num_agents, 2 * num_targets)),
    ], axis=1)


def _others(values: Array, num_agents: int) -> Array:
    """[N, N-1, ...] for each agent the rows of `values` ([N, ...]) of the others, in order.

    Row k of agent i is value k before i and value k + 1 from there on: two slices and a
    select, which fuse where a gather would not.
    """
    agent = jnp.arange(num_agents)[:, None]
    slot = jnp.arange(num_agents - 1)[None, :]
    before = (slot < agent).reshape(num_agents, num_agents - 1, *[1] * (values.ndim - 1))
    return jnp.where(before, values[None, :-1], values[None, 1:])
