"""What every planner promises, as checks that run on any of them: ours and a user's own.

Each check plays small missions of three robots on a map of 6 x 6 with planners made afresh,
and says what went wrong. Legend: N agents, M targets, T steps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import msgspec
import numpy as np

from moonteam.errors import InputError
from moonteam.planners import registry, simulate
from moonteam.planners.base import IntArray, Snapshot, WholePlanner
from moonteam.planners.kind import PlannerKind, PlannerOptions
from moonteam.problem.scenario import Agent, Scenario, Target

_STEPS = 16
"""Decisions that a check asks for at most."""

_OPEN = Scenario(
    (6, 6), (Agent((0, 0), ("A",), "walker"), Agent((5, 5), ("B",), "walker"),
             Agent((0, 5), ("A", "B"), "flyer")),
    (Target((3, 3), ("A", "B"), "AND"), Target((5, 1), ("A",), "OR"),
     Target((1, 3), ("A", "B"), "OR")), max_steps=40)
_WALLED = msgspec.structs.replace(_OPEN, blocked={
    "walker": ((2, 0), (2, 1), (2, 2), (2, 4), (2, 5), (4, 2), (4, 3), (4, 4))})


class Broken(Exception):
    """A promise that was not kept, in words."""


@dataclass(frozen=True)
class Result:
    """Of one check; `problem` is empty if it passed."""

    name: str
    problem: str = ""

    @property
    def passed(self) -> bool:
        """Whether the planner kept this promise."""
        return not self.problem


@dataclass(frozen=True)
class Subject:
    """The planner under test: makes any number of itself."""

    kind: PlannerKind
    make: Callable[[], WholePlanner]


def check(name: str, options: PlannerOptions | None = None) -> list[Result]:
    """Every check on a registered planner or `FILE.py:OBJECT`.

    Raises InputError if there is none such, or it cannot be made.
    """
    subject = Subject(registry.find(name), registry.maker(name, options or PlannerOptions()))
    subject.make()
    return [_result(words, promise, subject) for words, promise in CHECKS.items()]


def _result(name: str, promise: Callable[[Subject], None], subject: Subject) -> Result:
    try:
        promise(subject)
    except Broken as error:
        return Result(name, str(error))
    except Exception as error:
        return Result(name, f"{type(error).__name__}: {error}")
    return Result(name)


def _play(planner: WholePlanner, now: Snapshot, seed: int = 0, steps: int = _STEPS,
          change: Callable[[Snapshot], Snapshot] = lambda now: now, at: int = 3
          ) -> tuple[list[IntArray], Snapshot]:
    """Joint actions from this moment on, each held to be legal, and where they led.

    `change` happens to the world before the decision number `at`.
    """
    planner.reset(now, seed)
    done = []
    for step in range(steps):
        now = change(now) if step == at else now
        if now.step >= now.max_steps or (now.solved.all() and step > at):
            break
        joint = _asked(planner, now)
        done.append(joint)
        now = simulate.step(now, joint)
    return done, now


def _asked(planner: WholePlanner, now: Snapshot) -> IntArray:
    """The planner's joint action. Raises Broken if it is no legal one."""
    seen = replace(now, **{f.name: value.copy() for f in fields(now)
                           if isinstance(value := getattr(now, f.name), np.ndarray)})
    joint = planner.act(seen)
    where = f"at step {now.step}"
    for field in fields(now):
        if not np.array_equal(getattr(seen, field.name), getattr(now, field.name)):
            raise Broken(f"{where} it changed the snapshot's {field.name}")
    agents = len(now.cells)
    if not isinstance(joint, np.ndarray) or joint.dtype != np.int32 or joint.shape != (agents,):
        raise Broken(f"{where} act returned {joint!r}, not an int32 array of shape ({agents},)")
    if (joint < 0).any() or (joint > simulate.STAY).any():
        raise Broken(f"{where} act returned {joint.tolist()}; 0 to {simulate.STAY} are allowed")
    for i in np.flatnonzero(~now.agent_mask & (joint != simulate.STAY)).tolist():
        raise Broken(f"{where} agent {i} is lost and was told {joint[i]}, not to stay")
    if now.passable is not None:
        _check_ground(now, joint)
    return joint


def _check_ground(now: Snapshot, joint: IntArray) -> None:
    """Raises Broken where an agent is sent into ground that is closed to its kind."""
    wanted = now.cells + simulate.DISPLACEMENTS[joint]
    for i in np.flatnonzero(joint != simulate.STAY).tolist():
        x, y = wanted[i].tolist()
        inside = 0 <= x < now.size[0] and 0 <= y < now.size[1]
        assert now.passable is not None
        if inside and not now.passable[now.agent_kinds[i], y, x]:
            raise Broken(f"at step {now.step} agent {i} was sent into closed ground at {[x, y]}")


