"""Random missions on one site, or on several in turn: many worlds of one scene, from seeds.

Skills, targets and cells are drawn as in training (`grid.scenarios`); a draw is repeated where
the ground forbids it: a start that the kind cannot stand on, a target that the robots with its
skills cannot reach. Events come at random in the middle half of the mission, by the length of
the plan, so that they are the same whoever plans.

Legend: R robots, F missions of a fleet, K kinds.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
import numpy.typing as npt

from moonteam.errors import InputError
from moonteam.grid import scenarios
from moonteam.loading import decode_mission, load_mission
from moonteam.physics.scene import Placement, Scene, build_scene, check_starts, start_pose
from moonteam.planners import registry, simulate
from moonteam.planners.base import IntArray, Plan, Snapshot, WholePlanner
from moonteam.planners.unfolding.draw import EVERY_S, LOSS, SENSOR_M, STAYS, WORTH
from moonteam.planners.unfolding.future import lapsing
from moonteam.problem import mission as missions
from moonteam.problem.mission import (
    Event,
    Impassable,
    Map,
    Mission,
    Robot,
    Silent,
    Site,
    Slow,
    Target,
)
from moonteam.problem.scenario import MAX_SKILLS, MOST_AGENTS, Scenario
from moonteam.problem.timed import Prospect
from moonteam.robots import KINDS, OWN, RobotKind, team
from moonteam.terrain.site import Site as Ground
from moonteam.terrain.site import for_mission
from moonteam.terrain.traversability import passable_cells
from sim2grid.frame import Frame
from sim2grid.loop.asked import Body
from sim2grid.loop.prepare import bodies_of, prepare
from sim2grid.loop.replan import grid_problem, unsolvable, with_target
from sim2grid.waypoints import waypoints

TEAM: tuple[tuple[str, str], ...] = tuple(
    (KINDS.get(kind).callsign or kind, kind) for kind in OWN)
"""Names and kinds of the robots of a random mission."""

MOST_DRAWS = 10_000
SLOW_FACTORS = (0.3, 0.7)
SILENT_DECISIONS = (5, 15)

Unfold = Literal["following", "arrivals", "lapsing", "hidden", "losses"]
"""What nobody knows yet in random missions: targets that come when others are solved, or by the
clock, or that besides lapse and are worth more or less; hidden targets; a robot that is lost.
"""
MORE = 5
"""Targets that come, beside those that are known."""

BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Rates:
    """What happens to random missions: chances for each mission, and numbers of things."""

    lose: float = 0.0  # that one robot is lost
    slow: float = 0.0  # that one robot is slowed
    silent: float = 0.0  # that one robot is silent for some decisions
    new_targets: int = 0
    impassable: int = 0  # cells on the way of the plan that turn out closed to a kind


@dataclass(frozen=True)
class Recipe:
    """How the missions of a fleet are drawn; the same recipe gives the same missions."""

    preset: str
    site_seed: int
    seed: int
    num_targets: int = 5
    side: int = 32
    cell_m: float = 1.0
    max_steps: int = 128
    rates: Rates = Rates()
    team: tuple[tuple[str, str], ...] = TEAM  # names and kinds, which may be FILE.py:OBJECT
    planner: str = "exact"  # whose plan says that it can be done in time, and when events come
    skills: tuple[tuple[str, ...], ...] = ()  # of each robot; those of one with none are drawn
    ground: Site | None = None  # in place of the preset, which then is but its name
    sites: int = 1  # seeds of the ground, from site_seed on, which its missions go round
    unfold: Unfold | None = None  # then they are by the clock
    max_seconds: float = 600.0  # of those

    @property
    def site(self) -> Site:
        """The ground, as a mission names it."""
        return self.ground or Site(preset=self.preset, seed=self.site_seed)

    def of_site(self, index: int) -> Recipe:
        """Of one of its sites alone."""
        ground = self.ground and msgspec.structs.replace(
            self.ground, seed=self.ground.seed + index)
        return replace(self, site_seed=self.site_seed + index, ground=ground, sites=1)

    @property
    def source(self) -> str:
        """What its ground is called in messages."""
        return f"site {self.preset} {self.site_seed}"

    def eventful(self) -> bool:
        """Whether something may happen in its missions."""
        return self.rates != Rates() or self.unfold is not None


@dataclass(frozen=True)
class Given:
    """A mission of a user's in place of drawn ones: its file, the name of a bundled one, or one
    that was made in Python, of which `text` is the JSON.
    """

    name: str
    text: str = ""

    @classmethod
    def of(cls, mission: Mission) -> Given:
        """One that was made in Python."""
        return cls(mission.name or "mission", msgspec.json.encode(mission).decode())

    def mission(self) -> Mission:
        """The mission, checked. Raises InputError."""
        return decode_mission(self.text, self.name) if self.text else load_mission(self.name)

    def eventful(self) -> bool:
        """Whether something happens in it."""
        return bool(self.mission().events)


GIVEN = "missions"
"""What stands for the site of missions that were given."""


@dataclass(frozen=True)
class Fleet:
    """Missions of the same robots, with what their executions need.

    All are on the same ground, or each on one of `scene.sites` by `grounds`; then `site` and
    `passable` are the first's.
    """

    missions: tuple[Mission, ...]
    draws: tuple[int, ...]  # how often each was drawn until the ground allowed it
    scenarios: tuple[Scenario, ...]
    frame: Frame
    site: Ground
    passable: dict[str, BoolArray]  # kind -> [H, W], indexed [y, x]
    kinds: team.Kinds
    scene: Scene
    bodies: tuple[Body, ...]
    starts: npt.NDArray[np.float64]  # [F, nq]
    written: tuple[Mission, ...] = ()  # where a kind may be FILE.py:OBJECT; as `missions` if empty
    label: str = ""  # in place of the site's name
    grounds: tuple[int, ...] = ()  # [F] of each mission, where there are several

    def site_of(self, k: int) -> Ground:
        """The ground of mission `k`."""
        return self.scene.sites[self.grounds[k]] if self.grounds else self.site

    def place_of(self, k: int) -> tuple[str, int]:
        """Name and seed of mission `k`'s ground, by which rows are put together."""
        site = self.site_of(k)
        return (self.label, 0) if self.label else (site.name, site.seed)

    def entry(self, k: int) -> Mission:
        """Mission `k` as a file would have it."""
        return (self.written or self.missions)[k]

    @property
    def bases(self) -> tuple[int, ...]:
        """Index of each robot's free joint in qpos."""
        return tuple(body.base for body in self.bodies)


