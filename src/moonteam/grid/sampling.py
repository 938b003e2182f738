"""Random problems, drawn exactly and without rejection.

The distribution: target cells distinct; agents anywhere but on a target; every skill set
uniform over the non-empty subsets, all of it redrawn until the team covers every required
skill; type uniform for targets with two or more skills, OR for the others. "Redrawn until"
means the uniform distribution over the valid draws, and that is sampled directly:

1. the team's union U of skills, with probability proportional to the number of valid draws
   that have it: (ways in which N subsets have union U) * (2^|U| - 1)^M;
2. the agents' sets one after the other, each weighted by the number of ways in which the
   agents that follow can complete U;
3. the targets' sets, independent and uniform over the non-empty subsets of U;
4. cells by ranks among the cells still free (a Lehmer code), so that they are distinct.

Rounding is that of float32 weights and of 32-bit draws taken modulo the number of choices
(relative error below 3e-7 on a map of 32 x 32). Counts may be traced, for batches of mixed
sizes. Legend as in `types`; S skills, U a bitmask.
"""

from __future__ import annotations

from functools import lru_cache
from math import comb

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from moonteam.errors import InputError
from moonteam.grid.config import EnvConfig
from moonteam.grid.types import Buffer, Problem

Count = int | Array


@lru_cache(maxsize=32)
def _cover_tables(num_agents: int, num_skills: int) -> tuple[np.ndarray, np.ndarray]:
    """Probabilities of covering, by inclusion and exclusion in whole numbers.

    Returns:
      cover: [N + 1, S + 1, S + 1] float32, indexed [r, m, u]: the probability that r uniform
        non-empty subsets of u skills together hold m given ones.
      log_ways: [N + 1, S + 1] float32, indexed [n, u]: log of the number of n-tuples of
        non-empty subsets whose union is exactly u given skills.
    """
    cover = np.zeros((num_agents + 1, num_skills + 1, num_skills + 1), np.float32)
    log_ways = np.full((num_agents + 1, num_skills + 1), -np.inf, np.float32)
    for u in range(1, num_skills + 1):
        for r in range(num_agents + 1):
            for m in range(u + 1):
                ways = sum((-1) ** j * comb(m, j) * (2 ** (u - j) - 1) ** r for j in range(m + 1))
                cover[r, m, u] = ways / (2**u - 1) ** r
                if m == u and ways:
                    log_ways[r, u] = np.log(float(ways))
    return cover, log_ways


def sample(config: EnvConfig, key: Array, num_agents: Count | None = None,
           num_targets: Count | None = None, size: Array | None = None) -> tuple[Problem, Array]:
    """One random problem on an open map, and the agents' cells.

    Args:
      config: N, M, B, skills and map; the arrays have these sizes.
      key: JAX key.
      num_agents: real agents, at most N (may be traced); the rest is padding. Default N.
      num_targets: real targets, at most M (may be traced). Default M.
      size: [2] int32 cells, the map (may be traced). Default the config's.

    Returns:
      The problem, and cells [N, 2] int32. Padded entries hold zeros.

    Raises:
      InputError: if the config's map is too small for its targets and one agent.
    """
    if size is None and config.num_targets + config.num_buffer >= config.num_cells:
        raise InputError("num_targets", f"{config.num_targets + config.num_buffer} targets leave "
                         f"no free cell on a map of {config.width} x {config.height}")
    n, m, b = config.num_agents, config.num_targets, config.num_buffer
    real_agents = n if num_agents is None else num_agents
    real_targets = m if num_targets is None else num_targets
    area = jnp.array([config.width, config.height], jnp.int32) if size is None else size
    picks = m + b
    draws = jax.random.bits(key, (3 * picks + 2 * n + 1,), jnp.uint32)
    ends = np.cumsum([picks + n, n + 1, picks, picks])
    place, team, need, kind = (draws[a:z] for a, z in zip([0, *ends[:3]], ends, strict=True))
    agent_mask = jnp.arange(n) < real_agents
    target_mask = jnp.arange(m) < real_targets
    asked = jnp.concatenate([target_mask, jnp.ones(b, bool)])
    cells = _cells(place, area, asked, m, n)
    agent_skills, union = _team(team, config.num_skills, real_agents, n,
                                real_targets + b)
    skills = jnp.where(asked, _subsets(need, union, config.num_skills), 0)
    both = (jax.lax.population_count(skills) >= 2) & (kind >> 31 == 1)
    buffer = None
    if b:
        buffer = Buffer(cells[m:picks], skills[m:], both[m:], jnp.zeros((), jnp.int32))
    problem = Problem(
        size=area,
        agent_skills=jnp.where(agent_mask, agent_skills, 0),
        agent_kinds=jnp.zeros(n, jnp.int32),
        agent_mask=agent_mask,
        target_cells=jnp.where(target_mask[:, None], cells[:m], 0),
        target_skills=skills[:m],
        target_and=both[:m],
        target_mask=target_mask,
        buffer=buffer)
    return problem, jnp.where(agent_mask[:, None], cells[picks:], 0)


