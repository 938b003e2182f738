"""What has been seen of the area in which targets may be hidden: points, a metre apart.

Legend: H rows from south to north, W columns from west to east.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from moonteam.problem.timed import Place, Timed

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Look:
    """A place from which all that is not seen yet of a part of the ground can be seen."""

    at: Place
    unseen: Floats  # [U, 2] m
    share: float = 0.0  # of the part, what is not seen

    def from_afar(self, here: Floats, reach: float) -> Place:
        """The first place, to a hair, on the straight way there from which it is all in reach."""
        way = np.asarray(self.at) - here

        def sees(share: float) -> bool:
            return bool((np.hypot(*(self.unseen - (here + share * way)).T) <= reach).all())

        low, high = 0.0, 0.0 if sees(0.0) else 1.0
        while high - low > 1e-3:
            middle = (low + high) / 2
            low, high = (low, middle) if sees(middle) else (middle, high)
        x, y = here + high * way
        return float(x), float(y)


class Post(Look):
    """A place to wait at, of the same kind in what is shown of a mission."""

    def from_afar(self, here: Floats, reach: float) -> Place:
        """The place itself."""
        del here, reach
        return self.at


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

    def cuts(self, reach: float) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """The rows and the columns of equal parts, each to be seen whole from its middle."""
        size = self.points[-1, -1] - self.points[0, 0]
        wide, high = (max(1, math.ceil(v / (math.sqrt(2) * reach))) for v in size.tolist())
        rows, columns = (np.array_split(np.arange(n), parts) for n, parts in zip(
            self.seen.shape, (high, wide), strict=True))
        return rows, columns

    def looks(self, reach: float) -> list[Look]:
        """Places to look from: the middles of those parts of which not all has been seen."""
        found = []
        for own in itertools.product(*self.cuts(reach)):
            part = np.ix_(*own)
            unseen = self.points[part][~self.seen[part]]
            if len(unseen):
                x, y = (unseen.min(0) + unseen.max(0)) / 2
                found.append(Look((float(x), float(y)), unseen,
                                  len(unseen) / self.seen[part].size))
        return found

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
