"""Scenario files to arrays and back, batches of unlike problems, and random scenarios.

NumPy on the host; only `to_problem` and `stack` hand over JAX arrays. Legend as in `types`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array

from moonteam.errors import InputError
from moonteam.grid.config import EnvConfig
from moonteam.grid.types import Buffer, Problem
from moonteam.problem.scenario import Agent, Scenario, Target

LETTERS = "ABCDEFGH"
OPEN = "*"  # the kind of agents that name none; in `blocked`, every kind
TRIES = 10_000  # draws of one scenario before its numbers are called impossible


def config_for(scenario: Scenario, config: EnvConfig | None = None,
               num_buffer: int = 0) -> EnvConfig:
    """`config` with a scenario's sizes and horizon; weights and flags are kept."""
    return replace(
        config or EnvConfig(), num_agents=len(scenario.agents),
        num_targets=len(scenario.targets) - num_buffer, num_buffer=num_buffer,
        width=scenario.size[0], height=scenario.size[1], max_steps=scenario.max_steps)


def to_problem(scenario: Scenario, num_buffer: int = 0) -> tuple[Problem, Array]:
    """The arrays of a scenario, and its agents' cells [N, 2].

    Args:
      scenario: checked, see `moonteam.problem.scenario.load`.
      num_buffer: the last so many targets are the buffer of a replanning episode.

    Raises:
      InputError: if `num_buffer` leaves no target.
    """
    if not 0 <= num_buffer < len(scenario.targets):
        raise InputError("num_buffer", f"{num_buffer} is not in 0..{len(scenario.targets) - 1}, "
                         "the scenario's number of targets less one")
    kinds, passable = _passable(scenario)
    shown = len(scenario.targets) - num_buffer
    cells = np.array([t.at for t in scenario.targets], np.int32)
    skills = np.array([scenario.mask(t.skills) for t in scenario.targets], np.int32)
    both = np.array([t.type == "AND" and len(set(t.skills)) > 1 for t in scenario.targets])
    buffer = None
    if num_buffer:
        buffer = Buffer(jnp.asarray(cells[shown:]), jnp.asarray(skills[shown:]),
                        jnp.asarray(both[shown:]), jnp.asarray(np.zeros((), np.int32)))
    problem = Problem(
        size=jnp.array(scenario.size, jnp.int32),
        agent_skills=jnp.array([scenario.mask(a.skills) for a in scenario.agents], jnp.int32),
        agent_kinds=jnp.asarray(kinds),
        agent_mask=jnp.asarray(np.ones(len(kinds), bool)),
        target_cells=jnp.asarray(cells[:shown]),
        target_skills=jnp.asarray(skills[:shown]),
        target_and=jnp.asarray(both[:shown]),
        target_mask=jnp.asarray(np.ones(shown, bool)),
        passable=None if passable is None else jnp.asarray(passable),
        buffer=buffer)
    return problem, jnp.array([a.at for a in scenario.agents], jnp.int32)


def _passable(scenario: Scenario) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.bool_] | None]:
    """Each agent's kind index [N], kinds in sorted order, and [K, H, W]; None on an open map."""
    kinds = sorted({a.kind or OPEN for a in scenario.agents})
    index = np.array([kinds.index(a.kind or OPEN) for a in scenario.agents], np.int32)
    if not scenario.blocked:
        return index, None
    passable = np.ones((len(kinds), scenario.size[1], scenario.size[0]), bool)
    for k, kind in enumerate(kinds):
        closed = {*scenario.blocked.get(OPEN, ()), *scenario.blocked.get(kind, ())}
        for x, y in closed:
            passable[k, y, x] = False
    return index, passable


