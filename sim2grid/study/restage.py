"""One mission of an evaluation's report, ready to be run again to the bit.

Exact on the same machine with the same versions: the mission takes the row of the engine that
it had, and the other rows stand still.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import msgspec

from moonteam import files
from moonteam.errors import InputError, meant
from moonteam.physics.scene import build_scene
from moonteam.problem import mission as missions
from sim2grid.clock.execution import TimedExecution
from sim2grid.clock.prepare import by_the_clock, execution_of
from sim2grid.loop.drive import Backend, run
from sim2grid.loop.execution import Execution
from sim2grid.loop.prepare import Prepared, prepare
from sim2grid.measure.metrics import GridPlan
from sim2grid.study.evaluation import Contender, Entry, Row, chooser, maker, on_grid
from sim2grid.study.fleet import fleet_of, placements


@dataclass(frozen=True)
class Staged:
    """A mission of a report before its start. `row` is what came of it then."""

    contender: Contender
    prepared: Prepared
    execution: Execution | TimedExecution
    grid_plan: GridPlan | None  # None by the clock
    row: Row
    width: int

    def run(self, backend: Backend, progress: Callable[[], None] = lambda: None) -> None:
        """Runs the execution to its end on an engine of `prepared.scene`."""
        run([self.execution], backend, self.prepared.scene.qpos0, progress, width=self.width,
            rows=[self.row.slot])


def load_report(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The document of `evaluate execution`. Raises InputError."""
    report = files.read_json(path)
    if not isinstance(report, dict) or report.get("kind") != "execution":
        raise InputError(path, "is no report.json of `moonteam evaluate execution`")
    return report


def restage(report: dict[str, Any], number: int, source: object,
            contender: str | None = None) -> Staged:
    """Mission `number` of a report by a contender, the first in physics if none is named.

    Raises InputError for a mission or contender that the report does not hold.
    """
    chosen = _contender(report, contender, source)
    raw = next((r for r in report["rows"] if r["number"] == number
                and r["contender"] == chosen.name), None)
    entry = next((e for e in report["missions"] if e["number"] == number), None)
    if raw is None or entry is None:
        held = sorted(r["number"] for r in report["rows"] if r["contender"] == chosen.name)
        most = f"{held[0]} to {held[-1]}" if held else "none"
        raise InputError(source, f"holds no mission {number} of `{chosen.name}`; it holds {most}",
                         "--mission")
    row = msgspec.convert(raw, Row)
    mission = missions.check(msgspec.convert(entry, Entry).mission, source)
    width = min(int(report["options"]["width"]), int(report["options"]["count"]))
    if chosen.mode == "clock":
        prepared = prepare(by_the_clock(mission, source), source)
        timed = execution_of(
            prepared, chooser(chosen, prepared.mission, row.seed), row.seed)
        return Staged(chosen, _among(report, prepared), timed, None, row, width)
    prepared = _among(report, prepare(mission, source))
    make = maker(chosen)
    mission = prepared.mission
    fleet = fleet_of([mission], [1], prepared.site, prepared.passable,
                     [robot.kind for robot in prepared.scene.robots])
    grid = on_grid(fleet, make, events=True, seeds={0: row.seed})[0]
    route = None
    if chosen.loop == "open":
        route = on_grid(fleet, make, events=False, seeds={0: row.seed})[0].route
    execution = Execution(mission, prepared.scenario, make(), prepared.bodies, prepared.frame,
                          seed=row.seed, mode=chosen.mode, route=route)
    return Staged(chosen, prepared, execution, grid.plan, row, width)


def _among(report: dict[str, Any], prepared: Prepared) -> Prepared:
    """The same with a scene of several grounds, where the report's had: another program than that
    of one ground, and not the same to the last bit.
    """
    if report["options"].get("sites", 1) == 1:
        return prepared
    scene = build_scene([prepared.site] * 2, placements(
        prepared.mission, prepared.frame, [robot.kind for robot in prepared.scene.robots]))
    return replace(prepared, scene=scene)


def _contender(report: dict[str, Any], name: str | None, source: object) -> Contender:
    """The contender of that name, else the first that is in physics."""
    physical = {c["name"]: c for c in report["contenders"] if c["loop"] != "grid"}
    wanted = next(iter(physical), "") if name is None else name
    if wanted not in physical:
        raise InputError(source, f"has no contender {wanted!r} in physics; "
                         f"{meant(wanted, physical)}it has " + (", ".join(physical) or "none"),
                         "--contender")
    known = {key: value for key, value in physical[wanted].items() if key != "name"}
    return msgspec.convert(known, Contender)
