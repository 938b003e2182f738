"""What a user writes: robots, targets, map, site, events. YAML in, checked.

Knows neither wing; both read it. Which kinds of robot there are is `moonteam.robots.team`'s to say.
"""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from moonteam import files
from moonteam.errors import InputError, meant
from moonteam.problem import scenario, timed
from moonteam.problem.battery import Battery
from moonteam.problem.piece import Piece, Units
from moonteam.problem.scenario import MOST_AGENTS, MOST_STEPS, MOST_TARGETS, Cell, Name, Skills
from moonteam.problem.sun import Sun
from moonteam.strict import yaml_value

WHAT = ("lost", "target", "slow", "silent", "impassable")
"""Keys of an event, one of which says what happens."""

MOST_EVENTS = 1024
MOST_SEED = 2**31 - 1
SLOWEST = 0.001
"""m/s that a robot may be slowed down to."""

Place = tuple[int | float, int | float]
"""(x, y) in cells, [0, 0] the centre of the cell in the lower left; a cell where both are whole."""


SoilName = Literal["nominal", "loose", "dense", "lunar", "grc1"]
"""The soils of `moonteam.terrain.soil`."""


class Map(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The mission grid: `size` in cells (W, H), `cell_m` metres a side of a cell."""

    size: tuple[int, int]
    cell_m: float = 1.0


class Site(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """The ground: a `preset` made from `seed`, or a `dem` file (GeoTIFF or .npy).

    `ground` is rigid, or regolith, in which wheels and feet sink and slip, of a `soil` that
    `seed` scatters; `fields` of it are as robots were measured on that soil, or as on rigid
    ground; `thrift` is how much a way's energy there counts beside its time, from 0 to 1. The
    other keys are of a `dem`: which piece of it (`Piece`); metres a `pixel`
    and a unit of elevation (`scale`) where the file does not say; `detrend` takes the plane of
    best fit out; `detail` adds relief finer than its pixels, from `seed`.
    """

    preset: str | None = None
    dem: str | None = None
    seed: int = 0
    ground: Literal["rigid", "regolith"] = "rigid"
    soil: SoilName = "nominal"
    fields: Literal["measured", "rigid"] = "measured"
    thrift: float = 0.0
    centre: tuple[float, float] | None = None
    size: float | tuple[float, float] | None = None
    units: Units = "metres"
    rotation: float = 0.0
    pixel: float | None = None
    band: int = 0
    scale: float | None = None
    detrend: bool = False
    detail: bool = True

    @property
    def piece(self) -> Piece:
        """Which part of the model."""
        return Piece(self.size, self.centre, self.units, self.rotation)


MODEL_ONLY = tuple(key for key in Site.__struct_fields__
                   if key not in ("preset", "dem", "seed", "ground", "soil", "fields", "thrift"))
"""Keys of a site that mean nothing without a dem."""


class Robot(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """One robot of a kind (a registered name, or FILE.py:OBJECT), with skills and start.

    By the clock it may be slower than its kind (`speed`, m/s) and have a `home` to be back at.
    With a `battery` it is lost when that is empty. With eyes it sees targets that nobody knows of
    yet within `sensor_m`.
    """

    name: Name
    kind: str
    skills: Skills
    start: Place
    speed: float | None = None
    home: Place | None = None
    battery: Battery | None = None
    sensor_m: float | None = None

    @property
    def cell(self) -> Cell:
        """The cell of its start."""
        return cell_of(self.start)


class Target(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A place that needs skills; `type` may be left out where one skill is asked for.

    By the clock it may say more, as `timed.Target` explains: `service` s, `coalition` by skill
    and number (in place of skills and type), `after` (names of other targets), `appears` and
    `lapses` s, and `worth`, without which a target that lapses has failed the mission.
    """

    at: Place
    skills: Skills = ()
    type: Literal["AND", "OR"] = "OR"
    name: Name | None = None
    coalition: timed.Coalition = {}
    service: float = 0.0
    after: Annotated[tuple[str, ...], msgspec.Meta(max_length=MOST_TARGETS)] = ()
    appears: float = 0.0
    lapses: float | None = None
    worth: float = 0.0

    @property
    def cell(self) -> Cell:
        """The cell that it is in."""
        return cell_of(self.at)

    @property
    def either(self) -> bool:
        """Whether one robot with any of its skills will do."""
        return self.type == "OR" and not self.coalition

    def words(self) -> tuple[str, ...]:
        """What it asks for: its skills, with their numbers where they are more than one."""
        return tuple(skill if number == 1 else f"{number} {skill}"
                     for skill, number in self.needs().items())

    def needs(self) -> dict[str, int]:
        """Robots needed of each skill; where `either` holds, any one of them."""
        return self.coalition or dict.fromkeys(self.skills, 1)


def cell_of(place: Place) -> Cell:
    """The cell that a place lies in."""
    return math.floor(place[0] + 0.5), math.floor(place[1] + 0.5)


class Slow(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """From now on a robot travels at `factor` (0.1 to 1) of its speed."""

    robot: str
    factor: float


class Silent(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Nothing reaches a robot and nothing is heard of it for so many `decisions`, or `seconds`."""

    robot: str
    decisions: int = 0
    seconds: float = 0.0


class Impassable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The news that a kind of robot cannot cross a cell."""

    kind: str
    at: Cell


class Event(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Something that happens when decision `at_decision`, counted from 1, is done; one of the
    other keys says what. By the clock it happens at second `at_s`, and a target also when so many
    others are solved (`at_solved`), or once a robot with a sensor is near it (`on_sight`).
    """

    at_decision: int = 0
    lost: str | None = None
    target: Target | None = None
    slow: Slow | None = None
    silent: Silent | None = None
    impassable: Impassable | None = None
    at_s: float | None = None
    at_solved: int = 0
    on_sight: bool = False


class Mission(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A mission file, checked. Starts and targets are (x, y) in cells, origin lower left.

    `clock`: in steps a decision is one cell, as the paper has it, and the mission has failed after
    `max_steps` of them. In seconds a decision is a target, held until something happens, and the
    mission has failed after `max_seconds`. `sun`: without one, light is not asked about. `expects`:
    what everybody may expect of what nobody knows yet, its area in cells.
    """

    map: Map
    robots: Annotated[tuple[Robot, ...], msgspec.Meta(max_length=MOST_AGENTS)]
    targets: Annotated[tuple[Target, ...], msgspec.Meta(max_length=MOST_TARGETS)]
    site: Site = Site(preset="mare")
    name: Name = ""
    max_steps: int = 128
    events: Annotated[tuple[Event, ...], msgspec.Meta(max_length=MOST_EVENTS)] = ()
    clock: Literal["steps", "seconds"] = "steps"
    max_seconds: float = 900.0
    sun: Sun | None = None
    expects: timed.Prospect | None = None

    @property
    def unfolds(self) -> bool:
        """Whether it says what may come, or targets come by what the team does."""
        return self.expects is not None or any(
            event.on_sight or event.at_solved for event in self.events)

    @property
    def searches(self) -> bool:
        """Whether targets are hidden."""
        return any(event.on_sight for event in self.events)

    def powered(self) -> list[int]:
        """Numbers of the robots that have a battery."""
        return [i for i, robot in enumerate(self.robots) if robot.battery is not None]

    def unpowered(self) -> Mission:
        """The same mission, nobody's power counted."""
        robots = tuple(msgspec.structs.replace(robot, battery=None) for robot in self.robots)
        return msgspec.structs.replace(self, robots=robots) if self.powered() else self

    def target_name(self, index: int) -> str:
        """The target's own name, else T1, T2, ..."""
        return self.targets[index].name or f"T{index + 1}"

    def scenario(self) -> scenario.Scenario:
        """The grid problem of this mission, without blocked cells."""
        return scenario.Scenario(
            id=self.name,
            size=self.map.size,
            max_steps=self.max_steps,
            agents=tuple(scenario.Agent(r.cell, r.skills, r.kind) for r in self.robots),
            targets=tuple(scenario.Target(t.cell, tuple(t.needs()), "OR" if t.either else "AND")
                          for t in self.targets),
        )


def load(path: str | os.PathLike[str]) -> Mission:
    """Reads and checks a mission file; its `dem` is looked for beside it.

    Raises InputError naming file, key and what is allowed.
    """
    value = yaml_value(files.read_text(path), path)
    if value is None:
        raise InputError(path, "is empty; keys map, robots and targets are needed")
    if not isinstance(value, dict):
        raise InputError(path, "is not a mapping; keys map, robots and targets are needed")
    found = check(files.convert(value, Mission, path), path)
    if found.site.dem is None:
        return found
    beside = os.fspath(Path(path).parent / found.site.dem)
    return msgspec.structs.replace(found, site=msgspec.structs.replace(found.site, dem=beside))


def check(mission: Mission, source: object) -> Mission:
    """The rules that types cannot say. Raises InputError naming the key."""
    if not 0.25 <= mission.map.cell_m <= 100:
        raise InputError(source, f"{mission.map.cell_m} is not allowed; 0.25 to 100 metres",
                         "map.cell_m")
    _check_site(mission.site, source)
    _check_power(mission, source)
    _check_names(mission, source)
    if not mission.robots:
        raise InputError(source, "at least one robot is needed", "robots")
    _check_clock(mission, source)
    _as_mission_keys(mission, source)
    if mission.clock == "steps":  # by the clock ways are found one by one
        scenario.check_ways(mission.map.size, len({robot.kind for robot in mission.robots}),
                            len(mission.targets) + len(mission.events),
                            lambda problem: InputError(source, problem, "map.size"))
    _check_skills(mission, mission.targets, source, "targets[{}].skills")
    for e, event in enumerate(mission.events):
        _check_event(mission, event, source, f"events[{e}]")
    return mission


def _check_clock(mission: Mission, source: object) -> None:
    """What is said of time and of places off the lattice. Raises InputError."""
    if mission.clock == "steps":
        _check_steps(mission, source)
        return
    timed.check_limit(mission.max_seconds, lambda p: InputError(source, p, "max_seconds"))
    names = [mission.target_name(j) for j in range(len(mission.targets))]
    numbers = {name: j for j, name in enumerate(names)}
    team = timed.headcount(robot.skills for robot in mission.robots)
    for i, robot in enumerate(mission.robots):
        if robot.speed is not None and not SLOWEST <= robot.speed < math.inf:
            raise InputError(source, f"{robot.speed:g} is not allowed; at least {SLOWEST:g}",
                             f"robots[{i}].speed")
        if robot.home is not None:
            _check_cell(mission, cell_of(robot.home), source, f"robots[{i}].home")
    after: list[tuple[int, ...]] = []
    for j, target in enumerate(mission.targets):
        key = f"targets[{j}]"

        def fail(part: str, problem: str, key: str = key) -> InputError:
            return InputError(source, problem.replace("agent", "robot"), f"{key}.{part}")

        for name in target.after:
            if name not in numbers or name == names[j]:
                others = ", ".join(other for other in names if other != names[j])
                raise fail("after", f"{name!r} is not allowed; {meant(name, names)}other targets: "
                           + others)
        after.append(tuple(numbers[name] for name in target.after))
        if any(mission.targets[k].worth for k in after[-1]):
            raise fail("after", timed.NOT_SURE)
        timed.check_times(target, fail)
        timed.check_coalition(target, team, fail)
        if target.lapses is None and target.appears + target.service > mission.max_seconds:
            raise fail("service", f"would end after max_seconds, {mission.max_seconds:g}")
    _check_expects(mission, source)
    for j in timed.after_itself(after):
        raise InputError(source, "it would come before itself: a circle of targets that wait for "
                         "each other", f"targets[{j}].after")


def _check_steps(mission: Mission, source: object) -> None:
    """Raises InputError for what means nothing where a decision is one cell."""
    later = ("coalition", "service", "after", "appears", "lapses", "worth")
    said = [(f"robots[{i}].{key}", getattr(robot, key)) for i, robot in enumerate(mission.robots)
            for key in ("speed", "home", "sensor_m")]
    said += [("expects", mission.expects)]
    said += [(f"targets[{j}].{key}", getattr(target, key))
             for j, target in enumerate(mission.targets) for key in later]
    for key, value in said:
        if value:
            raise InputError(source, "is for missions by the clock; say clock: seconds too", key)
    places = [(f"robots[{i}].start", robot.start) for i, robot in enumerate(mission.robots)]
    places += [(f"targets[{j}].at", target.at) for j, target in enumerate(mission.targets)]
    for key, place in places:
        if place != cell_of(place):
            raise InputError(source, f"{list(place)} is no cell; whole numbers, or clock: seconds "
                             "too", key)


def _check_skills(mission: Mission, targets: tuple[Target, ...], source: object, key: str) -> None:
    """Raises InputError if the team can never solve one of them; `key` has a place for which."""
    asked = msgspec.structs.replace(mission, targets=targets).scenario()
    for j, skills in scenario.missing_skills(asked).items():
        have = sorted({s for r in mission.robots for s in r.skills})
        near = meant(skills[0], have) if len(skills) == 1 else ""
        raise InputError(source, f"no robot has skill {', '.join(skills) or '?'}; {near}the team "
                         f"has {', '.join(have)}", key.format(j))


def _as_mission_keys(mission: Mission, source: object) -> None:
    """Checks the grid problem, with keys named as they stand in the mission file."""
    brought = tuple(event.target for event in mission.events if event.target is not None)
    if not mission.targets and mission.clock == "seconds":  # then all of them come later
        mission = msgspec.structs.replace(mission, targets=brought)
    try:
        scenario.check(mission.scenario(), source)
    except InputError as error:
        key = error.key
        if key.startswith("agents["):
            key = key.replace("agents[", "robots[").replace(".at", ".start")
        key = {"size": "map.size", "agents": "robots"}.get(key, key)
        problem = error.problem.replace("agent", "robot")
        raise InputError(source, problem, key) from None


def _check_site(site: Site, source: object) -> None:
    if (site.preset is None) == (site.dem is None):
        raise InputError(source, "give one of preset and dem", "site")
    if site.dem is None:
        for key in MODEL_ONLY:
            if getattr(site, key) != getattr(Site(), key):
                raise InputError(source, "is for an elevation model; give dem in place of preset",
                                 f"site.{key}")
    if not 0 <= site.thrift <= 1:
        raise InputError(source, f"{site.thrift:g} is not allowed; 0 (time) to 1 (energy)",
                         "site.thrift")
    if site.thrift and site.fields == "rigid":
        raise InputError(source, "needs fields: measured; rigid ones know no energy", "site.thrift")
    for key in ("soil", "fields", "thrift"):
        if site.ground == "rigid" and getattr(site, key) != getattr(Site(), key):
            raise InputError(source, "is of ground: regolith, which is not given", f"site.{key}")
    site.piece.check(lambda key, problem: InputError(source, problem, f"site.{key}"))
    if site.band < 0:
        raise InputError(source, f"{site.band} is not allowed; at least 0", "site.band")
    if not 0 <= site.seed <= MOST_SEED:
        raise InputError(source, f"{site.seed} is not allowed; 0 to {MOST_SEED}", "site.seed")


def _check_power(mission: Mission, source: object) -> None:
    """The sun and batteries. Raises InputError."""
    if mission.sun is not None:
        mission.sun.check(lambda key, problem: InputError(
            source, problem, f"sun.{key}" if key else "sun"))
    for i in mission.powered():
        battery, at = mission.robots[i].battery, f"robots[{i}].battery"
        assert battery is not None
        battery.check(lambda key, problem, at=at: InputError(source, problem, f"{at}.{key}"))
        if battery.panel_w and mission.sun is None:
            raise InputError(source, f"{battery.panel_w:g} is not allowed without a sun; give the "
                             "mission a key sun too, or 0", f"{at}.panel_w")


def _check_names(mission: Mission, source: object) -> None:
    for group, names in (
        ("robots", [r.name for r in mission.robots]),
        ("targets", [mission.target_name(j) for j in range(len(mission.targets))]),
    ):
        for i, name in enumerate(names):
            if not name or not name.replace("_", "").replace("-", "").isalnum():
                raise InputError(source, f"{name!r} is not allowed; letters, digits, - and _",
                                 f"{group}[{i}].name")
            if name in names[:i]:
                raise InputError(source, f"{name!r} is already the name of "
                                 f"{group}[{names.index(name)}]; names must differ",
                                 f"{group}[{i}].name")


def _check_event(mission: Mission, event: Event, source: object, key: str) -> None:
    _check_when(mission, event, source, key)
    what = [name for name in WHAT if getattr(event, name) is not None]
    if len(what) != 1:
        raise InputError(source, f"give one of {', '.join(WHAT[:-1])} and {WHAT[-1]}", key)
    key = f"{key}.{what[0]}"
    if event.lost is not None:
        _check_robot(mission, event.lost, source, key)
    if event.target is not None:
        _check_cell(mission, event.target.cell, source, f"{key}.at")
        _check_skills(mission, (event.target,), source, f"{key}.skills")
        if mission.clock == "seconds":
            def fail(part: str, problem: str) -> InputError:
                return InputError(source, problem.replace("agent", "robot"), f"{key}.{part}")

            timed.check_times(event.target, fail)
            timed.check_coalition(event.target, timed.headcount(
                robot.skills for robot in mission.robots), fail)
    if event.slow is not None:
        _check_robot(mission, event.slow.robot, source, f"{key}.robot")
        if not 0.1 <= event.slow.factor <= 1:
            raise InputError(source, f"{event.slow.factor} is not allowed; 0.1 to 1",
                             f"{key}.factor")
    if event.silent is not None:
        _check_robot(mission, event.silent.robot, source, f"{key}.robot")
        if mission.clock == "steps" and not 1 <= event.silent.decisions <= MOST_STEPS:
            raise InputError(source, f"{event.silent.decisions} is not allowed; 1 to {MOST_STEPS}",
                             f"{key}.decisions")
        if mission.clock == "seconds":
            timed.check_limit(event.silent.seconds,
                              lambda problem: InputError(source, problem, f"{key}.seconds"))
    if event.impassable is not None:
        _check_cell(mission, event.impassable.at, source, f"{key}.at")


def _check_when(mission: Mission, event: Event, source: object, key: str) -> None:
    """Raises InputError for an event that comes at no time, or by the other clock."""
    later = [name for name in ("at_solved", "on_sight") if getattr(event, name)]
    if mission.clock == "seconds":
        if event.at_decision or (event.at_s is not None) + len(later) != 1:
            raise InputError(source, "say when: at_s, in seconds; decisions are counted only where "
                             "the clock is steps; a target may also come at_solved or on_sight",
                             key)
        if event.at_s is not None and not 0 <= event.at_s <= timed.MOST_SECONDS:
            raise InputError(source, f"{event.at_s:g} is not allowed; 0 to {timed.MOST_SECONDS:g}",
                             f"{key}.at_s")
        for name in later:
            _check_later(mission, event, source, f"{key}.{name}")
    elif later:
        raise InputError(source, "is for missions by the clock; say clock: seconds too, or "
                         "at_decision", f"{key}.{later[0]}")
    elif event.at_s is not None:
        raise InputError(source, "is for missions by the clock; say clock: seconds too, or "
                         "at_decision", f"{key}.at_s")
    elif not 1 <= event.at_decision <= MOST_STEPS:
        raise InputError(source, f"{event.at_decision} is not allowed; decisions are counted from "
                         f"1, and an event comes when one is done: 1 to {MOST_STEPS}",
                         f"{key}.at_decision")


def _check_later(mission: Mission, event: Event, source: object, key: str) -> None:
    """Raises InputError for a target that is found by nobody, or follows on too many others."""
    if event.target is None:
        raise InputError(source, "is for targets; for what else happens say at_s", key)
    if event.on_sight and all(robot.sensor_m is None for robot in mission.robots):
        raise InputError(source, "no robot can see it: give one a sensor_m, in metres", key)
    brought = [e for e in mission.events if e.target is not None]
    before = len(mission.targets) + sum(
        e is not event and e.at_solved < max(event.at_solved, 1) for e in brought)
    if event.at_solved and not 1 <= event.at_solved <= before:
        raise InputError(source, f"{event.at_solved} is not allowed; at most so many can be solved "
                         f"before it: {before}", key)


def _check_expects(mission: Mission, source: object) -> None:
    """What may come, and who could see it. Raises InputError."""
    for i, robot in enumerate(mission.robots):
        if robot.sensor_m is not None and not 0 < robot.sensor_m <= timed.MOST_SIDE:
            raise InputError(source, f"{robot.sensor_m:g} is not allowed; metres, above 0, at most "
                             f"{timed.MOST_SIDE}", f"robots[{i}].sensor_m")
    if mission.expects is not None:
        timed.check_expects(mission.expects, lambda key, p: InputError(source, p, key))


def _check_robot(mission: Mission, name: str, source: object, key: str) -> None:
    names = [robot.name for robot in mission.robots]
    if name not in names:
        raise InputError(source, f"no robot is named {name!r}; {meant(name, names)}robots: "
                         + ", ".join(names), key)


def _check_cell(mission: Mission, cell: Cell, source: object, key: str) -> None:
    scenario.check_cell(cell, mission.map.size, lambda problem: InputError(source, problem, key))
