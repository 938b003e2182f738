"""Which piece of an elevation model is the ground, as missions and commands say it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

Units = Literal["metres", "pixels", "degrees"]
Fail = Callable[[str, str], Exception]  # of a key and what is wrong with it


@dataclass(frozen=True)
class Piece:
    """A rectangle of an elevation model.

    In metres `size` is (width, height) and `centre` (east, north) of the model's centre; in pixels
    (columns, rows), and (column, row) counted from 0 in the model's upper left, whole numbers
    being the middles of pixels; in degrees (latitude, longitude) both, a size as long as so many
    degrees are there, latitude upwards and longitude across.
    """

    size: float | tuple[float, float] | None = None  # one number: both sides; None: all of it
    centre: tuple[float, float] | None = None  # None: the model's
    units: Units = "metres"
    rotation: float = 0.0  # degrees, clockwise from the model's north to the piece's

    def check(self, fail: Fail) -> None:
        """Raises `fail(key, problem)` for what cannot be, whatever the model is."""
        for side in self.sides or ():
            if not (math.isfinite(side) and side > 0):
                raise fail("size", f"{side:g} is not allowed; above 0 {self.units}")
        if self.centre is not None:
            self._check_centre(self.centre, fail)
        elif self.units == "degrees":
            raise fail("centre", "is needed where units are degrees: latitude and longitude")
        if not -360 <= self.rotation <= 360:
            raise fail("rotation", f"{self.rotation:g} is not allowed; -360 to 360 degrees")

    def _check_centre(self, centre: tuple[float, float], fail: Fail) -> None:
        if not all(map(math.isfinite, centre)):
            raise fail("centre", f"{centre[0]:g}, {centre[1]:g} is not allowed; two finite numbers "
                       "are needed")
        if self.units == "degrees" and not (abs(centre[0]) <= 90 and abs(centre[1]) <= 360):
            raise fail("centre", f"{centre[0]:g}, {centre[1]:g} is not allowed; a latitude of -90 "
                       "to 90 and a longitude of -360 to 360 degrees")

    @property
    def sides(self) -> tuple[float, float] | None:
        """Both sides, in `units`."""
        return self.size if isinstance(self.size, tuple) or self.size is None else (
            self.size, self.size)


WHOLE = Piece()
"""All of a model."""
