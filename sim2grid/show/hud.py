"""Words and signs laid over a film's pictures: labels, lists, cards. Pillow alone.

Text is drawn once and kept: what changes from picture to picture is little.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from sim2grid.show.picture import INK, NIGHT, Color, draw_robot, font

Box = tuple[float, float, float, float]  # left, top, right, bottom


@functools.lru_cache(maxsize=600)
def words(text: str, size: int, color: Color, bold: bool = True) -> Image.Image:
    """Text with a dark rim, as a picture with transparency."""
    rim = max(1, size // 9)
    left, top, right, bottom = font(size, bold).getbbox(text or " ", stroke_width=rim)
    image = Image.new("RGBA", (max(1, math.ceil(right - left)), max(1, round(1.25 * size) + rim)),
                      (*NIGHT, 0))
    del top, bottom
    ImageDraw.Draw(image).text((-left, 0), text, (*color, 255), font(size, bold),
                               stroke_width=rim, stroke_fill=(*NIGHT, 230))
    return image


def put(image: Image.Image, at: tuple[float, float], text: str, size: int, color: Color = INK,
        anchor: str = "l", bold: bool = True) -> float:
    """Writes text with its top at `at`: to the right of it, or about it (m), or to its left (r).

    Returns the width.
    """
    drawn = words(text, size, color, bold)
    x = at[0] - {"l": 0.0, "m": drawn.width / 2, "r": drawn.width}[anchor]
    image.paste(drawn, (round(x), round(at[1])), drawn)
    return drawn.width


def plate(image: Image.Image, box: Box, alpha: int = 140, edge: Color | None = None) -> None:
    """A dark plate under words."""
    pen = ImageDraw.Draw(image, "RGBA")
    pen.rounded_rectangle(box, 6, fill=(*NIGHT, alpha), outline=edge, width=2 if edge else 0)


class Label(NamedTuple):
    """A name in the picture. `at` [2] px is what it belongs to."""

    at: npt.NDArray
    text: str
    color: Color
    more: str = ""  # behind the name, in grey


@dataclass
class Labels:
    """Puts names beside what they belong to, none over another or over `taken`; what lies
    behind `hidden` has none.
    """

    size: tuple[int, int]
    taken: list[Box]
    hidden: list[Box]
    height: int  # of the letters, px

    def draw(self, image: Image.Image, labels: Sequence[Label]) -> int:
        """The first labels have the first choice; one that finds no place is left out.

        Returns how many stand.
        """
        pen = ImageDraw.Draw(image, "RGBA")
        count = 0
        for label in labels:
            name = words(label.text, self.height, label.color)
            more = words(label.more, round(0.86 * self.height), (205, 210, 220)) if (
                label.more) else None
            wide = name.width + (more.width + 6 if more else 0)
            box = self._place(label.at, wide + 10, name.height + 4)
            if box is None:
                continue
            count += 1
            self.taken.append(box)
            foot = (min(max(label.at[0], box[0]), box[2]), box[3] if box[3] <= label.at[1] else
                    box[1] if box[1] >= label.at[1] else label.at[1])
            if math.dist(foot, label.at) > 6:
                pen.line([foot, tuple(label.at)], fill=(*label.color, 190), width=2)
            pen.rounded_rectangle(box, 5, fill=(*NIGHT, 150))
            at = round(box[0] + 5), round(box[1] + 2)
            image.paste(name, at, name)
            if more:
                image.paste(more, (at[0] + name.width + 6, at[1] + round(0.12 * self.height)), more)
        return count

    def _place(self, at: npt.NDArray, wide: float, high: float) -> Box | None:
        """The first free place: above, a little aside, higher, below."""
        x, y = float(at[0]), float(at[1])
        if not (-0.02 * self.size[0] < x < 1.02 * self.size[0] and 0 < y < self.size[1]):
            return None
        if any(box[0] < x < box[2] and box[1] < y < box[3] for box in self.hidden):
            return None
        for rise in (high + 10, 2 * high + 16, 3 * high + 22, -10, -high - 16, 4 * high + 28):
            for aside in (0.0, -0.55, 0.55, -1.0, 1.0):
                left = min(max(x - wide / 2 + aside * wide, 4.0), self.size[0] - wide - 4.0)
                box = (left, y - rise, left + wide, y - rise + high)
                if box[1] >= 4 and box[3] <= self.size[1] - 4 and not any(
                        box[0] < t[2] + 3 and box[2] > t[0] - 3 and box[1] < t[3] + 3
                        and box[3] > t[1] - 3 for t in self.taken):
                    return box
        return None


def chip(image: Image.Image, box: Box, glyph: str, color: Color, lines: Sequence[tuple[str, Color]],
         unit: float) -> None:
    """A robot's plate in the strip along the bottom: its sign, its name, what it does."""
    plate(image, box, 165, color)
    pen = ImageDraw.Draw(image, "RGBA")
    size, middle = round(16 * unit), (box[1] + box[3]) / 2
    draw_robot(pen, glyph, (box[0] + 20 * unit, middle), 9 * unit, color)  # type: ignore[arg-type]
    x, y = box[0] + 38 * unit, box[1] + 5 * unit
    for text, shade in lines:
        drawn = words(text, size, shade)
        fits = max(1, int(box[2] - 4 - x))
        part = drawn if drawn.width <= fits else drawn.crop((0, 0, fits, drawn.height))
        image.paste(part, (round(x), round(y)), part)
        y += 21 * unit
        size = round(14 * unit)


