import numpy as np
import pytest

from moonteam.physics import render
from moonteam.physics.render import Renderer, RenderingUnavailable
from moonteam.physics.scene import Placement, build_scene
from moonteam.terrain.site import make_site


@pytest.fixture(scope="module")
def scene(sled):
    return build_scene(make_site("crater_rim", 3, 20.0), [
        Placement("one", sled.kind, (-3.0, 1.0)), Placement("two", sled.kind, (4.0, -1.0))])


@pytest.fixture(scope="module")
def renderer(scene):
    try:
        made = Renderer(scene, 160, 120)
    except RenderingUnavailable as error:
        pytest.skip(str(error))
    with made:
        yield made


def test_a_frame_shows_grey_ground_and_repeats(scene, renderer):
    frame = renderer.frame(scene.qpos0)
    assert frame.shape == (120, 160, 3)
    assert frame.dtype == np.uint8
    assert 25 < frame.mean() < 200
    assert frame.std() > 5
    assert np.abs(frame.mean(axis=(0, 1)) - frame.mean()).max() < 20
    assert np.array_equal(frame, renderer.frame(scene.qpos0))


def test_markers_show_in_their_colour_and_only_when_asked(scene, renderer):
    def green(picture):
        r, g, b = (picture[..., i].astype(int) for i in range(3))
        return ((g > r + 60) & (g > b + 60)).sum()

    target = np.array([0.0, 0.0])
    markers = [*render.post(scene, target, (0, 1, 0, 1), label="T1"),
               *render.square(scene, target, 1.0, (0, 1, 0, 1))]
    assert green(renderer.frame(scene.qpos0, None, markers)) > 20
    assert green(renderer.frame(scene.qpos0)) == 0


def test_a_robot_that_moves_is_drawn_elsewhere(scene, renderer):
    camera = render.overview(scene, scene.qpos0)
    moved = scene.qpos0.copy()
    moved[2] += 1.0
    change = np.abs(renderer.frame(moved, camera).astype(int) - renderer.frame(scene.qpos0, camera))
    assert (change > 15).sum() > 10


@pytest.mark.parametrize("azimuth", [0.0, 75.0, 200.0])
def test_framing_sees_every_point(azimuth):
    points = np.random.default_rng(1).uniform(-8, 8, (12, 3)) * [1, 1, 0.1]
    fovy, aspect = 45.0, 1.6
    camera = render.framing(points, fovy, azimuth, -35.0, aspect)
    az, el = np.radians([azimuth, -35.0])
    forward = np.array([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)])
    right = np.array([np.sin(az), -np.cos(az), 0])
    offset = points - (camera.lookat - camera.distance * forward)
    depth = offset @ forward
    tan = np.tan(np.radians(fovy) / 2)
    assert (depth > 0).all()
    assert (np.abs(offset @ right) / depth < tan * aspect * 1.01).all()
    assert (np.abs(offset @ np.cross(right, forward)) / depth < tan * 1.01).all()
    assert camera.distance < 60


def test_without_opengl_the_packages_are_named(scene, monkeypatch):
    def broken(*_):
        raise AttributeError("'NoneType' object has no attribute 'eglQueryString'")

    monkeypatch.setattr("mujoco.egl.GLContext", broken)
    monkeypatch.setenv("MUJOCO_GL", "egl")
    with pytest.raises(RenderingUnavailable, match="libegl1"):
        Renderer(scene, 64, 64)