def _legal(subject: Subject) -> None:
    _play(subject.make(), Snapshot.start(_OPEN))


def _blocked(subject: Subject) -> None:
    _play(subject.make(), Snapshot.start(_WALLED), steps=30)


def _whole(subject: Subject) -> None:
    for scenario in (_OPEN, _WALLED):
        now = Snapshot.start(scenario)
        plan = subject.make().plan(now)
        if plan.actions.ndim != 2 or plan.actions.shape[1] != len(now.cells):
            raise Broken(f"its plan's actions have shape {plan.actions.shape}, not (T, 3)")
        if plan.status == "infeasible":
            if not plan.reason:
                raise Broken("its plan is infeasible and gives no reason")
            continue
        trace = simulate.replay(now, plan.actions)
        if not trace.complete:
            raise Broken("its plan does not solve every target when it is played")
        if (trace.makespan, trace.moves) != (plan.makespan, plan.moves):
            raise Broken(f"its plan claims makespan {plan.makespan} and {plan.moves} moves; played "
                         f"it has {trace.makespan} and {trace.moves}")


def _under_way(subject: Subject) -> None:
    solved = np.array([False, True, False])
    begun = replace(Snapshot.start(_OPEN), solved=solved, step=17)
    _play(subject.make(), begun)
    over = replace(begun, solved=np.ones(3, bool))
    planner = subject.make()
    planner.reset(over)
    _asked(planner, over)


def _lost(subject: Subject) -> None:
    def lose(now: Snapshot) -> Snapshot:
        return replace(now, agent_mask=np.array([False, True, True]))

    _play(subject.make(), Snapshot.start(_OPEN), change=lose)
    _play(subject.make(), lose(Snapshot.start(_WALLED)))


def _new_target(subject: Subject) -> None:
    def appear(now: Snapshot) -> Snapshot:
        return replace(
            now, target_cells=np.append(now.target_cells, np.array([[5, 3]], np.int32), axis=0),
            target_skills=np.append(now.target_skills, np.int32(2)),
            target_and=np.append(now.target_and, False), solved=np.append(now.solved, False))

    _play(subject.make(), Snapshot.start(_OPEN), change=appear)


def _moved(subject: Subject) -> None:
    def push(now: Snapshot) -> Snapshot:
        return replace(now, cells=np.array([[0, 4], [3, 5], [5, 0]], np.int32))

    _play(subject.make(), Snapshot.start(_OPEN), change=push)


def _reset(subject: Subject) -> None:
    start = Snapshot.start(_OPEN)
    fresh, _ = _play(subject.make(), start, seed=4)
    used = subject.make()
    _play(used, replace(start, cells=start.cells[::-1].copy()), seed=9, steps=5)
    again, _ = _play(used, start, seed=4)
    _same(fresh, again, "after a reset it decides otherwise than one made afresh")


def _seed(subject: Subject) -> None:
    start = Snapshot.start(_OPEN)
    one, two = (_play(subject.make(), start, seed=4)[0] for _ in range(2))
    _same(one, two, "with the same seed it decides otherwise the second time")
    one, two = (list(subject.make().plan(start).actions) for _ in range(2))
    _same(one, two, "its second whole plan is another than its first")


def _same(one: list[IntArray], two: list[IntArray], what: str) -> None:
    if len(one) != len(two) or not all(map(np.array_equal, one, two)):
        raise Broken(what)


def _refusal(subject: Subject) -> None:
    most = subject.kind.most_targets
    if most is None:
        return
    cells = [(x, y) for y in range(1, 5) for x in range(6)][:most + 1]
    large = Snapshot.start(msgspec.structs.replace(
        _OPEN, targets=tuple(Target(cell, ("A",), "OR") for cell in cells)))
    for use in (lambda p: p.plan(large), lambda p: registry.check_planner(p, large)):
        try:
            use(subject.make())
        except InputError as error:
            if str(most) not in str(error):
                raise Broken(f"its refusal does not say that it takes {most}: {error}") from None
        else:
            raise Broken(f"it takes up to {most} targets and does not refuse {most + 1}")


CHECKS: dict[str, Callable[[Subject], None]] = {
    "legal joint actions": _legal,
    "no move into closed ground": _blocked,
    "whole plans keep what they claim": _whole,
    "a mission under way, targets solved": _under_way,
    "a lost robot stays": _lost,
    "a new target": _new_target,
    "robots elsewhere than foreseen": _moved,
    "reset forgets": _reset,
    "the same seed, the same decisions": _seed,
    "refuses what is too large": _refusal,
}
"""The promises, by name."""
