"""What stands in a row of a table: a planner with an objective, or a policy with a decoding."""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from moonteam import paths
from moonteam.errors import InputError
from moonteam.evaluation.apart import Part, chunks
from moonteam.evaluation.metrics import Outcomes
from moonteam.evaluation.played import play
from moonteam.evaluation.world import World, play_plans, snapshots, tally
from moonteam.planners import decode as decoding
from moonteam.planners import registry, simulate
from moonteam.planners.base import (
    BoolArray,
    IntArray,
    Objective,
    Snapshot,
    WholePlanner,
    check_objective,
)
from moonteam.planners.decode import Decode
from moonteam.planners.kind import DEFAULT_POLICY, NO_THREADS, PlannerKind, PlannerOptions
from moonteam.policies.brain import PointerBrain
from moonteam.policies.policy import Policy
from moonteam.report.journal import NOTHING, Kept
from moonteam.report.progress import track

POLICY = "policy"
"""The planner whose rows are played in batches, one for each decoding."""
MAKESPAN: tuple[Objective, ...] = ("makespan",)
Timed = tuple[list[list[int]], float]
"""Joint actions of a plan, and the seconds that it took."""


@dataclass(frozen=True)
class Options:
    """What a user asked for, as the commands hand it over; checked by `contenders`."""

    planners: Sequence[str]
    objectives: Sequence[str] = ()
    """Empty: planners least makespan, best-of-K what the preference asks for."""
    policies: Sequence[Path] = ()
    preferences: Sequence[float] = ()
    decodes: Sequence[str] = ("argmax",)
    alpha: float = 1.0
    beta: float = 0.05
    time_limits: Sequence[float] = ()
    """Seconds a plan that anytime planners may take, one row each; empty: theirs."""
    seed: int = 0
    alone: bool = False
    threads: int = 1
    """That a planner may search with, if it can."""

    def of(self, objective: Objective | None = None, limit: float | None = None,
           preference: float = 0.0, policy: str | Path | None = None) -> PlannerOptions:
        """What one planner of them is made from. Raises InputError."""
        return PlannerOptions(objective, self.alpha, self.beta, limit, self.seed,
                              policy or DEFAULT_POLICY, preference=preference,
                              threads=self.threads)


class Contender(Protocol):
    """One row of a table."""

    @property
    def name(self) -> str:
        """Its name in the report, such as exact(makespan) or policy(argmax)."""
        ...

    def check(self, world: World) -> None:
        """Raises InputError if it cannot serve these scenarios."""
        ...

    def run(self, world: World, kept: Kept = NOTHING) -> Outcomes:
        """Plans and plays every scenario; what is planned is noted in `kept`, or taken from it."""
        ...

    def parts(self, world: World, size: int, kept: Kept) -> list[Part]:
        """What `run` would note and is not in `kept` yet, to be made apart, with at most `size`
        scenarios to plan one by one in each part.
        """
        ...


