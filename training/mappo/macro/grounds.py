"""Problems on maps with blocked cells, made beforehand: only their tables of ways are kept.

Legend: P grounds, N agents, M targets, K kinds, W columns, H rows.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from moonteam.grid import scenarios, travel
from moonteam.grid.macro.draw import Draw, of_grid, unit_of
from moonteam.grid.macro.types import FAR, MacroProblem
from moonteam.grid.types import Problem
from moonteam.problem.rules import UNREACHABLE

KINDS = ("a", "b", "c")
"""Labels of kinds on the grid, from the one that crosses everything on."""


def blocked(rng: np.random.Generator, agents: int, targets: int, skills: int, side: int,
            max_steps: int) -> tuple[Problem, Array]:
    """A random problem on a square map with closed cells, and the agents' cells.

    The first kind crosses everything; the second is refused up to a fifth of the cells, the third
    more.
    """
    some = float(rng.uniform(0.02, 0.2))
    more = some + float(rng.uniform(0.02, 0.15))
    shares: dict[str, float] = dict(zip(KINDS, (0.0, some, more), strict=True))
    return scenarios.to_problem(scenarios.generate(
        rng, num_agents=agents, num_targets=targets, num_skills=skills, size=(side, side),
        max_steps=max_steps, blocked=shares, kinds=[KINDS[i % 3] for i in range(agents)]))


def make(family: Draw, count: int, seed: int) -> MacroProblem:
    """[P] problems of the family's most robots and targets, steps of a second, Manhattan ways.

    Speeds, services and the like are for `draw.asking`.
    """
    rng = np.random.default_rng(seed)
    few, most = family.targets
    made = []
    for number in range(count):
        side = int(rng.integers(family.sides[0], family.sides[1] + 1))
        # The first has the most targets: all are padded to its shape.
        targets = int(rng.integers(few, most + 1)) if number else most
        made.append(blocked(rng, family.agents[1], targets, family.num_skills, side, 1024))
    problems, cells = scenarios.stack(made)
    tables = jax.jit(jax.vmap(lambda p, c: _tables(family, p, c)))
    parts = [jax.tree.map(np.asarray, tables(*jax.tree.map(lambda x, i=i: x[i:i + 64],
                                                           (problems, cells))))
             for i in range(0, count, 64)]
    return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)


def _tables(family: Draw, problem: Problem, cells: Array) -> MacroProblem:
    fields = travel.problem_fields(problem)
    assert fields is not None
    spots = problem.target_cells
    start = travel.distances(problem, fields, cells)
    # From j to k: the field of k, at j.
    across = jnp.swapaxes(fields[:, :, spots[:, 1], spots[:, 0]], 1, 2)[problem.agent_kinds]
    start, between = (jnp.where(x < UNREACHABLE, x, FAR).astype(jnp.float32)
                      for x in (start, across))
    return of_grid(problem, cells, family.limit, skills=family.num_skills, start=start,
                   between=between)


def at_pace(problem: MacroProblem, speed: Array) -> MacroProblem:
    """The problem with each agent's times divided by its `speed` [N]."""
    start = jnp.where(problem.start < FAR, problem.start / speed[:, None], FAR)
    between = jnp.where(problem.between < FAR, problem.between / speed[:, None, None], FAR)
    unit = unit_of(start, problem.has, problem.need, problem.agent_mask, problem.target_mask)
    return replace(problem, start=start, between=between, unit=unit)