def parse_team(text: str) -> tuple[tuple[tuple[str, str], ...], tuple[tuple[str, ...], ...]]:
    """Names with kinds, and skills, of `KIND:SKILLS,KIND:SKILLS,...`.

    A kind is a registered name or FILE.py:OBJECT; skills are capital letters (AB) or names joined
    by + (drill+camera), or left out, to be drawn. Raises InputError for what is none of this.
    """
    names: list[str] = []
    kinds, skills = [], []
    for part in text.split(","):
        file, dot, rest = part.strip().rpartition(".py:")
        kind, _, said = rest.partition(":")
        kinds.append(file + dot + kind)
        skills.append(_skills(said, part) if said or part.rstrip().endswith(":") else ())
        known = KINDS.get(kinds[-1], "--team")
        name = known.callsign or known.name
        count = 1 + sum(other.rstrip("0123456789") == name for other in names)
        names.append(name if count == 1 else f"{name}{count}")
    if len({skill for its in skills for skill in its}) > MAX_SKILLS:
        raise InputError("--team", f"too many different skills; at most {MAX_SKILLS}")
    if len(kinds) > MOST_AGENTS:
        raise InputError("--team", f"{len(kinds)} robots; at most {MOST_AGENTS}")
    return tuple(zip(names, kinds, strict=True)), tuple(skills) if any(skills) else ()


def _skills(said: str, part: str) -> tuple[str, ...]:
    """What stands behind a kind. Raises InputError."""
    letters = said.isascii() and set(said) <= set(scenarios.LETTERS)
    found = tuple(said) if letters else tuple(said.split("+"))
    for skill in found:
        if not skill.replace("_", "").replace("-", "").isalnum() or found.count(skill) > 1:
            raise InputError("--team", f"{part.strip()!r} is not allowed; KIND or KIND:SKILLS, "
                             "skills as letters A to H or names joined by +, each once, such as "
                             "scout.py:SCOUT:A,rover.py:ROVER:drill+camera")
    return found or _skills("?", part)