def card(image: Image.Image, lines: Sequence[tuple[str, float, Color]], unit: float, share: float
         ) -> Image.Image:
    """Lines (text, size, colour) in the middle over a darkened picture; `share` of full."""
    dark = np.asarray(image).astype(np.float32) * (1.0 - 0.5 * share)
    image = Image.fromarray(dark.astype(np.uint8))
    if share < 0.5:
        return image
    sizes = []
    for text, size, color in lines:
        pixels = round(size * unit)
        while pixels > 10 and words(text, pixels, color).width > 0.94 * image.width:
            pixels -= 1
        sizes.append(pixels)
    y = 0.46 * image.height - 0.72 * sum(sizes)
    for (text, _, color), pixels in zip(lines, sizes, strict=True):
        put(image, (image.width / 2, y), text, pixels, color, "m")
        y += 1.5 * pixels
    return image


@functools.cache
def earth(pixels: int, towards: tuple[float, float, float]) -> Image.Image:
    """The Earth as seen from the Moon, lit from `towards` (right, up, to the viewer)."""
    random = np.random.default_rng(4)
    y, x = (np.mgrid[0:4 * pixels, 0:4 * pixels] + 0.5) / (2 * pixels) - 1.0
    inside = x**2 + y**2 < 1.0
    z = np.sqrt(np.maximum(1.0 - x**2 - y**2, 0.0))
    lit = np.clip(x * towards[0] - y * towards[1] + z * towards[2], 0.0, 1.0) ** 0.6
    noise = np.asarray(Image.fromarray(random.normal(size=(9, 9)).astype(np.float32)).resize(
        x.shape[::-1], Image.Resampling.BICUBIC))
    cloud = np.asarray(Image.fromarray(random.normal(size=(15, 8)).astype(np.float32)).resize(
        x.shape[::-1], Image.Resampling.BICUBIC))
    base = np.where((noise > 0.35)[..., None], [122, 116, 82], [38, 84, 160]).astype(float)
    white = np.clip(1.2 * cloud + 0.1 + 1.5 * (np.abs(y) > 0.86), 0, 1)[..., None]
    color = (base * (1 - white) + 240.0 * white) * lit[..., None]
    whole = np.dstack([color, 255.0 * inside]).clip(0, 255).astype(np.uint8)
    return Image.fromarray(whole, "RGBA").resize((pixels, pixels), Image.Resampling.BOX)
