"""Random missions on one site: many worlds of one scene, drawn from seeds.

Skills, targets and cells are drawn as in training (`grid.scenarios`); a draw is repeated where
the ground forbids it: a start that the kind cannot stand on, a target that the robots with its
skills cannot reach. Events come at random in the middle half of the mission, by the length of
the plan, so that they are the same whoever plans.

Legend: R robots, F missions of a fleet, K kinds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import msgspec
import numpy as np
import numpy.typing as npt

from moonteam.errors import InputError
from moonteam.grid import scenarios
from moonteam.physics.scene import Placement, Scene, build_scene, check_starts, start_pose
from moonteam.planners import registry, simulate
from moonteam.planners.base import IntArray, Plan, Snapshot, WholePlanner
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
from moonteam.problem.scenario import Scenario
from moonteam.robots import KINDS, OWN, team
from moonteam.terrain.site import Site as Ground
from moonteam.terrain.site import for_mission
from moonteam.terrain.traversability import passable_cells
from sim2grid.frame import Frame
from sim2grid.loop.asked import Body
from sim2grid.loop.prepare import bodies_of
from sim2grid.loop.replan import grid_problem, unsolvable, with_target
from sim2grid.waypoints import waypoints

TEAM: tuple[tuple[str, str], ...] = tuple(
    (KINDS.get(kind).callsign or kind, kind) for kind in OWN)
"""Names and kinds of the robots of a random mission."""

MOST_DRAWS = 10_000
SLOW_FACTORS = (0.3, 0.7)
SILENT_DECISIONS = (5, 15)

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
    team: tuple[tuple[str, str], ...] = TEAM  # names and kinds
    planner: str = "exact"  # whose plan says that it can be done in time, and when events come

    @property
    def site(self) -> Site:
        """The ground, as a mission names it."""
        return Site(preset=self.preset, seed=self.site_seed)


@dataclass(frozen=True)
class Fleet:
    """Missions of the same robots on the same ground, with what their executions need."""

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

    @property
    def bases(self) -> tuple[int, ...]:
        """Index of each robot's free joint in qpos."""
        return tuple(body.base for body in self.bodies)


def make_fleet(recipe: Recipe, count: int,
               change: Callable[[Ground], Ground] = lambda ground: ground) -> Fleet:
    """The first `count` missions of a recipe, on their ground after a `change`.

    Raises InputError for numbers out of range, or ground that allows no mission.
    """
    site, passable = ground_of(recipe, change)
    drawn = [draw_mission(recipe, number, site, passable) for number in range(count)]
    return fleet_of([m for m, _ in drawn], [n for _, n in drawn], site, passable)


def ground_of(recipe: Recipe, change: Callable[[Ground], Ground] = lambda ground: ground
              ) -> tuple[Ground, dict[str, BoolArray]]:
    """The site of a recipe's missions, and [H, W] cells that each kind of the team can cross."""
    empty = Mission(Map((recipe.side, recipe.side), recipe.cell_m), tuple(
        Robot(name, kind, ("A",), (0, 0)) for name, kind in recipe.team), (), recipe.site)
    site = change(for_mission(empty))
    kinds = {kind: KINDS.get(kind) for _, kind in recipe.team}
    return site, passable_cells(site, empty, team.limits(kinds))


def fleet_of(chosen: list[Mission], draws: list[int], site: Ground,
             passable: dict[str, BoolArray]) -> Fleet:
    """Missions with the same robots by name and kind, on one site."""
    frame = Frame(chosen[0].map.size, chosen[0].map.cell_m)
    scene = build_scene(site, placements(chosen[0], frame))
    starts = []
    for mission in chosen:
        pose = scene.qpos0.copy()
        for robot, placement in zip(scene.robots, placements(mission, frame), strict=True):
            pose[robot.qpos] = start_pose(site, placement)
        starts.append(pose)
    return Fleet(tuple(chosen), tuple(draws),
                 tuple(grid_problem(mission, passable) for mission in chosen),
                 frame, site, passable, {r.kind.name: r.kind for r in scene.robots}, scene,
                 bodies_of(scene), np.stack(starts))


