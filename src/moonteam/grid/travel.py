"""How far it is from cell to cell, with cells that some robot kinds cannot enter.

A move counts one and must enter a passable cell of the map. The cell an agent stands on
need not be passable: it may leave it, not come back. Legend as in `types`; F targets of a
field. On an open map (no `passable`) travel is the Manhattan distance, and the same
functions give it without a field.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from moonteam.grid.types import Problem
from moonteam.problem.rules import DISPLACEMENTS, UNREACHABLE, enterable


def distance_fields(passable: Array, targets: Array, size: Array | None = None) -> Array:
    """Travel from every cell to every target, for every kind.

    Each pass lets values run along whole rows and columns by doubling (1, 2, 4, ... cells at
    once), so that the passes needed are the turns of the longest shortest path, not its
    length. Jittable; vmap it for batches of maps.

    Args:
      passable: [K, H, W] bool, indexed [kind, y, x].
      targets: [F, 2] int32 cells (x, y).
      size: [2] int32 (W, H) of a smaller map padded to the array's size; None: all of it.

    Returns:
      [K, F, H, W] int32 moves; `UNREACHABLE` where there is no way. A target that a kind
      cannot enter is reached only by the agent that starts on it (0 there).
    """
    kinds, height, width = passable.shape
    x, y = jnp.arange(width), jnp.arange(height)
    if size is not None:
        on_map = (x[None, None, :] < size[0]) & (y[None, :, None] < size[1])
        passable = passable & on_map
    at = (x[None, None, :] == targets[:, 0, None, None]) & (
        y[None, :, None] == targets[:, 1, None, None])  # [F, H, W]
    start = jnp.where(at, 0, UNREACHABLE)[None]  # [1, F, H, W]
    field = jnp.broadcast_to(start, (kinds, targets.shape[0], height, width))
    jumps = _free_runs(passable)

    def relax(carry: tuple[Array, Array]) -> tuple[Array, Array]:
        old, _ = carry
        new = old
        for axis, shift, free in jumps:
            new = jnp.minimum(new, jnp.where(free[:, None], _shifted(new, shift, axis)
                                             + abs(shift), UNREACHABLE))
        return new, jnp.any(new != old)

    field, _ = jax.lax.while_loop(lambda c: c[1], relax, (field, jnp.array(True)))
    return field


def _free_runs(passable: Array) -> list[tuple[int, int, Array]]:
    """For each direction and power of two s: where s cells that way are all passable.

    Returns (axis, signed s, [K, H, W] bool), the axes counted in [K, F, H, W]; cell c may
    take over the value of the cell s further on when the cells c+1 .. c+s can be entered.
    """
    jumps = []
    for axis, length in ((3, passable.shape[2]), (2, passable.shape[1])):
        for sign in (1, -1):
            reach = 1
            free = _shifted(passable, sign, axis - 1)
            while reach < length:
                jumps.append((axis, sign * reach, free))
                free = free & _shifted(free, sign * reach, axis - 1)
                reach *= 2
    return jumps


def _shifted(values: Array, shift: int, axis: int) -> Array:
    """values[c + shift] at c along `axis`; beyond the edge False or UNREACHABLE."""
    length = values.shape[axis]
    edge = jnp.array(False if values.dtype == jnp.bool_ else UNREACHABLE, values.dtype)
    pads = [(0, 0, 0)] * values.ndim
    pads[axis] = (-shift, shift, 0)
    if abs(shift) >= length:
        return jnp.full_like(values, edge)
    return jax.lax.pad(values, edge, pads)


def problem_fields(problem: Problem) -> Array | None:
    """[K, M, H, W] fields of a problem's current targets; None on an open map.

    They hold until a target is replaced.
    """
    if problem.passable is None:
        return None
    return distance_fields(problem.passable, problem.target_cells, problem.size)


def distances(problem: Problem, fields: Array | None, cells: Array) -> Array:
    """[N, M] int32 moves from each agent's cell ([N, 2]) to each target.

    `fields` come from `problem_fields`; None means an open map. `UNREACHABLE` where there is
    no way. Masks are not looked at.
    """
    if fields is None:
        offset = problem.target_cells[None, :, :] - cells[:, None, :]
        return jnp.sum(jnp.abs(offset), axis=2)
    return fields[problem.agent_kinds, :, cells[:, 1], cells[:, 0]]


def first_step(problem: Problem, fields: Array | None, cells: Array) -> Array:
    """[N, M, 4] bool: the moves (up, down, left, right) that shorten each agent's way.

    All False for an agent in the target's cell, or with no way to it. Arguments as in
    `distances`.
    """
    if fields is None:
        offset = problem.target_cells[None, :, :] - cells[:, None, :]
        right, up = offset[..., 0], offset[..., 1]
        return jnp.stack([up > 0, up < 0, right < 0, right > 0], axis=2)
    here = distances(problem, fields, cells)
    moves = []
    for shift in DISPLACEMENTS[:4]:
        goal = cells + shift[None]
        free = enterable(goal, problem.agent_kinds, problem.size, problem.passable)
        shorter = distances(problem, fields, jnp.clip(goal, 0, problem.size[None] - 1)) == here - 1
        moves.append(shorter & free[:, None])
    return jnp.stack(moves, axis=2) & (here < UNREACHABLE)[:, :, None]
