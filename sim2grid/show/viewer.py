"""A live 3-D window on an execution, where there is a display.

The window shows what the engine logged, in real time where the engine keeps up: it is fed at each
look and never steps anything itself, so that watching changes nothing.
"""

from __future__ import annotations

import re
import time
import warnings
from typing import Any

import mujoco
import numpy as np

from moonteam.errors import InputError
from moonteam.physics import look
from moonteam.physics.render import Marker, on_ground, path, post, square
from moonteam.physics.scene import set_heights
from moonteam.robots.base import CONTROL_PERIOD
from sim2grid.clock.execution import TimedExecution
from sim2grid.loop.execution import Execution
from sim2grid.loop.prepare import Prepared
from sim2grid.show.picture import OPEN, SOLVED, robot_color
from sim2grid.show.views import rgba

TRAIL_M = 0.25  # between the points of a trail


def check_display() -> None:
    """Raises InputError, one line, where no window can be opened."""
    try:
        import glfw
    except ImportError:
        raise InputError("--viewer", "needs the package glfw: pip install 'moonteam[viewer]'"
                         ) from None
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        there = bool(glfw.init())
    if not there:
        words = str(said[0].message) if said else "GLFW cannot start"
        why = re.sub(r"^\(\d+\) b'(.*)'$", r"\1", " ".join(words.split()))
        raise InputError("--viewer", f"no display here ({why}); leave --viewer out: the video "
                         "shows the same")


class LiveView:
    """The window. Use as a context manager; `show` at each look of the execution."""

    def __init__(self, prepared: Prepared, log_every: int):
        self._prepared, self._period = prepared, CONTROL_PERIOD * log_every
        self._model = _dressed(prepared)
        self._data = mujoco.MjData(self._model)
        self._data.qpos[:] = prepared.scene.qpos0
        mujoco.mj_forward(self._model, self._data)
        self._chunks = 0
        self._due = time.perf_counter()
        self._trails: list[list[np.ndarray]] = [[] for _ in prepared.bodies]
        self._window: Any = None

    def __enter__(self) -> LiveView:
        from mujoco import viewer

        self._window = viewer.launch_passive(
            self._model, self._data, show_left_ui=False, show_right_ui=False)
        camera, extent = self._window.cam, max(self._prepared.frame.size)
        camera.lookat[:] = 0.0, 0.0, 0.0
        camera.distance = 1.3 * extent * self._prepared.frame.cell_m
        camera.azimuth, camera.elevation = 90.0, -40.0
        return self

    def __exit__(self, *error: object) -> None:
        self._window.close()

    def show(self, execution: Execution | TimedExecution) -> None:
        """Plays what was logged since the last call; nothing once the window is closed."""
        fresh = execution.record.qpos[self._chunks:]
        self._chunks += len(fresh)
        self._marks(execution)
        for qpos in (pose for chunk in fresh for pose in chunk):
            if not self._window.is_running():
                return
            with self._window.lock():
                self._data.qpos[:] = np.nan_to_num(qpos)
                mujoco.mj_forward(self._model, self._data)
            self._window.sync()
            self._due = max(self._due + self._period, time.perf_counter() - self._period)
            time.sleep(max(0.0, self._due - time.perf_counter()))

    def _marks(self, execution: Execution | TimedExecution) -> None:
        """Targets by state, where each robot is bound, and the trails."""
        if not self._window.is_running():
            return
        drawn = self._window.user_scn
        with self._window.lock():
            drawn.ngeom = 0
            for marker in self._markers(execution)[:drawn.maxgeom]:
                _put(drawn.geoms[drawn.ngeom], marker)
                drawn.ngeom += 1

    def _markers(self, execution: Execution | TimedExecution) -> list[Marker]:
        scene, frame, record = self._prepared.scene, self._prepared.frame, execution.record
        solved = {solve.target for solve in record.solves}
        found: list[Marker] = []
        for j, target in enumerate(record.targets):
            centre = frame.centre(np.array(target.at, float))
            color = rgba(SOLVED if j in solved else OPEN)
            found += square(scene, centre, 0.92 * frame.cell_m, color, 0.035 * frame.cell_m)
            found += post(scene, centre, color, height=0.9, label=record.target_names[j])
        for i, (base, leg) in enumerate(zip(self._prepared.bases, execution.book.legs,
                                              strict=True)):
            color = rgba(robot_color(i))
            at = record.qpos[-1][-1][base:base + 3].astype(float)
            trail = self._trails[i]
            if np.isfinite(at).all() and (
                    not trail or np.hypot(*(at - trail[-1])[:2]) >= TRAIL_M):
                flies = self._prepared.bodies[i].flies
                trail.append(at if flies else on_ground(scene, at[None, :2], 0.04)[0])
            found += path(np.array(trail), color, 0.03) if len(trail) > 1 else []
            if leg is not None and leg.moving and leg.ended is None:
                found += square(scene, leg.waypoint, 0.3 * frame.cell_m, color, 0.02)
        return found


def _dressed(prepared: Prepared) -> mujoco.MjModel:
    """The scene's model with light, sky and rocks."""
    scene = prepared.scene
    spec = scene.spec.copy()
    look.decorate(spec, scene.site)
    model = spec.compile()
    set_heights(model, scene.site.heights)
    look.mesh_offsets(model, scene.site)
    return model


def _put(geom: Any, marker: Marker) -> None:
    mujoco.mjv_initGeom(geom, marker.type, np.array(marker.size, np.float64),
                        np.asarray(marker.position, np.float64),
                        np.asarray(marker.matrix, np.float64).ravel(),
                        np.array(marker.rgba, np.float32))
    geom.category = mujoco.mjtCatBit.mjCAT_DECOR
    geom.emission, geom.label = marker.glow, marker.label
