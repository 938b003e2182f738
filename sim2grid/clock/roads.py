"""What the clock asks of the ground: how long, which way, and what it has learned to be closed.

`moonteam.terrain.travel` answers over terrain; `OpenGround` on ground that stops nobody.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


class Way(Protocol):
    """A way to drive: straight pieces from point to point."""

    @property
    def points(self) -> Floats:
        """Points [P, 2] m, the start first."""
        ...

    @property
    def legs(self) -> Floats:
        """Seconds [P - 1] of each piece at travelling speed."""
        ...

    @property
    def seconds(self) -> float:
        """Of all of it; infinite where there is no way."""
        ...


class Roads(Protocol):
    """Travel of every kind over one piece of ground, closed ground that was learned included."""

    def matrix(self, kind: str, starts: Floats, to: Floats) -> Floats:
        """Seconds [S, G] from starts [S, 2] m `to` goals [G, 2] m; infinite where no way is."""
        ...

    def way(self, kind: str, start: Floats, to: Floats) -> Way:
        """From a start [2] m `to` a goal [2] m. Raises InputError if there is no way."""
        ...

    def passable(self, kind: str, xy: Floats) -> bool:
        """Whether the kind can be sent to a point [2] m."""
        ...

    def close(self, kind: str, xy: Floats) -> Roads:
        """The same ground with the cell about a point [2] m closed to a kind."""
        ...


@dataclass(frozen=True)
class Straight:
    """A way in one piece."""

    points: Floats
    seconds: float

    @property
    def legs(self) -> Floats:
        """Seconds [1]."""
        return np.array([self.seconds])


@dataclass(frozen=True)
class OpenGround:
    """Straight ways at each kind's speed, m/s, everywhere."""

    speeds: Mapping[str, float]

    def matrix(self, kind: str, starts: Floats, to: Floats) -> Floats:
        """See `Roads`."""
        return np.linalg.norm(starts[:, None] - to[None], axis=-1) / self.speeds[kind]

    def way(self, kind: str, start: Floats, to: Floats) -> Straight:
        """See `Roads`."""
        return Straight(np.stack([start, to]),
                        float(np.linalg.norm(to - start)) / self.speeds[kind])

    def passable(self, kind: str, xy: Floats) -> bool:
        """See `Roads`."""
        return kind in self.speeds and bool(np.isfinite(xy).all())

    def close(self, kind: str, xy: Floats) -> OpenGround:
        """Nothing can be closed."""
        del kind, xy
        return self
