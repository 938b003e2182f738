"""A mission's team: every kind that its file names, found and called by its own name.

A kind is registered (ours, or an installed package's), or stands in a file beside the mission:
`kind: my_rover.py:ROVER`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path

import msgspec

from moonteam.errors import InputError
from moonteam.problem import mission as missions
from moonteam.problem.mission import Mission
from moonteam.robots import KINDS, RobotKind
from moonteam.terrain.site import Site
from moonteam.terrain.traversability import Limits

Kinds = dict[str, RobotKind]  # by their names


def load(path: str | os.PathLike[str]) -> tuple[Mission, Kinds]:
    """Reads and checks a mission file, kinds included. Raises InputError; see `resolve`."""
    return resolve(missions.load(path), path)


def resolve(mission: Mission, source: object) -> tuple[Mission, Kinds]:
    """The mission with each kind called by its own name, and the kinds that it names.

    Files are looked for beside `source`. Raises InputError naming source and key, with what is
    registered, for a kind that nobody knows, or two different ones of the same name.
    """
    kinds: Kinds = {}

    def name_of(written: str, key: str) -> str:
        kind = KINDS.get(beside(written, source), source, key)
        if kinds.setdefault(kind.name, kind) is not kind:
            raise InputError(source, f"{written}: another kind is called {kind.name!r} here", key)
        return kind.name

    found = with_kinds(mission, name_of)
    for i, robot in enumerate(found.robots):
        most = kinds[robot.kind].speed
        if robot.speed is not None and robot.speed > most:
            raise InputError(source, f"{robot.speed:g} is not allowed; a {robot.kind} robot "
                             f"travels at up to {most:g} m/s", f"robots[{i}].speed")
    return found, kinds


def settled(mission: Mission, source: object) -> Mission:
    """The mission with kinds that stand in files named by their full paths: it can be written
    anywhere. Raises InputError as `resolve` does.
    """
    resolve(mission, source)

    def full(written: str, _: str) -> str:
        found = beside(written, source)
        return found if found == written else str(Path(found).resolve())

    return with_kinds(mission, full)


def with_kinds(mission: Mission, name: Callable[[str, str], str]) -> Mission:
    """The mission with every kind that it names called `name(as written, key)`."""
    robots = tuple(
        msgspec.structs.replace(robot, kind=name(robot.kind, f"robots[{i}].kind"))
        for i, robot in enumerate(mission.robots))
    events = tuple(
        event if event.impassable is None else msgspec.structs.replace(
            event, impassable=msgspec.structs.replace(event.impassable, kind=name(
                event.impassable.kind, f"events[{e}].impassable.kind")))
        for e, event in enumerate(mission.events))
    return msgspec.structs.replace(mission, robots=robots, events=events)


def limits(kinds: Mapping[str, RobotKind], site: Site) -> dict[str, Limits]:
    """What ground of a site each kind can cross, as it is known there."""
    soil = site.soil.name if site.soil and site.known else None
    return {name: kind.limits_on(soil) for name, kind in kinds.items()}


def beside(written: str, source: object) -> str:
    """FILE.py:OBJECT with the file looked for in the folder of `source`; a name as it is."""
    file, colon, _ = written.rpartition(":")
    if not (colon and file.endswith(".py")):
        return written
    return str(Path(str(source)).parent / written)
