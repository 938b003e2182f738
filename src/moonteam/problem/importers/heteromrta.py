"""HeteroMRTA's test set: kinds of robot with skills of their own, each with a depot of its own.

A folder holds `env_*/config.json` (places and skills of robots and tasks, durations) and CTAS-D's
`results.yaml`, whose `timeCost` over `timePenalty` is the makespan: its routes end with the way
back to the depot, at that time. Robots drive straight at 0.2 (`graph.yaml` says: time is distance
over 0.2).

Dai et al., "Heterogeneous Multi-robot Task Allocation and Scheduling via Reinforcement Learning",
IEEE Robotics and Automation Letters, 2025.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from moonteam import files
from moonteam.errors import InputError
from moonteam.problem import timed
from moonteam.problem.importers.base import Importer, entry, folders, read_yaml, skill
from moonteam.problem.timed import Agent, Known, Target, Timed
from moonteam.report.progress import track

SOURCE = "jakbichler/HeteroMRTA on GitHub, RALTestSet; Apache License 2.0"
SPEED = 0.2
"""Units of length a unit of time."""


class Spot(msgspec.Struct, frozen=True):
    """A place."""

    x: float
    y: float


class Task(msgspec.Struct, frozen=True):
    """`skillset`: skill number -> robots wanted."""

    pos: Spot
    skillset: dict[str, int]
    duration: float


class Robot(msgspec.Struct, frozen=True):
    """`skillset`: skill number -> 1 where the robot has it."""

    pose: Spot
    skillset: dict[str, int]


class Config(msgspec.Struct, frozen=True):
    """config.json, what is read of it."""

    tasks: dict[str, Task]
    robots: dict[str, Robot]


def read(folder: Path) -> list[Timed]:
    """Every `env_*` of the folder, with CTAS-D's makespan where there are results."""
    found = folders(folder, "env_*")
    return [_instance(one) for one in track(found, "heteromrta", len(found))]


def _instance(folder: Path) -> Timed:
    path = folder / "config.json"
    config: Config = files.read_json(path, Config)
    agents = tuple(Agent(_place(r.pose), tuple(_skills(r.skillset, path)), SPEED, _place(r.pose))
                   for _, r in _in_order(config.robots, path, "robots"))
    targets = tuple(_target(t, path) for _, t in _in_order(config.tasks, path, "tasks"))
    published = _published(folder / "results.yaml")
    return timed.check(Timed(
        "seconds", agents, targets, id=folder.name, source=SOURCE,
        optimal=Known(published=published) if published else None), folder)


def _target(task: Task, path: Path) -> Target:
    needs = _skills(task.skillset, path)
    if any(number > 1 for number in needs.values()):
        return Target(_place(task.pos), coalition=needs, service=task.duration)
    return Target(_place(task.pos), tuple(needs), service=task.duration)


def _published(path: Path) -> dict[str, float]:
    """CTAS-D's makespan by its time limit; nothing where there is no file or no solution."""
    if not path.is_file():
        return {}
    said = read_yaml(path)
    if entry(said, path, "result", "flagSuccess", kind=int) != 1:
        return {}
    limit = entry(said, path, "solverMaxTime", kind=float)
    cost = entry(said, path, "result", "timeCost", kind=float)
    price = entry(said, path, "timePenalty", kind=float)
    if price <= 0:
        raise InputError(path, f"{price:g} is not allowed; above 0", "timePenalty")
    return {f"CTAS-D {limit:g}s": cost / price}


def _in_order(things: dict[str, Any], path: Path, key: str) -> list[tuple[str, Any]]:
    for name in things:
        if not name.isdecimal():
            raise InputError(path, f"{name!r} is not allowed; a number", key)
    return sorted(things.items(), key=lambda item: int(item[0]))


def _skills(said: dict[str, int], path: Path) -> dict[str, int]:
    return {skill(int(number)): wanted for number, wanted in _in_order(said, path, "skillset")
            if wanted > 0}


def _place(spot: Spot) -> tuple[float, float]:
    return spot.x, spot.y


IMPORTER = Importer("heteromrta", "jakbichler/HeteroMRTA, RALTestSet", read)
