"""Pictures of a scene without a screen: logged poses in, RGB frames out.

Markers (targets, paths, names) are drawn into the picture only; the physics never sees them.
"""

from __future__ import annotations

import atexit
import itertools
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Self

import jax.numpy as jnp
import mujoco
import numpy as np
import numpy.typing as npt

from moonteam.physics import look
from moonteam.physics.scene import Scene, set_heights

MAX_GEOMS = 4000
SHOWN_GROUPS = (1, 1, 1, 0, 0, 0)  # 3 holds what only touches

Color = tuple[float, float, float, float]
Points = npt.NDArray[np.floating]


class RenderingUnavailable(Exception):
    """This machine cannot draw without a screen; the message says what to install."""

    def __init__(self, reason: str):
        super().__init__(
            f"no off-screen OpenGL ({reason}); on Debian or Ubuntu install libegl1 "
            "libgl1-mesa-dri libglx-mesa0 libopengl0 (or set MUJOCO_GL=osmesa with libosmesa6)")


@dataclass(frozen=True)
class Marker:
    """One simple shape in a picture: a MuJoCo geom type, its sizes, its pose."""

    type: mujoco.mjtGeom
    size: tuple[float, float, float]
    position: Points  # [3] m
    rgba: Color
    matrix: Points = field(default_factory=lambda: np.eye(3))
    label: str = ""
    glow: float = 0.0  # light of its own, 0 to 1


class Canvas:
    """A compiled model with an off-screen window to draw it in, and what is drawn over it.

    Use as a context manager, or call `close`. Raises RenderingUnavailable.
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int, most_geoms: int):
        self.model, self.width, self.height = model, width, height
        self._data = mujoco.MjData(model)
        self._window = open_window(width, height)
        atexit.register(self.close)
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._drawn = mujoco.MjvScene(model, most_geoms)
        for flag in ("REFLECTION", "HAZE"):
            self._drawn.flags[getattr(mujoco.mjtRndFlag, f"mjRND_{flag}")] = False
        self._option = mujoco.MjvOption()
        self._option.label = mujoco.mjtLabel.mjLABEL_NONE
        self._option.flags[:] = False
        self._option.flags[mujoco.mjtVisFlag.mjVIS_TEXTURE] = True
        self._option.flags[mujoco.mjtVisFlag.mjVIS_STATIC] = True

    @property
    def _port(self) -> mujoco.MjrRect:
        """The whole picture."""
        return mujoco.MjrRect(0, 0, self.width, self.height)

    def _take(self, qpos: Points) -> None:
        """Takes a pose qpos [nq], lights and cameras with it, in this window."""
        self._window.make_current()
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self._data)
        mujoco.mj_comPos(self.model, self._data)  # lights and cameras need it
        mujoco.mj_camlight(self.model, self._data)

    def _update(self, camera: mujoco.MjvCamera) -> None:
        """The scene anew, with nothing drawn over it."""
        mujoco.mjv_updateScene(self.model, self._data, self._option, None, camera,
                               mujoco.mjtCatBit.mjCAT_ALL, self._drawn)

    def _draw(self, marker: Marker) -> None:
        geom = self._next()
        if geom is None:
            return
        mujoco.mjv_initGeom(geom, marker.type, np.array(marker.size, np.float64),
                            np.asarray(marker.position, np.float64),
                            np.asarray(marker.matrix, np.float64).ravel(),
                            np.array(marker.rgba, np.float32))
        geom.category = mujoco.mjtCatBit.mjCAT_DECOR
        geom.emission = marker.glow
        geom.label = marker.label

    def _next(self) -> mujoco.MjvGeom | None:
        """The scene's next geom; None where it is full."""
        if self._drawn.ngeom >= self._drawn.maxgeom:
            return None
        self._drawn.ngeom += 1
        return self._drawn.geoms[self._drawn.ngeom - 1]

    def close(self) -> None:
        """Frees the window; harmless twice. Without it Python may complain on exit."""
        atexit.unregister(self.close)
        for part in ("_context", "_window"):
            held = self.__dict__.pop(part, None)
            if held is not None:
                held.free()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


