"""What a scene looks like: regolith, rocks, a low sun, a black sky. Nothing here has a mass
or touches anything; the physics model is compiled without it.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np
import numpy.typing as npt
from PIL import Image

from moonteam.problem.sun import SunPosition
from moonteam.terrain.site import Site

Floats = npt.NDArray[np.float32]

SUN_AZIMUTH, SUN_ELEVATION = math.radians(215.0), math.radians(28.0)
"""Where the sunlight comes from unless the site has a sun of its own; low, so that relief shows.
The azimuth is from east counterclockwise.
"""

LOWEST_SUN = math.radians(2.0)
"""No picture has the sun lower: a site in the dark is shown as if it stood there."""

SUN_DISTANCE = 30.0
"""From where a picture looks to the sun's place in it, m; its light is parallel."""

TEXELS = 512
"""Side of the ground's texture, pixels."""

LOW_SUN = math.radians(13.0)
"""Elevation of the sun in films of missions, where its light lies in the ground's texture."""

BAKED_TEXELS = 2048
"""Side of that texture, pixels."""

STAR_TEXELS = 1024
"""Side of each of the sky's six pictures in films: a star is a pixel or two."""

APRON, APRON_PIECES, APRON_TEXELS = 5, 20, 1024
"""The ground around a site: how often as wide, samples for each width, texture pixels."""

SHADE = 0.13
"""Of the light in a film's shadows, what open ground has being 1: light from lit ground around."""

RESPONSE = 0.72
"""Of a film: how steeply its brightness grows with light."""

IN_SHADOW = round(255.0 * (1.0 - math.exp(-RESPONSE * SHADE)))
"""Brightness, of 255, of ground in shadow."""

UNLIT = 0.02
"""Of a material's own colour, which a light's share of it cannot be seen; its glow is the rest."""

VISUAL_GROUP = 1


def decorate(spec: mujoco.MjSpec, site: Site) -> None:
    """Adds light, sky, ground texture and rocks to a scene's spec."""
    _light(spec, site.sun)
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


def paint(spec: mujoco.MjSpec, site: Site) -> None:
    """As `decorate`, but the ground's light and its shadows lie in its texture.

    A picture then needs no shadow map and one pass over the ground in place of three. What moves
    casts no shadow by itself: `moonteam.physics.stage` puts it in.
    """
    decorate(spec, site)
    pixels = bake(site)
    texture, ground = spec.texture("regolith"), spec.material("regolith")
    texture.width = texture.height = len(pixels)
    texture.data = pixels[::-1].tobytes()
    ground.rgba, ground.emission = [UNLIT, UNLIT, UNLIT, 1.0], 1.0 / UNLIT
    _apron(spec, site)
    sun = spec.light("sun")
    sun.dir, sun.castshadow = -sunward(LOW_SUN, site.sun), False
    sky = spec.texture("sky")
    sky.width, sky.height, sky.random = STAR_TEXELS, 6 * STAR_TEXELS, 0.0004
    spec.visual.headlight.ambient = [0.20, 0.20, 0.22]
    spec.visual.quality.numslices, spec.visual.quality.numstacks = 20, 12


def _apron(spec: mujoco.MjSpec, site: Site) -> None:
    """Ground around the site as far as one sees, so that it has no edge; nobody gets there.

    The site is mirrored at its borders, and rises into hills farther out.
    """
    heights, within = _around(site)
    half = site.extent
    rows, columns = heights.shape
    pixels = bake(Site("apron", site.seed + 1, heights,
                       2 * APRON * float(np.mean(half)) / (columns - 1), sun=site.sun),
                  APRON_TEXELS)
    texture = spec.add_texture(name="apron", type=mujoco.mjtTexture.mjTEXTURE_2D,
                               width=APRON_TEXELS, height=APRON_TEXELS, nchannel=3)
    texture.data = pixels[::-1].tobytes()
    material = spec.add_material(name="apron", specular=0.0, shininess=0.0, reflectance=0.0,
                                 rgba=[UNLIT, UNLIT, UNLIT, 1.0], emission=1.0 / UNLIT)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "apron"
    heights = np.where(within, heights - float(np.ptp(site.heights)) - 1.0, heights - 0.03)
    relief = max(float(np.ptp(heights)), 1e-3)
    spec.add_hfield(name="apron", nrow=rows, ncol=columns,
                    size=[APRON * half[0], APRON * half[1], relief, 0.1],
                    userdata=((heights - heights.min()) / relief).ravel())
    spec.worldbody.add_geom(
        name="apron", type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="apron", material="apron",
        pos=[0, 0, float(heights.min())], contype=0, conaffinity=0, group=VISUAL_GROUP)


