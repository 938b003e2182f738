import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from moonteam.physics.scene import build_scene
from moonteam.terrain.site import OVERHANG, Boulder, Site, make_site
from moonteam.terrain.surface import Surface


def ray_heights(site: Site, xy: np.ndarray) -> np.ndarray:
    """Where MuJoCo rays from above meet the scene's ground."""
    model = build_scene(site, []).model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    geom = np.zeros(1, np.int32)
    down = np.array([0.0, 0.0, -1.0])
    return np.array([
        50.0 - mujoco.mj_ray(model, data, np.array([x, y, 50.0]), down, None, 1, -1, geom)
        for x, y in xy])


@pytest.mark.parametrize("preset", ["mare", "highland"])
def test_height_is_where_mujoco_rays_meet_the_ground(preset):
    made = make_site(preset, 4, (24.0, 16.0))
    site = Site(made.name, made.seed, made.heights, made.spacing)  # rays meet boulders too
    xy = np.random.default_rng(0).uniform(-1, 1, (1000, 2)) * np.array(site.extent) * 0.999
    surface = np.asarray(site.surface.height(jnp.asarray(xy, jnp.float32)))
    assert np.abs(surface - ray_heights(site, xy)).max() < 1e-3


def test_rough_ground_is_split_along_mujocos_diagonal():
    heights = np.random.default_rng(1).normal(scale=0.3, size=(13, 17)).astype(np.float32)
    site = Site("noise", 0, heights, 0.25)
    xy = np.random.default_rng(2).uniform(-1, 1, (1000, 2)) * np.array(site.extent) * 0.999
    surface = np.asarray(site.surface.height(jnp.asarray(xy, jnp.float32)))
    assert np.abs(surface - ray_heights(site, xy)).max() < 1e-3


def incline(gx: float, gy: float) -> Surface:
    y, x = np.mgrid[-10:11, -20:21] * 0.5
    return Surface(jnp.asarray(gx * x + gy * y, jnp.float32), 0.5)


def test_an_incline_has_its_slope_normal_and_plane():
    surface = incline(0.3, -0.4)
    xy = jnp.array([[0.1, 0.2], [3.3, -2.1]])
    normal = np.array([-0.3, 0.4, 1.0]) / np.sqrt(1.25)
    assert np.allclose(surface.slope(xy), np.arctan(0.5), atol=1e-5)
    assert np.allclose(surface.normal(xy), normal[None], atol=1e-5)
    height, fitted = surface.plane(xy, 0.7)
    assert np.allclose(height, surface.height(xy), atol=1e-5)
    assert np.allclose(fitted, normal[None], atol=1e-5)


def test_a_plane_smooths_what_a_triangle_does_not():
    heights = np.zeros((21, 21), np.float32)
    heights[10, 10] = 0.1  # one sharp sample in the middle
    surface = Surface(jnp.asarray(heights), 0.25)
    at = jnp.array([0.05, 0.0])
    _, normal = surface.plane(at, 1.0)
    assert float(surface.slope(at)) > 0.3
    assert float(jnp.arccos(normal[2])) < 0.02


def test_outside_the_site_the_border_goes_on():
    surface = incline(1.0, 0.0)
    assert float(surface.height(jnp.array([99.0, 0.0]))) == pytest.approx(10.0)
    assert float(surface.height(jnp.array([-99.0, 0.0]))) == pytest.approx(-10.0)


def test_any_batch_shape_and_jit():
    surface = incline(0.1, 0.2)
    xy = jnp.ones((2, 3, 2))
    assert jax.jit(Surface.height)(surface, xy).shape == (2, 3)
    assert surface.normal(xy).shape == (2, 3, 3)
    assert surface.plane(xy[0, 0], 0.3)[1].shape == (3,)


def test_tops_are_the_ground_and_the_boulders_on_it():
    rock = Boulder(np.array([1.0, -1.0, 0.2]), 0.5, np.zeros((0, 3)))
    heights = np.full((41, 41), 0.1, np.float32)
    surface = Site("one", 0, heights, 0.25, (rock,)).surface
    reach = rock.reach(0.1) + OVERHANG
    angle = np.linspace(0, 2 * np.pi, 16)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    for share, height in ((0.0, 0.7), (0.3, 0.7), (rock.reach(0.1) + 0.2, 0.7), (2 * reach, 0.1)):
        tops = surface.top(jnp.asarray(rock.centre[:2] + share * ring, jnp.float32))
        assert np.allclose(tops, height, atol=1e-5)
    assert float(surface.height(jnp.array([1.0, -1.0]))) == pytest.approx(0.1)
    assert float(Surface(jnp.asarray(heights), 0.25).top(jnp.zeros(2))) == pytest.approx(0.1)
