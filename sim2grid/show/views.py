"""The film's 3-D pictures: one camera on the whole scene, one on each robot.

Targets are outlines on the ground with a post, red while open and green once solved; each
robot draws its trail, a small square lies where it is bound, and a white diamond where
something brought a new plan. A dark disc under each robot says where on the ground it is: real
shadows are dear without a GPU.
"""

from __future__ import annotations

import math

import jax.numpy as jnp
import mujoco
import numpy as np
import numpy.typing as npt

from moonteam.physics.render import (
    Marker,
    Renderer,
    follow,
    framing,
    on_ground,
    path,
    post,
    square,
    turn_z_to,
)
from sim2grid.loop.prepare import Prepared
from sim2grid.show.film import CLOSE, FREE, HEIGHT, WIDTH, Film, Moment
from sim2grid.show.picture import OPEN, REPLAN, SOLVED, Color, robot_color

Rgba = tuple[float, float, float, float]

ELEVATION = -38.0  # degrees
SWING = 14.0  # degrees the camera swings to each side while the film lasts
DISC = 0.8  # of the disc under a robot, in its footprint's radius
WHOLE_MAP_M = 14.0  # maps up to this size are always seen whole
TRAIL_M = 0.25  # between the points of a trail
AHEAD_S, BEHIND_S = 8.0, 4.0  # mission seconds over which the camera averages what it follows