@dataclass(frozen=True)
class Planned:
    """A planner on the host. When a target appears, it plans again."""

    planner: WholePlanner
    kind: str
    objective: Objective
    limit: float | None = None  # where there are rows with several
    threads: int = 1

    @property
    def name(self) -> str:
        """Such as exact(makespan) or lns(makespan, 0.1 s)."""
        seconds = "" if self.limit is None else f", {self.limit:g} s"
        threads = "" if self.threads == 1 else f", {self.threads} threads"
        return f"{self.kind}({self.objective}{seconds}{threads})"

    def check(self, world: World) -> None:
        """Raises InputError, the planner's own, if a scenario has too many targets for it."""
        most = max(world.scenarios, key=lambda s: len(s.targets))
        allowed = getattr(self.planner, "most_targets", None)
        if allowed is not None and len(most.targets) - world.num_buffer > allowed:
            self.planner.plan(Snapshot.start(most))

    def run(self, world: World, kept: Kept = NOTHING) -> Outcomes:
        """See `Contender`; plans round by round, a round ends where a target appears."""
        spent, first_call = 0.0, 0.0

        def plan(moments: list[Snapshot], over: BoolArray, round_: int) -> list[IntArray]:
            nonlocal spent, first_call
            title = f"{self.name} {round_ + 1}" if world.num_buffer else self.name
            plans, seconds = self._plan_all(moments, over, title, round_,
                                            kept.within(self.name, str(round_)))
            spent, first_call = spent + sum(seconds[1:]), first_call + seconds[0]
            return plans

        walk = play_plans(world, plan)
        return Outcomes(self.name, *tally(world, walk), spent, first_call)

    def parts(self, world: World, size: int, kept: Kept) -> list[Part]:
        """See `Contender`; no target may appear under way."""
        moments, own = snapshots(world, world.start), kept.within(self.name, "0")
        left = [i for i in np.flatnonzero(~np.asarray(world.start.done)).tolist()
                if not own.has(str(i))]
        return [Part([(self.name, "0", str(i)) for i in some], self._apart,
                     ([moments[i] for i in some],)) for some in chunks(left, size)]

    def _apart(self, moments: list[Snapshot]) -> list[Timed]:
        self._actions(moments[0])  # what is loaded or compiled at the first call
        return [self._timed(moment) for moment in moments]

    def _plan_all(self, moments: list[Snapshot], over: BoolArray, title: str, round_: int,
                  kept: Kept) -> tuple[list[IntArray], list[float]]:
        """Plans for every episode that goes on; seconds of each, the first call's in front."""
        seconds = [0.0]
        left = [i for i in np.flatnonzero(~over).tolist() if not kept.has(str(i))]
        if round_ == 0 and left:  # what is loaded or compiled at the first call
            began = time.perf_counter()
            self._actions(moments[left[0]])
            seconds[0] = time.perf_counter() - began
        plans = []
        for i, moment in track(enumerate(moments), title, len(moments)):
            actions, spent = ([], 0.0) if over[i] else kept.once(
                (str(i),), Timed, lambda moment=moment: self._timed(moment))
            plans.append(np.array(actions, np.int32).reshape(-1, len(moment.cells)))
            seconds.append(spent)
        return plans, seconds

    def _timed(self, moment: Snapshot) -> Timed:
        began = time.perf_counter()
        actions = self._actions(moment)[:moment.max_steps]
        return actions.tolist(), time.perf_counter() - began

    def _actions(self, moment: Snapshot) -> IntArray:
        """The plan's joint actions; where there is none, what the planner does nevertheless."""
        plan = self.planner.plan(moment)
        if plan.status != "infeasible":
            return plan.actions
        self.planner.reset(moment)
        done = []
        while moment.step < moment.max_steps and not moment.solved.all():
            done.append(self.planner.act(moment))
            moment = simulate.step(moment, done[-1])
        return np.array(done, np.int32).reshape(len(done), len(moment.cells))


@dataclass(frozen=True)
class Learned:
    """A policy; best-of-K keeps, of K sampled rollouts, the best by the objective.

    Without an objective it is the one of the preference p, (1 - p) * makespan + p * moves.
    """

    name: str
    policy: Policy
    decode: Decode
    objective: Objective | None
    preference: float
    options: Options

    def check(self, world: World) -> None:
        """See `Contender`."""
        for moment in snapshots(world, world.start):
            self.policy.check(moment)

    def run(self, world: World, kept: Kept = NOTHING) -> Outcomes:
        """See `Contender`; kept as a whole, for it is played in one batch."""
        found = kept.once((self.name,), dict[str, Any], lambda: vars(self._run(world)))
        return Outcomes(**found | {
            "success": np.asarray(found["success"], bool),
            "steps": np.asarray(found["steps"], np.int64),
            "moves": np.asarray(found["moves"], np.int64)})

    def _run(self, world: World) -> Outcomes:
        options = self.options
        played = play(self.policy, world, self.decode,
                      options.of(self.objective, preference=self.preference), self.name,
                      options.alone)
        steps, rescues = played.steps, played.rescues
        note = ("planning time with one scenario at a time" if options.alone else
                "planning time is the whole set's, played in batches, over its scenarios; "
                "--alone plays one at a time")
        if self.decode.watch and not isinstance(self.policy.brain, PointerBrain):
            note = (f"the deadlock watch drew {rescues.sum()} of {steps.sum()} decisions, in "
                    f"{(rescues > 0).sum()} of {len(world)} scenarios; plain-argmax goes without; "
                    + note)
        return Outcomes(self.name, played.success, steps, played.moves, played.seconds,
                        played.compiling, note)

    def parts(self, world: World, size: int, kept: Kept) -> list[Part]:
        """See `Contender`; one, for the whole set is one batch."""
        return [] if kept.has(self.name) else [Part([(self.name,)], self._apart, (world,))]

    def _apart(self, world: World) -> list[dict[str, Any]]:
        return [vars(self._run(world))]