def to_scenario(problem: Problem, cells: Array, *, name: str = "", max_steps: int = 128,
                kinds: Sequence[str] | None = None) -> Scenario:
    """One (unbatched) problem as a scenario; padding is left out, buffered targets come last.

    Args:
      problem: as from `sample` or `to_problem`; skills become letters, A=1, B=2.
      cells: [N, 2] the agents' cells.
      name: the scenario's id.
      max_steps: T_max.
      kinds: names of the kinds [K], needed where the map has blocked cells.

    Raises:
      InputError: if the map has blocked cells and `kinds` does not name all kinds.
    """
    p = jax.tree.map(np.asarray, problem)
    if p.passable is not None and (kinds is None or len(kinds) != p.passable.shape[0]):
        raise InputError("kinds", f"{p.passable.shape[0]} names are needed, one a kind")
    agents = [
        Agent(at=_cell(at), skills=_letters(skills), kind=kinds[int(k)] if kinds else None)
        for at, skills, k, real in zip(np.asarray(cells), p.agent_skills, p.agent_kinds,
                                       p.agent_mask, strict=True) if real]
    rows = [row[:3] for row in zip(p.target_cells, p.target_skills, p.target_and, p.target_mask,
                                   strict=True) if row[3]]
    if p.buffer is not None:
        rows += zip(p.buffer.cells, p.buffer.skills, p.buffer.both, strict=True)
    targets = [Target(_cell(at), _letters(s), "AND" if both else "OR") for at, s, both in rows]
    blocked = None
    if p.passable is not None and kinds:
        width, height = (int(v) for v in p.size)
        blocked = {kind: _cells_where(~p.passable[k, :height, :width])
                   for k, kind in enumerate(kinds)}
    return Scenario(size=(int(p.size[0]), int(p.size[1])), agents=tuple(agents),
                    targets=tuple(targets), id=name, max_steps=max_steps, blocked=blocked)


def _cell(at: npt.NDArray[np.int32]) -> tuple[int, int]:
    return int(at[0]), int(at[1])


def _letters(mask: int) -> tuple[str, ...]:
    return tuple(s for bit, s in enumerate(LETTERS) if mask >> bit & 1)


def _cells_where(closed: npt.NDArray[np.bool_]) -> tuple[tuple[int, int], ...]:
    """(x, y) cells of a map [H, W]."""
    return tuple((int(x), int(y)) for y, x in np.argwhere(closed))


def stack(problems: Sequence[tuple[Problem, Array]]) -> tuple[Problem, Array]:
    """Pads problems to one shape and stacks them along a new first axis, for vmap.

    Where one of them has blocked cells, all get passable maps. Buffers must be of one length.

    Returns:
      The batch, and the agents' cells [batch, N, 2].

    Raises:
      InputError: if there are none, or their buffers differ in length.
    """
    if not problems:
        raise InputError("stack", "at least one problem is needed")
    lengths = {p.buffer.skills.shape[0] if p.buffer else 0 for p, _ in problems}
    if len(lengths) > 1:
        raise InputError("stack", f"buffers of different lengths: {sorted(lengths)}")
    n = max(p.agent_mask.shape[0] for p, _ in problems)
    m = max(p.target_mask.shape[0] for p, _ in problems)
    maps = [p.passable.shape for p, _ in problems if p.passable is not None]
    kinds = max(int(np.max(p.agent_kinds)) + 1 for p, _ in problems)
    sizes = [np.asarray(p.size) for p, _ in problems]
    shape = None
    if maps:
        sides = [(max(int(s[1]) for s in sizes), max(int(s[0]) for s in sizes))]
        shape = tuple(map(max, zip(*maps, (kinds, *sides[0]), strict=True)))
    padded = [_pad(p, cells, n, m, shape) for p, cells in problems]
    return jax.tree.map(lambda *rows: jnp.asarray(np.stack(rows)), *padded)


