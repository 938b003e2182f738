"""Pictures of a painted scene with their depth, for films: cheap on a CPU, with sharp shadows.

OpenGL on a CPU takes three passes over the ground for a shadow map. Here the ground's light lies
in its texture (`look.paint`), and what moves is drawn once more, small and from the sun: a pixel
is in shadow where that picture has something nearer to the sun. Edges are smoothed where they
are (FXAA), which costs a tenth of multisampling.

A stage needs the compiled model alone, so it can live in another process than the physics.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt

from moonteam.physics import look
from moonteam.physics.render import SHOWN_GROUPS, Canvas, Color, Marker, open_window
from moonteam.physics.scene import Scene, set_heights
from moonteam.problem.sun import SunPosition

MAX_GEOMS = 6000
NEAR, FAR = 0.15, 1500.0  # m
SUN_PIXELS = 224  # side of the picture from the sun
LARGE = 60_000  # pixels
BIAS = 0.035  # m
STILL, MOVING, HIDDEN = 5, 0, 3  # groups of the painted model's geoms

Floats = npt.NDArray[np.floating]
Picture = npt.NDArray[np.uint8]


def painted(scene: Scene) -> mujoco.MjModel:
    """The scene's model with its looks, to be drawn and nothing else."""
    spec = scene.spec.copy()
    look.paint(spec, scene.site)
    model = spec.compile()
    set_heights(model, scene.site.heights)
    look.mesh_offsets(model, scene.site)
    shown = np.array([SHOWN_GROUPS[group] == 1 for group in model.geom_group])
    model.geom_group[:] = np.where(model.geom_bodyid == 0, STILL, MOVING)
    model.geom_group[~shown] = HIDDEN
    return model


def check() -> None:
    """Raises RenderingUnavailable where nothing can be drawn."""
    window = open_window(64, 64)
    window.free()


@dataclass(frozen=True)
class View:
    """A camera at `eye` [3] m that looks at `aim` [3] m; `fovy` degrees from top to bottom."""

    eye: Floats
    aim: Floats
    fovy: float = 45.0

    @functools.cached_property
    def axes(self) -> Floats:
        """Rows [3, 3]: right, up, forward."""
        forward = np.asarray(self.aim, float) - self.eye
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= max(float(np.linalg.norm(right)), 1e-9)
        return np.stack([right, np.cross(right, forward), forward])

    def project(self, points: Floats, size: tuple[int, int]) -> tuple[Floats, Floats]:
        """Pixels [n, 2] (x right, y down) and depths [n] m of points [n, 3] m.

        `size`: width and height. Behind the camera the depth is not above 0.
        """
        offset = np.asarray(points, float) - self.eye
        right, up, depth = (offset @ axis for axis in self.axes)
        scale = size[1] / 2 / math.tan(math.radians(self.fovy) / 2) / np.maximum(depth, 1e-6)
        return np.stack([size[0] / 2 + right * scale, size[1] / 2 - up * scale], -1), depth


@dataclass(frozen=True)
class Caster:
    """What casts a shadow: within `radius` m of `centre` [3] m, `above` m over the ground.

    `body`: the root of its bodies, which alone are drawn from the sun; 0: all that moves.
    """

    centre: Floats
    radius: float
    above: float
    body: int = 0


@dataclass(frozen=True)
class Line:
    """Straight pieces [n, 2, 3] m, `width` pixels wide; no light falls on them."""

    pieces: Floats
    rgba: Color
    width: float


