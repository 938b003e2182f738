"""What wheels and feet leave behind in the film of a mission on regolith."""

import mujoco
import numpy as np

from moonteam.physics.scene import Placement, build_scene
from moonteam.robots import KINDS
from moonteam.terrain.site import make_site, with_soil
from sim2grid.show.ruts import EVERY, ruts_of

TIMES = np.arange(101) * 0.04


def marks(kind, qpos):
    its = KINDS.get(kind)
    scene = build_scene(with_soil(make_site("flat", 0, 16.0), "nominal"),
                        [Placement("one", its, (0.0, 0.0))])
    poses = np.tile(scene.qpos0, (len(TIMES), 1))
    poses[:, :qpos.shape[1]] += qpos
    return ruts_of(scene.model, TIMES, poses, {"one": its.tread},
                   lambda xy: np.zeros(np.shape(xy)[:-1]))


def rolled(metres, turned):
    """A rover that goes `metres` east, its rims `turned` m."""
    way = np.zeros((len(TIMES), 13))
    way[:, 0] = np.linspace(0.0, metres, len(TIMES))
    way[:, [8, 9, 11, 12]] = np.linspace(0.0, turned / 0.14, len(TIMES))[:, None]
    return way


def test_a_wheel_leaves_a_mark_for_each_piece_of_rim_the_closer_the_more_it_slips():
    held, slipped = marks("wheeled", rolled(1.0, 1.0)), marks("wheeled", rolled(0.5, 1.0))
    number = len(held.until(99.0))
    assert number == len(slipped.until(99.0)) == 4 * round(1.0 / EVERY)
    assert len(held.until(TIMES[50])) < 0.6 * number, "those that are there by then"
    first = [m.position for m in held.until(99.0)]
    assert all(m.type == mujoco.mjtGeom.mjGEOM_BOX for m in held.until(99.0))
    assert max(p[0] for p in first) > 1.0
    assert max(m.position[0] for m in slipped.until(99.0)) < 0.8
    assert all(abs(p[2]) < 0.01 for p in first)


def test_feet_leave_prints_where_they_stand_and_none_in_the_air():
    still = np.zeros((len(TIMES), 3))
    stood = marks("legged", still).until(99.0)
    assert len(stood) == 4, "four feet, no knee"
    high = still.copy()
    high[:, 2] = 0.5
    assert not marks("legged", high).until(99.0)
    dragged = still.copy()
    dragged[:, 0] = TIMES
    assert not marks("legged", dragged).until(99.0), "a foot that slides leaves no print"
