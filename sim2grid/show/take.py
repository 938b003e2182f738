"""What a film is made from: one mission's record and looks, without the physics.

Plain data, so that it can be sent to the processes that draw.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np
import numpy.typing as npt

from moonteam.problem.mission import Mission
from moonteam.robots.base import SOLE, Tread
from sim2grid.frame import Frame
from sim2grid.loop.record import SETTING_OUT, Record
from sim2grid.show.picture import Ground

if TYPE_CHECKING:
    import mujoco

    from moonteam.robots.base import Glyph
    from sim2grid.loop.prepare import Prepared

Layout = Literal["inset", "clean", "map"]


@dataclass(frozen=True)
class Style:
    """How a film is made. `size`: width and height, even."""

    size: tuple[int, int] = (1280, 720)
    fps: float = 30.0
    seconds: float = 24.0
    speed: float | None = None  # of the wide pictures; None: what `seconds` asks for
    camera: str = "auto"  # auto, wide, chase, or a robot's name
    shadows: bool = True
    layout: Layout = "inset"


@dataclass(frozen=True)
class Actor:
    """One robot as a film sees it."""

    base: int  # index of its free joint in qpos
    glyph: Glyph
    flies: bool = False
    radius: float = 0.5  # m about the base, all of it
    distance: float = 2.9  # m from which it is shown
    body: int = 0  # its root in the model
    tread: Tread = SOLE


@dataclass(frozen=True)
class Take:
    """All that a film needs to know. `planned`: each robot's way [n, 2] m as planned before the
    start, or none. `optimum`: lines for the end, what the best plan would have taken.
    """

    mission: Mission
    record: Record
    frame: Frame
    ground: Ground
    title: str
    actors: tuple[Actor, ...]
    barred: npt.NDArray[np.bool_] | None = None
    planned: tuple[npt.NDArray, ...] = ()
    optimum: tuple[str, ...] = ()
    about: str = ""  # planner, ground
    model: mujoco.MjModel | None = None  # painted; None: the map alone
    tops: npt.NDArray = field(default_factory=lambda: np.zeros((2, 2)))  # m, with boulders


def actors_of(prepared: Prepared) -> tuple[Actor, ...]:
    """The robots of a mission on its ground."""
    model = prepared.scene.model
    found = []
    for robot in prepared.scene.robots:
        geoms = np.flatnonzero(model.body_rootid[model.geom_bodyid] == robot.body)
        # As far as its parts reach when they are stretched out from joint to joint.
        reach = 0.0
        for geom in geoms:
            at, body = np.linalg.norm(model.geom_pos[geom]), int(model.geom_bodyid[geom])
            while body != robot.body:
                at += np.linalg.norm(model.body_pos[body])
                body = int(model.body_parentid[body])
            reach = max(reach, float(at + min(model.geom_rbound[geom], 0.3)))
        found.append(Actor(robot.qpos.start, robot.kind.glyph, robot.kind.flies,
                           min(reach, 1.5 * robot.kind.footprint + 0.5),
                           robot.kind.camera.distance, robot.body, robot.kind.tread))
    return tuple(found)


def ways(take: Take, robot: int, time_s: float) -> npt.NDArray:
    """Where a robot means to go from here, [n, 2] m without its own place; empty: nowhere."""
    coming: list[npt.NDArray] = []
    for leg in take.record.legs:
        if leg.robot != robot or (leg.end_s is not None and leg.end_s <= time_s + 1e-9):
            continue
        if leg.start_s > time_s + 1e-9 and (not coming or leg.action == SETTING_OUT):
            break
        if leg.start_s > time_s + 1e-9 and take.mission.clock != "seconds":
            break
        if leg.moving or leg.expected_s is not None:
            coming.append(leg.waypoint)
    return np.array(coming).reshape(-1, 2)


def planned_ways(cells: npt.NDArray, frame: Frame) -> tuple[npt.NDArray, ...]:
    """The ways [n, 2] m of a plan on the grid: cells [T + 1, R, 2]."""
    centres = np.asarray(frame.centre(np.asarray(cells, float)))
    found: list[npt.NDArray] = []
    for way in np.moveaxis(centres, 1, 0):
        stays = np.concatenate([[True], np.abs(np.diff(way, axis=0)).sum(axis=1) > 0])
        found.append(way[stays])
    return tuple(found)

