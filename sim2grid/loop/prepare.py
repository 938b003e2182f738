"""From a mission to what an execution needs: ground, map of where each kind can go, scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from moonteam.errors import InputError
from moonteam.physics.scene import Placement, Scene, build_scene
from moonteam.planners.base import Snapshot
from moonteam.problem.mission import Mission
from moonteam.problem.scenario import Scenario
from moonteam.robots import team
from moonteam.terrain.light import Sunlight
from moonteam.terrain.site import Site, for_mission
from moonteam.terrain.traversability import passable_cells
from sim2grid.frame import Frame
from sim2grid.loop.asked import Body
from sim2grid.loop.replan import grid_problem, unsolvable
from sim2grid.waypoints import waypoints


@dataclass(frozen=True)
class Prepared:
    """A mission on its ground. `passable`: kind -> [H, W] bool, indexed [y, x].

    `written` is the mission as its file has it, where a kind may be FILE.py:OBJECT; everywhere
    else kinds go by their names.
    """

    written: Mission
    mission: Mission
    kinds: team.Kinds
    frame: Frame
    site: Site
    passable: dict[str, npt.NDArray[np.bool_]]
    scenario: Scenario
    scene: Scene
    bodies: tuple[Body, ...]

    @property
    def bases(self) -> tuple[int, ...]:
        """Index of each robot's free joint in qpos."""
        return tuple(body.base for body in self.bodies)

    def barred(self) -> npt.NDArray[np.bool_] | None:
        """[H, W] cells that some robot of the mission cannot enter; None where there are none."""
        closed = ~np.logical_and.reduce([self.passable[r.kind] for r in self.mission.robots])
        return closed if closed.any() else None


def prepare(mission: Mission, source: object) -> Prepared:
    """Makes ground and scene. Raises InputError for a kind that nobody knows, or a mission that
    its ground forbids.

    `source` is the mission file, for messages.
    """
    written = mission
    mission, kinds = team.resolve(written, source)
    frame = Frame(mission.map.size, mission.map.cell_m)
    site = for_mission(mission, source=source)
    passable = passable_cells(site, mission, team.limits(kinds, site))
    for i, robot in enumerate(mission.robots):
        x, y = robot.cell
        if not passable[robot.kind][y, x]:
            raise InputError(source, f"cell {[x, y]} is ground that a {robot.kind} robot cannot "
                             f"cross (slope or boulder) on site {site.name} with seed "
                             f"{site.seed}; choose another cell or seed", f"robots[{i}].start")
    scenario = grid_problem(mission, passable)
    for j in unsolvable(Snapshot.start(scenario)):
        raise InputError(source, f"no robots with the skills of {mission.target_name(j)} can "
                         f"reach its cell {list(mission.targets[j].cell)} over this ground; choose "
                         "another cell or seed", f"targets[{j}].at")
    starts = waypoints(frame, np.array([r.cell for r in mission.robots]),
                       np.ones(len(mission.robots), bool))
    starts = starts + frame.cell_m * np.array(
        [np.subtract(r.start, r.cell) for r in mission.robots])
    scene = build_scene(site, [
        Placement(robot.name, kinds[robot.kind], (float(x), float(y)))
        for robot, (x, y) in zip(mission.robots, starts, strict=True)])
    return Prepared(written, mission, kinds, frame, site, passable, scenario, scene,
                    bodies_of(scene))


def bodies_of(scene: Scene) -> tuple[Body, ...]:
    """The robots of a scene as the executor needs to know them."""
    light = None if scene.site.sun is None else Sunlight(scene.site)
    return tuple(Body(robot.qpos.start, robot.kind.speed, robot.kind.flies, robot.kind.fall_tilt,
                      robot.kind.footprint, robot.kind.settle, robot.kind.lands_for, light)
                 for robot in scene.robots)