def make_fleet(recipe: Recipe | Given, count: int,
               change: Callable[[Ground], Ground] = lambda ground: ground) -> Fleet:
    """The first `count` missions of a recipe, on their ground after a `change`.

    Of G sites missions go round: mission k is the k // G-th of site k % G alone. Raises InputError
    for numbers out of range, or ground that allows no mission.
    """
    if isinstance(recipe, Given):
        return fleet_of_one(recipe.mission(), recipe.name)
    alone = [recipe.of_site(index) for index in range(min(recipe.sites, count))]
    made = [ground_of(its, change) for its in alone]
    standing = [k % len(made) for k in range(count)]
    # The same missions whatever is believed of the ground.
    able = made if all(site.known for site, _ in made) else [
        ground_of(replace(its, ground=msgspec.structs.replace(its.site, fields="measured")), change)
        for its in alone]
    drawn = [draw_mission(alone[g], k // len(made), made[g][0], able[g][1])
             for k, g in enumerate(standing)]
    chosen, kinds = [mission for mission, _ in drawn], crew(recipe)
    fleet = _fleet(chosen, [draws for _, draws in drawn], made, standing, kinds)
    files = {kinds[i].name: os.fspath(Path(written).resolve())
             for i, (_, written) in enumerate(recipe.team) if ".py:" in written}
    return replace(fleet, written=tuple(
        team.with_kinds(mission, lambda name, _: files.get(name, name)) for mission in chosen))


def fleet_of_one(written: Mission, source: object) -> Fleet:
    """One mission as it was given. Raises InputError, see `prepare`."""
    its = prepare(written, source)
    return Fleet((its.mission,), (0,), (its.scenario,), its.frame, its.site, its.passable,
                 its.kinds, its.scene, its.bodies, its.scene.qpos0[None], (written,), GIVEN)


def crew(recipe: Recipe) -> list[RobotKind]:
    """Each robot's kind. Raises InputError for one that nobody knows."""
    found = [KINDS.get(kind, "--team") for _, kind in recipe.team]
    for one in found:
        other = next(kind for kind in found if kind.name == one.name)
        if other is not one:
            raise InputError("--team", f"two different kinds are called {one.name!r}; rename one")
    return found


def ground_of(recipe: Recipe, change: Callable[[Ground], Ground] = lambda ground: ground
              ) -> tuple[Ground, dict[str, BoolArray]]:
    """The site of a recipe's missions, and [H, W] cells that each kind of the team can cross.

    Raises InputError where there is none, or a robot of the team can be nowhere on it.
    """
    kinds = {kind.name: kind for kind in crew(recipe)}
    empty = Mission(Map((recipe.side, recipe.side), recipe.cell_m), (), (), recipe.site)
    site = change(for_mission(empty))
    passable = passable_cells(site, empty, team.limits(kinds, site))
    for name, cells in passable.items():
        if not cells.any():
            raise InputError(recipe.source, f"no cell of it is open to a {name} robot (slopes, "
                             "steps, boulders); other ground or another team is needed")
    return site, passable


def fleet_of(chosen: list[Mission], draws: list[int], site: Ground,
             passable: dict[str, BoolArray], kinds: Sequence[RobotKind] = ()) -> Fleet:
    """Missions with the same robots by name and kind, on one site.

    `kinds` are those of the robots; without them kinds are registered.
    """
    return _fleet(chosen, draws, [(site, passable)], [0] * len(chosen), kinds)


def _fleet(chosen: list[Mission], draws: list[int],
           made: Sequence[tuple[Ground, dict[str, BoolArray]]], standing: Sequence[int],
           kinds: Sequence[RobotKind]) -> Fleet:
    """Missions of the same robots, each on one of the sites `made` by `standing` [F], the first on
    the first; as `ground_of` gives these.
    """
    frame = Frame(chosen[0].map.size, chosen[0].map.cell_m)
    kinds = kinds or [KINDS.get(robot.kind) for robot in chosen[0].robots]
    scene = build_scene([site for site, _ in made], placements(chosen[0], frame, kinds))
    starts = []
    for mission, g in zip(chosen, standing, strict=True):
        pose = scene.qpos0.copy()
        for robot, placement in zip(scene.robots, placements(mission, frame, kinds),
                                    strict=True):
            pose[robot.qpos] = start_pose(made[g][0], placement)
        starts.append(pose)
    return Fleet(tuple(chosen), tuple(draws),
                 tuple(grid_problem(mission, made[g][1])
                       for mission, g in zip(chosen, standing, strict=True)),
                 frame, *made[0], {r.kind.name: r.kind for r in scene.robots}, scene,
                 bodies_of(scene), np.stack(starts),
                 grounds=tuple(standing) if len(made) > 1 else ())


def placements(mission: Mission, frame: Frame, kinds: Sequence[RobotKind]) -> list[Placement]:
    """Where the robots of a mission, of these kinds, stand at its start."""
    starts = waypoints(frame, np.array([r.cell for r in mission.robots]),
                       np.ones(len(mission.robots), bool))
    return [Placement(robot.name, kind, (float(x), float(y)))
            for robot, kind, (x, y) in zip(mission.robots, kinds, starts, strict=True)]


def draw_mission(recipe: Recipe, number: int, site: Ground,
                 passable: dict[str, BoolArray]) -> tuple[Mission, int]:
    """Mission `number` of a recipe, and how many draws it took. Raises InputError."""
    rng = np.random.default_rng([recipe.seed, recipe.site_seed, number])
    kinds, names = crew(recipe), sorted({name for skills in recipe.skills for name in skills})
    planner = registry.make(recipe.planner)
    for draws in range(1, MOST_DRAWS + 1):
        drawn = _named(scenarios.generate(
            rng, num_agents=len(kinds), num_targets=recipe.num_targets,
            num_skills=len(names) or 2, size=(recipe.side, recipe.side),
            max_steps=recipe.max_steps, kinds=[kind.name for kind in kinds]), names)
        mission = Mission(
            Map(drawn.size, recipe.cell_m),
            tuple(Robot(name, kind.name, given or robot.skills, robot.at)
                  for (name, _), kind, given, robot in zip(
                      recipe.team, kinds, recipe.skills or [()] * len(kinds), drawn.agents,
                      strict=True)),
            tuple(Target(t.at, t.skills, t.type) for t in drawn.targets),
            recipe.site, f"{recipe.preset}-{recipe.site_seed}-{number}", recipe.max_steps)
        if plan := _allowed(mission, site, passable, planner, kinds):
            events = _draw_events(recipe.rates, mission, grid_problem(mission, passable), plan,
                                  rng, kinds)
            # Without rates nothing comes of these; by the clock other things do.
            done = (msgspec.structs.replace(mission, events=events) if recipe.unfold is None
                    else _unfolding(recipe, mission, passable, rng))
            return missions.check(done, done.name), draws
    share = ", ".join(f"{name} {100 * cells.mean():.0f} %" for name, cells in passable.items())
    raise InputError(recipe.source, f"allows none of {MOST_DRAWS} random missions; cells open to: "
                     f"{share}")


def _unfolding(recipe: Recipe, mission: Mission, passable: dict[str, BoolArray],
               rng: np.random.Generator) -> Mission:
    """The mission by the clock, with what nobody knows of it beforehand."""
    robots, targets, expects = mission.robots, mission.targets, Prospect()
    events: list[Event] = []
    if recipe.unfold == "hidden":
        robots = tuple(msgspec.structs.replace(r, sensor_m=SENSOR_M) for r in robots)
        events = [Event(target=target, on_sight=True) for target in targets]
        targets = ()
    elif recipe.unfold == "losses":
        expects, when = Prospect(loss=LOSS), float(rng.uniform(0.0, LOSS.until))
        who = robots[int(rng.integers(len(robots)))].name
        if rng.random() < LOSS.share:
            events = [Event(lost=who, at_s=round(when, 2))]
    else:
        snapshot = Snapshot.start(grid_problem(mission, passable))
        come = _new_targets(MORE, snapshot, mission, rng)
        times = np.cumsum(rng.exponential(EVERY_S, MORE)).round(2).tolist()
        if recipe.unfold != "following":
            expects = Prospect(every=EVERY_S) if recipe.unfold == "arrivals" else Prospect(
                every=EVERY_S, worth=WORTH, stays=STAYS)
            come = [msgspec.structs.replace(t, **lapsing(expects, s, rng))
                    for t, s in zip(come, times, strict=True)]
            events = [Event(target=t, at_s=s) for t, s in zip(come, times, strict=True)]
        else:
            events = [Event(target=t, at_solved=k) for k, t in enumerate(come, 1)]
    return msgspec.structs.replace(
        mission, robots=robots, targets=targets, events=tuple(events), expects=expects,
        clock="seconds", max_seconds=recipe.max_seconds)


def _named(drawn: Scenario, names: Sequence[str]) -> Scenario:
    """The scenario with its letters standing for `names`, where there are any."""
    if not names:
        return drawn

    def named(skills: Sequence[str]) -> tuple[str, ...]:
        return tuple(names[scenarios.LETTERS.index(letter)] for letter in skills)

    return msgspec.structs.replace(
        drawn, agents=tuple(msgspec.structs.replace(a, skills=named(a.skills))
                            for a in drawn.agents),
        targets=tuple(msgspec.structs.replace(t, skills=named(t.skills)) for t in drawn.targets))


def _allowed(mission: Mission, site: Ground, passable: dict[str, BoolArray],
             planner: WholePlanner, kinds: Sequence[RobotKind]) -> Plan | None:
    """The plan, if every robot may stand at its start and every target can be solved in time."""
    for robot in mission.robots:
        x, y = robot.cell
        if not passable[robot.kind][y, x]:
            return None
    snapshot = Snapshot.start(grid_problem(mission, passable))
    if unsolvable(snapshot):
        return None
    try:
        check_starts(site, placements(mission, Frame(mission.map.size, mission.map.cell_m), kinds))
    except InputError:
        return None
    plan = planner.plan(snapshot)
    return None if plan.makespan is None else plan


def _draw_events(rates: Rates, mission: Mission, scenario: Scenario, plan: Plan,
                 rng: np.random.Generator, kinds: Sequence[RobotKind]) -> tuple[Event, ...]:
    """Events in the middle half of the plan, in the order of their decisions."""
    snapshot = Snapshot.start(scenario)
    length = plan.makespan or 1
    names = [robot.name for robot in mission.robots]

    def when() -> int:
        return int(rng.integers(max(1, length // 4), max(2, 3 * length // 4 + 1)))

    # Drawn whether they happen or not, so that one rate does not change what the others bring.
    chances = rng.random(3)
    lost = Event(when(), lost=str(rng.choice(names)))
    slow = Event(when(), slow=Slow(str(rng.choice(names)),
                                   round(float(rng.uniform(*SLOW_FACTORS)), 2)))
    silent = Event(when(), silent=Silent(str(rng.choice(names)),
                                         int(rng.integers(*SILENT_DECISIONS))))
    events = [event for event, chance, rate in zip(
        (lost, slow, silent), chances, (rates.lose, rates.slow, rates.silent), strict=True)
        if chance < rate]
    events += [Event(when(), target=target)
               for target in _new_targets(rates.new_targets, snapshot, mission, rng)]
    if rates.impassable:
        cells = simulate.replay(snapshot, plan.actions).cells
        ground = [i for i, kind in enumerate(kinds) if not kind.flies]
        events += _closed_ways(rates.impassable, cells, mission, ground, when, rng)
    return tuple(sorted(events, key=lambda event: event.at_decision))


def _closed_ways(count: int, cells: IntArray, mission: Mission, on_ground: Sequence[int],
                 when: Callable[[], int], rng: np.random.Generator) -> list[Event]:
    """News that a cell which the plan, at `cells` [T + 1, R, 2], has yet to cross with a
    robot on the ground is closed to its kind.
    """
    found: list[Event] = []
    if not on_ground:
        return found
    for _ in range(count):
        at, robot = when(), int(rng.choice(on_ground))
        step = int(rng.integers(min(at + 1, len(cells) - 1), len(cells)))
        x, y = cells[step, robot].tolist()
        found.append(Event(at, impassable=Impassable(mission.robots[robot].kind, (x, y))))
    return found


def _new_targets(count: int, snapshot: Snapshot, mission: Mission,
                 rng: np.random.Generator) -> list[Target]:
    """Targets on free cells that the whole team can solve."""
    team = sorted({skill for robot in mission.robots for skill in robot.skills})
    bits = mission.scenario().skill_bits
    taken = {target.cell for target in mission.targets}
    found: list[Target] = []
    while len(found) < count:
        skills = tuple(skill for skill in team if rng.random() < 0.5)
        at = (int(rng.integers(mission.map.size[0])), int(rng.integers(mission.map.size[1])))
        target = Target(at, skills, "AND" if rng.random() < 0.5 and len(skills) > 1 else "OR",
                        f"N{len(found) + 1}")
        if not skills or at in taken:
            continue
        need = sum(bits[skill] for skill in skills)
        if not unsolvable(with_target(snapshot, target, need)):
            taken.add(at)
            found.append(target)
    return found