class Renderer(Canvas):
    """Draws a scene.

    Args:
      scene: what to draw.
      width, height: pixels.
      shadows: cast by the sun; several times dearer without a GPU.
      samples: of multisampling; 0 is the cheapest.
      shadow_reach: shadows fall only this far, m, around where the camera looks, and are the
        sharper for it; 0: everywhere.

    Raises RenderingUnavailable.
    """

    def __init__(self, scene: Scene, width: int, height: int, *, shadows: bool = False,
                 samples: int = 4, shadow_reach: float = 0.0):
        spec = scene.spec.copy()
        look.decorate(spec, scene.site)
        spec.visual.global_.offwidth, spec.visual.global_.offheight = width, height
        spec.visual.quality.offsamples = samples
        model = spec.compile()
        set_heights(model, scene.site.heights)
        look.mesh_offsets(model, scene.site)
        self.scene, self._follow_shadow = scene, shadow_reach > 0.0
        if self._follow_shadow:
            model.vis.map.shadowclip = shadow_reach / model.stat.extent
        super().__init__(model, width, height, MAX_GEOMS)
        self._drawn.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
        self._option.geomgroup[:] = SHOWN_GROUPS

    def frame(self, qpos: Points, camera: mujoco.MjvCamera | None = None,
              markers: Sequence[Marker] = (), words: str = "") -> npt.NDArray[np.uint8]:
        """The picture [height, width, 3] of a pose qpos [nq], with `words` in a corner.

        Without a camera: one that sees all robots.
        """
        self._take(qpos)
        seen = camera or overview(self.scene, qpos, aspect=self.width / self.height)
        if self._follow_shadow:
            sun = self._data.light_xdir[0]
            self._data.light_xpos[0] = np.asarray(seen.lookat) - look.SUN_DISTANCE * sun
        self._update(seen)
        for marker in markers:
            self._draw(marker)
        mujoco.mjr_render(self._port, self._drawn, self._context)
        if words:
            mujoco.mjr_overlay(mujoco.mjtFont.mjFONT_NORMAL, mujoco.mjtGridPos.mjGRID_TOPLEFT,
                               self._port, words, "", self._context)
        picture = np.empty((self.height, self.width, 3), np.uint8)
        mujoco.mjr_readPixels(picture, None, self._port, self._context)
        return picture[::-1]


def overview(
    scene: Scene,
    qpos: Points,
    points: Points | None = None,
    *,
    azimuth: float = 90.0,
    elevation: float = -35.0,
    aspect: float = 16 / 9,
) -> mujoco.MjvCamera:
    """A camera that sees every robot of a pose qpos [nq], and `points` [n, 3] m, whole.

    `azimuth`, `elevation`: of the view, degrees; turn the azimuth slowly for an orbit.
    """
    robots = np.stack([np.asarray(qpos)[r.qpos][:3] for r in scene.robots])
    seen = robots if points is None else np.concatenate([robots, points])
    return framing(seen, scene.model.vis.global_.fovy, azimuth, elevation, aspect)


def framing(points: Points, fovy: float, azimuth: float, elevation: float, aspect: float,
            margin: float = 1.0) -> mujoco.MjvCamera:
    """The nearest free camera along a view that shows points [n, 3] m and `margin` m around."""
    az, el = math.radians(azimuth), math.radians(elevation)
    forward = np.array([math.cos(el) * math.cos(az), math.cos(el) * math.sin(az), math.sin(el)])
    right = np.array([math.sin(az), -math.cos(az), 0.0])
    up = np.cross(right, forward)
    tan_y = math.tan(math.radians(fovy) / 2)
    around = np.concatenate([points + margin * s * axis[None, :]
                             for axis in (right, up) for s in (-1, 1)])
    centre = points.mean(axis=0)
    # Move the aim until the picture is balanced; distance and aim depend on each other.
    distance = 1.0
    for _ in range(20):
        offset = around - centre
        x, y, depth = offset @ right, offset @ up, offset @ forward
        distance = max(float(np.max(np.abs(x) / (tan_y * aspect) - depth)),
                       float(np.max(np.abs(y) / tan_y - depth)), 1.0)
        sx, sy = x / (distance + depth), y / (distance + depth)
        centre = centre + 0.5 * distance * (
            right * (sx.max() + sx.min()) / 2 + up * (sy.max() + sy.min()) / 2)
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.lookat[:], camera.distance = centre, distance
    camera.azimuth, camera.elevation = azimuth, elevation
    return camera


