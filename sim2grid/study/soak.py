"""Unlike missions in one process: what fails, and whether memory stays flat.

Mission `number` and who decides in it follow from (seed, number) alone. BLOCK missions in a row
share ground and kinds of robots, and so one engine, in which they run side by side; all else is
drawn for each.

Legend: R robots, M targets, F missions of a block.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from moonteam import compilation, interrupts
from moonteam.physics.backends import make_backend
from moonteam.physics.trials.speed import resident_mb
from moonteam.planners import registry
from moonteam.planners.base import Snapshot
from moonteam.planners.kind import PlannerOptions
from moonteam.planners.search.travel import UNREACHABLE, travel_times
from moonteam.planners.seconds import registry as timed_planners
from moonteam.problem import mission as missions
from moonteam.problem.mission import Event, Mission, Robot, Silent, Target
from moonteam.problem.scenario import Scenario
from moonteam.report.progress import bar
from moonteam.robots import KINDS, OWN, team
from moonteam.terrain.travel import Roads
from sim2grid.clock.execution import TimedExecution
from sim2grid.clock.prepare import choosing
from sim2grid.loop.asked import Mode
from sim2grid.loop.drive import Backend, run
from sim2grid.loop.execution import Execution
from sim2grid.loop.replan import grid_problem
from sim2grid.measure.metrics import Report, make_report
from sim2grid.measure.slip import ground_height
from sim2grid.study.fleet import Fleet, Rates, Recipe, draw_mission, fleet_of, ground_of
from sim2grid.study.summary import cause_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BLOCK = 10
"""F: missions in a row on the same ground with the same kinds of robots, and the engine's rows."""
FORGET = 20
"""Blocks after which what JAX traced of ever new teams and grounds is dropped: it takes megabytes a
mission, and is of no use to a team that does not come back.
"""

SIDES = {8: 0.6, 12: 0.2, 16: 0.1, 24: 0.05, 32: 0.03, 48: 0.01, 64: 0.01}
"""Sides of maps, m, each with its chance: small ones are driven in a second, large ones in ten."""

TEAMS = {1: 45, 2: 45, 3: 46, 4: 15, 5: 21, 6: 28}
"""Of 200 blocks, how many have so many robots: of large teams every mixture of kinds once."""

PLANNERS = {"exact": 0.3, "greedy": 0.25, "lns": 0.3, "policy": 0.15}
"""Each with its chance: a policy is compiled anew for each shape."""

LIMITS = {"exact": 2.0, "lns": 0.05}
"""s a plan by the clock. lns spends them, so that its plans depend on the machine's speed."""

MODES: tuple[Mode, ...] = ("barrier", "async", "clock", "clock")
MOST_TARGETS, MOST_NEW = 8, 2
MOST_ALIKE = 2  # robots of one skill in a coalition: more stand in each other's way in a cell
DECISION_S = 3.0  # that a decision of one cell takes, about
SERVICE_S, APPEARS_S, OPEN_S = 15.0, 30.0, 240.0  # at most


@dataclass(frozen=True)
class Who:
    """Who decides in a mission, as `moonteam rollout` takes it."""

    planner: str
    mode: Mode
    seed: int
    time_limit: float | None

    @property
    def options(self) -> PlannerOptions:
        """What the planner is made from; a policy is the one that ships."""
        return PlannerOptions("makespan", time_limit=self.time_limit, seed=self.seed)


class Entry(msgspec.Struct, frozen=True):
    """What came of one mission."""

    number: int
    site: str
    site_seed: int
    side: int  # m
    kinds: tuple[str, ...]
    targets: int  # before events
    events: tuple[str, ...]  # what happens
    mode: Mode
    planner: str
    success: bool
    cause: str | None  # of failure; an exception's last line
    traceback: str | None
    seconds: float | None  # of the mission
    decisions: int | None
    wall_s: float  # its share of what its block took
    resident_mib: float  # of the process, after the block
    process: int  # number of the mission that its process began with


