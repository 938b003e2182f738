"""What a user writes: robots, targets, map, site, events. YAML in, checked.

Knows neither wing; both read it. Which kinds of robot there are is `moonteam.robots.team`'s to say.
"""

from __future__ import annotations

import os
from typing import Literal

import msgspec
import yaml

from moonteam import files
from moonteam.errors import InputError
from moonteam.problem import scenario
from moonteam.problem.scenario import Cell

WHAT = ("lost", "target", "slow", "silent", "impassable")
"""Keys of an event, one of which says what happens."""


class Map(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The mission grid: `size` in cells (W, H), `cell_m` metres a side of a cell."""

    size: tuple[int, int]
    cell_m: float = 1.0


class Site(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """The ground: a `preset` made from `seed`, or a `dem` file (GeoTIFF or .npy)."""

    preset: str | None = None
    dem: str | None = None
    seed: int = 0


class Robot(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One robot of a kind (a registered name, or FILE.py:OBJECT), with skills and start cell."""

    name: str
    kind: str
    skills: tuple[str, ...]
    start: Cell


class Target(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A cell that needs skills; `type` may be left out where one skill is asked for."""

    at: Cell
    skills: tuple[str, ...]
    type: Literal["AND", "OR"] = "OR"
    name: str | None = None


class Slow(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """From now on a robot travels at `factor` (0.1 to 1) of its speed."""

    robot: str
    factor: float


class Silent(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Nothing reaches a robot and nothing is heard of it for so many `decisions`."""

    robot: str
    decisions: int


class Impassable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The news that a kind of robot cannot cross a cell."""

    kind: str
    at: Cell


class Event(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Something that happens at decision `at_decision`; one of the other keys says what."""

    at_decision: int
    lost: str | None = None
    target: Target | None = None
    slow: Slow | None = None
    silent: Silent | None = None
    impassable: Impassable | None = None


class Mission(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A mission file, checked. Start and target cells are (x, y), origin lower left."""

    map: Map
    robots: tuple[Robot, ...]
    targets: tuple[Target, ...]
    site: Site = Site(preset="mare")
    name: str = ""
    max_steps: int = 128
    events: tuple[Event, ...] = ()

    def target_name(self, index: int) -> str:
        """The target's own name, else T1, T2, ..."""
        return self.targets[index].name or f"T{index + 1}"

    def scenario(self) -> scenario.Scenario:
        """The grid problem of this mission, without blocked cells."""
        return scenario.Scenario(
            id=self.name,
            size=self.map.size,
            max_steps=self.max_steps,
            agents=tuple(scenario.Agent(r.start, r.skills, r.kind) for r in self.robots),
            targets=tuple(scenario.Target(t.at, t.skills, t.type) for t in self.targets),
        )


class _Loader(yaml.SafeLoader):
    """YAML that refuses a key given twice: the first would be lost without a word."""

    def construct_mapping(self, node, deep=False):
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        for key, (where, _) in zip(keys, node.value, strict=True):
            if keys.count(key) > 1:
                raise yaml.constructor.ConstructorError(
                    None, None, f"key {key!r} is given twice", where.start_mark)
        return super().construct_mapping(node, deep)


def load(path: str | os.PathLike[str]) -> Mission:
    """Reads and checks a mission file. Raises InputError naming file, key and what is allowed."""
    text = files.read_text(path)
    try:
        value = yaml.load(text, Loader=_Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" (line {mark.line + 1})" if mark else ""
        raise InputError(path, f"not YAML: {getattr(error, 'problem', error)}{where}") from None
    if value is None:
        raise InputError(path, "is empty; keys map, robots and targets are needed")
    if not isinstance(value, dict):
        raise InputError(path, "is not a mapping; keys map, robots and targets are needed")
    return check(files.convert(value, Mission, path), path)


def check(mission: Mission, source: object) -> Mission:
    """The rules that types cannot say. Raises InputError naming the key."""
    if not 0.25 <= mission.map.cell_m <= 100:
        raise InputError(source, f"{mission.map.cell_m} is not allowed; 0.25 to 100 metres",
                         "map.cell_m")
    _check_site(mission.site, source)
    _check_names(mission, source)
    if not mission.robots:
        raise InputError(source, "at least one robot is needed", "robots")
    _as_mission_keys(mission, source)
    for j, target in enumerate(mission.targets):
        _check_skills(mission, target, source, f"targets[{j}].skills")
    for e, event in enumerate(mission.events):
        _check_event(mission, event, source, f"events[{e}]")
    return mission


def _check_skills(mission: Mission, target: Target, source: object, key: str) -> None:
    """Raises InputError if the team can never solve the target."""
    alone = msgspec.structs.replace(
        mission.scenario(), targets=(scenario.Target(target.at, target.skills, target.type),))
    for skills in scenario.missing_skills(alone).values():
        raise InputError(source, f"no robot has skill {', '.join(skills) or '?'}; the team has "
                         + ", ".join(sorted({s for r in mission.robots for s in r.skills})), key)


def _as_mission_keys(mission: Mission, source: object) -> None:
    """Checks the grid problem, with keys named as they stand in the mission file."""
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
    if site.seed < 0:
        raise InputError(source, f"{site.seed} is not allowed; at least 0", "site.seed")


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
    if event.at_decision < 1:
        raise InputError(source, f"{event.at_decision} is not allowed; at least 1",
                         f"{key}.at_decision")
    what = [name for name in WHAT if getattr(event, name) is not None]
    if len(what) != 1:
        raise InputError(source, f"give one of {', '.join(WHAT[:-1])} and {WHAT[-1]}", key)
    key = f"{key}.{what[0]}"
    if event.lost is not None:
        _check_robot(mission, event.lost, source, key)
    if event.target is not None:
        _check_cell(mission, event.target.at, source, f"{key}.at")
        _check_skills(mission, event.target, source, f"{key}.skills")
    if event.slow is not None:
        _check_robot(mission, event.slow.robot, source, f"{key}.robot")
        if not 0.1 <= event.slow.factor <= 1:
            raise InputError(source, f"{event.slow.factor} is not allowed; 0.1 to 1",
                             f"{key}.factor")
    if event.silent is not None:
        _check_robot(mission, event.silent.robot, source, f"{key}.robot")
        if event.silent.decisions < 1:
            raise InputError(source, f"{event.silent.decisions} is not allowed; at least 1",
                             f"{key}.decisions")
    if event.impassable is not None:
        _check_cell(mission, event.impassable.at, source, f"{key}.at")


def _check_robot(mission: Mission, name: str, source: object, key: str) -> None:
    names = [robot.name for robot in mission.robots]
    if name not in names:
        raise InputError(source, f"no robot is named {name!r}; robots: {', '.join(names)}", key)


def _check_cell(mission: Mission, cell: Cell, source: object, key: str) -> None:
    scenario.check_cell(cell, mission.map.size, lambda problem: InputError(source, problem, key))
