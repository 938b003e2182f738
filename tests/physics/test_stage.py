"""Pictures with depth of a painted scene: shadows where the sun is kept off, smooth edges."""

import dataclasses

import numpy as np
import pytest

from moonteam.physics import look, stage
from moonteam.physics.render import RenderingUnavailable
from moonteam.physics.scene import Placement, build_scene
from moonteam.problem.sun import SunPosition
from moonteam.terrain.site import Boulder, Site, make_site


@pytest.fixture(scope="module")
def scene(sled):
    return build_scene(make_site("flat", 3, 20.0), [Placement("one", sled.kind, (0.0, 0.0))])


@pytest.fixture(scope="module")
def drawing(scene):
    try:
        made = stage.Stage(stage.painted(scene), 320, 240)
    except RenderingUnavailable as error:
        pytest.skip(str(error))
    with made:
        yield made


VIEW = stage.View(np.array([0.0, -3.0, 2.0]), np.zeros(3))


def test_depths_are_metres_along_the_line_of_sight(scene, drawing):
    picture, depth = drawing.frame(scene.qpos0, VIEW)
    assert picture.shape == (240, 320, 3)
    spots = np.array([[1.0, 0.5, 0.0], [-1.2, 0.3, 0.0], [0.8, -0.9, 0.0]])
    pixels, away = VIEW.project(spots, (320, 240))
    for (x, y), metres in zip(np.floor(pixels).astype(int), away, strict=True):
        assert depth[y, x] == pytest.approx(metres, abs=0.06)


def test_a_shadow_falls_away_from_the_sun_and_only_where_it_is_wanted(scene, drawing):
    centre = scene.qpos0[:3]
    plain, _ = drawing.frame(scene.qpos0, VIEW)
    cast, _ = drawing.frame(scene.qpos0, VIEW, casters=[stage.Caster(centre, 0.6, centre[2])])
    darker = plain.astype(int).sum(axis=2) - cast.astype(int).sum(axis=2) > 40
    assert darker.sum() > 50
    away = -look.sunward(look.LOW_SUN)[:2]
    ahead = np.array([*(0.55 * away / np.linalg.norm(away)), 0.0])
    (inside, outside), _ = VIEW.project(np.stack([ahead, -2 * ahead]), (320, 240))
    assert darker[int(inside[1]), int(inside[0])]
    assert not darker[int(outside[1]) - 3:int(outside[1]) + 3,
                      int(outside[0]) - 3:int(outside[0]) + 3].any()


def test_the_baked_ground_is_dark_behind_a_ridge_and_a_rock():
    y, x = np.mgrid[-40:41, -40:41] * 0.25
    sun = look.sunward(look.LOW_SUN)[:2]
    along = (x * sun[0] + y * sun[1]) / np.linalg.norm(sun)
    ridge = np.exp(-(along / 0.5) ** 2).astype(np.float32)
    light = look.bake(Site("ridge", 1, ridge, 0.25), 256).astype(float).mean(axis=2)

    def texel(metres):
        """So far towards the sun from the middle."""
        return tuple((128 + metres * sun[::-1] / np.linalg.norm(sun) / 20 * 256).astype(int))

    assert light[texel(-3.0)] < 0.45 * light[texel(4.0)]
    rock = Boulder(np.array([0.0, 0.0, 0.3]), 0.5, np.zeros((0, 3)))
    level = Site("level", 1, np.zeros((81, 81), np.float32), 0.25, (rock,))
    light = look.bake(level, 256).astype(float).mean(axis=2)
    assert light[texel(-1.2)] < 0.45 * light[texel(1.5)]


def test_a_staircase_becomes_a_slope_and_flat_parts_stay():
    y, x = np.mgrid[0:64, 0:96]
    steps = np.where(y > 20 + x // 6, 200, 40).astype(np.uint8)
    picture = np.repeat(steps[..., None], 3, axis=2)
    smooth = stage.smoothed(picture)
    inner = smooth[..., 0]
    between = (inner > 60) & (inner < 180)
    assert between.sum() > 40
    far = np.abs(y - 20 - x / 6) > 4
    np.testing.assert_array_equal(smooth[far], picture[far])
    even = np.clip(40 + 160 * (y - 20 - x / 6 + 5 / 12), 40, 200)
    off, before = (np.abs(values.astype(float) - even)[10:54, 10:86].sum()
                   for values in (inner, steps))
    assert off < 0.8 * before


def test_a_sites_own_sun_is_baked_into_its_ground():
    """From the north, then from the south; and in the dark as if it stood a little up."""
    y = np.mgrid[-40:41, -40:41][0] * 0.25
    ridge = np.exp(-(y / 0.5) ** 2).astype(np.float32)
    bright = {}
    for azimuth in (0.0, np.pi):
        site = Site("ridge", 1, ridge, 0.25, sun=SunPosition(azimuth, np.radians(8)))
        light = look.bake(site, 256).astype(float).mean(axis=2)
        bright[azimuth] = light[150:165].mean(), light[91:106].mean()  # north and south of it
    assert bright[0.0][0] > 2 * bright[0.0][1]
    assert bright[np.pi][1] > 2 * bright[np.pi][0]
    low = SunPosition(0.3, -0.2)
    np.testing.assert_allclose(look.sunward(sun=low), SunPosition(0.3, look.LOWEST_SUN).toward)


def test_a_sites_own_sun_throws_the_shadows_of_what_moves(scene, drawing):
    del drawing  # where nothing can be drawn, this is skipped
    lit = dataclasses.replace(scene, site=dataclasses.replace(
        scene.site, sun=SunPosition(np.radians(90), np.radians(10))))
    model = stage.painted(lit)
    np.testing.assert_allclose(model.light("sun").dir, -look.sunward(sun=lit.site.sun), atol=1e-6)
    centre = scene.qpos0[:3]
    with stage.Stage(model, 320, 240, lit.site.sun) as made:
        plain, _ = made.frame(scene.qpos0, VIEW)
        cast, _ = made.frame(scene.qpos0, VIEW, casters=[stage.Caster(centre, 0.6, centre[2])])
    darker = plain.astype(int).sum(axis=2) - cast.astype(int).sum(axis=2) > 40
    (west, east), _ = VIEW.project(np.array([[-0.9, 0.0, 0.0], [0.9, 0.0, 0.0]]), (320, 240))
    assert darker[int(west[1]), int(west[0])]
    assert not darker[int(east[1]), int(east[0])]