@dataclass(frozen=True)
class Stage:
    """The missions of a block, and what runs them."""

    fleet: Fleet
    backend: Backend

    @functools.cached_property
    def roads(self) -> Roads:
        """Ways in seconds."""
        fleet = self.fleet
        return Roads.of_mission(fleet.site, fleet.missions[0], team.limits(fleet.kinds, fleet.site))

    def run(self, deciders: Mapping[int, Who]) -> dict[int, Report]:
        """Missions of the block to their ends, side by side: index -> report.

        Each keeps to its row of an engine of F, and so comes to the same with others or without.
        """
        fleet = self.fleet
        executions = [self._execution(index, who) for index, who in deciders.items()]
        run(executions, self.backend, np.stack([fleet.starts[index] for index in deciders]),
            width=BLOCK, rows=list(deciders))
        return {index: make_report(
            execution.record, fleet.missions[index], fleet.frame, fleet.bases,
            planner=who.planner, objective=None if who.planner == "policy" else "makespan",
            mode=who.mode, backend=self.backend_name, seed=who.seed, grid_plan=None,
            kinds=fleet.kinds, height=ground_height(fleet.site.heights, fleet.site.spacing))
            for (index, who), execution in zip(deciders.items(), executions, strict=True)}

    def _execution(self, index: int, who: Who) -> Execution | TimedExecution:
        fleet = self.fleet
        mission, scenario = fleet.missions[index], fleet.scenarios[index]
        if who.mode == "clock":
            chooser = choosing(timed_planners.find(who.planner).make(who.options), mission)
            return TimedExecution(mission, scenario, chooser, fleet.bodies, fleet.frame,
                                  self.roads, seed=who.seed)
        return Execution(mission, scenario,
                         registry.make(who.planner, replace(who.options, seed=0)),
                         fleet.bodies, fleet.frame, seed=who.seed, mode=who.mode)

    @property
    def backend_name(self) -> str:
        """Of the engine."""
        return str(getattr(self.backend, "name", ""))


