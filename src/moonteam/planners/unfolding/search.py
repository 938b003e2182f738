"""Two patterns by which robots with eyes look for hidden targets, to compare with.

Legend: N robots, U points not seen yet.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from moonteam.planners.unfolding.state import distances
from moonteam.planners.unfolding.world import View
from moonteam.problem.timed import Place

INSIDE = 0.98
"""Share of a sensor's reach from which a point is looked at."""


class Pattern(Protocol):
    """Says where to look next."""

    def look(self, view: View, idle: Sequence[int]) -> dict[int, Place]:
        """A place for each robot that has nothing else to do."""
        ...


class NearestUnseen:
    """Everybody to the point not seen yet that it can look at soonest and nobody else looks at.

    Who is soonest chooses first; what it will see from there is left out for the others.
    """

    def look(self, view: View, idle: Sequence[int]) -> dict[int, Place]:
        """See `Pattern`."""
        if view.ground is None or not idle:
            return {}
        left = view.ground.unseen
        found: dict[int, Place] = {}
        todo = list(idle)
        while todo and len(left):
            here = view.places[todo]
            reach = np.array([INSIDE * (view.agents[i].sensor or 0.0) for i in todo])
            speed = np.array([view.agents[i].speed for i in todo])
            gap = np.maximum(distances(here, left, "straight") - reach[:, None], 0.0)
            cost = gap / speed[:, None]
            row, column = np.unravel_index(int(cost.argmin()), cost.shape)
            i, point = todo.pop(int(row)), left[int(column)]
            place = from_afar(view.places[i], point, float(reach[row]))
            found[i] = place
            left = left[np.hypot(*(left - place).T) > reach[row]]
        return found


class Sweep:
    """Boustrophedon: the area is cut into strips from west to east, a robot each, as wide as it is
    fast; each goes up and down its own in lanes as wide as it sees, then looks where it is nearest.
    """

    def __init__(self) -> None:
        self._lanes: dict[int, list[Place]] = {}
        self._rest = NearestUnseen()
        self._cut = False

    def look(self, view: View, idle: Sequence[int]) -> dict[int, Place]:
        """See `Pattern`."""
        if view.ground is None:
            return {}
        if not self._cut:
            self._strips(view)
        found, free = {}, []
        for i in idle:
            lanes = self._lanes.get(i, [])
            while lanes and np.hypot(*(view.places[i] - lanes[0])) < 1e-6:
                lanes.pop(0)
            if lanes:
                found[i] = lanes[0]
            else:
                free.append(i)
        return found | self._rest.look(view, free)

    def _strips(self, view: View) -> None:
        """Lanes of everybody who has eyes, the westernmost robot the westernmost strip."""
        assert view.ground is not None
        self._cut = True
        (west, south), (east, north) = view.ground.points[0, 0], view.ground.points[-1, -1]
        eyes = [i for i in np.flatnonzero(view.moment.present).tolist()
                if view.agents[i].sensor is not None]
        eyes.sort(key=lambda i: float(view.places[i, 0]))
        speeds = np.array([view.agents[i].speed for i in eyes])
        edges = west + (east - west) * np.concatenate([[0.0], np.cumsum(speeds) / speeds.sum()])
        for k, i in enumerate(eyes):
            reach = INSIDE * (view.agents[i].sensor or 0.0)
            width = edges[k + 1] - edges[k]
            count = max(1, int(np.ceil(width / (2 * reach))))
            middles = edges[k] + width * (np.arange(count) + 0.5) / count
            # The ends of a lane are seen from as far inside as half a lane allows.
            inset = min(np.sqrt(max(reach**2 - (width / count / 2)**2, 0.0)), (north - south) / 2)
            low, high = float(south + inset), float(north - inset)
            up = abs(view.places[i, 1] - low) <= abs(view.places[i, 1] - high)
            if abs(view.places[i, 0] - middles[0]) > abs(view.places[i, 0] - middles[-1]):
                middles = middles[::-1]
            lanes: list[Place] = []
            for x in middles.tolist():
                lanes += [(x, low), (x, high)] if up else [(x, high), (x, low)]
                up = not up
            self._lanes[i] = lanes


def from_afar(here: np.ndarray, point: np.ndarray, reach: float) -> Place:
    """The place on the straight way to a point from which it is within reach."""
    gap = float(np.hypot(*(point - here)))
    share = max(gap - reach, 0.0) / gap if gap > 0 else 0.0
    x, y = here + share * (point - here)
    return float(x), float(y)
