"""An exported pointing policy on board, in NumPy alone: no JAX, nothing else of moonteam.

    session = onnxruntime.InferenceSession("team.onnx")
    now = moment(ways=ways, between=between, has=has, need=need)   # s; more: see `moment`
    logits = session.run(["logits"], inputs(now))[0][0]
    choice = choose(now, logits)            # of each robot a target, M: wait

What it sees is a moment of a mission by the clock. A choice is held until something happens: a
robot arrives, a service ends, a target appears. Then everybody makes a moment anew, with those on
their way bound to their `goal`, or let loose by `loosen` where they may turn; all robots compute
the same, and each takes its own row. On a map of cells, `onboard.steps_from` gives the ways.

This file can be copied beside the exported one. Legend: N robots, M targets, S skills; times are
seconds from now, in float32, of any unit that is the same for all.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

FAR = np.float32(1.0e9)
"""s that stand for "no way" and "no limit"."""

LONG = np.float32(16.0)
"""Units of time above which it makes no difference how long."""

SOON = np.float32(5e-4)
"""s below which two events are one."""

Bools = npt.NDArray[np.bool_]
Floats = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int32]


@dataclass(frozen=True)
class Moment:
    """What a robot knows of a mission at one moment; made by `moment`."""

    ways: Floats  # [N, M] s from where each robot is, or will be when free, to each target
    start: Floats  # [N, M] s the same, from where it began, or last turned; FAR: no way at all
    between: Floats  # [N, M, M] s from target to target, by each robot
    home: Floats  # [N, M] s from each target to the robot's home; 0 where it has none
    has: Bools  # [N, S]
    need: Ints  # [M, S] robots wanted of each skill
    either: Bools  # [M] one robot with any of the skills that are needed will do
    goal: Ints  # [N] the target it is bound to; M: none
    busy: Floats  # [N] s until it arrives at its goal, its service ends, or it can first set out
    serving: Bools  # [M]
    solved: Bools  # [M]
    known: Bools  # [M] it has been shown
    service: Floats  # [M] s that a coalition stays
    after: Bools  # [M, M] after[j, k]: j starts when k has ended
    appears: Floats  # [M] s before which it does not start
    lapses: Floats  # [M] s after which it does not start; FAR: never
    team: Bools  # [N] False for a lost robot
    unit: np.float32  # s, by which times are divided; the same all through a mission
    preference: np.float32  # 0 time .. 1 effort


def moment(ways: Any, between: Any, has: Any, need: Any, *, goal: Any = None, busy: Any = None,
           solved: Any = None, serving: Any = None, either: Any = None, known: Any = None,
           service: Any = None, after: Any = None, appears: Any = None, lapses: Any = None,
           home: Any = None, team: Any = None, start: Any = None, unit: float | None = None,
           preference: float = 0.0) -> Moment:
    """A moment, with what is not given as in a mission of travel alone that begins now.

    Args:
      ways: [N, M] s from where each robot is (of one that is bound: from its goal) to each target;
        FAR or more where there is no way.
      between: [N, M, M] s from target to target by each robot, or [M, M] where all are alike.
      has: [N, S] bool.
      need: [M, S] robots wanted of each skill.
      goal: [N] the target that each is bound to: on its way, waiting there or serving; M: none.
      busy: [N] s until it arrives, its service ends, or it can first set out.
      solved: [M] bool.
      serving: [M] bool.
      either: [M] bool, one robot with any of the skills that are needed will do.
      known: [M] bool, others nobody knows of.
      service: [M] s that a coalition stays.
      after: [M, M] bool, after[j, k]: j starts when k has ended.
      appears: [M] s before which it does not start.
      lapses: [M] s after which it does not start.
      home: [N, M] s from each target to the robot's home.
      team: [N] bool, False for a lost robot.
      start: [N, M] s from where each robot began, or last turned; as `ways` if not given.
      unit: s, `unit_of` at the mission's beginning; of this moment if not given.
      preference: 0 time .. 1 effort.
    """
    ways, needs = np.minimum(np.asarray(ways, np.float32), FAR), np.asarray(need, np.int32)
    robots, targets = ways.shape
    skills, members = np.asarray(has, bool), _bools(team, robots, True)
    skills = skills & members[:, None]
    between = np.minimum(np.asarray(between, np.float32), FAR)
    began, done = _floats(start, (robots, targets), ways), _bools(solved, targets, False)
    if unit is None:
        unit = float(unit_of(ways, skills, np.where(done[:, None], 0, needs)))
    return Moment(
        ways, began, np.broadcast_to(between, (robots, targets, targets)),
        _floats(home, (robots, targets), 0.0), skills, needs, _bools(either, targets, False),
        np.full(robots, targets, np.int32) if goal is None else np.asarray(goal, np.int32),
        _floats(busy, (robots,), 0.0), _bools(serving, targets, False),
        done, _bools(known, targets, True),
        _floats(service, (targets,), 0.0),
        np.zeros((targets, targets), bool) if after is None else np.asarray(after, bool),
        _floats(appears, (targets,), 0.0), _floats(lapses, (targets,), FAR), members,
        np.float32(unit), np.float32(preference))


def _bools(value: Any, length: int, default: bool) -> Bools:
    return np.full(length, default) if value is None else np.asarray(value, bool)


def _floats(value: Any, shape: tuple[int, ...], default: Any) -> Floats:
    return np.broadcast_to(np.asarray(default if value is None else value, np.float32), shape)


def unit_of(ways: Any, has: Any, need: Any) -> np.float32:
    """s, the mean way to a target of robots that share a skill with it; 1 if there is none."""
    ways, has, need = np.asarray(ways, np.float32), np.asarray(has, bool), np.asarray(need)
    use = (has[:, None] & (need[None] > 0)).any(2) & (ways < FAR)
    mean = ways[use].mean() if use.any() else np.float32(1.0)
    return np.float32(mean if mean > 0 else 1.0)


def missing(now: Moment, goal: Ints) -> Ints:
    """[M, S] robots of each skill that a target lacks, counting those bound to it by `goal` [N].

    Of a target that any will do for, with anybody bound to it: none.
    """
    there = _one_hot(now, goal).T.astype(np.int32) @ now.has.astype(np.int32)
    met = now.either & ((there > 0) & (now.need > 0)).any(1)
    return np.where(met[:, None], 0, np.maximum(now.need - there, 0)).astype(np.int32)


def _one_hot(now: Moment, goal: Ints) -> Bools:
    """[N, M]."""
    return goal[:, None] == np.arange(len(now.need))


def _free(now: Moment) -> Bools:
    """[N] robots that choose now."""
    return now.team & (now.goal == len(now.need)) & (now.busy <= 0)


def _open(now: Moment) -> Bools:
    """[M] known, neither solved nor being served."""
    return ~now.solved & ~now.serving & now.known


def inputs(now: Moment) -> dict[str, np.ndarray]:
    """The exported network's inputs for one moment, with a batch axis of 1."""
    lacks = missing(now, now.goal)
    incomplete: Bools = np.any(lacks > 0, axis=1)
    open_ = _open(now) & incomplete
    ready = np.maximum(now.appears, np.float32(0.0))
    ends = _ends(now, lacks, ready)
    aim, bound, here = _aims(now)
    free_at = np.where(now.serving[here], now.busy, ends[here])
    spare = np.where(bound, free_at, now.busy)
    travel = np.where(aim & ~now.serving, now.busy[:, None], spare[:, None] + now.ways)
    best = np.where(now.team[:, None, None], now.between, FAR).min(0)
    waits = now.after & ~now.solved
    under = np.where(aim & now.serving, now.busy[:, None], np.float32(0.0)).max(0)
    under = np.where(now.serving, under, ends)
    going = now.serving | (now.known & ~incomplete)
    ready = np.maximum(ready, np.where(waits & going, under, np.float32(0.0)).max(1))

    def norm(times: np.ndarray) -> np.ndarray:
        return np.minimum(times / now.unit, LONG).astype(np.float32)

    found = {
        "agents": now.team, "targets": open_, "free": _free(now), "spare": norm(spare),
        "slow": _slow(now, open_, best), "travel": norm(travel), "between": norm(best),
        "goal": aim, "has": now.has, "lacks": lacks, "either": now.either,
        "service": norm(now.service), "ready": norm(ready),
        "left": norm(np.maximum(now.lapses, np.float32(0.0))), "after": waits,
        "home": norm(now.home), "preference": now.preference}
    return {name: np.asarray(value)[None] for name, value in found.items()}


