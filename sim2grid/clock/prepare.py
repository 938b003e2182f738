"""From a mission to its execution by the clock."""

from __future__ import annotations

import msgspec

from moonteam.errors import InputError
from moonteam.planners.seconds.base import TimedPlanner
from moonteam.planners.seconds.keeper import MARGIN_MS, Keeper
from moonteam.planners.unfolding.deciding.make import (
    PLACES,
    Search,
    check_futures,
    check_search,
    decider_of,
    pointing,
)
from moonteam.problem.mission import Mission
from moonteam.robots import team
from moonteam.terrain.travel import Roads
from sim2grid.clock.execution import Chooser, TimedExecution
from sim2grid.clock.unfold import Scouting
from sim2grid.loop.prepare import Prepared

NEAR_M = 1.0
"""m from where it was to look from at which a body can be sent on; it is asked a little before."""


def by_the_clock(mission: Mission, source: object) -> Mission:
    """The mission with a decision a target. Raises InputError for events told in decisions."""
    if mission.clock == "steps" and mission.events:
        raise InputError(source, "say when by at_s, with clock: seconds; decisions are "
                         "counted only where the clock is steps", "events")
    return msgspec.structs.replace(mission, clock="seconds")


def choosing(planner: TimedPlanner, mission: Mission, search: Search | None = None,
             futures: int = 0, seed: int = 0) -> Chooser:
    """Who decides by the clock with this planner; `search` and `futures` where missions unfold.

    Hidden targets are looked for on the nearest ground not seen yet, where nothing else is said.
    Raises InputError for what means nothing in this mission.
    """
    if not mission.unfolds:
        for option, given in (("--search", search), ("--futures", futures)):
            if given:
                raise InputError(option, f"has no effect in {mission.name or 'the mission'}, which "
                                 "says nothing of what nobody knows yet (expects, on_sight, "
                                 "at_solved)")
        return Keeper(planner)
    if futures:
        check_futures(futures)
    if search:
        check_search(search, mission.searches)
    if mission.searches and search is None:
        search = PLACES if futures and pointing(planner) else "nearest"
    expects = mission.expects
    certain = expects is None or not expects.scatter
    return Scouting(planner.name, decider_of(
        planner, search=search or "", futures=futures, seed=seed, certain=certain,
        margin_ms=MARGIN_MS, near_m=NEAR_M))


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