def placements(mission: Mission, frame: Frame) -> list[Placement]:
    """Where the robots of a mission stand at its start."""
    starts = waypoints(frame, np.array([r.cell for r in mission.robots]),
                       np.ones(len(mission.robots), bool))
    return [Placement(robot.name, KINDS.get(robot.kind), (float(x), float(y)))
            for robot, (x, y) in zip(mission.robots, starts, strict=True)]


def draw_mission(recipe: Recipe, number: int, site: Ground,
                 passable: dict[str, BoolArray]) -> tuple[Mission, int]:
    """Mission `number` of a recipe, and how many draws it took. Raises InputError."""
    rng = np.random.default_rng([recipe.seed, recipe.site_seed, number])
    kinds = [kind for _, kind in recipe.team]
    planner = registry.make(recipe.planner)
    for draws in range(1, MOST_DRAWS + 1):
        drawn = scenarios.generate(
            rng, num_agents=len(kinds), num_targets=recipe.num_targets,
            size=(recipe.side, recipe.side), max_steps=recipe.max_steps, kinds=kinds)
        mission = Mission(
            Map(drawn.size, recipe.cell_m),
            tuple(Robot(name, kind, robot.skills, robot.at) for (name, kind), robot
                  in zip(recipe.team, drawn.agents, strict=True)),
            tuple(Target(t.at, t.skills, t.type) for t in drawn.targets),
            recipe.site, f"{recipe.preset}-{recipe.site_seed}-{number}", recipe.max_steps)
        if plan := _allowed(mission, site, passable, planner):
            events = _draw_events(recipe.rates, mission, grid_problem(mission, passable), plan, rng)
            done = msgspec.structs.replace(mission, events=events)
            return missions.check(done, done.name), draws
    raise InputError(f"site {recipe.preset} {recipe.site_seed}",
                     f"allows none of {MOST_DRAWS} random missions")


def _allowed(mission: Mission, site: Ground, passable: dict[str, BoolArray],
             planner: WholePlanner) -> Plan | None:
    """The plan, if every robot may stand at its start and every target can be solved in time."""
    for robot in mission.robots:
        x, y = robot.cell
        if not passable[robot.kind][y, x]:
            return None
    snapshot = Snapshot.start(grid_problem(mission, passable))
    if unsolvable(snapshot):
        return None
    try:
        check_starts(site, placements(mission, Frame(mission.map.size, mission.map.cell_m)))
    except InputError:
        return None
    plan = planner.plan(snapshot)
    return None if plan.makespan is None else plan


def _draw_events(rates: Rates, mission: Mission, scenario: Scenario, plan: Plan,
                 rng: np.random.Generator) -> tuple[Event, ...]:
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
        events += _closed_ways(rates.impassable, cells, mission, when, rng)
    return tuple(sorted(events, key=lambda event: event.at_decision))


def _closed_ways(count: int, cells: IntArray, mission: Mission,
                 when: Callable[[], int], rng: np.random.Generator) -> list[Event]:
    """News that a cell which the plan, at `cells` [T + 1, R, 2], has yet to cross with a
    robot on the ground is closed to its kind.
    """
    on_ground = [i for i, robot in enumerate(mission.robots) if not KINDS.get(robot.kind).flies]
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
    taken = {target.cell for target in mission.targets}
    found: list[Target] = []
    while len(found) < count:
        skills = tuple(skill for skill in team if rng.random() < 0.5)
        at = (int(rng.integers(mission.map.size[0])), int(rng.integers(mission.map.size[1])))
        target = Target(at, skills, "AND" if rng.random() < 0.5 and len(skills) > 1 else "OR",
                        f"N{len(found) + 1}")
        if not skills or at in taken:
            continue
        need = sum(1 << "ABCDEFGH".index(skill) for skill in skills)
        if not unsolvable(with_target(snapshot, target, need)):
            taken.add(at)
            found.append(target)
    return found