def _around(site: Site) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """Elevations of the apron, and which of them lie within the site."""
    half = np.array(site.extent)
    count = APRON * APRON_PIECES + 1  # odd, and the site's border falls on samples
    x, y = (np.linspace(-APRON * h, APRON * h, count) for h in half)
    ny, nx = site.heights.shape
    mirrored = [h - np.abs((v + h) % (4 * h) - 2 * h) for v, h in zip((x, y), half, strict=True)]
    column, row = (np.clip(np.rint((v + h) / site.spacing), 0, n - 1).astype(int)
                   for v, h, n in zip(mirrored, half, (nx, ny), strict=True))
    inside = site.heights[row][:, column].astype(np.float32)
    away = np.maximum(np.abs(x)[None, :] - half[0], np.abs(y)[:, None] - half[1])
    out = np.maximum(away, 0.0)
    hills = _resized(np.random.default_rng(site.seed).normal(size=(12, 12)), count)
    near = np.exp(-out / 20.0)
    heights = near * inside + (1.0 - near) * (float(site.heights.mean()) + 0.013 * out * hills)
    return heights.astype(np.float32), away < -1e-6


def shown(sun: SunPosition) -> SunPosition:
    """The sun as pictures have it: no lower than LOWEST_SUN."""
    return sun._replace(elevation=max(sun.elevation, LOWEST_SUN))


def bearing(sun: SunPosition | None) -> float:
    """Where the light of a picture comes from, rad from east counterclockwise."""
    return SUN_AZIMUTH if sun is None else math.pi / 2 - sun.azimuth


def sunward(elevation: float = SUN_ELEVATION, sun: SunPosition | None = None
            ) -> npt.NDArray[np.float64]:
    """Unit vector [3] to the sun of a picture: a site's own, else at that elevation, rad."""
    if sun is not None:
        return np.array(shown(sun).toward)
    return np.array([math.cos(elevation) * math.cos(SUN_AZIMUTH),
                     math.cos(elevation) * math.sin(SUN_AZIMUTH), math.sin(elevation)])


def bake(site: Site, side: int = BAKED_TEXELS) -> npt.NDArray[np.uint8]:
    """The ground under a low sun, or the site's own [side, side, 3], row 0 in the south.

    Relief comes from the elevations; grain and pits finer than their spacing are paint, nobody
    drives over them.
    """
    random = np.random.default_rng(site.seed)
    half = np.array(site.extent)
    texel = 2.0 * half / side  # [2] m
    north, east = np.array(np.gradient(site.heights.astype(np.float32), site.spacing))
    grain_north, grain_east = np.array(np.gradient(
        _grain(random, side, float(texel.mean())), texel[1], texel[0]), np.float32)
    slope_x = _resized(east, side) + grain_east
    slope_y = _resized(north, side) + grain_north
    sun = sunward(LOW_SUN, site.sun).astype(np.float32)
    facing = (sun[2] - slope_x * sun[0] - slope_y * sun[1]) / np.sqrt(
        1.0 + slope_x**2 + slope_y**2)
    lit = np.clip(facing / sun[2], 0.0, 3.2) * (1.0 - _shadowed(site, side))
    albedo = np.ones((side, side), np.float32)
    for cells, strength in ((7, 0.06), (40, 0.04)):
        albedo += strength * _resized(random.normal(size=(cells, cells)), side)
    light = albedo * (SHADE + (1.0 - SHADE) * lit)
    # A film's response: steep in the dark, saturating in the bright.
    bright = 255.0 * (1.0 - np.exp(-RESPONSE * light))
    return (bright[..., None] * np.array([1.0, 0.985, 0.955], np.float32)).astype(np.uint8)


def _grain(random: np.random.Generator, side: int, texel: float) -> Floats:
    """Heights [side, side] m of what is finer than the elevations: grain, and pits of a hand's
    width to a step.
    """
    relief = np.zeros((side, side), np.float32)
    for metres, height in ((0.6, 0.010), (0.22, 0.0045), (0.08, 0.0018), (0.03, 0.0008)):
        cells = max(8, min(side, round(side * texel / metres)))
        relief += height * _resized(random.normal(size=(cells, cells)), side)
    count = min(4000, round(0.9 * (side * texel) ** 2))
    for x, y, share in zip(*random.uniform(size=(3, count)), strict=True):
        radius = 0.04 * (1.0 - 0.93 * share) ** -0.6 / texel  # texels
        if radius < 1.5:
            continue
        reach = math.ceil(1.6 * radius)
        column, row = (int(reach + v * (side - 2 * reach - 1)) for v in (x, y))
        step = np.arange(-reach, reach + 1, dtype=np.float32) / radius
        away = np.sqrt(step[:, None] ** 2 + step[None, :] ** 2)
        bowl = np.where(away < 1.0, away**2 - 1.0, 0.0) + 0.35 * np.exp(-((away - 1.0) / 0.22)**2)
        relief[row - reach:row + reach + 1, column - reach:column + reach + 1] += (
            0.18 * radius * texel * bowl)
    return relief