def _cells(draws: Array, size: Array, asked: Array, num_targets: int, num_agents: int) -> Array:
    """[P + N, 2] cells: P distinct ones for targets and buffer, then N for the agents.

    Agents avoid the first `num_targets` picks only: the buffer appears later. A rank among
    the free cells becomes a cell by undoing the picks before it, the latest first.
    """
    picks = asked.shape[0]
    real = asked.astype(jnp.int32)
    before = jnp.cumsum(real) - real
    taken = jnp.concatenate([before, jnp.full(num_agents, jnp.sum(real[:num_targets]))])
    free = (size[0] * size[1] - taken).astype(jnp.uint32)
    ranks = (draws % free).astype(jnp.int32)
    index = jnp.arange(picks + num_agents)
    agent = index >= picks
    values = ranks
    for i in reversed(range(picks)):
        later = agent if i < num_targets else jnp.zeros_like(agent)
        later = (later | ((index > i) & ~agent)) & asked[i]
        values = values + (later & (values >= ranks[i]))
    return jnp.stack([values % size[0], values // size[0]], axis=1)


def _team(draws: Array, num_skills: int, real_agents: Count, num_agents: int,
          num_targets: Count) -> tuple[Array, Array]:
    """Agents' skills [N] and their union [], given that the union covers all targets."""
    cover, log_ways = (jnp.asarray(t) for t in _cover_tables(num_agents, num_skills))
    subsets = jnp.arange(1, 2**num_skills, dtype=jnp.int32)  # [2^S - 1]
    sizes = jax.lax.population_count(subsets)
    choices = jnp.log(jnp.asarray([1.0, *(2.0**u - 1 for u in range(1, num_skills + 1))]))
    logits = log_ways[real_agents][sizes] + num_targets * choices[sizes]
    union = subsets[_pick(jnp.exp(logits - jnp.max(logits)), draws[0])]
    inside = (subsets & ~union) == 0
    full = jax.lax.population_count(union)
    covered = jnp.zeros((), jnp.int32)
    skills = []
    for i in range(num_agents):
        left = jnp.maximum(real_agents - 1 - i, 0)
        missing = jax.lax.population_count(union & ~(covered | subsets))
        weight = jnp.where(inside, cover[left, missing, full], 0.0)
        skill = subsets[_pick(weight, draws[i + 1])]
        covered = covered | skill
        skills.append(skill)
    return jnp.stack(skills), union


def _pick(weights: Array, draw: Array) -> Array:
    """Index [] drawn with probability proportional to `weights` [C], which may hold zeros."""
    total = jnp.cumsum(weights)
    uniform = (draw >> 8).astype(jnp.float32) * 2.0**-24  # [0, 1)
    index = jnp.sum(total <= uniform * total[-1])
    return jnp.minimum(index, weights.shape[0] - 1)


def _subsets(draws: Array, union: Array, num_skills: int) -> Array:
    """[P] int32 uniform non-empty subsets of `union`: bits of 1..2^|U|-1 dealt out to it."""
    count = (1 << jax.lax.population_count(union)) - 1
    number = 1 + (draws % count.astype(jnp.uint32)).astype(jnp.int32)
    result = jnp.zeros_like(number)
    rank = jnp.zeros((), jnp.int32)
    for bit in range(num_skills):
        has = (union >> bit) & 1
        result = result | (((number >> rank) & has) << bit)
        rank = rank + has
    return result