def follow(position: Points, *, distance: float = 2.5, azimuth: float = 135.0,
           elevation: float = -20.0) -> mujoco.MjvCamera:
    """A camera `distance` m from a place [3] m, for a close view of one robot."""
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.lookat[:], camera.distance = position, distance
    camera.azimuth, camera.elevation = azimuth, elevation
    return camera


def post(scene: Scene, xy: Points, rgba: Color, *, height: float = 1.2, label: str = ""
         ) -> list[Marker]:
    """A signpost at xy [2] m: a thin pole with a ball on it, named by `label`."""
    foot = on_ground(scene, np.asarray(xy)[None], 0.0)[0]
    pole = Marker(mujoco.mjtGeom.mjGEOM_CYLINDER, (0.025, height / 2, 0.0),
                  foot + np.array([0, 0, height / 2]), rgba, glow=0.3)
    ball = Marker(mujoco.mjtGeom.mjGEOM_SPHERE, (0.11, 0.11, 0.11),
                  foot + np.array([0, 0, height]), rgba, label=label, glow=0.5)
    return [pole, ball]


def square(scene: Scene, xy: Points, side: float, rgba: Color, width: float = 0.04
           ) -> list[Marker]:
    """The outline of a square of `side` m about xy [2] m, draped over the ground."""
    half = side / 2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    corners = np.asarray(xy)[None] + half
    along = np.linspace(0, 1, max(2, math.ceil(side / 0.25)), endpoint=False)[:, None]
    edge = np.concatenate([a + along * (b - a) for a, b in
                           itertools.pairwise(corners)] + [corners[-1:]])
    return path(on_ground(scene, edge, 0.03), rgba, width)


def path(points: Points, rgba: Color, width: float = 0.02) -> list[Marker]:
    """A line of capsules through points [n, 3] m."""
    found = []
    for start, end in itertools.pairwise(points):
        along = end - start
        length = float(np.linalg.norm(along))
        if length < 1e-6:
            continue
        found.append(Marker(mujoco.mjtGeom.mjGEOM_CAPSULE, (width, length / 2, 0.0),
                            (start + end) / 2, rgba, turn_z_to(along / length), glow=0.4))
    return found


def on_ground(scene: Scene, xy: Points, above: float) -> Points:
    """Points [n, 3] m standing `above` m over the ground at xy [n, 2] m."""
    xy = np.asarray(xy, np.float64)
    height = np.asarray(scene.surface.height(jnp.asarray(xy, jnp.float32)), np.float64)
    return np.concatenate([xy, height[:, None] + above], axis=1)


def turn_z_to(axis: Points) -> Points:
    """A rotation matrix [3, 3] whose third column is the unit vector `axis` [3]."""
    helper = np.array([1.0, 0, 0]) if abs(axis[0]) < 0.9 else np.array([0, 1.0, 0])
    x = np.cross(helper, axis)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], axis=1)


def open_window(width: int, height: int) -> Any:
    """An off-screen OpenGL context, made current. EGL is asked for directly, so importing
    mujoco never fails where it is missing; MUJOCO_GL=osmesa or glfw is heeded.
    """
    choice = os.environ.get("MUJOCO_GL", "egl").lower()
    try:
        if choice in ("osmesa", "glfw"):
            window = mujoco.GLContext(width, height)
        else:
            from mujoco.egl import GLContext

            window = GLContext(width, height)
        window.make_current()
    except Exception as error:  # PyOpenGL raises anything from ImportError to AttributeError
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise RenderingUnavailable(reason) from None
    return window