class SceneViews:
    """See `film.Views`. Raises RenderingUnavailable where no OpenGL is to be had."""

    def __init__(self, prepared: Prepared, film: Film):
        self.prepared, self.film = prepared, film
        self.scene = prepared.scene
        self._wide = Renderer(self.scene, WIDTH, HEIGHT, samples=4)
        # Drawn at twice the size and reduced: cheaper without a GPU than multisampling.
        self._near = Renderer(self.scene, 2 * CLOSE[0], 2 * CLOSE[1], samples=0)
        self._trails = [self._trail(i) for i in range(len(prepared.bodies))]
        self._targets = [self._target_markers(j) for j in range(len(film.record.targets))]
        self._posts = np.array([m[True][-1].position for m in self._targets])
        self._goals: dict[tuple[int, float, float], list[Marker]] = {}
        self._replans = [[] if r.xy is None else self._replan(r.xy)
                         for r in film.story.replans]

    def main(self, moment: Moment, qpos: npt.NDArray) -> npt.NDArray[np.uint8]:
        """[HEIGHT, WIDTH, 3]: the whole scene."""
        return self._wide.frame(qpos, self._camera(moment), self._markers(moment, qpos))

    def close(self, moment: Moment, qpos: npt.NDArray, robot: int) -> npt.NDArray[np.uint8]:
        """[CLOSE[1], CLOSE[0], 3]: one robot from near by."""
        base = self.prepared.bodies[robot].base
        camera = follow(qpos[base:base + 3], distance=1.9, elevation=-20.0,
                        azimuth=130.0 + 3.0 * moment.time_s / self.film.speed)
        large = self._near.frame(qpos, camera, self._ground_part(moment, qpos))
        return large.reshape(CLOSE[1], 2, CLOSE[0], 2, 3).mean(axis=(1, 3)).astype(np.uint8)

    def shut(self) -> None:
        """Frees the windows."""
        self._wide.close()
        self._near.close()

    def _camera(self, moment: Moment) -> mujoco.MjvCamera:
        """Sees what matters, in the part of the picture that no words or maps cover."""
        share = moment.time_s / max(self.film.record.seconds(), 1e-6)
        azimuth = 90.0 + SWING * math.sin(math.pi * (2.0 * share - 0.5))
        fovy = float(self.scene.model.vis.global_.fovy)
        left, top, right, bottom = FREE
        tangent = math.tan(math.radians(fovy) / 2)
        narrow = 2 * math.degrees(math.atan(tangent * (bottom - top) / HEIGHT))
        camera = framing(self._seen(moment), narrow, azimuth, ELEVATION,
                         (right - left) / (bottom - top), margin=0.7)
        metres = 2 * camera.distance * tangent / HEIGHT  # a pixel, where the camera looks
        az, el = math.radians(azimuth), math.radians(ELEVATION)
        forward = np.array([math.cos(el) * math.cos(az), math.cos(el) * math.sin(az),
                            math.sin(el)])
        aside = np.array([math.sin(az), -math.cos(az), 0.0])
        above = np.cross(aside, forward)
        camera.lookat[:] += metres * (aside * (WIDTH - left - right) / 2
                                      - above * (HEIGHT - top - bottom) / 2)
        return camera

    def _seen(self, moment: Moment) -> npt.NDArray:
        """Points [n, 3] m the camera keeps in the picture.

        On a small map everything, always; on a large one the robots, a little ahead and
        behind in time so that the camera glides.
        """
        times, film = self.film.times, self.film
        size = max(film.frame.size) * film.frame.cell_m
        first, last = ((0, len(times) - 1) if size <= WHOLE_MAP_M else np.searchsorted(
            times, [moment.time_s - BEHIND_S, moment.time_s + AHEAD_S]))
        rows = np.linspace(first, min(int(last), len(times) - 1), 12).astype(int)
        robots = np.concatenate([film.qpos[rows, b:b + 3] for b in self.prepared.bases])
        points = robots.astype(float)
        if size <= WHOLE_MAP_M:
            points = np.concatenate([points, self._posts])
        return points[np.isfinite(points).all(axis=1)]

    def _markers(self, moment: Moment, qpos: npt.NDArray) -> list[Marker]:
        """Targets, new plans, goals and trails of a moment."""
        found = self._ground_part(moment, qpos)
        for i, goal in enumerate(moment.goals):
            if moment.status[i] == "moving":
                found += self._goal(i, goal)
            times, trail = self._trails[i]
            count = int(np.searchsorted(times, moment.time_s, side="right"))
            found += trail[:max(count - 1, 0)]
        return found

    def _ground_part(self, moment: Moment, qpos: npt.NDArray) -> list[Marker]:
        """What lies or stands on the ground: discs under robots, targets, new plans' places."""
        found = self._discs(qpos)
        for j in range(moment.targets):
            found += self._targets[j][j in moment.solved]
        for markers in self._replans[:len(moment.replans)]:
            found += markers
        return found

    def _discs(self, qpos: npt.NDArray) -> list[Marker]:
        """A flat dark disc on the ground under each robot."""
        xy = np.stack([np.nan_to_num(qpos[b:b + 2]) for b in self.prepared.bases])
        feet = on_ground(self.scene, xy, 0.015)
        normals = np.asarray(self.scene.surface.plane(jnp.asarray(xy, jnp.float32), 0.3)[1])
        return [Marker(mujoco.mjtGeom.mjGEOM_CYLINDER,
                       (DISC * robot.kind.footprint, 0.002, 0.0), foot,
                       (0.0, 0.0, 0.0, 0.5), turn_z_to(normal))
                for robot, foot, normal in zip(self.scene.robots, feet, normals, strict=True)]

    def _replan(self, xy: npt.NDArray) -> list[Marker]:
        """A diamond on the ground, wide enough to show around the robot that stands in it."""
        reach = 0.48 * self.film.frame.cell_m
        corners = reach * np.array([[0, -1], [1, 0], [0, 1], [-1, 0], [0, -1]])
        return path(on_ground(self.scene, xy[None] + corners, 0.05), rgba(REPLAN), 0.035)

    def _target_markers(self, target: int) -> dict[bool, list[Marker]]:
        """The target's markers, open and solved."""
        frame, spec = self.film.frame, self.film.record.targets[target]
        centre = frame.centre(np.array(spec.at, float))
        return {state: [
            *square(self.scene, centre, 0.92 * frame.cell_m, rgba(color), 0.035 * frame.cell_m),
            *post(self.scene, centre, rgba(color), height=0.9)]
            for state, color in ((False, OPEN), (True, SOLVED))}

    def _goal(self, robot: int, goal: npt.NDArray) -> list[Marker]:
        key = (robot, round(float(goal[0]), 3), round(float(goal[1]), 3))
        if key not in self._goals:
            self._goals[key] = square(self.scene, goal, 0.3 * self.film.frame.cell_m,
                                      rgba(robot_color(robot)), 0.02)
        return self._goals[key]

    def _trail(self, robot: int) -> tuple[npt.NDArray, list[Marker]]:
        """Times [n] s of a robot's trail points, and the [n - 1] pieces between them."""
        xy = self.film.paths[robot]
        keep = [0]
        for k in range(1, len(xy)):
            if np.hypot(*(xy[k] - xy[keep[-1]])) >= TRAIL_M:
                keep.append(k)
        points = on_ground(self.scene, xy[keep], 0.04)
        if self.prepared.bodies[robot].flies:
            base = self.prepared.bodies[robot].base
            points[:, 2] = self.film.qpos[keep, base + 2]
        return self.film.times[keep], path(points, rgba(robot_color(robot), 0.8), 0.03)


def rgba(color: Color, alpha: float = 1.0) -> Rgba:
    """A colour as MuJoCo takes it."""
    red, green, blue = (value / 255 for value in color)
    return red, green, blue, alpha