@dataclass
class Soak:
    """`count` missions, a block after the other.

    `keep` is called with each entry and its mission, None where that could not even be drawn.
    """

    seed: int
    count: int
    keep: Callable[[Entry, Mission | None], None]
    done: set[int] = field(default_factory=set)
    seconds: float | None = None  # after which no other mission is begun

    def run(self) -> None:
        """Runs what is not done yet. An exception ends its mission, not the soak."""
        begun = time.perf_counter()
        todo = [number for number in range(self.count) if number not in self.done]
        done = self.count - len(todo)
        with bar("soak", self.count, done) as update:
            for _, numbers in itertools.groupby(todo, key=lambda number: number // BLOCK):
                if self.seconds is not None and time.perf_counter() - begun > self.seconds:
                    return
                those = list(numbers)
                self._block(those, todo[0])
                update(done := done + len(those), f"mission {those[-1]}")

    def _block(self, numbers: list[int], first: int) -> None:
        """Missions of a block, side by side; after an exception one by one, to see whose it was."""
        try:
            told = self._told(numbers, first)
        except Exception as error:
            if len(numbers) > 1:
                for number in numbers:
                    self._block([number], first)
                return
            told = [self._failed(numbers[0], first, error)]
        for entry, mission in told:
            self.keep(entry, mission)
        interrupts.hold()

    def _told(self, numbers: list[int], first: int) -> list[tuple[Entry, Mission | None]]:
        begun, stage = time.perf_counter(), _stage(self.seed, numbers[0] // BLOCK)
        found = stage.run({n % BLOCK: who_decides(self.seed, n) for n in numbers})
        each = (time.perf_counter() - begun) / len(numbers)
        return [self._entry(number, first, stage.fleet.missions[number % BLOCK],
                            None if report.success else cause_of(report), report, wall_s=each)
                for number, report in zip(numbers, found.values(), strict=True)]

    def _failed(self, number: int, first: int, error: Exception) -> tuple[Entry, Mission | None]:
        mission = None
        with contextlib.suppress(Exception):  # where it could not even be drawn
            mission = _stage(self.seed, number // BLOCK).fleet.missions[number % BLOCK]
        return self._entry(number, first, mission, f"exception: {type(error).__name__}: {error}",
                           traceback="".join(traceback.format_exception(error)))

    def _entry(self, number: int, first: int, mission: Mission | None, cause: str | None,
               report: Report | None = None, traceback: str | None = None, wall_s: float = 0.0
               ) -> tuple[Entry, Mission | None]:
        recipe, who = block(self.seed, number // BLOCK), who_decides(self.seed, number)
        return Entry(
            number, recipe.preset, recipe.site_seed, recipe.side,
            tuple(kind for _, kind in recipe.team), recipe_targets(self.seed, number),
            tuple(what(event) for event in mission.events) if mission else (), who.mode,
            who.planner, cause is None, cause, traceback, report and report.seconds,
            report and report.decisions, round(wall_s, 3),
            round(resident_mb() * 1e6 / 2**20, 1), first), mission


def what(event: Event) -> str:
    """What happens: the event's key."""
    return next(name for name in missions.WHAT if getattr(event, name) is not None)


def block(seed: int, index: int) -> Recipe:
    """Ground and team of a block, as a recipe of missions without events."""
    rng = np.random.default_rng([seed, index, 0])
    teams = mixtures(seed, index // sum(TEAMS.values()))
    kinds = teams[index % len(teams)]
    return Recipe(
        str(rng.choice(("mare", "highland"))), int(rng.integers(1000)), seed,
        side=int(rng.choice(list(SIDES), p=list(SIDES.values()))),
        team=tuple((f"{kind}{i + 1}", kind) for i, kind in enumerate(kinds)), planner="greedy")


@functools.lru_cache(maxsize=1)
def mixtures(seed: int, cycle: int) -> tuple[tuple[str, ...], ...]:
    """The kinds of the robots of the blocks of a cycle, in random order."""
    rng = np.random.default_rng([seed, cycle, 1])
    found = []
    for robots, blocks in TEAMS.items():
        teams = list(itertools.combinations_with_replacement(OWN, robots))
        found += [teams[k % len(teams)] for k in range(blocks)]
    return tuple(found[k] for k in rng.permutation(len(found)))


def who_decides(seed: int, number: int) -> Who:
    """Planner, mode and the planner's seed of a mission."""
    rng = np.random.default_rng([seed, number, 2])
    planner = str(rng.choice(list(PLANNERS), p=list(PLANNERS.values())))
    mode = MODES[rng.integers(len(MODES))]
    return Who(planner, mode, number, LIMITS.get(planner) if mode == "clock" else None)


def recipe_targets(seed: int, number: int) -> int:
    """Targets of a mission, before events: 1 to 8, one eight times as often as eight."""
    chances = 1 / np.arange(1, MOST_TARGETS + 1)
    rng = np.random.default_rng([seed, number, 3])
    return 1 + int(rng.choice(MOST_TARGETS, p=chances / chances.sum()))


@functools.lru_cache(maxsize=1)
def _stage(seed: int, index: int) -> Stage:
    """The missions of a block. Raises InputError where its ground allows none."""
    if index % FORGET == 0:
        compilation.forget()
    recipe = block(seed, index)
    site, passable = ground_of(recipe)
    drawn = [_draw(recipe, number, site, passable)
             for number in range(index * BLOCK, (index + 1) * BLOCK)]
    fleet = fleet_of(drawn, [1] * len(drawn), site, passable)
    return Stage(fleet, make_backend("native", fleet.scene))


def _draw(recipe: Recipe, number: int, site: Any, passable: dict[str, Any]) -> Mission:
    rng = np.random.default_rng([recipe.seed, number, 4])
    lose, slow, silent = (float(chance) for chance in rng.choice((0.0, 0.0, 1.0), 3))
    rates = Rates(lose, slow, silent, int(rng.integers(MOST_NEW + 1)), int(rng.integers(3)))
    mission, _ = draw_mission(
        replace(recipe, num_targets=recipe_targets(recipe.seed, number), rates=rates,
                max_steps=4 * recipe.side + 32), number, site, passable)
    mission = msgspec.structs.replace(mission, name=f"soak-{recipe.seed}-{number}")
    if who_decides(recipe.seed, number).mode != "clock":
        return mission
    clocked = by_the_clock(mission, grid_problem(mission, passable), rng)
    return missions.check(clocked, clocked.name)


def by_the_clock(mission: Mission, scenario: Scenario, rng: np.random.Generator) -> Mission:
    """The mission in seconds, with what only the clock knows: services, coalitions by number,
    an order of targets, windows, homes, slower robots, places off the lattice.
    """
    reach = travel_times(Snapshot.start(scenario)).start < UNREACHABLE  # [R, M]
    targets: list[Target] = []
    for j, target in enumerate(mission.targets):
        able = [robot for robot, comes in zip(mission.robots, reach[:, j], strict=True) if comes]
        names = tuple(f"T{k + 1}" for k in range(j))
        targets.append(_timed(target, able, names, rng))
    return msgspec.structs.replace(
        mission, clock="seconds", max_seconds=120.0 + 10.0 * mission.map.size[0], max_steps=128,
        robots=tuple(_unlike(robot, rng) for robot in mission.robots), targets=tuple(targets),
        events=tuple(_at_second(event) for event in mission.events))


def _timed(target: Target, able: list[Robot], before: tuple[str, ...],
           rng: np.random.Generator) -> Target:
    chance = rng.random(6)
    dx, dy = (round(float(d), 2) for d in rng.uniform(-0.4, 0.4, 2))
    changes: dict[str, Any] = {"at": (target.at[0] + dx, target.at[1] + dy)}
    if chance[0] < 0.5:
        changes["service"] = round(float(rng.uniform(0, SERVICE_S)), 1)
    if target.type == "AND" and chance[1] < 0.5:
        have = {skill: min(MOST_ALIKE, sum(skill in robot.skills for robot in able))
                for skill in target.skills}
        changes |= {"skills": (), "type": "OR", "coalition": {
            skill: int(rng.integers(1, count + 1)) for skill, count in have.items()}}
    if before and chance[2] < 0.2:
        changes["after"] = (str(rng.choice(before)),)
    if chance[3] < 0.15:
        changes["appears"] = round(float(rng.uniform(0, APPEARS_S)), 1)
    if chance[4] < 0.1:
        changes["lapses"] = changes.get("appears", 0.0) + OPEN_S
    return msgspec.structs.replace(target, **changes)


def _unlike(robot: Robot, rng: np.random.Generator) -> Robot:
    """Perhaps slower than its kind, perhaps with a home."""
    slower, homing = rng.random(2) < 0.25
    speed = round(0.7 * KINDS.get(robot.kind).speed, 3) if slower else None
    return msgspec.structs.replace(robot, speed=speed, home=robot.start if homing else None)


def _at_second(event: Event) -> Event:
    silent = event.silent and Silent(
        event.silent.robot, seconds=DECISION_S * event.silent.decisions)
    return msgspec.structs.replace(event, at_decision=0, at_s=DECISION_S * event.at_decision,
                                   silent=silent)


def memory(entries: list[Entry]) -> dict[str, Any]:
    """The line through resident memory against missions, MiB a 1000 missions: over all of them
    and over the second half, when all shapes have been compiled. Each process has its own offset.

    Within a stretch of `FORGET` blocks memory rises, for what was compiled is kept; what does not
    come back after it is a leak, so the lowest and highest of each stretch stand beside the line.
    """
    half = entries[len(entries) // 2:]
    stretches = [[e.resident_mib for e in group] for _, group in itertools.groupby(
        entries, key=lambda entry: entry.number // (FORGET * BLOCK))]
    return {"first_mib": entries[0].resident_mib if entries else None,
            "last_mib": entries[-1].resident_mib if entries else None,
            "most_mib": max((e.resident_mib for e in entries), default=None),
            "slope": _slope(entries), "slope_second_half": _slope(half),
            "lowest_mib": [min(one) for one in stretches],
            "highest_mib": [max(one) for one in stretches]}


def _slope(entries: list[Entry]) -> float | None:
    across = along = 0.0
    for _, group in itertools.groupby(entries, key=lambda entry: entry.process):
        points = np.array([(entry.number, entry.resident_mib) for entry in group])
        x, y = (points - points.mean(0)).T
        across, along = across + float(x @ y), along + float(x @ x)
    return round(1000 * across / along, 1) if along else None


def figure(entries: list[Entry]) -> Figure:
    """Resident memory against missions."""
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(7, 3), layout="constrained")
    axes = drawn.subplots()
    for _, group in itertools.groupby(entries, key=lambda entry: entry.process):
        points = [(entry.number, entry.resident_mib) for entry in group]
        axes.plot(*zip(*points, strict=True), ".", markersize=2, color="tab:blue")
    axes.set(xlabel="mission", ylabel="resident memory (MiB)", ylim=(0, None))
    axes.grid(alpha=0.3)
    return drawn


def table(entries: list[Entry], key: Callable[[Entry], str]) -> list[list[str]]:
    """A row for each value of `key`: missions, solved, failures by cause, wall s a mission."""
    groups: dict[str, list[Entry]] = {}
    for entry in entries:
        groups.setdefault(key(entry), []).append(entry)
    return [[name, str(len(group)), str(sum(entry.success for entry in group)),
             "; ".join(f"{cause}: {len(numbers)}" for cause, numbers in failures(group).items())
             or "-", f"{sum(entry.wall_s for entry in group) / len(group):.2f}"]
            for name, group in sorted(groups.items())]


def failures(entries: list[Entry]) -> dict[str, list[int]]:
    """Cause -> numbers of the missions that failed for it, the most frequent first."""
    found: dict[str, list[int]] = {}
    for entry in entries:
        if not entry.success:
            found.setdefault(str(entry.cause), []).append(entry.number)
    return dict(sorted(found.items(), key=lambda item: (-len(item[1]), item[0])))
