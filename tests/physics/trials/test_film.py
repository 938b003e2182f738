"""Films: which traverses are chosen, a camera that nothing hides, files that hold pictures."""

import math
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from moonteam.physics import render
from moonteam.physics.scene import Placement, build_scene
from moonteam.physics.trials import film
from moonteam.physics.trials.traverse import Recording, Route
from moonteam.robots import KINDS
from moonteam.robots.base import Camera
from moonteam.terrain.site import Boulder, Site


def site(heights=None, boulders=()):
    heights = np.zeros((121, 121)) if heights is None else heights
    return Site("test", 0, np.asarray(heights, np.float32), 0.25, tuple(boulders))


def ridge():
    """A ridge of 1 m along x = 5, a slope of 14 degrees beyond y = 5."""
    y, x = np.mgrid[-60:61, -60:61] * 0.25
    return np.exp(-((x - 5) ** 2) / 2) + 0.25 * np.maximum(y - 5, 0)


def test_the_largest_event_of_each_name_is_chosen():
    rock = Boulder(np.array([-5.0, -9.0, 0.0]), 0.6, np.zeros((0, 3)))
    routes = [Route((0.0, 0.0), (10.0, 0.0), 0.0), Route((-9.0, 3.0), (-9.0, 13.0), 0.0),
              Route((-10.0, -10.5), (0.0, -10.5), 0.0), Route((-9.0, 0.0), (-1.0, 0.0), 0.0)]
    shots = {s.event: s for s in film.choose([(site(ridge(), [rock]), routes)])}
    assert {name: s.route for name, s in shots.items()} == {"rim": 0, "slope": 1, "boulders": 2}
    assert shots["rim"].along == pytest.approx(5.0, abs=0.3)
    assert shots["rim"].size == pytest.approx(1.0, abs=0.1)
    assert shots["slope"].size == pytest.approx(math.degrees(math.atan(0.25)), abs=0.5)
    assert shots["boulders"].along == pytest.approx(5.0, abs=0.3)
    assert len(film.choose([(site(), routes[:1])])) == 1  # no route twice


def test_the_camera_looks_over_walls():
    y, _ = np.mgrid[-60:61, -60:61] * 0.25
    walls = np.where(np.abs(y) > 1.4, 3.0, 0.0)  # a trench along x
    scene = build_scene(site(walls), [Placement("robot", KINDS.get("wheeled"), (0.0, 0.0))])
    poses = np.tile(scene.qpos0, (100, 1))
    poses[:, 0] = np.linspace(-4, 4, 100)
    for camera in film._cameras(scene, poses, 4.0):
        azimuth, elevation = np.radians([camera.azimuth, camera.elevation])
        look = np.array([np.cos(elevation) * np.cos(azimuth),
                         np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        line = camera.lookat - np.linspace(0, 0.99, 20)[:, None] * camera.distance * look
        assert (line[:, 2] > np.asarray(scene.surface.top(line[:, :2].astype(np.float32)))).all()


def test_a_film_and_its_contact_sheet(tmp_path):
    kind = replace(KINDS.get("drone"), camera=Camera(4.2, 0.48))
    place, route = site(), Route((0.0, 0.0), (3.0, 0.0), 0.0)
    scene = build_scene(place, [Placement("robot", kind, route.start)])
    poses = np.tile(scene.qpos0, (30, 1))
    poses[:, 0] = np.linspace(0, 3, 30)
    try:
        stills = film.film(Recording(scene, route, poses), tmp_path / "drone.mp4", event="rim",
                           along=1.5, width=160, height=120)
    except render.RenderingUnavailable as error:
        pytest.skip(str(error))
    assert (tmp_path / "drone.mp4").stat().st_size > 1000
    assert len(stills) == film.FRAMES
    assert stills[0].shape == (120, 160, 3)
    film.contact_sheet([stills, stills], tmp_path / "sheet.png", 500)
    with Image.open(tmp_path / "sheet.png") as sheet:
        assert sheet.size == (500, 150)
