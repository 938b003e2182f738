"""Films of single robots: which traverses are worth a look, and the camera that shows them.

Of many random routes three are filmed: the one that crosses the highest rim, the one that
passes the most boulders, the one with the steepest stretch. A film shows the seconds around
that event as fast as they passed.

Letters: B routes of a site, S stations along a route, T poses.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
import numpy.typing as npt

from moonteam.files import replacing
from moonteam.physics import render
from moonteam.physics.look import SUN_AZIMUTH
from moonteam.physics.scene import Scene
from moonteam.physics.trials.traverse import SAMPLE_SECONDS, Recording, Route
from moonteam.report import video
from moonteam.terrain.site import Site

EVENTS = ("rim", "boulders", "slope")
STATION = 0.25  # m between the points that a route is judged on
STRETCH = 2.0  # m over which a slope is taken
RIM = 2.5  # m: a rim is as high as its crest stands over the ground this far before and behind
EVERY = 2  # poses a frame: 12.5 frames a second
SHADOW_REACH = 7.0  # m around the robot
RIM_DISTANCE = 1.4  # times as far, so that the rim is seen as one
LOWEST, HIGHEST = 12.0, 75.0  # degrees, camera above the horizon
VIEWS = (-125.0, -55.0, 55.0, 125.0)  # degrees, from the heading to where the camera looks
RIM_VIEWS = (-95.0, 95.0)  # from the side, where its profile shows
CLEAR = 0.25  # m, kept between the line of sight and the ground or a boulder
FRAME_SECONDS = EVERY * SAMPLE_SECONDS
FRAMES = 5  # of each film on a contact sheet

Floats = npt.NDArray[np.floating]


class Shot(NamedTuple):
    """A traverse worth a film. `size`: m of rim, boulders (nearness-weighted m), degrees."""

    event: str
    place: int  # which site
    route: int  # which of its routes
    along: float  # m from the start
    size: float


def choose(places: Sequence[tuple[Site, Sequence[Route]]]) -> list[Shot]:
    """The largest event of each name, every route at most once."""
    found = [Shot(name, p, r, along, size)
             for p, (site, routes) in enumerate(places) for r, route in enumerate(routes)
             for name, (along, size) in _events(site, route).items()]
    shots: list[Shot] = []
    for name in EVENTS:
        taken = {(shot.place, shot.route) for shot in shots}
        left = [s for s in found if s.event == name and (s.place, s.route) not in taken]
        if left:
            shots.append(max(left, key=lambda shot: shot.size))
    return shots


def _events(site: Site, route: Route) -> dict[str, tuple[float, float]]:
    """Event -> metres along the route, and how large it is."""
    start, way = np.array(route.start), np.array(route.goal) - route.start
    length = float(np.linalg.norm(way))
    stations = np.linspace(0.0, length, max(9, round(length / STATION) + 1))  # [S] m
    line = start + stations[:, None] / length * way
    heights = np.asarray(site.surface.height(jnp.asarray(line, jnp.float32)), np.float64)
    step = stations[1] - stations[0]
    apart = max(1, min(round(RIM / step), len(stations) // 2 - 1))
    rim = np.zeros(len(stations))
    rim[apart:-apart] = heights[apart:-apart] - np.maximum(heights[:-2 * apart],
                                                           heights[2 * apart:])
    reach = max(1, min(round(STRETCH / step), len(stations) - 1))
    grade = np.abs(heights[reach:] - heights[:-reach]) / (reach * step)
    near = np.zeros(len(stations))
    for rock in site.boulders:
        away = np.linalg.norm(line - rock.centre[:2], axis=1)
        at = int(away.argmin())
        high = rock.centre[2] + rock.radius - heights[at]
        near[at] += high / (1.0 + max(0.0, away[at] - rock.radius) ** 2)
    return {
        "rim": (float(stations[rim.argmax()]), float(rim.max())),
        "boulders": (float(stations[near.argmax()]), float(near.sum())),
        "slope": (float(stations[grade.argmax()] + reach * step / 2),
                  math.degrees(math.atan(grade.max())))}


def film(recording: Recording, path: Path, *, event: str = "", along: float | None = None,
         width: int = 480, height: int = 360) -> list[npt.NDArray[np.uint8]]:
    """Writes an MP4 of the seconds around the robot's passing `along` m, else from the start.

    A yellow line marks the way, a white tick every metre of it, a green post of 1.2 m the goal.
    Returns FRAMES of its pictures. Raises RenderingUnavailable without off-screen OpenGL.
    """
    scene, route, poses = recording
    first, last = _clip(recording, along)
    shown = poses[first:last:EVERY]
    distance, views = scene.robots[0].kind.camera.distance, VIEWS
    if event == "rim":
        distance, views = RIM_DISTANCE * distance, RIM_VIEWS
    markers, cameras = _markers(scene, route), _cameras(scene, shown, distance, views)
    speeds, rises = _speeds(poses)[first:last:EVERY], shown[:, 2] - poses[0, 2]
    kept = set(np.linspace(0, len(shown) - 1, FRAMES).round().astype(int).tolist())
    stills = []
    drawing = render.Renderer(scene, width, height, shadows=True, shadow_reach=SHADOW_REACH)
    with (drawing as renderer,
          video.writing(path, (height, width), 1.0 / FRAME_SECONDS, crf=26) as add):
        for index, (pose, camera) in enumerate(zip(shown, cameras, strict=True)):
            seconds = first * SAMPLE_SECONDS + index * FRAME_SECONDS
            words = _words(scene, event, seconds, pose, speeds[index], rises[index])
            picture = renderer.frame(pose, camera, markers, words)
            add(picture)
            if index in kept:
                stills.append(picture.copy())
    return stills


def contact_sheet(rows: Sequence[Sequence[npt.NDArray[np.uint8]]], path: Path,
                  width: int = 1280) -> None:
    """Writes a picture with a row for each film and its frames side by side."""
    from PIL import Image

    count = max(len(row) for row in rows)
    wide, (height, full, _) = width // count, rows[0][0].shape
    high = round(wide * height / full)
    sheet = Image.new("RGB", (wide * count, high * len(rows)))
    for y, row in enumerate(rows):
        for x, frame in enumerate(row):
            small = Image.fromarray(frame).resize((wide, high), Image.Resampling.LANCZOS)
            sheet.paste(small, (x * wide, y * high))
    small = sheet.quantize(256, kmeans=2, dither=Image.Dither.NONE)  # a third of the bytes
    with replacing(path) as temporary:
        small.save(temporary, "PNG", optimize=True)


def _clip(recording: Recording, along: float | None) -> tuple[int, int]:
    """First and past-the-last pose of a film."""
    scene, route, poses = recording
    count = round(scene.robots[0].kind.camera.seconds / SAMPLE_SECONDS)
    if along is None or len(poses) <= count:
        return 0, min(count, len(poses))
    way = np.array(route.goal) - route.start
    progress = (poses[:, :2] - route.start) @ way / np.linalg.norm(way)
    at = int(np.flatnonzero(progress >= min(along, float(progress.max())))[0])
    first = min(max(0, at - count // 2), len(poses) - count)
    return first, first + count


def _markers(scene: Scene, route: Route) -> list[render.Marker]:
    start, way = np.array(route.start), np.array(route.goal) - route.start
    length = float(np.linalg.norm(way))
    ahead = way / length
    aside = np.array([-ahead[1], ahead[0]])
    line = start + np.linspace(0.0, length, round(length / 0.2) + 1)[:, None] * ahead
    found = render.path(render.on_ground(scene, line, 0.015), (0.9, 0.7, 0.1, 1.0), 0.012)
    for metre in range(math.floor(length) + 1):
        ends = start + metre * ahead + np.array([[-0.12], [0.0], [0.12]]) * aside
        found += render.path(render.on_ground(scene, ends, 0.02), (0.95, 0.95, 0.95, 1.0), 0.014)
    # Beyond the goal, or the robot would stop with the pole through it.
    return found + render.post(scene, start + (length + 0.7) * ahead, (0.1, 0.8, 0.3, 1.0))


def _cameras(scene: Scene, poses: Floats, distance: float, views: Sequence[float] = VIEWS
             ) -> list[mujoco.MjvCamera]:
    """A camera for each pose [T, nq]: from the side, sun behind it, nothing in the way."""
    aim = _smooth(poses[:, :3].astype(np.float64), 0.6, FRAME_SECONDS)
    if scene.robots[0].kind.flies:
        aim[:, 2] -= 0.5  # its shadow shows how high it is
    way = aim[-1, :2] - aim[0, :2]
    heading = math.degrees(math.atan2(way[1], way[0]))
    sunlight = math.degrees(SUN_AZIMUTH) + 180.0
    best: tuple[float, Floats, float] | None = None
    for view in views:
        azimuth = heading + view
        needed = _elevation(scene, aim, azimuth, distance)
        # The sun 50 degrees off the line of sight shows relief best.
        off = abs(abs((azimuth - sunlight + 180.0) % 360.0 - 180.0) - 50.0)
        cost = float(needed.mean()) + 0.3 * off
        if best is None or cost < best[0]:
            best = cost, needed, azimuth
    assert best is not None
    return [render.follow(at, distance=distance, azimuth=best[2], elevation=-above)
            for at, above in zip(aim, best[1], strict=True)]


def _elevation(scene: Scene, aim: Floats, azimuth: float, distance: float) -> Floats:
    """Degrees [T] above the horizon from which a camera sees aim [T, 3] m, changing slowly."""
    shares = np.linspace(0.15, 1.0, 9)
    back = -np.array([math.cos(math.radians(azimuth)), math.sin(math.radians(azimuth))])
    flat = aim[:, None, :2] + (distance * shares)[None, :, None] * back[None, None, :]
    tops = np.asarray(scene.surface.top(jnp.asarray(flat, jnp.float32)), np.float64)
    rise = tops + CLEAR - aim[:, 2:]  # [T, 9] m over the aim
    steepest = np.degrees(np.arctan2(rise, distance * shares[None, :])).max(axis=1)
    needed = np.clip(steepest, LOWEST, HIGHEST)
    half = round(1.0 / FRAME_SECONDS)
    padded = np.pad(needed, half, mode="edge")
    highest = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1).max(axis=1)
    return _smooth(highest[:, None], 1.0, FRAME_SECONDS)[:, 0]


def _smooth(values: Floats, seconds: float, step: float) -> Floats:
    """Values [T, n], `step` s apart, averaged over that long."""
    half = max(1, round(seconds / 2 / step))
    padded = np.pad(values, ((half, half), (0, 0)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1, axis=0)
    return windows.mean(axis=-1)


def _speeds(poses: Floats) -> Floats:
    """m/s [T] over half a second."""
    steps = np.linalg.norm(np.diff(poses[:, :3].astype(np.float64), axis=0), axis=1)
    moving = np.concatenate([steps[:1], steps]) if len(steps) else np.zeros(1)
    return _smooth(moving[:, None], 0.5, SAMPLE_SECONDS)[:, 0] / SAMPLE_SECONDS


def _words(scene: Scene, event: str, seconds: float, pose: Floats, speed: float, rise: float
           ) -> str:
    """What the film says of a moment; `rise` m over the start."""
    kind, site = scene.robots[0].kind, scene.site
    at = jnp.asarray(pose[:2], jnp.float32)
    _, normal = scene.surface.plane(at, kind.footprint)
    slope = math.degrees(math.acos(min(1.0, float(normal[2]))))
    x, y = float(pose[4]), float(pose[5])
    tilt = math.degrees(math.acos(max(-1.0, min(1.0, 1.0 - 2.0 * (x * x + y * y)))))
    lines = [f"{kind.name}, {event}: {site.name} {site.seed}",
             f"{seconds:4.1f} s  {speed:.2f} m/s  {rise:+.2f} m",
             f"ground {slope:2.0f} deg  tilt {tilt:2.0f} deg"]
    if kind.flies:
        feet = float(pose[2]) - kind.spawn_height - float(scene.surface.height(at))
        lines.append(f"feet {max(0.0, feet):.1f} m above the ground")
    return "\n".join(lines)