def _pad(problem: Problem, cells: Array, num_agents: int, num_targets: int,
         shape: tuple[int, ...] | None) -> tuple[Problem, Array]:
    """The problem with arrays of N agents, M targets and a map of `shape` [K, H, W]."""

    def to(values: Array, length: int) -> Array:
        rows = np.asarray(values)
        return jnp.asarray(
            np.pad(rows, [(0, length - rows.shape[0]), *[(0, 0)] * (rows.ndim - 1)]))

    passable = None
    if shape is not None:
        whole = np.ones(shape, bool)
        if problem.passable is not None:
            k, h, w = problem.passable.shape
            whole[:k, :h, :w] = np.asarray(problem.passable)
        passable = jnp.asarray(whole)
    return replace(
        problem,
        agent_skills=to(problem.agent_skills, num_agents),
        agent_kinds=to(problem.agent_kinds, num_agents),
        agent_mask=to(problem.agent_mask, num_agents),
        target_cells=to(problem.target_cells, num_targets),
        target_skills=to(problem.target_skills, num_targets),
        target_and=to(problem.target_and, num_targets),
        target_mask=to(problem.target_mask, num_targets),
        passable=passable), to(cells, num_agents)


def generate(seed: int | np.random.Generator, *, num_agents: int = 3, num_targets: int = 5,
             num_skills: int = 2, size: tuple[int, int] = (32, 32), max_steps: int = 128,
             blocked: Mapping[str, float] | None = None, kinds: Sequence[str] | None = None,
             name: str = "") -> Scenario:
    """A random scenario with the distribution of `sampling`, drawn independently of it.

    With `blocked`, one smooth random roughness covers the map and each kind cannot enter the
    given share of it, the roughest cells: what stops one kind also stops every kind with a
    larger share. Agents then start on cells they may enter, and each target lies on a cell
    where the team can solve it (the agents that have a way there bring the skills), so that
    every scenario is solvable.

    Args:
      seed: an integer, or a generator that is drawn from.
      num_agents: N.
      num_targets: M.
      num_skills: skills in the family, named A, B, ...
      size: (W, H) cells.
      max_steps: T_max.
      blocked: share of the map, 0 to 1, that each kind cannot enter; None: an open map.
      kinds: each agent's kind [N]; None: drawn from the keys of `blocked`, or no kind at all.
      name: the scenario's id.

    Raises:
      InputError: if numbers are out of range, or no solvable scenario was found.
    """
    rng = np.random.default_rng(seed)
    _check_numbers(num_agents, num_targets, num_skills, size, blocked, kinds)
    for _ in range(TRIES):
        skills = rng.integers(1, 2**num_skills, num_agents)
        needs = rng.integers(1, 2**num_skills, num_targets)
        team = int(np.bitwise_or.reduce(skills))
        if np.any(needs & ~team):
            continue
        both = (rng.random(num_targets) < 0.5) & ((needs & (needs - 1)) != 0)
        types: list[Literal["AND", "OR"]] = ["AND" if b else "OR" for b in both]
        named = kinds or (tuple(rng.choice(sorted(blocked), num_agents)) if blocked else None)
        rough = _roughness(rng, size) if blocked else None
        closed = {k: rough >= 1.0 - share for k, share in blocked.items()} \
            if blocked and rough is not None else None
        places = _place_open(rng, size, num_agents, num_targets) if not closed or not named \
            else _place_blocked(rng, closed, named, skills, needs, both)
        if places is None:
            continue
        starts, goals = places
        return Scenario(
            size=(int(size[0]), int(size[1])), id=name, max_steps=max_steps,
            agents=tuple(Agent(at, _letters(int(s)), str(named[i]) if named else None)
                         for i, (at, s) in enumerate(zip(starts, skills, strict=True))),
            targets=tuple(Target(at, _letters(int(s)), t)
                          for at, s, t in zip(goals, needs, types, strict=True)),
            blocked={k: _cells_where(c) for k, c in closed.items()} if closed else None)
    raise InputError("generate", f"no solvable scenario in {TRIES} draws; ask for fewer "
                     "targets, a larger map or less blocked ground")


Places = tuple[list[tuple[int, int]], list[tuple[int, int]]]


