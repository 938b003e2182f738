"""One grid problem as a file: a JSON object, or one a line in a `.jsonl` set.

This module knows neither wing. Cells are (x, y): x right, y up, origin lower left.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from moonteam import files
from moonteam.errors import InputError
from moonteam.strict import json_value

ACTIONS = ("up", "down", "left", "right", "stay")
"""The paper's order: 0 up (+y), 1 down (-y), 2 left (-x), 3 right (+x), 4 stay."""

MAX_SKILLS = 8
MOST_SIDE = 1024
"""Cells of a map's side."""
MOST_AGENTS = 256
MOST_TARGETS = 1024
MOST_STEPS = 100_000
MOST_WAYS = 1 << 28
"""Steps to each target from each cell by each kind, that maps with closed cells are given."""

Cell = tuple[int, int]
Name = Annotated[str, msgspec.Meta(max_length=100)]
Count = Annotated[int, msgspec.Meta(ge=0, le=2**31 - 1)]
Skills = Annotated[tuple[Name, ...], msgspec.Meta(max_length=8 * MAX_SKILLS)]


class Agent(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A robot on the grid; `kind` matters only where some cells are blocked for some kinds."""

    at: Cell
    skills: Skills
    kind: str | None = None


class Target(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A cell that needs skills: any of them (OR), or all at once (AND)."""

    at: Cell
    skills: Skills
    type: Literal["AND", "OR"]


class Optimal(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Certified optima of the two objectives, each on its own; None where not certified.

    For sets too large to certify, the best known values stand in `best_*` and lower
    bounds in `bound_*`.
    """

    makespan: Count | None = None
    moves: Count | None = None
    best_makespan: Count | None = None
    best_moves: Count | None = None
    bound_makespan: Count | None = None
    bound_moves: Count | None = None


class Scenario(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A grid problem. `blocked` maps a kind (or ``*`` for all) to cells it cannot enter."""

    size: tuple[int, int]
    agents: Annotated[tuple[Agent, ...], msgspec.Meta(max_length=MOST_AGENTS)]
    targets: Annotated[tuple[Target, ...], msgspec.Meta(max_length=MOST_TARGETS)]
    id: str = ""
    max_steps: int = 128
    blocked: dict[str, tuple[Cell, ...]] | None = None
    optimal: Optimal | None = None

    @property
    def skill_bits(self) -> dict[str, int]:
        """Bit of each skill: a capital letter has its place in the alphabet (A=1, B=2, C=4).

        Other names take the bits that are left, in sorted order.
        """
        names = sorted({s for item in (*self.agents, *self.targets) for s in item.skills})
        letters = {s: 1 << (ord(s) - ord("A")) for s in names if s in "ABCDEFGH"}
        free = (1 << b for b in range(MAX_SKILLS) if 1 << b not in letters.values())
        return letters | {s: next(free) for s in names if s not in letters}

    def mask(self, skills: Iterable[str]) -> int:
        """Bitmask f(S) of a skill set: A=1, B=2, AB=3."""
        bits = self.skill_bits
        return sum(bits[s] for s in set(skills))


def check(scenario: Scenario, source: object, where: str = "") -> Scenario:
    """The rules that types cannot say. Raises InputError naming the key."""

    def fail(key: str, problem: str) -> InputError:
        return InputError(source, problem, f"{where}.{key}" if where else key)

    width, height = scenario.size
    if not (1 <= width <= MOST_SIDE and 1 <= height <= MOST_SIDE):
        raise fail("size", f"{list(scenario.size)} is not allowed; each side 1 to {MOST_SIDE}")
    if not 1 <= scenario.max_steps <= MOST_STEPS:
        raise fail("max_steps", f"{scenario.max_steps} is not allowed; 1 to {MOST_STEPS}")
    if not scenario.agents:
        raise fail("agents", "at least one agent is needed")
    if not scenario.targets:
        raise fail("targets", "at least one target is needed")
    names = {s for item in (*scenario.agents, *scenario.targets) for s in item.skills}
    if len(names) > MAX_SKILLS:
        raise fail("agents", f"{len(names)} different skills; at most {MAX_SKILLS} are allowed")
    for group, items in (("agents", scenario.agents), ("targets", scenario.targets)):
        for i, item in enumerate(items):
            check_cell(item.at, scenario.size, lambda p, k=f"{group}[{i}].at": fail(k, p))
            if not item.skills or "" in item.skills:
                raise fail(f"{group}[{i}].skills", "at least one non-empty skill name is needed")
    first_at: dict[Cell, int] = {}
    for j, target in enumerate(scenario.targets):
        if target.at in first_at:
            raise fail(f"targets[{j}].at",
                       f"{list(target.at)} is already the cell of targets[{first_at[target.at]}]; "
                       "target cells must differ")
        first_at[target.at] = j
    for kind, cells in (scenario.blocked or {}).items():
        for i, cell in enumerate(cells):
            check_cell(cell, scenario.size, lambda p, k=f"blocked.{kind}[{i}]": fail(k, p))
    if scenario.blocked:
        kinds = len({agent.kind for agent in scenario.agents})
        check_ways(scenario.size, kinds, len(scenario.targets), lambda p: fail("size", p))
    return scenario


def check_ways(size: tuple[int, int], kinds: int, targets: int, fail) -> None:
    """Raises `fail(problem)` where maps of the ways to all targets would take too much memory."""
    if size[0] * size[1] * kinds * targets > MOST_WAYS:
        raise fail(f"{list(size)} with {kinds} kinds and {targets} targets is too much for maps of "
                   f"closed cells; at most {MOST_WAYS:,} cells times kinds times targets")


def check_cell(cell: Cell, size: tuple[int, int], fail) -> None:
    """Raises `fail(problem)` if the cell lies off the map."""
    x, y = cell
    if not (0 <= x < size[0] and 0 <= y < size[1]):
        raise fail(f"cell {[x, y]} is off the map; x in 0..{size[0] - 1}, y in 0..{size[1] - 1}")


def missing_skills(scenario: Scenario) -> dict[int, list[str]]:
    """Targets that the team can never solve, with the skills it lacks."""
    team = {s for agent in scenario.agents for s in agent.skills}
    lacking = {}
    for j, target in enumerate(scenario.targets):
        need = set(target.skills)
        if (target.type == "AND" and not need <= team) or not need & team:
            lacking[j] = sorted(need - team)
    return lacking


def _decode(text: str, source: object, where: str = "") -> Scenario:
    value = json_value(text, source, where)
    return check(files.convert(value, Scenario, source, where), source, where)


def load(path: str | os.PathLike[str]) -> Scenario:
    """One scenario from a JSON file. Raises InputError."""
    return _decode(files.read_text(path), path)


def load_set(path: str | os.PathLike[str]) -> list[Scenario]:
    """A `.jsonl` set (or one `.json` scenario). Raises InputError naming the line."""
    if Path(path).suffix == ".json":
        return [load(path)]
    return files.read_lines(path, lambda line, where: _decode(line, path, where), "scenario")


def save_set(path: str | os.PathLike[str], scenarios: Iterable[Scenario]) -> None:
    """Writes a `.jsonl` set, whole or not at all."""
    files.write_lines(path, scenarios)
