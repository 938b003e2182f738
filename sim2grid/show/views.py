"""The film's 3-D pictures: wide ones from a mast, close ones beside a robot or a target.

Targets are outlines on the ground with a post, red while open and green once solved; a robot
draws its track behind it, the way it means to go lies dashed before it, a white diamond where
something brought a new plan. Thrusters that burn show a plume, which nobody would see in a vacuum.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt
from PIL import Image

from moonteam.physics import look
from moonteam.physics.render import Marker, framing, turn_z_to
from moonteam.physics.stage import FAR, Caster, Line, Stage, View
from moonteam.problem.sun import SunPosition
from sim2grid.measure.slip import ground_height, strides
from sim2grid.show.cut import Shot
from sim2grid.show.film import CHIP, MARGIN, SIDE, Film, Moment, Seen
from sim2grid.show.hud import Box, Label, earth
from sim2grid.show.picture import (
    GREY,
    OPEN,
    REPLAN,
    SOLVED,
    Color,
    requirement,
    robot_color,
)
from sim2grid.show.ruts import ruts_of

Rgba = tuple[float, float, float, float]
Points = npt.NDArray[np.float64]

FOVY = 40.0  # degrees
WIDE_BELOW, CHASE_BELOW, CLOSE_BELOW = 20.0, 11.0, 15.0  # degrees below the horizon
STEEPEST = 80.0
NORTH = 90.0  # degrees a wide picture looks to, as the map does
SWINGS = (-14.0, 16.0, 2.0, -22.0, 24.0)  # degrees from it, of one wide picture after another
DRIFT = 5.0  # degrees a camera turns during a picture
CLEAR = 0.3  # m, kept between a line of sight and what stands under it
GLIDE_S = 0.6  # mission seconds over which a chase averages what it follows
BACKLIGHT = 62.0  # degrees the sun stands off the line of sight, best for relief
TRACK_M = 0.25  # between the points of a track
DASH_M = 0.35
ABOVE_M = 0.05  # of what lies on the ground
NEAR_M = 4.0  # from a target: what belongs to its solving
SHADOWS_M = 45.0  # from the camera: farther ones are not seen
PLUME = ((0.012, 0.10, (0.95, 0.97, 1.0, 0.55)), (0.032, 0.26, (0.50, 0.66, 1.0, 0.13)))
"""Half width m, half length m and colour of a plume's core and of what is around it."""
EARTH = (100.0, 6.0, 1.9)  # degrees: where it stands in the sky, how wide


@dataclass(frozen=True)
class _Stand:
    """Where a picture's camera stands, as far as it stays the same through the picture."""

    azimuth: float  # degrees to which it looks
    below: float  # degrees below the horizon
    aim: Points | None = None  # [3] m; None: it follows a robot
    distance: float = 0.0


