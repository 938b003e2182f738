"""Many missions executed by several contenders, one row each; rows to means and failures.

A contender is a loop with a planner and a mode:

- `closed`: the planner is asked again at each decision, with the grid as physics left it.
- `oracle`: the same with the exact planner.
- `open`: the grid plan, made once before any event, walked through blindly: all robots together
  take the plan's next cell when all have arrived or timed out, wherever they are.
- `grid`: no physics, every robot is at once where it was sent (see `ideal`).

In mode `clock` a decision is a target, and the planner plans in seconds over the ground's slopes
(see `sim2grid.clock`); the loop is closed, and who decides is a planner by the clock.

Missions keep row and number of rows of the engine however they are run, so that each can be
repeated alone to the bit, and in a worker of a cluster. Legend: F missions of a fleet, B rows of
the engine.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from moonteam import interrupts
from moonteam.cluster import Cluster
from moonteam.errors import InputError
from moonteam.physics.backends import MjxBackend
from moonteam.planners import registry
from moonteam.planners.base import Objective, Planner
from moonteam.planners.kind import DEFAULT_POLICY, PlannerOptions
from moonteam.planners.seconds import registry as timed_planners
from moonteam.planners.seconds.base import MS, Moment
from moonteam.planners.seconds.keeper import Keeper
from moonteam.planners.unfolding.deciding.make import Search, check_futures
from moonteam.policies.brain import PointerBrain
from moonteam.problem.mission import Mission
from moonteam.report.progress import bar
from moonteam.robots import team
from moonteam.terrain.travel import Roads
from sim2grid.clock.execution import Chooser, TimedExecution
from sim2grid.clock.prepare import by_the_clock, choosing
from sim2grid.loop.asked import Mode, Route
from sim2grid.loop.drive import Backend, run
from sim2grid.loop.execution import Execution
from sim2grid.loop.fused import whole
from sim2grid.loop.fused.deciders import decider_of
from sim2grid.loop.record import Record
from sim2grid.loop.rules import Rules
from sim2grid.measure.metrics import GridPlan, Report, make_report
from sim2grid.measure.slip import ground_height
from sim2grid.study.fleet import Fleet, Given, Recipe, make_fleet
from sim2grid.study.ideal import (
    IdealBackend,
    ideal_bodies,
    ideal_start,
    nominal_times,
    on_the_clock,
    route_of,
)

Loop = Literal["closed", "open", "oracle", "grid"]


class Contender(msgspec.Struct, frozen=True):
    """Who decides, how often, and who waits for whom."""

    loop: Loop
    mode: Mode
    planner: str  # a registered one, or FILE.py:OBJECT
    policy: str | None = None  # file or name of a bundled one
    decode: str = "argmax"
    objective: Objective | None = "makespan"  # None: makespan; best-of-K: what it prefers
    backend: str = "native"  # engine; without meaning for the loop `grid`
    alpha: float = 1.0  # weights of the objective weighted
    beta: float = 0.05
    time_limit: float | None = None  # seconds a plan, of anytime planners
    preference: float = 0.0  # of a policy
    search: Search | None = None  # by the clock, where targets are hidden
    futures: int = 0  # by the clock, where missions unfold: over how many it decides

    @classmethod
    def of(cls, planner: str, options: PlannerOptions, by_the_clock: bool = False) -> Contender:
        """A planner, in steps or by the clock, with what concerns it of its options.

        Raises InputError for none such.
        """
        kind = timed_planners.find(planner) if by_the_clock else registry.find(planner)
        if not kind.wants_policy:
            limit = options.time_limit if kind.anytime else None
            return cls("closed", "barrier", planner, objective=options.goal[0],
                       alpha=options.alpha, beta=options.beta, time_limit=limit)
        objective = options.objective if options.preference else options.goal[0]
        return cls("closed", "barrier", planner, str(options.policy), options.decode, objective,
                   alpha=options.alpha, beta=options.beta, preference=options.preference)

    @property
    def options(self) -> PlannerOptions:
        """What its planners are made from. Raises InputError."""
        return PlannerOptions(self.objective, self.alpha, self.beta, self.time_limit,
                              policy=self.policy or DEFAULT_POLICY, decode=self.decode,
                              preference=self.preference)

    @property
    def who(self) -> str:
        """Planner, or policy with its decoding where that is not argmax, and its preference; over
        how many futures, and how it searches.
        """
        return " ".join([
            self._decider, *([f"over {self.futures} futures"] if self.futures else []),
            *([self.search] if self.search else [])])

    @property
    def _decider(self) -> str:
        if self.planner != "policy":
            return registry.shown(self.planner)
        words = [self.decode] if self.decode != "argmax" else []
        words += [f"preference {self.preference:g}"] if self.preference else []
        name = Path(self.policy or "").stem
        return f"{name}({', '.join(words)})" if words else name

    @property
    def name(self) -> str:
        """Such as `closed exact barrier`; open loop and grid have no mode to choose.

        The engine is named where it is not the native one.
        """
        words = [self.loop] + ([self.who] if self.loop != "oracle" else [])
        words += [self.mode] if self.loop in ("closed", "oracle") else []
        return " ".join(words + ([self.backend] if self.backend != "native" else []))


class Row(msgspec.Struct, frozen=True):
    """One mission by one contender. `number` counts missions over all sites of the report."""

    number: int
    contender: str
    site: str
    site_seed: int
    seed: int  # of the planner
    slot: int  # row of the engine
    solvable: bool  # False where lost robots of the mission's own events left it unsolvable
    nominal_s: float | None  # mission s of its planner on the grid; by the clock, as first planned
    report: Report


class Entry(msgspec.Struct, frozen=True):
    """A mission of the report."""

    number: int
    draws: int  # until the ground allowed it
    mission: Mission


@dataclass(frozen=True)
class Promise:
    """What a mission would cost if all went as planned."""

    plan: GridPlan | None
    nominal_s: float | None


@dataclass(frozen=True)
class OnGrid(Promise):
    """What a planner makes of a mission on the grid alone."""

    plan: GridPlan
    nominal_s: float
    report: Report
    route: Route


@dataclass
class Evaluation:
    """Missions of several recipes, each of a site or more, and the contenders that try them.

    `rows` holds what is done, by contender and number; `keep` is called with each new row.
    """

    recipes: Sequence[Recipe | Given]
    count: int  # missions a site; 1 where missions are given
    contenders: Sequence[Contender]
    seed: int = 0
    width: int = 25  # B
    threads: int = 0  # of the native engine, 0 for all CPUs
    keep: Callable[[Row], None] = lambda row: None
    rows: dict[tuple[str, int], Row] = field(default_factory=dict)
    entries: list[Entry] = field(default_factory=list)
    label: str = ""  # before what the progress bar is called
    cluster: Cluster | None = None  # where missions are run; None: in this process
    _fleets: list[Fleet] = field(default_factory=list)

    def prepare(self) -> None:
        """Draws the missions. Raises InputError before a mission that cannot be run."""
        self._check_fused()
        self._fleets = [make_fleet(recipe, self.count) for recipe in self.recipes]
        self.entries = [Entry(index * self.count + k, draws, fleet.entry(k))
                        for index, fleet in enumerate(self._fleets)
                        for k, draws in enumerate(fleet.draws)]
        unlike = {(m.unfolds, m.searches): m for fleet in self._fleets for m in fleet.missions}
        for contender, mission in itertools.product(self.contenders, unlike.values()):
            if contender.mode == "clock" and (contender.search or contender.futures):
                chooser(contender, mission)

    def run(self) -> None:
        """Runs what is not done yet. Raises InputError before a mission that cannot be run."""
        if not self._fleets:
            self.prepare()
        if self.cluster is not None:
            self._run_on(self.cluster)
            return
        for index, fleet in enumerate(self._fleets):
            Group(self, fleet, index * self.count).run()

    def todo(self, contender: Contender, first: int) -> list[int]:
        """Numbers, within a site's missions of which `first` is the first, that have no row yet."""
        return [k for k in range(self.count) if (contender.name, first + k) not in self.rows]

    def _run_on(self, cluster: Cluster) -> None:
        sites = [(recipe, index * self.count) for index, recipe in enumerate(self.recipes)]
        pieces = [(recipe, first, self.count, self.seed, self.width, contender, part)
                  for recipe, first in sites for contender in self.contenders
                  for part in self._cut(contender, self.todo(contender, first), cluster)]
        left = sum(len(part) for *_, part in pieces)
        total = len(self.recipes) * len(self.contenders) * self.count
        with bar(f"{self.label}on {cluster.name}", total, total - left) as update:
            for _, rows in cluster.done(played, pieces):
                for row in rows:
                    self.add(row)
                left -= len(rows)
                update(total - left, f"{total - left} of {total} missions")

    def _cut(self, contender: Contender, todo: list[int], cluster: Cluster) -> list[list[int]]:
        """Pieces of work: some missions, or on an accelerator's engine all that it holds at once,
        whose program costs the same however many of its rows are idle.
        """
        whole = contender.backend != "native" and contender.loop != "grid"
        size = self.width if whole else cluster.size(self.count)
        return [list(part) for _, part in itertools.groupby(todo, lambda k: k // size)]

    def add(self, row: Row) -> None:
        """Keeps what is done."""
        self.rows[row.contender, row.number] = row
        interrupts.hold()
        self.keep(row)

    def _check_fused(self) -> None:
        """Raises InputError for what the fused program cannot run, before anything is."""
        for contender in self.contenders:
            if contender.backend != "fused":
                continue
            decider_of(maker(contender)())
            if any(recipe.eventful() for recipe in self.recipes):
                raise InputError("--backend fused", "takes missions without events; the other "
                                 "backends take them: native, mjx")

    def sorted_rows(self) -> list[Row]:
        """Rows by site, contender and number, however they came."""
        order = {c.name: i for i, c in enumerate(self.contenders)}
        return sorted(self.rows.values(), key=lambda row: (
            row.number // self.count, order.get(row.contender, len(order)), row.number))


class Group:
    """The missions of one recipe."""

    def __init__(self, evaluation: Evaluation, fleet: Fleet, first: int):
        self._all, self._fleet, self._first = evaluation, fleet, first
        self._width = min(evaluation.width, len(fleet.missions))
        self._engines: dict[str, Backend] = {}
        self._plans: dict[tuple, dict[int, OnGrid]] = {}
        self._roads: dict[int, Roads] = {}

    def run(self) -> None:
        """All contenders."""
        for contender in self._all.contenders:
            if todo := self._all.todo(contender, self._first):
                self.play(contender, todo)

    def play(self, contender: Contender, todo: list[int]) -> None:
        """Some missions by one contender."""
        if contender.mode == "clock":
            self._drive(contender, todo, [self._by_the_clock(contender, k) for k in todo],
                        self._promises(contender, todo))
            return
        make = maker(contender)
        grid = self._on_grid(contender, make, todo)
        if contender.loop == "grid":
            for k in todo:
                self._keep(contender, k, grid[k].report, grid[k].nominal_s)
            return
        blind: dict[int, OnGrid] = {}
        if contender.loop == "open":
            blind = self._on_grid(contender, make, todo, events=False)
        routes = {k: plan.route for k, plan in blind.items()}
        self._drive(contender, todo,
                    [self._execution(contender, make, k, routes.get(k)) for k in todo], grid)

    def _drive(self, contender: Contender, todo: list[int],
               executions: Sequence[Execution | TimedExecution],
               promised: Mapping[int, Promise]) -> None:
        """Runs missions in physics and keeps their rows."""
        done = len(self._fleet.missions) - len(todo)
        total = len(self._fleet.missions)
        name = self._fleet.missions[0].name if self._fleet.label else self._fleet.site.name
        grounds = [self._fleet.grounds[k] for k in todo] if self._fleet.grounds else []
        title = f"{self._all.label}{name}: {contender.name}"

        def finished(index: int) -> None:
            nonlocal done
            k = todo[index]
            report = self._report(contender, k, executions[index].record,
                                  promised[k].plan)
            executions[index].book.record = Record()  # its poses are not needed any more
            self._keep(contender, k, report, promised[k].nominal_s)
            done += 1
            update(done, f"{done} of {total} missions")

        with bar(title, total, done) as update:
            update(done, f"{done} of {total} missions")
            if contender.backend == "fused":
                whole.run([one for one in executions if isinstance(one, Execution)],
                          MjxBackend(self._fleet.scene), self._fleet.starts[todo], self._width,
                          finished, grounds)
                return
            run(executions, self._backend(contender.backend), self._fleet.starts[todo],
                width=self._width, rows=[k % self._width for k in todo], finished=finished,
                grounds=grounds)

    def _backend(self, name: str) -> Backend:
        if name not in self._engines:
            from moonteam.physics.backends import make_backend

            self._engines[name] = make_backend(
                name, self._fleet.scene, threads=self._all.threads)
        return self._engines[name]

    def _execution(self, contender: Contender, make: Callable[[], Planner], k: int,
                   route: Route | None) -> Execution:
        fleet = self._fleet
        return Execution(fleet.missions[k], fleet.scenarios[k], make(), fleet.bodies, fleet.frame,
                         seed=self._seed(k), mode=contender.mode, route=route)

    def _by_the_clock(self, contender: Contender, k: int, settling: bool = True
                      ) -> TimedExecution:
        """A mission before its start; without settling, as if ways were all that takes time."""
        fleet = self._fleet
        bodies = fleet.bodies if settling else [replace(body, settle=0.0) for body in fleet.bodies]
        mission = by_the_clock(fleet.missions[k], "--mode clock")
        return TimedExecution(
            mission, fleet.scenarios[k], chooser(contender, mission, self._seed(k)), bodies,
            fleet.frame, self._roads_of(k), seed=self._seed(k))

    def _roads_of(self, k: int) -> Roads:
        """The ways over mission `k`'s ground."""
        fleet = self._fleet
        ground = fleet.grounds[k] if fleet.grounds else 0
        if ground not in self._roads:
            site = fleet.site_of(k)
            self._roads[ground] = Roads.of_mission(
                site, fleet.missions[k], team.limits(fleet.kinds, site))
        return self._roads[ground]

    def _promises(self, contender: Contender, todo: Iterable[int]) -> dict[int, Promise]:
        """What a planner by the clock makes of each mission at its start, ways alone counted."""
        found = {}
        for k in todo:
            execution = self._by_the_clock(contender, k, settling=False)
            execution.start(self._fleet.starts[k])
            plan, now = None, execution.question
            # Where missions unfold nothing is promised.
            if isinstance(execution.planner, Keeper) and isinstance(now, Moment):
                execution.planner.act(now)
                plan = execution.planner.plan
            expected = None if plan is None or plan.makespan is None else plan.makespan / MS
            found[k] = Promise(None, expected)
        return found

    def _seed(self, k: int) -> int:
        return self._all.seed + self._first + k

    def _report(self, contender: Contender, k: int, record: Record, plan: GridPlan | None
                ) -> Report:
        objective = None if contender.planner == "policy" else contender.objective
        site = self._fleet.site_of(k)
        return make_report(
            record, self._fleet.missions[k], self._fleet.frame, self._fleet.bases,
            planner=contender.who, objective=objective, mode=contender.mode,
            backend=contender.backend, seed=self._seed(k), grid_plan=plan, kinds=self._fleet.kinds,
            height=ground_height(site.heights, site.spacing))

    def _keep(self, contender: Contender, k: int, report: Report, nominal_s: float | None
              ) -> None:
        site, site_seed = self._fleet.place_of(k)
        losses = {robot.lost for robot in report.robots if robot.lost}
        by_event = report.cause == "unsolvable" and losses == {"event"}
        row = Row(number=self._first + k, contender=contender.name, site=site,
                  site_seed=site_seed, seed=report.seed, slot=k % self._width,
                  solvable=not by_event, nominal_s=nominal_s, report=report)
        self._all.add(row)

    def _on_grid(self, contender: Contender, make: Callable[[], Planner], todo: Sequence[int],
                 events: bool = True) -> dict[int, OnGrid]:
        """Missions on the grid alone, kept for the other contenders of that planner."""
        events = events and any(mission.events for mission in self._fleet.missions)
        held = self._plans.setdefault((contender.who, contender.objective, events), {})
        if new := {k: self._seed(k) for k in todo if k not in held}:
            held |= on_grid(self._fleet, make, events, new)
        return held


@cache
def _group(recipe: Recipe | Given, first: int, count: int, seed: int, width: int
           ) -> tuple[Evaluation, Group]:
    """In a worker: a site's missions, kept with their engines for the pieces to come."""
    whole = Evaluation([recipe], count, [], seed, width, threads=1)
    return whole, Group(whole, make_fleet(recipe, count), first)


def played(recipe: Recipe | Given, first: int, count: int, seed: int, width: int,
           contender: Contender, todo: list[int]) -> list[Row]:
    """The rows of some missions by one contender, a pure function of all these.

    Args:
      recipe: of the site's missions.
      first: number of the first of them in the report.
      count: of them.
      seed: of the report.
      width: rows of the engine.
      contender: who decides.
      todo: which of them, 0 to count - 1.
    """
    whole, group = _group(recipe, first, count, seed, width)
    group.play(contender, todo)
    return [whole.rows.pop((contender.name, first + k)) for k in todo]


def on_grid(fleet: Fleet, make: Callable[[], Planner], events: bool, seeds: Mapping[int, int]
            ) -> dict[int, OnGrid]:
    """What a planner makes of a fleet's missions without physics, with or without events.

    `seeds` gives the missions, by number, each with the planner's seed.
    """
    bodies, rules = ideal_bodies(fleet.bodies), Rules()
    executions = []
    for k, seed in seeds.items():
        mission = fleet.missions[k]
        spec = mission if events else msgspec.structs.replace(mission, events=())
        spec = spec.unpowered()  # nothing is driven, so nothing is used up
        executions.append(Execution(spec, fleet.scenarios[k], make(), bodies, fleet.frame,
                                    seed=seed, rules=rules))
    starts = np.stack([ideal_start(fleet.frame, [r.cell for r in fleet.missions[k].robots])
                       for k in seeds])
    run(executions, IdealBackend(rules.chunk_steps), starts)
    return {k: _ideal(fleet, k, execution, bodies)
            for k, execution in zip(seeds, executions, strict=True)}


def _ideal(fleet: Fleet, k: int, execution: Execution, bodies: Sequence[Any]) -> OnGrid:
    record, mission = execution.record, fleet.missions[k]
    times = nominal_times(record, bodies, fleet.frame.cell_m)
    moves = sum(leg.action != 4 for leg in record.legs)
    makespan = len(record.decisions) if record.success else None
    plan = GridPlan(record.success, makespan, moves)
    report = make_report(record, mission, fleet.frame, [body.base for body in bodies],
                         planner=execution.planner.name, objective=None, mode="barrier",
                         backend="grid", seed=execution.asked.seed, grid_plan=plan)
    starts = [robot.cell for robot in mission.robots]
    return OnGrid(plan, round(float(times[-1]), 4), on_the_clock(report, times),
                  route_of(record, starts))


def unfolded(rows: Sequence[Contender], searches: Sequence[Search], futures: Sequence[int]
             ) -> list[Contender]:
    """Rows by the clock in missions that unfold: by every way to search, and over futures too.

    Raises InputError for a number of futures that is none.
    """
    for count in futures:
        check_futures(count)
    return [msgspec.structs.replace(row, search=search, futures=count)
            for row, search, count in itertools.product(rows, searches or (None,), (0, *futures))]


def maker(contender: Contender) -> Callable[[], Planner]:
    """Makes the planners of a contender. Raises InputError."""
    return registry.maker(contender.planner, contender.options)


def chooser(contender: Contender, mission: Mission, seed: int = 0) -> Chooser:
    """Who decides for a contender by the clock in a mission. Raises InputError."""
    planner = timed_planners.find(contender.planner).make(contender.options)
    return choosing(planner, mission, contender.search, contender.futures, seed)


def deciders(name: str, options: PlannerOptions, modes: Sequence[Mode]
             ) -> tuple[Contender | None, Contender | None]:
    """A planner as it decides in steps and by the clock, as far as the modes ask for it.

    One of a user's file, or of another package, may be for one of the two alone; of policies those
    that point at targets decide by the clock. Raises InputError for who decides in none of them.
    """
    clock, steps = "clock" in modes, any(mode != "clock" for mode in modes)
    said: list[InputError] = []
    found: list[Contender | None] = []
    for wanted, timed in ((steps, False), (clock, True)):
        found.append(None)
        if wanted:
            try:
                who = Contender.of(name, options, timed)
                found[-1] = who if _able(who, timed, clock and steps) else None
            except InputError as error:
                said.append(error)
    if not any(found) and said:
        raise said[0]
    return found[0], found[1]


def _able(who: Contender, timed: bool, both: bool) -> bool:
    """Whether it decides in steps, or `timed`. Raises InputError for what is no planner of these.

    An object that has what both need is taken by the clock only where nothing else is asked for.
    """
    if not timed:
        if not registry.find(who.planner).wants_policy:
            maker(who)()
        return True
    if who.planner == "policy":
        return isinstance(who.options.loaded().brain, PointerBrain)
    kind = timed_planners.find(who.planner)
    planner = who if kind.wants_policy else kind.make(who.options)
    return not (both and callable(getattr(planner, "act", None)))


def contenders(loops: Iterable[Loop], modes: Sequence[Mode], planners: Iterable[Contender],
               backends: Sequence[str] = ("native",),
               by_the_clock: Iterable[Contender] | None = None) -> list[Contender]:
    """All combinations that mean something, each once; `planners` give who decides.

    By the clock `by_the_clock` decide; None: the same planners, of policies those alone that point
    at targets. The exact planner stands in where nobody does.
    """
    found: dict[str, Contender] = {}
    planners, exact = list(planners), Contender("oracle", "barrier", "exact")
    timed = [] if "clock" not in modes else [
        who for who in planners if _able(who, True, False)] if by_the_clock is None else [
        *by_the_clock]
    for loop in loops:
        for mode, backend in itertools.product(
                modes if loop in ("closed", "oracle") else ("barrier",),
                backends if loop != "grid" else ("native",)):
            if backend == "fused" and (loop, mode) != ("closed", "barrier"):
                continue  # it only knows how to decide again, all together
            if loop == "oracle" and mode == "clock":
                continue  # closed with the exact planner
            who_decides = (timed or [exact]) if mode == "clock" else planners
            for who in who_decides if loop != "oracle" else [exact]:
                one = msgspec.structs.replace(who, loop=loop, mode=mode, backend=backend)
                if found.setdefault(one.name, one) != one:
                    raise InputError("--planner", f"two would be called {who.who}; rename one")
    return list(found.values())
