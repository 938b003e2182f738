from dataclasses import replace

import mujoco
import numpy as np
import pytest

from moonteam.errors import InputError
from moonteam.physics.scene import Placement, build_scene, check_collisions
from moonteam.robots import KINDS, OWN
from moonteam.robots.base import GRAVITY
from moonteam.terrain.site import Boulder, Site, make_site


def incline(degrees: float) -> Site:
    x = np.arange(-40, 41) * 0.25
    heights = np.tile(np.tan(np.radians(degrees)) * x, (81, 1)).astype(np.float32)
    return Site("slope", 0, heights, 0.25)


def forward(scene) -> mujoco.MjData:
    data = mujoco.MjData(scene.model)
    data.qpos[:] = scene.qpos0
    mujoco.mj_forward(scene.model, data)
    return data


def test_the_scene_is_on_the_moon_without_air():
    option = build_scene(make_site("flat", 0, 12.0), []).model.opt
    assert option.gravity.tolist() == [0, 0, -GRAVITY]
    assert option.density == option.viscosity == 0


@pytest.mark.parametrize("kind", [KINDS.get(name) for name in OWN], ids=lambda k: k.name)
@pytest.mark.parametrize("site", [make_site("mare", 3, 20.0), incline(12)], ids=lambda s: s.name)
def test_robots_start_on_the_ground_and_not_in_it(kind, site):
    scene = build_scene(site, [Placement("one", kind, (1.3, -0.7), 0.4)])
    data = forward(scene)
    assert all(data.contact.dist > -0.02)
    # Something touches, or would after a fall of a few centimetres.
    feet = [g for g in range(scene.model.ngeom) if scene.model.geom_conaffinity[g] & 1]
    gaps = [data.geom_xpos[g][2] - scene.model.geom_size[g, 0]
            - float(site.surface.height(np.array(data.geom_xpos[g][:2], np.float32)))
            for g in feet]
    assert min(gaps) < 0.08


def test_bodies_are_aligned_with_the_slope_and_head_where_told(sled):
    scene = build_scene(incline(12), [Placement("one", sled.kind, (0.0, 0.0), np.pi / 2)])
    matrix = forward(scene).xmat[scene.robots[0].body].reshape(3, 3)
    angle = np.radians(12)
    assert np.allclose(matrix[:, 2], [-np.sin(angle), 0, np.cos(angle)], atol=1e-3)
    assert np.allclose(matrix[:, 0], [0, 1, 0], atol=1e-3)


def test_each_robot_has_its_own_slices():
    kinds = [KINDS.get(name) for name in OWN]
    scene = build_scene(make_site("flat", 0, 20.0), [
        Placement(k.name, k, (3.0 * i - 3, 0.0)) for i, k in enumerate(kinds)])
    model = scene.model
    for name, size in (("qpos", model.nq), ("qvel", model.nv), ("ctrl", model.nu)):
        covered = [i for r in scene.robots for i in range(size)[getattr(r, name)]]
        assert covered == list(range(size))
    for robot in scene.robots:
        assert model.body(robot.body).name == f"{robot.name}/{robot.kind.base}"
        assert len(scene.qpos0[robot.qpos]) == 7 + len(robot.kind.home)


def test_regolith_friction_wins_over_the_robots(sled):
    scene = build_scene(make_site("flat", 0, 12.0), [Placement("one", sled.kind, (0, 0))])
    data = forward(scene)
    data.qpos[2] -= 0.005
    mujoco.mj_forward(scene.model, data)
    assert data.ncon >= 4
    assert np.allclose(data.contact.friction[:, 0], 0.75)


STARTS = [
    ((0.0, 0.2), "in a boulder"), ((9.0, 0.0), "on a slope of"), ((11.9, 0.0), "off the site"),
    ((-4.0, 0.1), "where robot first stands"),
]


@pytest.mark.parametrize(("xy", "words"), STARTS)
def test_impossible_starts_get_one_line(sled, xy, words):
    heights = np.zeros((97, 97), np.float32)
    heights[:, 80:] = 0.25 * np.arange(17)[None, :]  # a wall in the east
    rock = Boulder(np.array([0.0, 0.0, 0.1]), 0.5, np.zeros((0, 3)))
    site = Site("walled", 0, heights, 0.25, (rock,))
    first = Placement("first", sled.kind, (-4.0, 0.0))
    with pytest.raises(InputError, match=words) as caught:
        build_scene(site, [first, Placement("second", sled.kind, xy)])
    assert "second" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_shape_that_mjx_cannot_collide_is_named(sled):
    kind = replace(sled.kind, load=lambda: sled.load(sled.xml.replace(
        'name="a" type="sphere" size=".06"', 'name="a" type="cylinder" size=".06 .02"')))
    with pytest.raises(ValueError, match=r"one/a.*cylinder"):
        build_scene(make_site("flat", 0, 12.0), [Placement("one", kind, (0, 0))])


def test_a_margin_on_the_ground_is_named(sled):
    kind = replace(sled.kind, load=lambda: sled.load(sled.xml.replace(
        'name="a" type="sphere"', 'name="a" margin=".01" type="sphere"')))
    with pytest.raises(ValueError, match=r"margin.*one/a"):
        build_scene(make_site("flat", 0, 12.0), [Placement("one", kind, (0, 0))])


def test_the_check_passes_the_real_robots():
    site = make_site("highland", 2, 24.0)
    assert site.boulders
    scene = build_scene(replace(site, boulders=site.boulders[:2]), [])
    check_collisions(scene.model)