class SceneViews:
    """See `film.Views`. Raises RenderingUnavailable where no OpenGL is to be had."""

    def __init__(self, film: Film):
        self.film, self.take = film, film.take
        assert self.take.model is not None
        self.sun = film.take.ground.sun
        self.stage = Stage(self.take.model, film.width, film.height, self.sun)
        ground = self.take.ground
        self.height = ground_height(ground.heights, ground.spacing)
        self.top = ground_height(self.take.tops, ground.spacing)
        self._tracks = [self._track(i) for i in range(len(self.take.actors))]
        self._targets = [self._target_markers(j) for j in range(len(film.record.targets))]
        self._stands: dict[int, _Stand] = {}
        self._thrusters = [_thrusters(self.take.model, robot.name)
                           for robot in film.mission.robots]
        soft = film.mission.site.ground == "regolith"
        treads = {robot.name: actor.tread for robot, actor in zip(
            film.mission.robots, self.take.actors, strict=True)}
        self._ruts = ruts_of(self.take.model, film.times, film.qpos, treads,
                             self.height) if soft else None
        rates = np.concatenate(film.record.propellant)
        self._burning = rates / np.maximum(rates.max(axis=0, initial=0.0), 1e-9)  # [T, R]

    def seen(self, shot: int, share: float, moment: Moment, qpos: npt.NDArray) -> Seen:
        """What a shot's camera sees, `share` of the shot being over."""
        view = self._view(shot, share, moment, qpos)
        markers, lines = self._ground_part(moment)
        markers += self._ruts.until(moment.time_s) if self._ruts else []
        markers += self._plumes(moment, qpos)
        casters = self._casters(view, qpos) if self.film.style.shadows else ()
        picture, depth = self.stage.frame(qpos, view, markers, lines, casters)
        picture = self._with_earth(picture, depth, view)
        return Seen(picture, self._labels(shot, moment, qpos, view, depth),
                    self._boxes(view, qpos))

    def shut(self) -> None:
        """Frees the window."""
        self.stage.close()

    # Cameras

    def _view(self, index: int, share: float, moment: Moment, qpos: npt.NDArray) -> View:
        shot = self.film.shots[index]
        stand = self._stands.get(index)
        if stand is None:
            stand = self._stands[index] = self._stand(index, shot)
        azimuth = stand.azimuth + DRIFT * (share - 0.5)
        if stand.aim is not None:
            return self._at(stand.aim, azimuth, stand.below, stand.distance)
        robot = shot.robot or 0
        aim = self._followed(robot, moment.time_s, GLIDE_S * max(1.0, self._speed(shot)))
        return self._at(aim, azimuth, stand.below, stand.distance)

    def _stand(self, index: int, shot: Shot) -> _Stand:
        if shot.kind in ("title", "end"):
            return self._mast(NORTH, self._everything())
        if shot.kind == "wide":
            before = sum(s.kind == "wide" for s in self.film.shots[:index])
            return self._mast(NORTH + SWINGS[before % len(SWINGS)], self._between(shot))
        if shot.target is not None:
            return self._beside_target(shot, shot.target)
        return self._beside_robot(shot, shot.robot or 0)

    def _mast(self, azimuth: float, points: Points) -> _Stand:
        """Sees points [n, 3] m in the part of the picture that no words or maps cover."""
        film, u = self.film, self.film.unit
        covered = film.style.layout == "inset"
        left, right = 0.0, (SIDE + 2 * MARGIN) * u * covered
        top, bottom = (40 if covered else 10) * u, (CHIP[1] + 2 * MARGIN) * u * covered
        wide, high = film.width - left - right, film.height - top - bottom
        fovy = math.degrees(2 * math.atan(math.tan(math.radians(FOVY / 2)) * high / film.height))
        camera = framing(points, fovy, azimuth, -WIDE_BELOW, wide / high, margin=1.6)
        metres = 2 * float(camera.distance) * math.tan(math.radians(FOVY / 2)) / film.height
        view = self._at(np.array(camera.lookat), azimuth, WIDE_BELOW, float(camera.distance))
        aside, above, _ = view.axes
        aim = camera.lookat + metres * (aside * (right - left) / 2 + above * (top - bottom) / 2)
        return _Stand(azimuth, self._clear(aim, azimuth, WIDE_BELOW, camera.distance), aim,
                      float(camera.distance))

    def _beside_target(self, shot: Shot, target: int) -> _Stand:
        """Sees a target and those that come to solve it."""
        film = self.film
        centre = film.take.frame.centre(np.array(film.record.targets[target].at, float))
        robots = next((s.robots for s in film.record.solves if s.target == target), ())
        times = np.linspace(max(shot.start_s, shot.end_s - 2.2), shot.end_s, 6)
        points = [np.array([*centre, float(self.height(centre)) + h]) for h in (0.0, 0.9)]
        for time_s in times:
            pose = film.pose(min(time_s, film.record.seconds()))
            for i in robots:
                at = pose[self.take.actors[i].base:][:3]
                if np.hypot(*(at[:2] - centre)) < NEAR_M:
                    points += [at, np.array([*at[:2], float(self.height(at[:2]))])]
        seen = np.array(points)
        best: tuple[float, _Stand] | None = None
        for azimuth in np.arange(0.0, 360.0, 20.0):
            aspect = film.width / film.height
            camera = framing(seen, FOVY, azimuth, -CLOSE_BELOW, 0.62 * aspect, margin=0.75)
            aim, distance = np.array(camera.lookat), max(float(camera.distance), 2.6)
            below = max(self._clear(aim, azimuth + turn, CLOSE_BELOW, distance)
                        for turn in (-DRIFT / 2, DRIFT / 2))
            cost = (below - CLOSE_BELOW) + 0.35 * _off_sun(azimuth, self.sun)
            if best is None or cost < best[0]:
                best = cost, _Stand(azimuth, below, aim, distance)
        assert best is not None
        return best[1]

    def _beside_robot(self, shot: Shot, robot: int) -> _Stand:
        """Goes along with a robot, before or behind it, on the better side of the sun."""
        film, actor = self.film, self.take.actors[robot]
        last = min(shot.end_s, film.record.seconds())
        times = np.linspace(shot.start_s, last, 7)
        glide = GLIDE_S * max(1.0, self._speed(shot))
        aims = [self._followed(robot, time_s, glide) for time_s in times]
        way = aims[-1][:2] - aims[0][:2]
        turn = film.pose(shot.start_s)[actor.base + 3:][:4]
        heading = math.degrees(math.atan2(way[1], way[0])) if np.hypot(*way) > 0.15 else (
            math.degrees(2 * math.atan2(turn[3], turn[0])))
        distance = (1.3 if actor.flies else 1.15) * actor.distance
        best: tuple[float, _Stand] | None = None
        for off in (-145.0, -120.0, -60.0, -40.0, 40.0, 60.0, 120.0, 145.0):
            below = max(self._clear(aim, heading + off + d, CHASE_BELOW, distance)
                        for aim in aims for d in (-DRIFT / 2, DRIFT / 2))
            cost = (below - CHASE_BELOW) + 0.35 * _off_sun(heading + off, self.sun)
            if best is None or cost < best[0]:
                best = cost, _Stand(heading + off, below, None, distance)
        assert best is not None
        return best[1]

    def _at(self, aim: Points, azimuth: float, below: float, distance: float) -> View:
        """A view on `aim`, its eye never under what stands there."""
        eye = aim - distance * _towards(azimuth, below)
        eye[2] = max(float(eye[2]), float(self.top(eye[:2])) + CLEAR)
        return View(eye, aim, FOVY)

    def _clear(self, aim: Points, azimuth: float, below: float, distance: float) -> float:
        """Degrees below the horizon from which nothing stands before the aim; not under `below`."""
        shares = np.linspace(0.12, 1.0, 14)
        back = -_towards(azimuth, 0.0)[:2]
        flat = aim[:2] + distance * shares[:, None] * back
        rise = np.asarray(self.top(flat)) + CLEAR - aim[2]
        steepest = np.degrees(np.arctan2(rise, distance * shares)).max()
        return float(np.clip(steepest, below, STEEPEST))

    def _followed(self, robot: int, time_s: float, glide: float) -> Points:
        """[3] m: where a robot is, averaged over `glide` s to each side."""
        film, base = self.film, self.take.actors[robot].base
        first, last = np.searchsorted(film.times, [time_s - glide, time_s + glide])
        rows = np.unique(np.linspace(first, min(int(last), len(film.times) - 1), 9).astype(int))
        aim = film.qpos[rows, base:base + 3].astype(float)
        aim = np.nan_to_num(aim[np.isfinite(aim).all(axis=1)])
        return np.array(aim.mean(axis=0), np.float64) if len(aim) else np.zeros(3)

    def _between(self, shot: Shot) -> Points:
        """Where robots are during a shot and where they mean to go, [n, 3] m."""
        film = self.film
        rows = np.linspace(film.story.index(shot.start_s), film.story.index(shot.end_s), 14)
        spots = [film.qpos[rows.astype(int), a.base:a.base + 3] for a in self.take.actors]
        found = np.concatenate(spots).astype(float)
        known = [j for j in range(film.story.targets_at(film.moment(shot.end_s).decision))
                 if shot.start_s - 1 < self._solved_s(j) <= shot.end_s + 6]
        posts = [m[True][-1].position for j, m in enumerate(self._targets) if j in known]
        found = np.concatenate([found, np.array(posts).reshape(-1, 3)])
        return np.asarray(found[np.isfinite(found).all(axis=1)], np.float64)

    def _everything(self) -> Points:
        posts = np.array([m[True][-1].position for m in self._targets]).reshape(-1, 3)
        rows = np.linspace(0, len(self.film.times) - 1, 24).astype(int)
        spots = [self.film.qpos[rows, a.base:a.base + 3] for a in self.take.actors]
        found = np.concatenate([posts, *spots]).astype(float)
        return found[np.isfinite(found).all(axis=1)]

    def _solved_s(self, target: int) -> float:
        return next((s.time_s for s in self.film.record.solves if s.target == target), math.inf)

    def _speed(self, shot: Shot) -> float:
        return shot.speed(self.film.style.fps)

    # What lies in the picture

    def _casters(self, view: View, qpos: npt.NDArray) -> list[Caster]:
        found = []
        for actor in self.take.actors:
            at = np.nan_to_num(qpos[actor.base:actor.base + 3])
            if np.linalg.norm(at - view.eye) < SHADOWS_M:
                above = max(0.0, float(at[2] - self.height(at[:2])))
                found.append(Caster(at, actor.radius, above, actor.body))
        return found

    def _ground_part(self, moment: Moment) -> tuple[list[Marker], list[Line]]:
        """Targets, new plans' places, tracks and ways."""
        markers: list[Marker] = []
        lines: list[Line] = []
        for j in range(moment.targets):
            markers += self._targets[j][j in moment.solved]
        unit = self.film.unit
        for replan in moment.replans:
            if replan.xy is not None:
                lines.append(Line(self._diamond(replan.xy), rgba(REPLAN), 3 * unit))
        for i, way in enumerate(self.take.planned):
            lines.append(Line(self._dashes(way, 0.6), rgba(robot_color(i), 0.45), 1.5 * unit))
        for i, way in enumerate(moment.ways):
            if len(way) > 1:
                lines.append(Line(self._dashes(way, DASH_M), rgba(robot_color(i)), 2.5 * unit))
            times, pieces = self._tracks[i]
            count = int(np.searchsorted(times, moment.time_s, side="right"))
            lines.append(Line(pieces[:max(count - 1, 0)], rgba(robot_color(i), 0.9), 3 * unit))
        return markers, lines

    def _plumes(self, moment: Moment, qpos: npt.NDArray) -> list[Marker]:
        found: list[Marker] = []
        for i, sites in enumerate(self._thrusters):
            share = float(self._burning[moment.index, i]) if sites else 0.0
            if share <= 0.01:
                continue
            self.stage.pose(qpos)
            share = math.sqrt(share)
            for name in sites:
                at, axes = self.stage.site(name)
                for wide, long, color in PLUME:
                    length = long * share
                    found.append(Marker(
                        mujoco.mjtGeom.mjGEOM_ELLIPSOID, (wide, wide, length),
                        at - axes[:, 2] * (0.09 + 0.9 * length), color, axes, glow=1.0))
        return found

    def _diamond(self, xy: npt.NDArray) -> Points:
        reach = 0.48 * self.take.frame.cell_m
        corners = reach * np.array([[0, -1], [1, 0], [0, 1], [-1, 0], [0, -1]])
        return _pairs(self._on_ground(xy[None] + corners))

    def _dashes(self, way: npt.NDArray, dash: float) -> Points:
        """A way [n, 2] m as dashes on the ground [k, 2, 3] m."""
        found = []
        for start, end in itertools.pairwise(way):
            length = float(np.hypot(*(end - start)))
            shares = np.arange(0.0, length, 2 * dash) / max(length, 1e-9)
            for share in shares:
                found.append([start + (end - start) * share,
                              start + (end - start) * min(share + dash / length, 1.0)])
        flat = np.array(found).reshape(-1, 2)
        return self._on_ground(flat, 1.5 * ABOVE_M).reshape(-1, 2, 3)

    def _on_ground(self, xy: npt.NDArray, above: float = ABOVE_M) -> Points:
        return np.concatenate([xy, np.asarray(self.height(xy))[:, None] + above], axis=1)

    def _target_markers(self, target: int) -> dict[bool, list[Marker]]:
        """The target's outline and post, open and solved; the post's ball stands last."""
        frame, spec = self.take.frame, self.film.record.targets[target]
        centre = frame.centre(np.array(spec.at, float))
        half = 0.46 * frame.cell_m * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
        edge = np.concatenate([a + np.linspace(0, 1, 4, endpoint=False)[:, None] * (b - a)
                               for a, b in itertools.pairwise(half)] + [half[-1:]])
        # In a corner, or the robots that stand in the cell would have it through them.
        foot = self._on_ground((centre + half[2])[None], 0.0)[0]
        return {state: [*_ribbon(self._on_ground(centre + edge, 0.02), rgba(color)),
                        *_post(foot, rgba(color))]
                for state, color in ((False, OPEN), (True, SOLVED))}

    def _track(self, robot: int) -> tuple[npt.NDArray, Points]:
        """Times [n] s of a robot's track points, and the [n - 1, 2, 3] pieces between them."""
        xy, actor = self.film.paths[robot], self.take.actors[robot]
        keep = strides(xy, TRACK_M)
        points = self._on_ground(np.nan_to_num(xy[keep]))
        if actor.flies:
            points[:, 2] = np.maximum(points[:, 2], np.nan_to_num(
                self.film.qpos[keep, actor.base + 2]))
        return self.film.times[keep], _pairs(points)

    # Names, and the Earth

    def _labels(self, index: int, moment: Moment, qpos: npt.NDArray, view: View,
                depth: npt.NDArray) -> list[Label]:
        """Robots' names, then targets' with what they need, the nearer first."""
        film, found = self.film, []
        close = film.shots[index].kind in ("close", "chase")
        for i, robot in enumerate(film.mission.robots):
            actor = self.take.actors[i]
            at = np.nan_to_num(qpos[actor.base:actor.base + 3]) + np.array(
                [0.0, 0.0, 0.3 + 0.3 * actor.radius])
            lost = moment.status[i].startswith("lost")
            found.append((at, Label(np.zeros(2), robot.name, GREY if lost else robot_color(i)), 0))
        for j in range(moment.targets):
            target = film.record.targets[j]
            done = j in moment.solved
            at = self._targets[j][done][-1].position
            found.append((at, Label(np.zeros(2), film.record.target_names[j],
                                    SOLVED if done else OPEN,
                                    "" if done else requirement(target)), 1))
        pixels, away = view.project(np.array([at for at, _, _ in found]),
                                    (film.width, film.height))
        shown = []
        for pixel, metres, (_, label, order) in zip(pixels, away, found, strict=True):
            if metres <= 0.3 or (close and metres > 14.0):
                continue
            x, y = (int(v) for v in np.floor(pixel))
            if 0 <= x < film.width and 0 <= y < film.height and (
                    depth[y, x] > metres - 1.0):  # nothing stands before it
                shown.append((order, metres, label._replace(at=pixel)))
        return [label for _, _, label in sorted(shown, key=lambda one: one[:2])]

    def _boxes(self, view: View, qpos: npt.NDArray) -> list[Box]:
        """What robots cover, so that no name is written over one."""
        size = (self.film.width, self.film.height)
        bodies = np.stack([np.nan_to_num(qpos[a.base:a.base + 3]) for a in self.take.actors])
        pixels, away = view.project(bodies, size)
        scale = size[1] / 2 / math.tan(math.radians(view.fovy) / 2)
        found = []
        for (x, y), metres, actor in zip(pixels, away, self.take.actors, strict=True):
            if metres > 0.3:
                reach = 0.6 * actor.radius * scale / metres
                found.append((x - reach, y - reach, x + reach, y + reach))
        return found

    def _with_earth(self, picture: npt.NDArray[np.uint8], depth: npt.NDArray, view: View
                    ) -> npt.NDArray[np.uint8]:
        """The Earth, where it stands in the picture's sky."""
        azimuth, elevation, wide = EARTH
        film = self.film
        towards = _towards(azimuth, -elevation)
        (pixel,), (ahead,) = view.project((view.eye + 100.0 * towards)[None],
                                          (film.width, film.height))
        scale = film.height / 2 / math.tan(math.radians(FOVY / 2))
        size = max(4, round(2 * scale * math.tan(math.radians(wide / 2))))
        x, y = (round(float(v) - size / 2) for v in pixel)
        if ahead <= 0 or not (0 <= x < film.width - size and 0 <= y < film.height - size):
            return picture
        sun = look.sunward(look.LOW_SUN, self.sun)
        right, up, forward = view.axes
        globe = earth(size, (round(float(sun @ right), 2), round(float(sun @ up), 2),
                             round(float(-sun @ forward), 2)))
        sky = depth[y:y + size, x:x + size] > 0.9 * FAR
        mask = np.asarray(globe.getchannel("A")) * sky
        image = Image.fromarray(picture)
        image.paste(globe.convert("RGB"), (x, y), Image.fromarray(mask.astype(np.uint8)))
        return np.asarray(image)


