"""MRTA-Benchmark: small instances with precedence, each with a schedule proved optimal.

A folder holds `problem_instances/problem_instance_ID.json` and
`solutions/optimal_schedule_ID.json`. Q [N, S] says which robot has which skill, R [M + 2, S] which
task needs which, T_e [M + 2] the services, T_t [M + 2, M + 2] the ways, which are straight between
`task_locations`. The first node is where all robots start, the last where all must end, and the
makespan counts the way there. A pair [i, j] of `precedence_constraints`: i has ended before j
starts.

Bichler, "MRTA-Benchmark dataset", TU Delft, 2025.
"""

from __future__ import annotations

import math
from pathlib import Path

import msgspec

from moonteam import files
from moonteam.errors import InputError
from moonteam.problem import timed
from moonteam.problem.importers.base import Importer, entry, numbered, skill
from moonteam.problem.timed import Agent, Known, Place, Target, Timed
from moonteam.report.progress import track

SOURCE = ("MRTA-Benchmark by Jakob Bichler (TU Delft), as in zyYu2000/CSC445_project on GitHub, "
          "dataset_optimal_8t3r3s; CC BY 4.0; written in another format")
BEFORE = "problem_instance_"


class Instance(msgspec.Struct, frozen=True):
    """A problem file; M tasks between a start and an end."""

    Q: list[list[float]]
    R: list[list[float]]
    T_e: list[float]
    T_t: list[list[float]]
    task_locations: list[Place]
    precedence_constraints: list[tuple[int, int]] | None = None


def read(folder: Path) -> list[Timed]:
    """Every problem of the folder, with the optimum where its solution is there."""
    found = numbered(folder / "problem_instances", f"{BEFORE}*.json")
    return [_instance(path, folder / "solutions" / path.name.replace(BEFORE, "optimal_schedule_"))
            for path in track(found, "mrta-benchmark", len(found))]


def _instance(path: Path, solution: Path) -> Timed:
    said: Instance = files.read_json(path, Instance)
    _check(said, path)
    at, last = said.task_locations, len(said.T_e) - 1
    after: dict[int, list[int]] = {}
    for i, j in said.precedence_constraints or ():
        after.setdefault(j, []).append(i - 1)
    agents = tuple(Agent(at[0], _skills(row), home=at[last]) for row in said.Q)
    targets = tuple(Target(at[j], _skills(said.R[j]), service=said.T_e[j],
                           after=tuple(after.get(j, ()))) for j in range(1, last))
    known = None
    if solution.is_file():
        best: float = entry(files.read_json(solution), solution, "makespan", kind=float)
        known = Known(best, published={"MILP": best})
    return timed.check(Timed("seconds", agents, targets, id=path.stem.removeprefix(BEFORE),
                             source=SOURCE, optimal=known), path)


def _skills(row: list[float]) -> tuple[str, ...]:
    return tuple(skill(i) for i, has in enumerate(row) if has > 0)


def _check(said: Instance, path: Path) -> None:
    """Raises InputError for arrays that do not fit each other, or ways that are not straight."""
    nodes = len(said.T_e)
    if nodes < 3:
        raise InputError(path, f"{nodes} nodes; a start, at least one task and an end", "T_e")
    for key in ("R", "T_t", "task_locations"):
        if len(getattr(said, key)) != nodes:
            raise InputError(path, f"{len(getattr(said, key))} rows; T_e has {nodes}", key)
    for i, row in enumerate(said.T_t):
        if len(row) != nodes:
            raise InputError(path, f"{len(row)} ways; {nodes} are needed", f"T_t[{i}]")
        for j, way in enumerate(row):
            straight = math.dist(said.task_locations[i], said.task_locations[j])
            if abs(way - straight) > 1e-6:
                raise InputError(path, f"{way:g} is not the straight way, {straight:g}",
                                 f"T_t[{i}][{j}]")
    for n, pair in enumerate(said.precedence_constraints or ()):
        if not all(1 <= node < nodes - 1 for node in pair):
            raise InputError(path, f"{list(pair)} is not allowed; tasks 1 to {nodes - 2}",
                             f"precedence_constraints[{n}]")


IMPORTER = Importer("mrta-benchmark", "zyYu2000/CSC445_project, dataset_optimal_8t3r3s", read)
