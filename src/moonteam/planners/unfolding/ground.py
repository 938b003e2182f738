"""What has been seen of the area in which targets may be hidden: points, a metre apart.

Legend: H rows from south to north, W columns from west to east.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from moonteam.problem.timed import Timed

Floats = npt.NDArray[np.float64]


@dataclass
class Ground:
    """Points, and which of them have been seen."""

    points: Floats  # [H, W, 2] m
    seen: npt.NDArray[np.bool_]  # [H, W]

    @classmethod
    def of(cls, problem: Timed) -> Ground | None:
        """Nothing seen yet; None where nothing is hidden."""
        area = None if problem.expects is None else problem.expects.area
        if area is None or all(agent.sensor is None for agent in problem.agents):
            return None
        west, south, east, north = area
        x = np.arange(west, east + 1e-9, 1.0)
        y = np.arange(south, north + 1e-9, 1.0)
        points = np.stack(np.meshgrid(x, y), axis=-1)
        return cls(points, np.zeros(points.shape[:2], bool))

    @property
    def share(self) -> float:
        """Of the points, those that have been seen."""
        return float(self.seen.mean())

    @property
    def unseen(self) -> Floats:
        """[U, 2] m."""
        return self.points[~self.seen]

    def see(self, way: Floats, reach: float) -> None:
        """What is within reach of a way [P, 2] is seen."""
        for a, b in itertools.pairwise(way):
            run = b - a
            length = float(run @ run)
            shift = self.points - a
            share = np.clip((shift @ run) / length, 0.0, 1.0) if length > 0 else np.zeros(
                self.seen.shape)
            gap = shift - share[..., None] * run
            self.seen |= (gap**2).sum(-1) <= reach**2 + 1e-9

    def copy(self) -> Ground:
        """Another that sees on its own."""
        return Ground(self.points, self.seen.copy())