class Stage(Canvas):
    """Draws a painted model under the sun of its site. Raises RenderingUnavailable."""

    def __init__(self, model: mujoco.MjModel, width: int, height: int,
                 sun: SunPosition | None = None):
        model.vis.global_.offwidth = max(width, SUN_PIXELS)
        model.vis.global_.offheight = max(height, SUN_PIXELS)
        model.vis.quality.offsamples = 0
        model.vis.quality.shadowsize = 0
        super().__init__(model, width, height, MAX_GEOMS)
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self._groups = model.geom_group.copy()
        self._roots = model.body_rootid[model.geom_bodyid]
        for flag in ("SHADOW", "FOG"):
            self._drawn.flags[getattr(mujoco.mjtRndFlag, f"mjRND_{flag}")] = False
        # Under a sun that is asked about much lies in shadow, where nothing throws another.
        self._darkest = np.uint8(0 if sun is None else look.IN_SHADOW)
        light = look.sunward(look.LOW_SUN, sun)
        aside = np.cross([0.0, 1.0, 0.0] if abs(light[2]) > 0.999 else [0.0, 0.0, 1.0], light)
        aside /= np.linalg.norm(aside)
        self._sun = np.stack([aside, np.cross(light, aside), light])  # rows: right, up, to the sun

    def frame(self, qpos: Floats, view: View, markers: Sequence[Marker] = (),
              lines: Sequence[Line] = (), casters: Sequence[Caster] = ()
              ) -> tuple[Picture, npt.NDArray[np.float32]]:
        """The picture [height, width, 3] of a pose qpos [nq], and depths [height, width] m.

        `casters`: whose shadows are wanted.
        """
        self._take(np.nan_to_num(qpos))
        size = (self.width, self.height)
        boxes = [_screen_box(view, size, caster, self._sun) for caster in casters]
        seen = [None if box is None else self._from_the_sun(caster)
                for caster, box in zip(casters, boxes, strict=True)]
        self._scene(every=True)
        for marker in markers:
            self._draw(marker)
        for line in lines:
            self._draw_line(line)
        self._aim(view.eye, view.axes[2], view.axes[1], math.radians(view.fovy))
        mujoco.mjr_render(self._port, self._drawn, self._context)
        picture = np.empty((self.height, self.width, 3), np.uint8)
        raw = np.empty((self.height, self.width), np.float32)
        mujoco.mjr_readPixels(picture, raw, self._port, self._context)
        picture, depth = picture[::-1].copy(), _metres(raw[::-1])
        for caster, box, shade in zip(casters, boxes, seen, strict=True):
            if box is not None and shade is not None:
                self._cast(picture, depth, view, caster, box, shade)
        return smoothed(picture), depth

    def site(self, name: str) -> tuple[Floats, Floats]:
        """Place [3] m and axes [3, 3], columns, of a site in the pose drawn last."""
        at = self._data.site(name)
        return np.array(at.xpos), np.array(at.xmat).reshape(3, 3)

    def pose(self, qpos: Floats) -> None:
        """Takes a pose qpos [nq] without drawing it, for `site`."""
        self._data.qpos[:] = np.nan_to_num(qpos)
        mujoco.mj_kinematics(self.model, self._data)

    def _scene(self, every: bool, body: int = 0) -> None:
        """Everything, or what moves alone; of that a root body's part where one is given."""
        self._option.geomgroup[:] = 0
        self._option.geomgroup[MOVING] = 1
        self._option.geomgroup[STILL] = every
        self.model.geom_group[:] = np.where(self._roots == body, self._groups, HIDDEN) if (
            body) else self._groups
        self._drawn.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = every
        camera = mujoco.MjvCamera()
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        self._update(camera)

    def _aim(self, eye: Floats, forward: Floats, up: Floats, fovy: float, flat: float = 0.0
             ) -> None:
        """Turns both of the scene's cameras; `flat` > 0: parallel, that many m to each side."""
        for camera in self._drawn.camera:
            camera.pos[:], camera.forward[:], camera.up[:] = eye, forward, up
            camera.frustum_near, camera.frustum_far = NEAR, FAR
            top = flat or NEAR * math.tan(fovy / 2)
            camera.frustum_top, camera.frustum_bottom = top, -top
            camera.frustum_center, camera.frustum_width = 0.0, 0.0
            camera.orthographic = int(flat > 0)
            if flat:
                camera.frustum_near, camera.frustum_far = SUN_NEAR, 2.0 * SUN_FAR

    def _from_the_sun(self, caster: Caster) -> npt.NDArray[np.float32]:
        """How far towards the sun, m from the centre, it reaches [SUN_PIXELS, SUN_PIXELS];
        -inf where there is nothing. Row 0 is the lowest.
        """
        self._scene(every=False, body=caster.body)
        eye = np.asarray(caster.centre) + SUN_FAR * self._sun[2]
        self._aim(eye, -self._sun[2], self._sun[1], 0.0, caster.radius)
        port = mujoco.MjrRect(0, 0, SUN_PIXELS, SUN_PIXELS)
        mujoco.mjr_render(port, self._drawn, self._context)
        raw = np.empty((SUN_PIXELS, SUN_PIXELS), np.float32)
        mujoco.mjr_readPixels(None, raw, port, self._context)
        metres = SUN_NEAR + (1.0 - raw) * (2.0 * SUN_FAR - SUN_NEAR)
        return np.where(raw > 0.0, SUN_FAR - metres, -np.inf).astype(np.float32)

    def _cast(self, picture: Picture, depth: npt.NDArray[np.float32], view: View, caster: Caster,
              box: tuple[int, int, int, int], shade: npt.NDArray[np.float32]) -> None:
        """Darkens, in place, the pixels whose ray to the sun the caster stops."""
        radius = caster.radius
        left, top, right, bottom = box
        # A large shadow is worked out for every second pixel each way: it is soft all the same.
        step = 1 if (right - left) * (bottom - top) < LARGE else 2
        scale = math.tan(math.radians(view.fovy) / 2) / (self.height / 2)
        x = ((np.arange(left, right, step) + 0.5 - self.width / 2) * scale).astype(np.float32)
        y = ((self.height / 2 - np.arange(top, bottom, step) - 0.5) * scale).astype(np.float32)
        away = depth[top:bottom:step, left:right:step]

        def along(axis: Floats) -> npt.NDArray[np.float32]:
            """m along an axis from the caster's centre."""
            across, rise, ahead = (np.float32(a @ axis) for a in view.axes)
            metres = away * (rise * y[:, None] + (across * x + ahead)[None, :])
            return np.asarray(metres + np.float32((view.eye - caster.centre) @ axis), np.float32)

        texel = np.float32(SUN_PIXELS / (2.0 * radius))
        column = ((along(self._sun[0]) + np.float32(radius)) * texel).astype(np.int32)
        row = ((along(self._sun[1]) + np.float32(radius)) * texel).astype(np.int32)
        inside = (column > 0) & (column < SUN_PIXELS) & (row > 0) & (row < SUN_PIXELS)
        at = np.nonzero(inside & (away < FAR / 2))
        dark = np.zeros(away.shape, np.float32)
        dark[at] = along(self._sun[2])[at] + BIAS < shade[row[at], column[at]]
        if not dark.any():
            return
        dark = _blurred(dark).repeat(step, 0).repeat(step, 1) if step > 1 else dark
        dark = _blurred(dark)[:bottom - top, :right - left]
        rows, columns = np.nonzero(dark)
        part = picture[top:bottom, left:right]
        kept = 1.0 - np.float32(1.0 - 2.0 * look.SHADE) * dark[rows, columns]
        before = part[rows, columns]
        part[rows, columns] = np.maximum((before * kept[:, None]).astype(np.uint8),
                                         np.minimum(before, self._darkest))

    def _draw_line(self, line: Line) -> None:
        kind, width = mujoco.mjtGeom.mjGEOM_LINE, line.width
        nothing, turn = np.zeros(3), np.eye(3).ravel()
        rgba = np.array(line.rgba, np.float32)
        for start, end in np.asarray(line.pieces, np.float64):
            geom = self._next()
            if geom is None:
                return
            mujoco.mjv_initGeom(geom, kind, nothing, nothing, turn, rgba)
            mujoco.mjv_connector(geom, kind, width, start, end)
            geom.category = mujoco.mjtCatBit.mjCAT_DECOR


