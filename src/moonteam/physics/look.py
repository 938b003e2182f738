"""What a scene looks like: regolith, rocks, a low sun, a black sky. Nothing here has a mass
or touches anything; the physics model is compiled without it.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np

from moonteam.terrain.site import Site

SUN_AZIMUTH, SUN_ELEVATION = math.radians(215.0), math.radians(28.0)
"""Where the sunlight comes from; low, so that relief shows."""

SUN_DISTANCE = 30.0
"""From where a picture looks to the sun's place in it, m; its light is parallel."""

TEXELS = 512
"""Side of the ground's texture, pixels."""

VISUAL_GROUP = 1


def decorate(spec: mujoco.MjSpec, site: Site) -> None:
    """Adds light, sky, ground texture and rocks to a scene's spec."""
    _light(spec)
    _sky(spec)
    _regolith(spec, site)
    for index, boulder in enumerate(site.boulders):
        spec.add_mesh(name=f"rock{index}", uservert=boulder.vertices.ravel(), smoothnormal=0,
                      inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX)
        shade = 0.34 + 0.10 * ((index * 0.618) % 1.0)
        spec.worldbody.add_geom(
            name=f"rock{index}", type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"rock{index}",
            pos=boulder.centre, contype=0, conaffinity=0, group=VISUAL_GROUP,
            rgba=[shade, shade, 0.98 * shade, 1])


def mesh_offsets(model: mujoco.MjModel, site: Site) -> None:
    """Puts rocks back where their corners were given: compilation centres meshes."""
    for index, boulder in enumerate(site.boulders):
        geom, mesh = model.geom(f"rock{index}").id, model.mesh(f"rock{index}").id
        model.geom_pos[geom] = boulder.centre + model.mesh_pos[mesh]
        model.geom_quat[geom] = model.mesh_quat[mesh]


def _light(spec: mujoco.MjSpec) -> None:
    direction = -np.array([
        math.cos(SUN_ELEVATION) * math.cos(SUN_AZIMUTH),
        math.cos(SUN_ELEVATION) * math.sin(SUN_AZIMUTH), math.sin(SUN_ELEVATION)])
    spec.worldbody.add_light(
        name="sun", type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, dir=direction,
        pos=-SUN_DISTANCE * direction, diffuse=[1.25, 1.23, 1.17], specular=[0.15, 0.15, 0.15],
        ambient=[0, 0, 0], castshadow=True)
    spec.visual.headlight.ambient = [0.17, 0.17, 0.19]
    spec.visual.headlight.diffuse = [0.13, 0.13, 0.14]
    spec.visual.headlight.specular = [0, 0, 0]
    spec.visual.quality.shadowsize = 4096
    spec.visual.map.zfar = 60.0
    spec.visual.map.znear = 0.02
    spec.visual.map.shadowclip = 1.0


def _sky(spec: mujoco.MjSpec) -> None:
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT, rgb1=[0.0, 0.0, 0.0], rgb2=[0.0, 0.0, 0.01],
        width=512, height=3072, mark=mujoco.mjtMark.mjMARK_RANDOM, markrgb=[0.75, 0.75, 0.8],
        random=0.0012)
    spec.visual.rgba.haze = [0, 0, 0, 1]


def _regolith(spec: mujoco.MjSpec, site: Site) -> None:
    """Grey with grain at several scales, a little darker in hollows where light is blocked."""
    random = np.random.default_rng(site.seed)
    grain = np.zeros((TEXELS, TEXELS))
    for cells, strength in ((6, 0.035), (24, 0.03), (96, 0.035), (TEXELS, 0.05)):
        coarse = random.normal(size=(cells, cells))
        grain += strength * _stretch(coarse, TEXELS)
    hollow = _stretch(_hollows(site.heights), TEXELS)
    albedo = np.clip(0.50 * (1 + grain) - 0.10 * hollow, 0.1, 0.95)
    pixels = (255 * albedo[..., None] * np.array([1.0, 0.985, 0.96])).astype(np.uint8)
    # Row 0 of a texture is the north edge, of a site the south edge.
    texture = spec.add_texture(name="regolith", type=mujoco.mjtTexture.mjTEXTURE_2D,
                               width=TEXELS, height=TEXELS, nchannel=3)
    texture.data = pixels[::-1].tobytes()
    material = spec.add_material(name="regolith", specular=0.0, shininess=0.0, reflectance=0.0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "regolith"
    ground = spec.geom("ground")
    ground.material, ground.rgba = "regolith", [1, 1, 1, 1]


def _hollows(heights: np.ndarray) -> np.ndarray:
    """How far each sample lies under its surroundings, 0 to 1, by box means of 9 samples."""
    padded = np.pad(heights.astype(np.float64), 4, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (9, 9))
    return np.clip((windows.mean(axis=(2, 3)) - heights) / 0.06, 0, 1)


def _stretch(image: np.ndarray, side: int) -> np.ndarray:
    """An image [h, w] stretched to [side, side], bilinear."""
    rows, columns = (np.linspace(0, n - 1, side) for n in image.shape)
    tall = np.stack([np.interp(rows, np.arange(len(image)), image[:, j])
                     for j in range(image.shape[1])], axis=1)
    return np.stack([np.interp(columns, np.arange(image.shape[1]), row) for row in tall])