def _aims(now: Moment) -> tuple[Bools, Bools, Ints]:
    """[N, M] who is bound where, [N] who is bound at all, [N] the goal, the last for nowhere."""
    targets = len(now.need)
    return (_one_hot(now, now.goal), now.goal < targets,
            np.minimum(now.goal, targets - 1).astype(np.int32))


def _ends(now: Moment, lacks: Ints, ready: Floats) -> Floats:
    """[M] s at which each target that is not being served could be done, at the soonest.

    A coalition meets when its last is there; of those still missing, at the soonest of the rest.
    """
    none = np.float32(0.0)
    wanted = lacks > 0
    incomplete: Bools = np.any(wanted, axis=1)
    aim, bound, here = _aims(now)
    arrive = np.where(aim, now.busy[:, None], none).max(0)
    loose = now.team & ~(bound & incomplete[here])
    come = np.where(loose[:, None], now.busy[:, None] + now.ways, FAR)  # [N, M]
    times = np.where(now.has[:, None], come[:, :, None], FAR)  # [N, M, S]
    there = (times[None] <= times[:, None]).sum(1)
    soonest = np.where(there >= lacks, times, FAR).min(0)  # [M, S], when so many are there
    any_, all_ = np.where(wanted, soonest, FAR).min(1), np.where(wanted, soonest, none).max(1)
    soonest = np.where(now.either, any_, all_)
    soonest = np.where(incomplete & (soonest < FAR), soonest, none)
    meet = np.maximum(np.maximum(arrive, soonest), ready)
    return np.where(now.serving, none, meet + now.service)