def _check_numbers(num_agents: int, num_targets: int, num_skills: int, size: tuple[int, int],
                   blocked: Mapping[str, float] | None, kinds: Sequence[str] | None) -> None:
    EnvConfig(num_agents=num_agents, num_targets=num_targets, num_skills=num_skills,
              width=size[0], height=size[1])
    if num_targets >= size[0] * size[1]:
        raise InputError("num_targets", f"{num_targets} targets leave no free cell on a map of "
                         f"{size[0]} x {size[1]}")
    for kind, share in (blocked or {}).items():
        if not 0.0 <= share < 1.0:
            raise InputError("blocked", f"{share} is not in [0, 1)", kind)
    if kinds is not None and len(kinds) != num_agents:
        raise InputError("kinds", f"{len(kinds)} kinds for {num_agents} agents")
    if blocked and kinds is not None and not set(kinds) <= set(blocked):
        raise InputError("kinds", "every kind needs its share in `blocked` (0 for none)")


def _place_open(rng: np.random.Generator, size: tuple[int, int], num_agents: int,
                num_targets: int) -> Places:
    """Distinct targets, agents anywhere else."""
    order = rng.permutation(size[0] * size[1])
    targets, free = order[:num_targets], order[num_targets:]
    agents = rng.choice(free, num_agents)
    width = size[0]
    return ([(int(c) % width, int(c) // width) for c in agents],
            [(int(c) % width, int(c) // width) for c in targets])


def _place_blocked(rng: np.random.Generator, closed: Mapping[str, npt.NDArray[np.bool_]],
                   kinds: Sequence[str], skills: npt.NDArray[np.int64],
                   needs: npt.NDArray[np.int64], both: npt.NDArray[np.bool_]) -> Places | None:
    """Agents on cells they may enter, targets where the team can solve them; None if nowhere."""
    starts = []
    brought = np.zeros(next(iter(closed.values())).shape, np.int64)  # [H, W] skills that can come
    for kind, skill in zip(kinds, skills, strict=True):
        free = np.argwhere(~closed[kind])
        if not len(free):
            return None
        y, x = free[rng.integers(len(free))]
        starts.append((int(x), int(y)))
        brought |= np.where(reachable(~closed[kind], (int(x), int(y))), skill, 0)
    taken = np.zeros(brought.shape, bool)
    for x, y in starts:
        taken[y, x] = True
    goals = []
    for need, every in zip(needs, both, strict=True):
        met = (brought & need) == need if every else (brought & need) != 0
        free = np.argwhere(met & ~taken)
        if not len(free):
            return None
        y, x = free[rng.integers(len(free))]
        taken[y, x] = True
        goals.append((int(x), int(y)))
    return starts, goals


def reachable(passable: npt.NDArray[np.bool_], start: tuple[int, int]) -> npt.NDArray[np.bool_]:
    """[H, W] cells with a way from `start` (x, y), itself included, on a map [H, W]."""
    seen = np.zeros(passable.shape, bool)
    seen[start[1], start[0]] = True
    while True:
        grown = seen.copy()
        grown[1:] |= seen[:-1]
        grown[:-1] |= seen[1:]
        grown[:, 1:] |= seen[:, :-1]
        grown[:, :-1] |= seen[:, 1:]
        grown = seen | (grown & passable)
        if np.array_equal(grown, seen):
            return seen
        seen = grown


def _roughness(rng: np.random.Generator, size: tuple[int, int]) -> npt.NDArray[np.float64]:
    """[H, W] smooth noise as ranks in [0, 1): the share of cells that are smoother."""
    noise = rng.standard_normal((size[1], size[0]))
    for axis in (0, 1, 0, 1):
        padded = np.pad(noise, [(1, 1) if a == axis else (0, 0) for a in (0, 1)], mode="edge")
        noise = padded.take(range(noise.shape[axis]), axis) + noise + padded.take(
            range(2, noise.shape[axis] + 2), axis)
    ranks = np.empty(noise.size)
    ranks[np.argsort(noise, axis=None)] = np.arange(noise.size) / noise.size
    return ranks.reshape(noise.shape)