def rgba(color: Color, alpha: float = 1.0) -> Rgba:
    """A colour as MuJoCo takes it."""
    red, green, blue = (value / 255 for value in color)
    return red, green, blue, alpha


def _off_sun(azimuth: float, sun: SunPosition | None) -> float:
    """Degrees by which a picture that looks to `azimuth` misses the best light."""
    sunlight = math.degrees(look.bearing(sun)) + 180.0
    return abs(abs((azimuth - sunlight + 180.0) % 360.0 - 180.0) - BACKLIGHT)


def _towards(azimuth: float, below: float) -> Points:
    """Unit vector [3] to `azimuth` degrees, `below` degrees below the horizon."""
    a, b = math.radians(azimuth), math.radians(below)
    return np.array([math.cos(b) * math.cos(a), math.cos(b) * math.sin(a), -math.sin(b)])


def _pairs(points: Points) -> Points:
    """Points [n, 3] as pieces [n - 1, 2, 3]."""
    return np.stack([points[:-1], points[1:]], axis=1)


def _ribbon(points: Points, color: Rgba, half: float = 0.02) -> list[Marker]:
    """Flat bars through points [n, 3] m."""
    found = []
    for start, end in _pairs(points):
        along = end - start
        length = float(np.linalg.norm(along))
        axes = turn_z_to(along / length)
        found.append(Marker(mujoco.mjtGeom.mjGEOM_BOX, (half, half, length / 2 + half),
                            (start + end) / 2, color, axes, glow=0.7))
    return found


def _post(foot: Points, color: Rgba, height: float = 0.9) -> list[Marker]:
    """A thin pole with a ball on it."""
    up = np.array([0.0, 0.0, 1.0])
    return [Marker(mujoco.mjtGeom.mjGEOM_CYLINDER, (0.015, height / 2, 0.0),
                   foot + height / 2 * up, color, glow=0.5),
            Marker(mujoco.mjtGeom.mjGEOM_SPHERE, (0.065, 0.065, 0.065), foot + height * up,
                   color, glow=0.6)]


def _thrusters(model: mujoco.MjModel, robot: str) -> list[str]:
    """Names of the sites at which a robot's actuators push."""
    found = []
    for actuator in range(model.nu):
        if (model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_SITE
                and model.actuator(actuator).name.startswith(robot + "/")):
            found.append(model.site(int(model.actuator_trnid[actuator, 0])).name)
    return found