def _slow(now: Moment, open_: Bools, best: Floats) -> Floats:
    """[N] log of each robot's time between targets over the quickest's, or to the last target."""
    least, none = np.float32(1e-6), np.float32(0.0)
    known = open_[:, None] & open_[None] & (best > 0) & (best < FAR)
    ways = np.where(known[None] & (now.between < FAR), now.between, none)
    quickest = np.where(ways > 0, best[None], none)
    ratio = ways.sum((1, 2)) / np.maximum(quickest.sum((1, 2)), least)
    first = np.where(open_[None] & (now.start < FAR), now.start, FAR)
    plain = np.where(first < FAR, first.min(0)[None], none).sum(1)
    alone = np.where(first < FAR, now.start, none).sum(1) / np.maximum(plain, least)
    return np.log(np.clip(np.where(ratio > 0, ratio, alone), 0.05, 20.0)).astype(np.float32)


def allowed(now: Moment, goal: Ints) -> Bools:
    """[N, M]: what each robot may choose, given everybody's `goal` [N] so far.

    A robot may go where it brings a skill that is missing there, if those still missing after it
    can come from robots that do not themselves wait for others; and if all targets that must come
    before are sure to be served. So no two robots wait for each other for ever.
    """
    lacking = missing(now, goal)
    incomplete: Bools = np.any(lacking > 0, axis=1)
    here = np.minimum(goal, len(now.need) - 1)
    loose = now.team & ~((goal < len(now.need)) & incomplete[here])
    has = now.has.astype(np.int32)
    able = ((now.start < FAR) & loose[:, None]).astype(np.int32)  # [N, M]
    helps = ((lacking[None] > 0) & now.has[:, None]).any(2)
    left = np.maximum(lacking[None] - has[:, None], 0)  # [N, M, S]
    left = np.where(now.either[None, :, None], 0, left)
    others = (able.T @ has)[None] - able[:, :, None] * has[:, None]
    whole = (others >= left).all(2)
    sure = now.solved | now.serving | ~incomplete
    before = (~now.after | sure).all(1)
    in_time = now.ways <= np.minimum(now.lapses, FAR / 2)[None] + SOON
    return (_open(now) & before)[None] & helps & whole & in_time & _free(now)[:, None]


def choose(now: Moment, logits: np.ndarray) -> Ints:
    """[N] the free robots' likeliest choices, one after the other, the surest first.

    Args:
      now: the moment.
      logits: [N, M + 1], each target, then waiting.

    Returns:
      M for waiting, and for robots that are not free.
    """
    robots, targets = now.ways.shape
    goal, todo = now.goal.copy(), _free(now)
    choice = np.full(robots, targets, np.int32)
    coming = bool(((now.busy > 0) & now.team).any())
    while todo.any():
        may = allowed(now, goal) & todo[:, None]
        some = may.any(1)
        # Somebody must go if nobody is on the way: the last who can.
        wait = coming | (some.sum() > 1) | ~some
        options = np.concatenate([may, wait[:, None]], axis=1)
        held = np.where(options, logits, -FAR).astype(np.float32)
        # The log-probability of the likeliest; who has no choice comes last.
        sure = -np.log(np.exp(held - held.max(1, keepdims=True)).sum(1))
        first = int(np.where(todo, np.where(some, sure, -2 * FAR), -3 * FAR).argmax())
        choice[first] = goal[first] = held[first].argmax()
        todo = todo & (np.arange(robots) != first)
        coming = coming or bool(choice[first] < targets)
    return choice


def may_turn(now: Moment) -> Bools:
    """[N] who is on its way and may choose anew.

    Nobody who serves, nor from a target that others, bound already, wait for.
    """
    aim, bound, here = _aims(now)
    someone: Bools = np.any(aim, axis=0)
    due: Bools = np.any(now.after & someone[:, None], axis=0)
    return now.team & bound & (now.busy > 0) & ~now.serving[here] & ~due[here]


def loosen(now: Moment, ways: Any) -> Moment:
    """The moment in which those of `may_turn` are free, at `ways` [N, M] s from each target.

    The ways are from where each robot is at this moment; rows of others are not looked at.
    """
    who, targets = may_turn(now), len(now.need)
    here = np.minimum(np.asarray(ways, np.float32), FAR)
    return replace(
        now, ways=np.where(who[:, None], here, now.ways),
        start=np.where(who[:, None], here, now.start),
        goal=np.where(who, targets, now.goal).astype(np.int32),
        busy=np.where(who, np.float32(0.0), now.busy))
