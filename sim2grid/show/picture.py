"""The map seen from above: ground, grid, targets by state, robots and their paths.

Drawn with Pillow alone, so it needs neither a GPU nor a display. Pixels: x right, y down;
the map's north is up.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib
import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from moonteam.problem.mission import Target
from moonteam.problem.skills import needed
from moonteam.problem.sun import SunPosition
from sim2grid.frame import Frame

if TYPE_CHECKING:
    from moonteam.robots.base import Glyph
    from moonteam.terrain.site import Site

Color = tuple[int, int, int]

INK: Color = (235, 238, 245)
NIGHT: Color = (14, 17, 26)
UNSEEN = 150
"""How dark what nobody has seen yet is on the map, of 255."""
OPEN: Color = (255, 86, 60)
SOLVED: Color = (70, 215, 110)
BARRED: Color = (150, 60, 60)
REPLAN: Color = (255, 250, 235)
GREY: Color = (130, 130, 130)
STATES: dict[str, Color] = {
    "moving": INK, "waiting": (170, 178, 195), "late": (255, 180, 60), "lost": OPEN}
ROBOTS: tuple[Color, ...] = (
    (64, 196, 255), (255, 214, 64), (236, 120, 255), (120, 255, 214),
    (255, 160, 90), (150, 160, 255), (190, 255, 100), (255, 130, 170))

DARK = 0.4
"""Brightness of ground in shadow, that of the same ground in light being 1; ground over which a
robot's panel alone has light is halfway.
"""

SMOOTH = 2
"""Drawn this many times larger, then reduced: smooth edges."""


@functools.cache
def font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """DejaVu Sans, which matplotlib brings along, `size` pixels high."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name, size)


def robot_color(index: int) -> Color:
    """A robot's colour, the same in every picture."""
    return ROBOTS[index % len(ROBOTS)]


def requirement(target: Target) -> str:
    """What a target asks for, see `needed`."""
    return needed(target.words(), target.either)


@dataclass(frozen=True)
class Ground:
    """Elevations [ny, nx] m about the origin, row 0 in the south, `spacing` m apart."""

    heights: npt.NDArray
    spacing: float
    sun: SunPosition | None = None
    light: npt.NDArray | None = None  # [ny, nx] 1 lit by it, 0.5 for a robot's panel alone, else 0

    @classmethod
    def of(cls, site: Site) -> Ground:
        """That of a site, and the light on it where it has a sun."""
        if site.sun is None:
            return cls(site.heights, site.spacing)
        from moonteam.terrain.light import PANEL, lit

        light = (lit(site, site.sun) + 1.0 * lit(site, site.sun, PANEL)) / 2
        return cls(site.heights, site.spacing, site.sun, light)


def hillshade(ground: Ground) -> npt.NDArray[np.uint8]:
    """Brightness [ny, nx] of ground lit from the north-west, or from where its sun stands, with
    what is in shadow darkened; row 0 in the south.
    """
    heights, sun = ground.heights, ground.sun
    north, east = np.gradient(heights.astype(float), ground.spacing)
    flat = (-1.0, 1.0) if sun is None else (2**0.5 * math.sin(sun.azimuth),
                                            2**0.5 * math.cos(sun.azimuth))
    light = np.array([*flat, 1.2]) / np.linalg.norm([*flat, 1.2])
    up = 1.0 / np.sqrt(1.0 + east**2 + north**2)
    shade = (-east * light[0] - north * light[1] + light[2]) * up
    relief = (heights - heights.min()) / max(float(np.ptp(heights)), 1e-6)
    contrast = (shade - light[2]) / max(float(shade.std()), 0.05)  # level ground: none
    bright = np.clip(100 + 22 * contrast + 30 * (relief - 0.5), 15, 200)
    if ground.light is not None:
        bright = bright * (DARK + (1.0 - DARK) * ground.light)
    return bright.astype(np.uint8)


@dataclass(frozen=True)
class RobotMark:
    """A robot on the map: its path so far [T, 2] m ends where it is."""

    name: str
    glyph: Glyph
    path: npt.NDArray
    lost: bool = False
    sensor_m: float | None = None
    """m about its path that it has seen, where something is hidden."""


@dataclass(frozen=True)
class TargetMark:
    """A target on the map."""

    name: str
    target: Target
    solved: bool


