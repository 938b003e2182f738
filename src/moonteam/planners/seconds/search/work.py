"""The open part of a moment as the searches by the clock take it: plain arrays for Numba.

Legend: N agents of the team, M open targets, K travel classes, S skills, E pairs of precedence.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from moonteam.planners.seconds.base import NEVER, Bools, Int64, Moment


class Work(NamedTuple):
    """What is still to do, by whom; Numba reads it as it is."""

    start: Any  # [N, M] int64 ms from each agent to each target
    between: Any  # [K, M, M] int64 ms
    home: Any  # [N, M] int64 ms from each target home
    idle_way: Any  # [N] int64 ms home of an agent that serves nothing
    classes: Any  # [N] int64 index into `between`
    has: Any  # [N, S] bool
    need: Any  # [M, S] int64
    either: Any  # [M] bool
    service: Any  # [M] int64 ms
    ready: Any  # [M] int64 ms: it has appeared, and all before it that is under way has ended
    late: Any  # [M] int64 ms: the latest start
    first_before: Any  # [M + 1] int64: the targets before j are before[first[j]:first[j + 1]]
    before: Any  # [E] int64 open targets
    first_then: Any  # [M + 1] int64: as `before`, of the targets that wait for j
    then: Any  # [E] int64
    free: Any  # [N] int64 ms
    effort: Any  # [N] float64 cost of a ms of travel
    kind: Any  # [N] int64: agents of a kind have the same skills
    first_able: Any  # [S + 1] int64: agents with skill s are able[first[s]:first[s + 1]]
    able: Any  # int64
    first_need: Any  # [M + 1] int64: as `able`, skills that target j needs
    needed: Any  # int64
    single: bool  # no agent has two skills, and no target can do with either of two
    floor: int  # ms: what is under way has ended
    limit: int  # ms


@dataclass(frozen=True)
class Open:
    """The work, and whose numbers in the moment its rows and columns are."""

    work: Work
    agents: Int64  # [N]
    targets: Int64  # [M]
    reason: str  # why it can never be done, found before any search; else empty


def compact(now: Moment) -> Open:
    """The agents of the team and the open targets, contiguous."""
    agents = np.flatnonzero(now.present)
    targets = np.flatnonzero(~now.solved)
    after = now.after[np.ix_(targets, targets)]
    ready = np.maximum(now.appears, np.where(now.after & now.solved, now.ends, 0).max(
        axis=1, initial=0))[targets]
    first_before, before = _pairs(after)
    first_then, then = _pairs(after.T)
    home = now.home[np.ix_(agents, targets)]
    has, need = now.has[agents], now.need[targets]
    first_able, able = _pairs(has.T)
    first_need, needed = _pairs(need > 0)
    work = Work(
        start=np.ascontiguousarray(now.start[np.ix_(agents, targets)]),
        between=np.ascontiguousarray(now.between[:, targets][:, :, targets]),
        home=np.ascontiguousarray(home), idle_way=now.home_now[agents].copy(),
        classes=now.classes[agents].copy(), has=np.ascontiguousarray(has),
        need=np.ascontiguousarray(need), either=now.either[targets].copy(),
        service=now.service[targets].copy(), ready=ready,
        late=np.minimum(now.lapses[targets], now.limit - now.service[targets]),
        first_before=first_before, before=before, first_then=first_then, then=then,
        free=now.free[agents].copy(), effort=now.effort[agents].astype(np.float64),
        kind=np.unique(has, axis=0, return_inverse=True)[1].reshape(-1).astype(np.int64),
        first_able=first_able, able=able, first_need=first_need, needed=needed,
        single=bool((has.sum(axis=1) <= 1).all() and not now.either[targets].any()),
        floor=int(now.ends.max(initial=0)), limit=int(now.limit))
    return Open(work, agents, targets, _hopeless(work, after, targets))


def _pairs(after: Bools) -> tuple[Int64, Int64]:
    """Rows of a relation [M, M], one behind the other."""
    first = np.concatenate([[0], np.cumsum(after.sum(axis=1))]).astype(np.int64)
    return first, np.nonzero(after)[1].astype(np.int64)


def _hopeless(work: Work, after: Bools, targets: Int64) -> str:
    """Why there is no plan, where one look says so; empty where it does not."""
    if work.floor > work.limit:
        return f"what is under way ends at {work.floor} ms, after the limit of {work.limit} ms"
    left = np.ones(len(targets), bool)
    while (free := left & ~(after & left).any(axis=1)).any():
        left &= ~free
    if left.any():
        return f"targets {targets[left].tolist()} wait for each other"
    if not len(targets):
        return ""
    nearest = np.minimum(work.start, _nearest(work))
    able = work.has[:, None, :] & (nearest < NEVER)[:, :, None]  # [N, M, S]
    have, wanted = able.sum(0), work.need
    for j, name in enumerate(targets.tolist()):
        short = np.flatnonzero(have[j] < wanted[j])
        if work.either[j] and not ((wanted[j] > 0) & (have[j] > 0)).any():
            return f"target {name}: nobody in the team that can reach it has a skill that it needs"
        if not work.either[j] and len(short):
            skill = int(short[0])
            return (f"target {name}: needs {wanted[j, skill]} agents with skill {skill}; the team "
                    f"has {have[j, skill]} that can reach it")
    return ""


def _nearest(work: Work) -> Int64:
    """[N, M] ms of the shortest last leg to each target from another one: finite where a way is."""
    count = work.start.shape[1]
    apart = work.between + np.where(np.eye(count, dtype=bool), NEVER, 0)
    return apart.min(axis=1, initial=NEVER)[work.classes]


def places(work: Work) -> int:
    """Agents of the largest team that is chosen one by one."""
    wanted = np.where(work.either, 1, work.need.sum(1))
    return int(min(len(work.free), wanted.max(initial=1)))


def horizon(work: Work) -> int:
    """ms by which any plan that wastes no time is done."""
    legs = work.between[work.between < NEVER]
    starts, homes = work.start[work.start < NEVER], work.home[work.home < NEVER]
    idle = work.idle_way[work.idle_way < NEVER]
    longest = max(int(x.max(initial=0)) for x in (legs, starts))
    most = (int(work.service.sum()) + len(work.service) * longest
            + int(work.free.max(initial=0)) + int(work.ready.max(initial=0))
            + max(int(homes.max(initial=0)), int(idle.max(initial=0))) + work.floor)
    return min(work.limit, most)