def _shadowed(site: Site, side: int) -> Floats:
    """0 to 1 [side, side]: ground and rocks between the ground and the sun."""
    sun = sunward(LOW_SUN, site.sun)
    climb = sun[2] / math.hypot(sun[0], sun[1])
    heights = site.heights.astype(np.float32)
    ny, nx = heights.shape
    steps = np.arange(1.0, max(2.0, float(np.ptp(heights)) / climb / site.spacing + 1.0))
    pad = len(steps) + 2
    padded = Image.fromarray(np.pad(heights, pad, mode="edge"))
    over = np.full(heights.shape, -1.0, np.float32)  # m by which the sun's ray is undercut
    for step in steps:
        shift = step * sun[:2] / math.hypot(sun[0], sun[1])
        seen = padded.transform((nx, ny), Image.Transform.AFFINE,
                                (1, 0, pad + shift[0], 0, 1, pad + shift[1]),
                                Image.Resampling.BILINEAR)
        np.maximum(over, np.asarray(seen) - heights - step * site.spacing * climb, out=over)
    shadow = np.clip(_resized(over, side) / 0.03 + 0.5, 0.0, 1.0)
    for boulder in site.boulders:
        _rock_shadow(shadow, site, boulder.centre, boulder.radius, sun)
    return shadow


def _rock_shadow(shadow: Floats, site: Site, centre: npt.NDArray, radius: float, sun: npt.NDArray
                 ) -> None:
    """Darkens, in place, the ground whose ray to the sun passes through a sphere."""
    side = len(shadow)
    half = np.array(site.extent)
    ends = np.stack([centre[:2], centre[:2] - sun[:2] / sun[2] * 2.5 * radius])
    low = np.clip((ends.min(axis=0) - 1.2 * radius + half) / (2 * half) * side, 0, side)
    high = np.clip((ends.max(axis=0) + 1.2 * radius + half) / (2 * half) * side, 0, side)
    columns, rows = (np.arange(int(a), int(b)) for a, b in zip(low, high, strict=True))
    if not len(columns) or not len(rows):
        return
    x, y = (2 * h * (v + 0.5) / side - h for h, v in zip(half, (columns, rows), strict=True))
    ny, nx = site.heights.shape
    ground = site.heights[np.clip(np.rint((y + half[1]) / site.spacing), 0, ny - 1).astype(int)][
        :, np.clip(np.rint((x + half[0]) / site.spacing), 0, nx - 1).astype(int)]
    away = np.stack(np.broadcast_arrays(centre[0] - x[None, :], centre[1] - y[:, None],
                                        centre[2] - ground), axis=-1)
    along = away @ sun
    beside = np.sqrt(np.maximum((away**2).sum(axis=-1) - along**2, 0.0))
    dark = np.clip((radius - beside) / 0.06 + 0.5, 0.0, 1.0) * (along > -radius)
    part = shadow[rows[0]:rows[-1] + 1, columns[0]:columns[-1] + 1]
    np.maximum(part, dark.astype(np.float32), out=part)


def _resized(image: npt.NDArray, side: int) -> Floats:
    """Samples [h, w], the outer ones on the border, at the middles of [side, side] pixels."""
    high, wide = image.shape
    return np.asarray(Image.fromarray(np.asarray(image, np.float32)).resize(
        (side, side), Image.Resampling.BICUBIC, box=(0.5, 0.5, wide - 0.5, high - 0.5)))


def mesh_offsets(model: mujoco.MjModel, site: Site) -> None:
    """Puts rocks back where their corners were given: compilation centres meshes."""
    for index, boulder in enumerate(site.boulders):
        geom, mesh = model.geom(f"rock{index}").id, model.mesh(f"rock{index}").id
        model.geom_pos[geom] = boulder.centre + model.mesh_pos[mesh]
        model.geom_quat[geom] = model.mesh_quat[mesh]


def _light(spec: mujoco.MjSpec, sun: SunPosition | None) -> None:
    direction = -sunward(sun=sun)
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
