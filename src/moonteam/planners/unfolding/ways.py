"""The way of a robot over open ground: where it is when, and when it comes near something."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from moonteam.planners.seconds.base import MS, NEVER
from moonteam.problem.timed import Metric, Place

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Way:
    """From a place to another at an even pace. Times in ms."""

    points: tuple[Place, ...]  # corners, first to last
    since: int
    arrives: int
    expected: int  # when it would arrive if ways took what is expected

    @classmethod
    def of(cls, start: Place, end: Place, metric: Metric, speed: float, now: int,
           factor: float = 1.0) -> Way:
        """Setting out at `now`; the way takes `factor` times what is expected."""
        points = [start, end] if metric == "straight" else [start, (end[0], start[1]), end]
        whole = [p for k, p in enumerate(points) if k == 0 or p != points[k - 1]] or [start]
        metres = sum(math.dist(a, b) for a, b in itertools.pairwise(whole))
        usual = round(MS * metres / speed)
        return cls(tuple(whole), now, now + round(factor * usual), now + usual)

    @property
    def end(self) -> Place:
        """Where it leads."""
        return self.points[-1]

    def onwards(self, now: int) -> Way:
        """The rest of the way, as it is expected."""
        share = self._share(now)
        left = round((1.0 - share) * (self.expected - self.since))
        pieces = self.between(now, self.arrives)
        points = tuple((float(x), float(y)) for x, y in pieces)
        return replace(self, points=points, since=now, arrives=now + left, expected=now + left)

    def at(self, now: int) -> Place:
        """Where it is at a time."""
        x, y = self.between(now, now)[-1]
        return float(x), float(y)

    def between(self, since: int, until: int) -> Floats:
        """[P, 2] the corners of the piece that is driven from one time to another."""
        corners = np.array(self.points, float)
        if len(corners) == 1:
            return np.repeat(corners, 2, axis=0)
        lengths = np.hypot(*np.diff(corners, axis=0).T)
        marks = np.concatenate([[0.0], np.cumsum(lengths)])
        low, high = (self._share(t) * marks[-1] for t in (since, until))
        inner = corners[(marks > low) & (marks < high)]
        ends = [[np.interp(d, marks, corners[:, k]) for k in (0, 1)] for d in (low, high)]
        return np.concatenate([[ends[0]], inner, [ends[1]]])

    def within(self, place: Place, reach: float, now: int, until: int) -> int:
        """ms, from `now` on and before `until`, at which it is first within reach; else NEVER."""
        pieces = self.between(now, min(until, self.arrives))
        gone, whole = 0.0, float(np.hypot(*np.diff(pieces, axis=0).T).sum())
        if whole <= 0.0:
            return NEVER
        for a, b in itertools.pairwise(pieces):
            length = math.dist(a, b)
            if length <= 0.0:
                continue
            along = ((place[0] - a[0]) * (b[0] - a[0]) + (place[1] - a[1]) * (b[1] - a[1])) / length
            off = (place[0] - a[0])**2 + (place[1] - a[1])**2 - along**2
            if off <= reach**2:
                enters = along - math.sqrt(reach**2 - off)
                if max(enters, 0.0) <= length and along + math.sqrt(reach**2 - off) >= 0.0:
                    share = (gone + max(enters, 0.0)) / whole
                    return now + math.ceil(share * (min(until, self.arrives) - now))
            gone += length
        return NEVER

    def _share(self, now: int) -> float:
        if self.arrives <= self.since:
            return 1.0
        return min(max((now - self.since) / (self.arrives - self.since), 0.0), 1.0)
