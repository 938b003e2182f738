"""DCMRTA's test sets: one kind of robot, coalitions by number, straight ways from one depot.

A folder holds `env_*/{graph,task_param,vehicle_param,planner_param}.yaml` and a `.csv` of results
for each method. Tasks are nodes 0 to m - 1 of the graph, node m is where all robots start and
node m + 1, the same depot, where they end. An edge is [from, to, 0, distance, 0, time], `nodeK`
the time of task K's service. The graph gives distances only, so places are made from them.

Li et al., "Dynamic Coalition Formation and Routing for Multirobot Task Allocation via
Reinforcement Learning", ICRA 2024.
"""

from __future__ import annotations

import csv
import io
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from moonteam import files
from moonteam.errors import InputError
from moonteam.problem import timed
from moonteam.problem.importers.base import Importer, entry, folders, places, read_yaml, skill
from moonteam.problem.scenario import MOST_AGENTS, MOST_TARGETS
from moonteam.problem.timed import Agent, Known, Target, Timed
from moonteam.report.progress import track

SOURCE = ("marmotlab/DCMRTA on GitHub, testSet_20A_50T_CONDET; MIT License, copyright (c) 2021 "
          "MARMot Lab @ NUS-ME; places made from their distances")

Edge = tuple[int, int, float, float, float, float]


def read(folder: Path) -> list[Timed]:
    """Every `env_*` of the folder, with the results that its `.csv` files publish."""
    found = folders(folder, "env_*")
    published = results(folder)
    return [_instance(one, published.get(int(re.findall(r"\d+", one.name)[-1]), {}))
            for one in track(found, "dcmrta", len(found))]


def results(folder: Path) -> dict[int, dict[str, float]]:
    """Instance -> method -> makespan, of each `.csv`; what did not solve all tasks is left out."""
    found: dict[int, dict[str, float]] = {}
    for path in sorted(folder.glob("*.csv")):
        for row in csv.DictReader(io.StringIO(files.read_text(path))):
            try:
                number, makespan = int(row[""]), float(row["makespan"])
                solved = float(row["success_rate"]) == 1.0
            except KeyError as error:
                raise InputError(path, "missing column", error.args[0] or "the first") from None
            except (TypeError, ValueError):
                raise InputError(path, "is not a table of numbers") from None
            if solved and math.isfinite(makespan):
                found.setdefault(number, {})[path.stem.replace("_", " ")] = makespan
    return found


def _instance(folder: Path, published: dict[str, float]) -> Timed:
    plan, graph = folder / "planner_param.yaml", folder / "graph.yaml"
    said = read_yaml(plan)
    count = entry(said, plan, "taskNum", kind=int)
    teams = entry(said, plan, "vehNumPerType", kind=list[int])
    if len(teams) != 1:
        raise InputError(plan, f"{len(teams)} types of robot; this format has one", "vehNumPerType")
    for key, number, most in (("taskNum", count, MOST_TARGETS),
                              ("vehNumPerType", teams[0], MOST_AGENTS)):
        if not 1 <= number <= most:
            raise InputError(plan, f"{number} is not allowed; 1 to {most}", key)
    ways = read_yaml(graph)
    distances, speed = _distances(ways, graph, count)
    at = places(distances, graph)
    agent = Agent(at[0], _abilities(folder / "vehicle_param.yaml"), speed, home=at[0])
    tasks = read_yaml(folder / "task_param.yaml")
    targets = tuple(
        Target(at[k + 1], coalition=_needs(tasks, folder / "task_param.yaml", k),
               service=entry(ways, graph, "vehicle0", f"node{k}", kind=float))
        for k in range(count))
    return timed.check(Timed(
        "seconds", (agent,) * teams[0], targets, id=folder.name, source=SOURCE,
        optimal=Known(published=published) if published else None), folder)


def _abilities(path: Path) -> tuple[str, ...]:
    vector = entry(read_yaml(path), path, "vehicle0", "capVector", kind=list[float])
    return tuple(skill(i) for i, has in enumerate(vector) if has > 0)


def _needs(tasks: Any, path: Path, number: int) -> dict[str, int]:
    """A task's robots by skill: all of its `and`s, each of which must be one `or`."""
    name = f"task{number}"
    found: dict[str, int] = {}
    for clause, choices in entry(tasks, path, name, kind=dict[str, Any]).items():
        if len(entry(tasks, path, name, clause, kind=dict[str, Any])) != 1:
            raise InputError(path, f"{len(choices)} choices; only one is read", f"{name}.{clause}")
        which = entry(tasks, path, name, clause, "or0", "capId", kind=int)
        wanted = entry(tasks, path, name, clause, "or0", "capReq", kind=float)
        if wanted != int(wanted) or wanted < 1:
            raise InputError(path, f"{wanted:g} is not allowed; a whole number, at least 1",
                             f"{name}.{clause}.or0.capReq")
        found[skill(which)] = int(wanted)
    return found


def _distances(ways: Any, path: Path, count: int) -> tuple[npt.NDArray[np.float64], float]:
    """Distances [1 + M, 1 + M] of depot and tasks, and the speed that all edges agree on."""
    edges = {key: files.convert(value, Edge, path, f"vehicle0.{key}")
             for key, value in entry(ways, path, "vehicle0", kind=dict[str, Any]).items()
             if key.startswith("edge")}
    found = np.full((count + 1, count + 1), np.nan)
    np.fill_diagonal(found, 0.0)
    speeds = [edge[3] / edge[5] for edge in edges.values() if edge[5] > 0]
    if not speeds or max(speeds) - min(speeds) > 1e-6 * max(speeds):
        raise InputError(path, "its edges have no common speed", "vehicle0")
    for key, (a, b, _, length, _, _) in edges.items():
        i, j = ((0 if node >= count else node + 1) for node in (a, b))
        if min(a, b) < 0 or max(a, b) > count + 1:
            raise InputError(path, f"{[a, b]} is not allowed; nodes 0 to {count + 1}",
                             f"vehicle0.{key}")
        if found[i, j] == found[i, j] and abs(found[i, j] - length) > 1e-9:
            raise InputError(path, "start and end differ, or ways back and forth; they must not",
                             f"vehicle0.{key}")
        found[i, j] = found[j, i] = length
    if np.isnan(found).any():
        i, j = (int(k) for k in np.argwhere(np.isnan(found))[0])
        raise InputError(path, f"no edge between nodes {(i or count + 1) - 1} and {j - 1}",
                         "vehicle0")
    return found, round(float(np.median(speeds)), 9)


IMPORTER = Importer("dcmrta", "marmotlab/DCMRTA, testSet_20A_50T_CONDET", read)
