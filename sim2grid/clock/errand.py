"""What each robot is about: on its way to a target, waiting there, in service, or free.

Legend: R robots, M targets, P points of a way.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from moonteam.planners.seconds.keeper import HOME, WAIT
from sim2grid.clock.roads import Floats, Way
from sim2grid.clock.steer import along

Phase = Literal["free", "going", "there", "serving"]


@dataclass
class Errand:
    """One robot's. `place` [2] m is where it has to be in the end."""

    choice: int
    phase: Phase
    place: Floats
    points: Floats  # [P, 2] m still to be driven, the first where it set out or turned
    legs: Floats  # [P - 1] s expected of each piece
    since: float  # mission second at which it set out
    expected: float  # s that the whole way takes
    until: float = 0.0  # mission second at which its service ends
    behind: bool = False  # it has been said that it is late
    look: Floats | None = None  # [2] m, where it is to look from on its way
    watched: float = 0.0  # mission second at which its progress was last judged
    mark: Floats | None = None  # [2] m, where it was then

    @classmethod
    def idle(cls, xy: Floats, now: float) -> Errand:
        """Standing free at xy [2]."""
        return cls(WAIT, "free", xy.copy(), xy[None].copy(), np.zeros(0), now, 0.0)

    @classmethod
    def to(cls, choice: int, place: Floats, way: Way, pace: float, now: float) -> Errand:
        """Off to a place; `pace` times the way's seconds are what it takes."""
        points = np.asarray(way.points, float)
        return cls(choice, "going", place, points, pace * np.asarray(way.legs, float), now,
                   pace * float(way.seconds), watched=now, mark=points[0].copy())

    @property
    def at_home(self) -> bool:
        """Whether it has come home."""
        return self.phase == "there" and self.choice == HOME

    def drive(self, xy: Floats) -> int:
        """Drops the pieces that are behind a robot at xy [2]; returns how many."""
        if len(self.points) < 3:
            return 0
        done, share = along(self.points, xy)
        if share > 0.98 and done < len(self.points) - 2:
            done += 1
        self.points, self.legs = self.points[done:], self.legs[done:]
        return done

    def left(self, xy: Floats) -> float:
        """Seconds that the rest of the way takes from xy [2]."""
        if self.phase != "going" or not len(self.legs):
            return 0.0
        piece, share = along(self.points, xy)
        return float((1.0 - share) * self.legs[piece] + self.legs[piece + 1:].sum())
