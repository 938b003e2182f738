"""The macro world's data.

Legend of shapes: N agents, M targets, S skills; any leading batch axes come from vmap. Times are
float32 seconds (or whatever unit the tables are in). Arrays may be padded: `agent_mask` and
`target_mask` are True where an entry is real.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
from jax import Array

from moonteam.grid.macro.sight import Sight
from moonteam.grid.macro.streets import Streets

FAR = 1.0e9
"""s that stand for "no way" and "no limit"."""

LONG = 16.0
"""Units of time above which it makes no difference to an observer how long."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MacroProblem:
    """What does not change within an episode; the same as `planners.seconds.base.Moment` says."""

    start: Array  # [N, M] s from where each agent starts to each target; FAR: no way
    between: Array  # [N, M, M] s from target to target, by each agent
    home: Array  # [N, M] s from each target to the agent's home; 0 where it has none
    home_now: Array  # [N] s from where the agent starts to its home; 0 where it has none
    has: Array  # [N, S] bool
    need: Array  # [M, S] int32 agents wanted of each skill
    either: Array  # [M] bool, OR: one agent with any of the skills that are needed
    service: Array  # [M] s that a coalition stays
    after: Array  # [M, M] bool, after[j, k]: j starts when k has ended
    appears: Array  # [M] s before which j does not start
    shown: Array  # [M] s before which nobody knows of j
    following: Array  # [M] int32, targets that are solved before anybody knows of j
    looks: Array  # [M] bool, of use while targets come: places to look from, or to wait at (posts)
    unseen: Array  # [M] share of the ground looked at from there that nobody has seen
    coming: Array  # [] int32, targets still to be known of that have no entry here
    middle: Array  # [M] s from j to where targets may come, in the mean; 0 where nobody can say
    middle_now: Array  # [N] the same from where each agent starts
    lapses: Array  # [M] s after which j does not start; FAR where it does not lapse
    worth: Array  # [M] what serving it counts, of one that may lapse; 0: it has to be served
    free: Array  # [N] s at which each agent can first set out
    lost: Array  # [N] s at which each agent is lost, which nobody knows before; FAR: never
    effort: Array  # [N] what a second of travel costs each agent
    limit: Array  # [] s in which everything must be done
    agent_mask: Array  # [N] bool
    target_mask: Array  # [M] bool
    unit: Array  # [] s by which times are divided where numbers of order one are wanted
    streets: Streets | None = None
    """Where ways are along x and then y, and nothing bars them: places, for those who turn."""
    sight: Sight | None = None
    """Where targets are hidden: places, what robots see and have seen; then ways are straight."""


def plain(start: Any, between: Any, has: Any, need: Any, either: Any, *, limit: Any,
          agent_mask: Any, target_mask: Any, unit: Any) -> MacroProblem:
    """A problem of travel and coalitions alone, of NumPy's arrays or JAX's."""
    xp = start.__array_namespace__()
    agents, targets = start.shape
    nobody, none = xp.zeros(agents, xp.float32), xp.zeros(targets, xp.float32)
    return MacroProblem(
        start=start, between=between, home=xp.zeros((agents, targets), xp.float32),
        home_now=nobody, has=has, need=need, either=either, service=none,
        after=xp.zeros((targets, targets), bool), appears=none, shown=none,
        following=xp.zeros(targets, xp.int32), looks=xp.zeros(targets, bool), unseen=none,
        coming=xp.zeros((), xp.int32), middle=none, middle_now=nobody,
        lapses=none + xp.float32(FAR), worth=none, free=nobody, lost=nobody + xp.float32(FAR),
        effort=nobody + 1, limit=limit,
        agent_mask=agent_mask, target_mask=target_mask, unit=unit)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MacroState:
    """A moment at which somebody has to decide, or the end.

    An agent is free (`goal` is M), or bound to a target: on its way, waiting there, or serving.
    """

    problem: MacroProblem
    now: Array  # [] s
    node: Array  # [N] int32, the target where it is or will be when next free; M: its start
    origin: Array  # [N] int32, where its last way began: a target, or M: its start
    leg: Array  # [N] s, of its last way
    goal: Array  # [N] int32, the target it is bound to; M: none
    busy: Array  # [N] s until it arrives at its goal, its service ends, or it can first set out
    serving: Array  # [M] bool
    solved: Array  # [M] bool; padded targets, and those that have lapsed, count as solved
    lapsed: Array  # [M] bool, those that it had been worth something to serve
    since: Array  # [N] s, when it last became free
    travelled: Array  # [N] s
    served: Array  # [M] s at which each service started; 0 before


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MacroResult:
    """What one joint choice brings about."""

    state: MacroState
    seconds: Array  # [] s that passed; at the end, until everybody with a home is there too
    effort: Array  # [] weighted s of travel set out on, at the end with the ways home
    missed: Array  # [] worth of the targets that lapsed
    terminated: Array  # [] bool, every target is solved or has lapsed, whatever has been looked at
    truncated: Array  # [] bool, the limit was passed, or nothing can happen any more
