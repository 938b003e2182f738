"""Random problems of the macro world, for training; and the grid's problems by the clock.

Legend as in `types`.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import Array

from moonteam.grid.config import EnvConfig
from moonteam.grid.macro.types import FAR, MacroProblem
from moonteam.grid.sampling import sample
from moonteam.grid.types import Problem
from moonteam.problem.scenario import MAX_SKILLS
from moonteam.problem.timed import Metric


def bits(mask: Array, skills: int = MAX_SKILLS) -> Array:
    """[...] bit mask -> [..., S] bool."""
    shifts = jnp.arange(skills, dtype=mask.dtype).reshape((1,) * mask.ndim + (skills,))
    return ((mask[..., None] >> shifts) & 1) == 1


def apart(a: Array, b: Array, metric: Metric) -> Array:
    """[..., A, B] metres from places a [..., A, 2] to b [..., B, 2]."""
    shift = jnp.abs(a[..., :, None, :] - b[..., None, :, :]).astype(jnp.float32)
    if metric == "manhattan":
        return jnp.sum(shift, axis=-1)
    return jnp.sqrt(jnp.sum(shift**2, axis=-1))


def unit_of(start: Array, has: Array, need: Array, agent_mask: Array, target_mask: Array) -> Array:
    """[] s, the mean way to a target of agents that share a skill with it; 1 if there is none."""
    share = jnp.any(has[:, None] & (need[None] > 0), axis=2)
    use = share & agent_mask[:, None] & target_mask[None] & (start < FAR)
    mean = jnp.sum(jnp.where(use, start, 0.0)) / jnp.maximum(jnp.sum(use), 1)
    return jnp.where(mean > 0, mean, 1.0)


def of_grid(problem: Problem, cells: Array, limit: Array | float, metric: Metric = "manhattan",
            speed: Array | None = None, skills: int = MAX_SKILLS,
            start: Array | None = None, between: Array | None = None) -> MacroProblem:
    """A problem of the one-cell world by the clock: by default one cell a second.

    Args:
      problem: on an open map, if `start` and `between` are not given.
      cells: [N, 2] of the agents, whole or between two.
      limit: s.
      metric: of the ways.
      speed: [N] cells a second; 1 if not given.
      skills: S, at least as many as there are bits in use.
      start: [N, M] cells from each agent to each target, FAR where there is no way.
      between: [N, M, M] cells from target to target.
    """
    agents, targets = len(problem.agent_skills), len(problem.target_skills)
    pace = jnp.ones(agents) if speed is None else speed
    if start is None:
        start = apart(cells, problem.target_cells, metric)
    if between is None:
        flat = apart(problem.target_cells, problem.target_cells, metric)
        between = jnp.broadcast_to(flat[None], (agents, targets, targets))
    start = jnp.where(start < FAR, start / pace[:, None], FAR)
    between = jnp.where(between < FAR, between / pace[:, None, None], FAR)
    has = bits(problem.agent_skills, skills) & problem.agent_mask[:, None]
    need = (bits(problem.target_skills, skills) & problem.target_mask[:, None]).astype(jnp.int32)
    zero = jnp.zeros(targets)
    return MacroProblem(
        start=start, between=between, home=jnp.zeros((agents, targets)),
        home_now=jnp.zeros(agents), has=has, need=need,
        either=~problem.target_and, service=zero, after=jnp.zeros((targets, targets), bool),
        appears=zero, shown=zero, lapses=zero + FAR, free=jnp.zeros(agents),
        effort=jnp.ones(agents), limit=jnp.asarray(limit, jnp.float32),
        agent_mask=problem.agent_mask, target_mask=problem.target_mask,
        unit=unit_of(start, has, need, problem.agent_mask, problem.target_mask))


@dataclass(frozen=True)
class Draw:
    """A family of random problems of the macro world; hashable."""

    agents: tuple[int, int] = (3, 3)
    """Fewest and most robots."""
    targets: tuple[int, int] = (5, 7)
    """Fewest and most targets."""
    num_skills: int = 2
    """Skills that exist."""
    sides: tuple[int, int] = (32, 32)
    """Smallest and largest side of the square map, cells."""
    metric: Metric = "manhattan"
    """Of the ways."""
    speeds: tuple[float, ...] = (1.0,)
    """Cells a second that a robot may have; each draws one."""
    limit: float = 128.0
    """s in which everything must be done."""

    @property
    def config(self) -> EnvConfig:
        """The grid's family with the largest team, most targets and largest map."""
        return EnvConfig(num_agents=self.agents[1], num_targets=self.targets[1],
                         width=self.sides[1], height=self.sides[1], num_skills=self.num_skills)


def draw(family: Draw, key: Array) -> MacroProblem:
    """One random problem."""
    many, pose, size, pace, team = jax.random.split(key, 5)
    count = jax.random.randint(many, (), family.targets[0], family.targets[1] + 1)
    number = jax.random.randint(team, (), family.agents[0], family.agents[1] + 1)
    side = jax.random.randint(size, (), family.sides[0], family.sides[1] + 1)
    problem, cells = sample(family.config, pose, number, count, jnp.stack([side, side]))
    speeds = jnp.asarray(family.speeds)
    speed = speeds[jax.random.randint(pace, (family.agents[1],), 0, len(family.speeds))]
    return of_grid(problem, cells, family.limit, family.metric, speed, family.num_skills)
