"""Cells <-> metres: the map lies centred on the site, its middle at the origin.

Every function works on NumPy arrays, on JAX arrays and inside jit and vmap: it takes the
array library from its argument. Cells are (x, y) with the origin lower left; `xy` is in
metres, x east, y north.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from moonteam.problem import rules

HYSTERESIS = 0.05
"""Fraction of a cell by which a robot must be past a border before its cell changes."""


@dataclass(frozen=True)
class Frame:
    """Where a map of `size` (W, H) cells, each `cell_m` metres wide, lies on its site."""

    size: tuple[int, int]
    cell_m: float

    def _size(self, xp: Any, like: Any) -> Any:
        """(W, H) spelled out to the shape of `like`: ranks are never promoted silently."""
        return xp.broadcast_to(xp.asarray(self.size), like.shape)

    def centre(self, cells: Any) -> Any:
        """Centres [..., 2] m of cells [..., 2]."""
        return rules.centre(cells, self.size, self.cell_m)

    def continuous(self, xy: Any) -> Any:
        """Points [..., 2] m in units of cells from the map's lower left corner, [..., 2]."""
        xp = xy.__array_namespace__()
        return xy / self.cell_m + self._size(xp, xy) / 2

    def cell(self, xy: Any) -> Any:
        """The cell [..., 2] int32 that holds points [..., 2] m; off the map, the nearest."""
        xp = xy.__array_namespace__()
        last = self._size(xp, xy) - 1
        return xp.clip(xp.floor(self.continuous(xy)), 0, last).astype(xp.int32)

    def settle(self, xy: Any, cells: Any, margin: float = HYSTERESIS) -> Any:
        """The cell [..., 2] of robots at xy [..., 2] m that were last in `cells` [..., 2].

        A robot keeps its cell until it is past the border by `margin` cells, so that one
        that stands on a border does not flicker between two.
        """
        xp = xy.__array_namespace__()
        past = xp.abs(self.continuous(xy) - (cells + 0.5)).max(-1, keepdims=True)
        return xp.where(past > 0.5 + margin, self.cell(xy), xp.asarray(cells, dtype=xp.int32))

    def inside(self, xy: Any, cells: Any) -> Any:
        """[...] True where points [..., 2] m lie in `cells` [..., 2], borders included."""
        xp = xy.__array_namespace__()
        return (xp.abs(self.continuous(xy) - (cells + 0.5)) <= 0.5).all(-1)

    def off_map(self, xy: Any, margin: float = 0.5) -> Any:
        """[...] True where points [..., 2] m are past the map's border by `margin` cells."""
        xp = xy.__array_namespace__()
        at = self.continuous(xy)
        return ((at < -margin) | (at > self._size(xp, xy) + margin)).any(-1)

    def on_map(self, xy: Any) -> Any:
        """Points [..., 2] m, those off the map moved to its border."""
        xp = xy.__array_namespace__()
        half = self._size(xp, xy) * (self.cell_m / 2)
        return xp.clip(xy, -half, half)


def tilt(quat: Any) -> Any:
    """Angle [...] rad between a body's z axis and up, from quaternions [..., 4] wxyz."""
    xp = quat.__array_namespace__()
    x, y = quat[..., 1], quat[..., 2]
    norm = xp.maximum((quat ** 2).sum(-1), 1e-12)
    return xp.arccos(xp.clip(1.0 - 2.0 * (x * x + y * y) / norm, -1.0, 1.0))