def contenders(options: Options) -> list[Contender]:
    """All rows asked for. Raises InputError at the first wrong name or number."""
    if not options.planners:
        raise InputError("--planner", "at least one is needed: " + ", ".join(registry.names()))
    given: list[Objective] = [check_objective(one, options.alpha, options.beta)
             for one in dict.fromkeys(options.objectives)]
    for limit in options.time_limits:
        options.of(limit=limit)
    for preference in options.preferences:
        options.of(preference=preference)
    for text in options.decodes:
        decoding.parse(text)
    kinds = {planner: registry.find(planner) for planner in options.planners}
    if options.threads > 1 and not any(kind.parallel for kind in kinds.values()):
        raise InputError("--threads", NO_THREADS)
    found: list[Contender] = []
    for planner, kind in kinds.items():
        found += policies(options, given) if kind.name == POLICY else _planned(
            planner, kind, options, given or MAKESPAN)
    if options.policies and not any(kind.wants_policy for kind in kinds.values()):
        raise InputError("--policy", f"has no effect without --planner {POLICY}")
    names = [one.name for one in found]
    for name in names:
        if names.count(name) > 1:
            raise InputError("--planner", f"two rows would be called {name}; rename one")
    return found


def _planned(planner: str, kind: PlannerKind, options: Options,
             objectives: Sequence[Objective]) -> list[Contender]:
    """The rows of one planner: every objective, policy file and, if it is anytime, limit."""
    limits = [*dict.fromkeys(options.time_limits)] if kind.anytime else []
    files = options.policies if kind.wants_policy else ()
    found: list[Contender] = []
    for objective, file, limit in itertools.product(objectives, files or [None],
                                                    limits or [None]):
        name = kind.name + (f" {called(file)}" if file is not None and len(files) > 1 else "")
        made = registry.make(planner, options.of(objective, limit, policy=file))
        found.append(Planned(made, name, objective, limit if len(limits) > 1 else None,
                             options.threads if kind.parallel else 1))
    return found


def called(path: Path) -> str:
    """What a policy file is called: its run's folder, where it is a run's own."""
    return path.absolute().parent.name if path.stem == "policy" else path.stem


def policies(options: Options, objectives: Sequence[Objective]) -> list[Learned]:
    """The rows of every policy file, preference and decoding."""
    decodes = [decoding.parse(text) for text in dict.fromkeys(options.decodes)]
    files = options.policies or [paths.find(DEFAULT_POLICY, "policies", ".safetensors")]
    loaded = [Policy.load(path) for path in files]
    found: list[Learned] = []
    for path, policy in zip(files, loaded, strict=True):
        stem = "policy" if len(loaded) == 1 else called(path)
        given = options.preferences if policy.brain.prefers else ()
        for preference in given or (0.0,):
            for decode in decodes:
                for objective in objectives if decode.rollouts > 1 and objectives else [None]:
                    words = [decode.name]
                    if objective and len(objectives) > 1:
                        words.append(objective)
                    if given:
                        words.append(f"preference {preference:g}")
                    found.append(Learned(f"{stem}({', '.join(words)})", policy, decode,
                                         objective, preference, options))
    names = [one.name for one in found]
    if len(set(names)) < len(names):
        raise InputError("--policy", "two policy files have the same name; rename one")
    return found