SUN_NEAR, SUN_FAR = 0.5, 20.0  # m from the eye in the sun to what it sees first, to the middle


def _metres(raw: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Depths m of what the buffer holds: 1 at NEAR, 0 at FAR."""
    return (NEAR * FAR / (NEAR + raw * (FAR - NEAR))).astype(np.float32)


def _screen_box(view: View, size: tuple[int, int], caster: Caster, sun: Floats
                ) -> tuple[int, int, int, int] | None:
    """Left, top, right, bottom pixels of a caster and its shadow; None: not in the picture."""
    radius = caster.radius
    long = (caster.above + 2.0 * radius) / sun[2, 2] + radius
    corners = [caster.centre + radius * (a * sun[0] + b * sun[1]) + c * sun[2]
               for a in (-1, 1) for b in (-1, 1) for c in (radius, -long)]
    pixels, depth = view.project(np.array(corners), size)
    if (depth <= NEAR).all():
        return None
    if (depth <= NEAR).any():
        return 0, 0, size[0], size[1]
    low = np.clip(np.floor(pixels.min(axis=0)), 0, size).astype(int)
    high = np.clip(np.ceil(pixels.max(axis=0)), 0, size).astype(int)
    if (high - low < 1).any():
        return None
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def _blurred(mask: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """A mask [h, w] averaged over 3 by 3."""
    padded = np.pad(mask, 1, mode="edge")
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    return ((rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]) / 9.0).astype(np.float32)


def smoothed(picture: Picture, contrast: int = 42, search: int = 8) -> Picture:
    """FXAA (Lottes 2009) of a picture [h, w, 3], worked out at its edges alone.

    `contrast`: levels of green from which on neighbours are an edge; `search`: pixels that an
    edge is followed to each side. The outermost `search` pixels stay as they are.
    """
    luma = np.ascontiguousarray(picture[..., 1])
    height, width = luma.shape
    if min(height, width) <= 2 * search + 2:
        return picture
    border = slice(search, height - search), slice(search, width - search)
    middle = luma[border]
    around = [luma[search + a:height - search + a, search + b:width - search + b]
              for a, b in ((-1, 0), (1, 0), (0, -1), (0, 1))]
    high = functools.reduce(np.maximum, around, middle)
    low = functools.reduce(np.minimum, around, middle)
    y, x = np.nonzero(high - low > np.maximum(contrast, high >> 3))
    if not len(y):
        return picture
    spread = (high - low)[y, x].astype(np.float32)
    index = (y + search) * width + x + search
    values = luma.ravel().astype(np.int16)
    here = values[index]
    up, down, left, right = (values[index + k] for k in (-width, width, -1, 1))
    ul, ur, dl, dr = (values[index + k] for k in (-width - 1, -width + 1, width - 1, width + 1))
    tall = (2 * np.abs(up + down - 2 * here) + np.abs(ul + dl - 2 * left)
            + np.abs(ur + dr - 2 * right))
    broad = (2 * np.abs(left + right - 2 * here) + np.abs(ul + ur - 2 * up)
             + np.abs(dl + dr - 2 * down))
    flat = tall >= broad
    before, after = np.where(flat, up, left), np.where(flat, down, right)
    steep = np.abs(before - here) >= np.abs(after - here)
    other = np.where(steep, before, after)
    across = np.where(flat, width, 1) * np.where(steep, -1, 1)
    pair = here + other  # twice the brightness of the edge itself
    limit = np.abs(other - here) // 2
    follow = np.where(flat, 1, width)
    far_b, end_b = _edge_end(values, index, across, -follow, pair, limit, search)
    far_a, end_a = _edge_end(values, index, across, follow, pair, limit, search)
    end = np.where(far_b < far_a, end_b, end_a)
    good = (end < 0) != (2 * here - pair < 0)
    offset = np.where(good, 0.5 - np.minimum(far_b, far_a) / (far_a + far_b), 0.0)
    # Single pixels and thin lines: as far as the pixel stands out of its surroundings.
    out = np.abs((2 * (up + down + left + right) + ul + ur + dl + dr) / np.float32(12) - here)
    thin = np.clip(out / spread, 0, 1)
    thin = 0.6 * (thin * thin * (3 - 2 * thin)) ** 2
    share = np.maximum(offset, thin).astype(np.float32)[:, None]
    result = picture.copy()
    pixels, flat_result = picture.reshape(-1, 3), result.reshape(-1, 3)
    flat_result[index] = (pixels[index] * (1 - share) + pixels[index + across] * share
                          + np.float32(0.5)).astype(np.uint8)
    return result


def _edge_end(values: npt.NDArray[np.int16], index: npt.NDArray, across: npt.NDArray,
              follow: npt.NDArray, pair: npt.NDArray, limit: npt.NDArray, search: int
              ) -> tuple[npt.NDArray[np.float32], npt.NDArray]:
    """How many pixels [n] an edge goes on to one side, and by how much its pair differs there."""
    far = np.full(len(index), search, np.float32)
    last = np.zeros(len(index), np.int16)
    going = np.arange(len(index))
    for step in (1, 2, 3, 5, search):
        there = index[going] + step * follow[going]
        differ = values[there] + values[there + across[going]] - pair[going]
        last[going] = differ
        ended = np.abs(differ) >= limit[going]
        far[going[ended]] = step
        going = going[~ended]
    return far, last