class MapPicture:
    """Draws a mission's map at about `side` pixels; the ground is drawn once and kept."""

    def __init__(self, frame: Frame, ground: Ground, side: int,
                 barred: npt.NDArray[np.bool_] | None = None):
        self.frame = frame
        self.pixel = max(1.0, side / max(frame.size)) * SMOOTH  # a cell's width
        self.width = round(frame.size[0] * self.pixel)
        self.height = round(frame.size[1] * self.pixel)
        self._base = self._draw_base(ground, barred)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the finished picture, pixels."""
        return self.width // SMOOTH, self.height // SMOOTH

    def draw(self, robots: Sequence[RobotMark], targets: Sequence[TargetMark],
             replans: Sequence[npt.NDArray] = (), labels: bool = True,
             wished: Sequence[npt.NDArray] = ()) -> Image.Image:
        """The map with targets, paths, robots, and a mark at each place [2] m that brought a
        new plan; `labels` writes names beside them. `wished`: where each robot means to go,
        [n, 2] m, dashed.
        """
        image = self._base.copy()
        if any(robot.sensor_m for robot in robots):
            self._shade_unseen(image, robots)
        pen = ImageDraw.Draw(image)
        for mark in targets:
            self._target(pen, mark, labels)
        for i, robot in enumerate(robots):
            if len(robot.path) > 1:
                points = [tuple(p) for p in self._pixels(robot.path)]
                pen.line(points, fill=robot_color(i), width=max(2, round(self.pixel * 0.07)),
                         joint="curve")
        for i, way in enumerate(wished):
            if len(way) > 1 and not robots[i].lost:
                self._wish(pen, self._pixels(way), robot_color(i))
        for place in replans:
            x, y = self._pixels(place)
            draw_replan(pen, (float(x), float(y)), max(self.pixel * 0.2, 4.5 * SMOOTH))
        for i, robot in enumerate(robots):
            self._robot(pen, i, robot, labels)
        return image.resize(self.size, Image.Resampling.BOX)

    def _pixels(self, xy: npt.NDArray) -> npt.NDArray:
        """Pixels [..., 2] of points [..., 2] m."""
        at = self.frame.continuous(np.nan_to_num(xy)) * self.pixel
        return np.stack([at[..., 0], self.height - at[..., 1]], axis=-1)

    def _shade_unseen(self, image: Image.Image, robots: Sequence[RobotMark]) -> None:
        """Darkens what no robot with a sensor has come near."""
        unseen = Image.new("L", image.size, UNSEEN)
        pen = ImageDraw.Draw(unseen)
        for robot in robots:
            if robot.sensor_m is None:
                continue
            reach = robot.sensor_m / self.frame.cell_m * self.pixel
            points = self._pixels(robot.path)
            if len(points) > 1:
                pen.line([tuple(p) for p in points], fill=0, width=round(2 * reach), joint="curve")
            for x, y in points[[0, -1]]:
                pen.ellipse([x - reach, y - reach, x + reach, y + reach], fill=0)
        image.paste(NIGHT, (0, 0, *image.size), unseen)

    def _draw_base(self, ground: Ground, barred: npt.NDArray[np.bool_] | None) -> Image.Image:
        shade = hillshade(ground)
        ny, nx = shade.shape
        half = np.array(self.frame.size) * self.frame.cell_m / 2
        middle = np.array([nx - 1, ny - 1]) / 2
        low, high = middle - half / ground.spacing, middle + half / ground.spacing
        whole = Image.fromarray(shade[::-1])  # north up
        box = (low[0] + 0.5, ny - 0.5 - high[1], high[0] + 0.5, ny - 0.5 - low[1])
        image = whole.transform((self.width, self.height), Image.Transform.EXTENT, box,
                                Image.Resampling.BILINEAR).convert("RGB")
        pen = ImageDraw.Draw(image, "RGBA")
        if barred is not None:
            for y, x in np.argwhere(barred):
                left, top = x * self.pixel, self.height - (y + 1) * self.pixel
                pen.rectangle([left, top, left + self.pixel, top + self.pixel],
                              fill=(*BARRED, 110))
        for x in range(self.frame.size[0] + 1):
            pen.line([(x * self.pixel, 0), (x * self.pixel, self.height)], (255, 255, 255, 45), 1)
        for y in range(self.frame.size[1] + 1):
            pen.line([(0, y * self.pixel), (self.width, y * self.pixel)], (255, 255, 255, 45), 1)
        return image

    def _target(self, pen: ImageDraw.ImageDraw, mark: TargetMark, labels: bool) -> None:
        color = SOLVED if mark.solved else OPEN
        x, y = self._pixels(self.frame.centre(np.array(mark.target.at, float)))
        reach = max(self.pixel * 0.46, 5.0 * SMOOTH)
        width = max(2, round(reach * 0.2))
        pen.rectangle([x - reach, y - reach, x + reach, y + reach], outline=color, width=width)
        size = round(max(self.pixel * 0.26, (12 if labels else 9) * SMOOTH))
        need = requirement(mark.target)
        # What solved a target stands in it: its needs are written beside its name then.
        inside = not mark.solved and self.pixel * 0.9 > pen.textlength(need, font(size, True))
        if inside:
            _text(pen, (x, y), need, color, size, "mm")
        if labels:
            text = mark.name if inside else f"{mark.name} {need}"
            below = y + reach + size * 1.2 < self.height
            _text(pen, (self._fit(pen, x, text, size),
                        y + reach + 2 if below else y - reach - 2),
                  text, color, size, "ma" if below else "md")

    def _wish(self, pen: ImageDraw.ImageDraw, way: npt.NDArray, color: Color) -> None:
        """A dashed way [n, 2] px, a ring at its end."""
        dash, line = 4.0 * SMOOTH, max(2, round(1.2 * SMOOTH))
        for start, end in itertools.pairwise(way):
            count = max(1, round(float(np.hypot(*(end - start))) / (2 * dash)))
            for k in range(count):
                piece = [tuple(start + (end - start) * (k + part) / count) for part in (0.0, 0.5)]
                pen.line(piece, fill=color, width=line)
        reach = 4.0 * SMOOTH
        x, y = way[-1]
        pen.ellipse([x - reach, y - reach, x + reach, y + reach], outline=color, width=line)

    def _fit(self, pen: ImageDraw.ImageDraw, x: float, text: str, size: int) -> float:
        """The middle of a text near x that stays inside the picture."""
        half = pen.textlength(text, font(size, True)) / 2 + 4
        return float(np.clip(x, half, max(half, self.width - half)))

    def _robot(self, pen: ImageDraw.ImageDraw, index: int, robot: RobotMark,
               labels: bool) -> None:
        color = GREY if robot.lost else robot_color(index)
        x, y = self._pixels(robot.path[-1])
        draw_robot(pen, robot.glyph, (float(x), float(y)),
                   max(self.pixel * 0.24, 4.5 * SMOOTH), color)
        if labels:
            size = round(max(self.pixel * 0.22, 12 * SMOOTH))
            away = max(self.pixel * 0.3, 8 * SMOOTH)
            above = y - away - size * 1.3 > 0
            _text(pen, (self._fit(pen, x, robot.name, size), y - away if above else y + away),
                  robot.name, color, size, "md" if above else "ma")


def draw_robot(pen: ImageDraw.ImageDraw, glyph: Glyph, at: tuple[float, float], reach: float,
               color: Color) -> None:
    """The mark of a robot's kind, about `reach` pixels from its middle to its edge."""
    x, y = at
    line = max(1, round(reach * 0.2))
    if glyph == "triangle":
        low = y + reach * 0.8
        corners = [(x, y - reach * 1.15), (x - reach, low), (x + reach, low)]
        pen.polygon(corners, fill=color, outline=NIGHT, width=line)
    elif glyph == "disc":
        pen.ellipse([x - reach, y - reach, x + reach, y + reach], color, NIGHT, line)
    elif glyph == "square":
        side = reach * 0.85
        pen.rectangle([x - side, y - side, x + side, y + side], color, NIGHT, line)
    else:
        sides = {"pentagon": 5, "hexagon": 6}[glyph]
        turns = 2 * np.pi * (np.arange(sides) / sides - 0.25)
        corners = [(x + 1.1 * reach * float(np.cos(t)), y + 1.1 * reach * float(np.sin(t)))
                   for t in turns]
        pen.polygon(corners, fill=color, outline=NIGHT, width=line)


def draw_replan(pen: ImageDraw.ImageDraw, at: tuple[float, float], reach: float) -> None:
    """A white diamond: what happened here brought a new plan."""
    x, y = at
    for size, color in ((reach, NIGHT), (reach * 0.75, REPLAN), (reach * 0.35, NIGHT)):
        pen.polygon([(x, y - size), (x + size, y), (x, y + size), (x - size, y)], fill=color)


def _text(pen: ImageDraw.ImageDraw, at: tuple[float, float], text: str, color: Color, size: int,
          anchor: str) -> None:
    """Bold text with a dark rim, legible on any ground."""
    pen.text(at, text, color, font(size, True), anchor, stroke_width=max(1, size // 9),
             stroke_fill=NIGHT)
