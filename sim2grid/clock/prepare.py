"""From a mission to its execution by the clock."""

from __future__ import annotations

import msgspec

from moonteam.errors import InputError
from moonteam.problem.mission import Mission
from moonteam.robots import team
from moonteam.terrain.travel import Roads
from sim2grid.clock.execution import Chooser, TimedExecution
from sim2grid.loop.prepare import Prepared


def by_the_clock(mission: Mission, source: object) -> Mission:
    """The mission with a decision a target. Raises InputError for events told in decisions."""
    if mission.clock == "steps" and mission.events:
        raise InputError(source, "say when by at_s, with clock: seconds; decisions are "
                         "counted only where the clock is steps", "events")
    return msgspec.structs.replace(mission, clock="seconds")


def roads_of(prepared: Prepared) -> Roads:
    """The ways of a mission's ground, which are found as they are asked for."""
    limits = team.limits(prepared.kinds, prepared.site)
    return Roads.of_mission(prepared.site, prepared.mission, limits)


def execution_of(prepared: Prepared, chooser: Chooser, seed: int,
                 roads: Roads | None = None) -> TimedExecution:
    """The mission on its ground, before its start; `roads`, if they are there already."""
    roads = roads or roads_of(prepared)
    return TimedExecution(prepared.mission, prepared.scenario, chooser, prepared.bodies,
                          prepared.frame, roads, seed=seed)
