"""The grid environment: pure functions for `jax.jit` and `jax.vmap`.

`reset` draws a problem, `step` moves the team and rewards it, `renew` starts new episodes
where old ones ended. Actions are int32: 0 up (+y), 1 down (-y), 2 left (-x), 3 right (+x),
4 stay. A move off the map, or into a cell that the agent's kind cannot enter, leaves the
agent on its last cell and still counts as a move. Several agents may share a cell.

A target is solved once, after the moves of a step, by the agents then in its cell: OR when
one of them has one of its skills, AND when together they have all. Legend as in `types`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
from jax import Array

from moonteam import trees
from moonteam.grid import rewards
from moonteam.grid.config import EnvConfig
from moonteam.grid.observe import observe
from moonteam.grid.sampling import Count, sample
from moonteam.grid.types import Problem, State, StepResult
from moonteam.problem import rules
from moonteam.problem.rules import NUM_ACTIONS, STAY


def reset(config: EnvConfig, key: Array, num_agents: Count | None = None,
          num_targets: Count | None = None, size: Array | None = None) -> tuple[State, Array]:
    """A random problem (see `sampling`) before its first step, and its observation [N, D]."""
    problem, cells = sample(config, key, num_agents, num_targets, size)
    return reset_to(config, problem, cells)


def reset_to(config: EnvConfig, problem: Problem, cells: Array) -> tuple[State, Array]:
    """A given problem with its agents on `cells` [N, 2], and its observation [N, D].

    A requirement that already holds is solved at step 0.
    """
    solved = meets(problem, cells) | ~problem.target_mask
    state = State(problem=problem, cells=cells, solved=solved, step=jnp.zeros((), jnp.int32))
    return state, observe(config, state)


def step(config: EnvConfig, state: State, actions: Array) -> StepResult:
    """Moves the team by one joint action [N] int32 and says all that follows from it.

    Replanning: as long as the problem's buffer lasts, a target solved in this step is
    replaced in its slot by the next of the buffer, which can be solved from the next step on.
    AR, WC and TC see the replaced target.
    """
    cells = moved(state.problem, state.cells, actions)
    newly = meets(state.problem, cells) & ~state.solved
    problem, replaced = _replace_solved(state.problem, newly)
    solved = (state.solved | newly) & ~replaced
    after = State(problem=problem, cells=cells, solved=solved, step=state.step + 1)
    done = jnp.all(solved)
    terms = rewards.compute(config, after, actions, newly, done & jnp.any(newly))
    return StepResult(
        state=after,
        observation=observe(config, after),
        rewards=terms,
        reward=rewards.weighted(config.weights, terms),
        terminated=done,
        truncated=(after.step >= config.max_steps) & ~done,
        true_moves=jnp.any(cells != state.cells, axis=1),
        newly_solved=newly)


def moved(problem: Problem, cells: Array, actions: Array) -> Array:
    """[N, 2] cells after a joint action; borders and blocked cells turn an agent back."""
    return rules.moved(cells, cells + _displacement(actions), problem.agent_mask,
                       problem.agent_kinds, problem.size, problem.passable)


def meets(problem: Problem, cells: Array) -> Array:
    """[M] bool: the agents now in the target's cell meet its requirement."""
    here = jnp.all(cells[:, None, :] == problem.target_cells[None, :, :], axis=2)
    here = here & problem.agent_mask[:, None] & problem.target_mask[None, :]
    present = jnp.zeros_like(problem.target_skills)
    for i in range(cells.shape[0]):
        present = present | jnp.where(here[i], problem.agent_skills[i], 0)
    return (rules.met(present, problem.target_skills, problem.target_and)
            & problem.target_mask)


def available(state: State) -> Array:
    """[N, 5] bool, actions that do what they say: staying, and moves that are not turned back.

    An agent that is padding can only stay.
    """
    problem = state.problem
    columns = []
    for action in range(NUM_ACTIONS):
        goal = state.cells + _displacement(jnp.full(state.cells.shape[:1], action))
        if action == STAY:
            columns.append(jnp.ones_like(problem.agent_mask))
        else:
            ok = rules.enterable(goal, problem.agent_kinds, problem.size, problem.passable)
            columns.append(ok & problem.agent_mask)
    return jnp.stack(columns, axis=1)


def renew(config: EnvConfig, key: Array, states: State, ended: Array,
          draw: Callable[[Array], State] | None = None) -> State:
    """Fresh problems in place of the episodes that ended, for a batch of environments.

    Far fewer fresh problems are drawn than there are environments: each ended one takes its
    own from a small batch, and only when that is not enough is the whole batch drawn. Every
    fresh problem is independent of the others, as from `reset`.

    Args:
      config: the family to draw from; the states must come from `reset` with it.
      key: one JAX key.
      states: [E] batch.
      ended: [E] bool.
      draw: what a fresh state is drawn by, given a key, where it is not `reset(config, key)`:
        mixed sizes, or blocked maps from a pool.
    """
    start = draw or (lambda k: reset(config, k)[0])
    num_envs = ended.shape[0]
    few = max(1, num_envs // 16)

    def fresh(count: int) -> State:
        return jax.vmap(start)(jax.random.split(key, count))

    def by_few() -> State:
        index = jnp.nonzero(ended, size=few, fill_value=num_envs)[0]
        return jax.tree.map(lambda new, old: old.at[index].set(new, mode="drop"),
                            fresh(few), states)

    def by_all() -> State:
        return trees.where(ended, fresh(num_envs), states)

    return jax.lax.cond(jnp.sum(ended) <= few, by_few, by_all)


def _displacement(actions: Array) -> Array:
    """[N, 2] int32 cells."""
    right = (actions == 3).astype(jnp.int32) - (actions == 2).astype(jnp.int32)
    up = (actions == 0).astype(jnp.int32) - (actions == 1).astype(jnp.int32)
    return jnp.stack([right, up], axis=1)


def _replace_solved(problem: Problem, newly: Array) -> tuple[Problem, Array]:
    """Puts the next buffered targets into the slots just solved, in slot order.

    Returns the problem and [M] bool, the slots that hold a new target.
    """
    buffer = problem.buffer
    if buffer is None:
        return problem, jnp.zeros_like(newly)
    count = buffer.skills.shape[0]
    turn = buffer.used + jnp.cumsum(newly) - 1  # [M] which buffered target a slot would take
    replaced = newly & (turn < count)
    index = jnp.clip(turn, 0, count - 1)
    used = buffer.used + jnp.sum(newly, dtype=jnp.int32)
    return replace(
        problem,
        target_cells=jnp.where(replaced[:, None], buffer.cells[index], problem.target_cells),
        target_skills=jnp.where(replaced, buffer.skills[index], problem.target_skills),
        target_and=jnp.where(replaced, buffer.both[index], problem.target_and),
        buffer=replace(buffer, used=jnp.minimum(used, count)),
    ), replaced
