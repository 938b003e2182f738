"""Travel in seconds: how long each kind of robot needs between any two places, and its way.

`Roads` answers planners (matrices), the executor (waypoints), maps (fields) and reports
(expected times) from the same fields, one for each kind and target, made when first asked for.
Positions are metres, x east, y north, the site's centre at the origin.

Legend: P points, F points from, T points to, H, W rows and columns of the raster.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from moonteam.errors import InputError, meant
from moonteam.problem.mission import Mission
from moonteam.problem.rules import centre
from moonteam.terrain.light import PANEL, lit_at
from moonteam.terrain.site import Site
from moonteam.terrain.travel.field import REACH, look_ups, renew, solve
from moonteam.terrain.travel.lines import at, line_seconds
from moonteam.terrain.travel.raster import Raster, costs, slowness
from moonteam.terrain.travel.ways import way
from moonteam.terrain.traversability import BoolMap, FloatMap, Limits

MOST_FIELDS, MOST_TOLD = 256, 65536
"""Fields, and seconds of ways, kept for each kind; the oldest go first."""

Place = tuple[float, float]
Floats = npt.NDArray[np.float64]
Points = npt.NDArray[Any] | Sequence[Any]  # one [2] or several [P, 2], m


@dataclass(frozen=True)
class Way:
    """A way at any angle: straight legs from point to point."""

    points: Floats  # [P, 2] m, where it starts first, the target last
    legs: Floats  # [P - 1] s each leg takes

    @property
    def seconds(self) -> float:
        """How long all of it takes; turning and stopping are not in it."""
        return float(self.legs.sum())

    @property
    def metres(self) -> float:
        """How long it is, seen from above."""
        return float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())

    def arrivals(self, leaving: float = 0.0) -> Floats:
        """When each point is expected to be reached [P] s, if the first is left at `leaving`."""
        return leaving + np.concatenate([[0.0], np.cumsum(self.legs)])


@dataclass(frozen=True)
class Fields:
    """One kind's fields, made as they are asked for, over its slowness.

    `slow` and fields are as `field` has them; targets are (x, y) spacings from the first point.
    """

    slow: Floats  # [H + 2, W + 2] s a spacing, within a border of infinity
    plain: bool  # everywhere open and alike: ways are straight
    found: dict[Place, Floats] = field(default_factory=dict)  # [H + 2, W + 2] s, by target
    known: dict[Place, tuple[Floats, float]] = field(default_factory=dict)
    """Fields from before ground was closed, and up to how many s they still stand."""
    real: Floats | None = None
    """[H + 2, W + 2] s a spacing as they are, where `slow` weighs them to choose ways by."""
    told: dict[tuple[Place, Place], float] = field(default_factory=dict)  # real s, by ends

    def field(self, to: Place) -> Floats:
        """[H + 2, W + 2] s from everywhere to the target at `to` spacings."""
        found = self.found.get(to)
        if found is None:
            found = self._solved(to)
            while len(self.found) >= MOST_FIELDS:
                self.found.pop(next(iter(self.found)), None)
            self.found[to] = found
        return found

    def _solved(self, to: Place) -> Floats:
        if self.plain:
            rows, columns = (np.arange(-1.0, n - 1.0) for n in self.slow.shape)
            return self.slow * np.hypot(columns[None, :] - to[0], rows[:, None] - to[1])
        before = self.known.pop(to, None)
        if before is not None:
            return renew(self.slow, *before)
        return solve(self.slow, *to)

    def closed(self, shut: BoolMap) -> Fields:
        """With points [H, W] that are shut; fields that this changes are dropped."""
        inner = np.pad(shut, 1) & np.isfinite(self.slow)
        if not inner.any():
            return self
        fresh = Fields(np.where(inner, np.inf, self.slow), False, real=self.real)
        slowest = float(self.slow[np.isfinite(self.slow)].max())
        for to, (seconds, until) in (self.known | {
                to: (its, math.inf) for to, its in self.found.items()}).items():
            soonest = min(float(seconds[inner].min()) - 3.0 * slowest, until)
            if soonest == math.inf:
                fresh.found[to] = seconds
            elif soonest > REACH * slowest:
                fresh.known[to] = seconds, soonest
        return fresh


    def way(self, begin: Floats, end: Floats) -> tuple[Floats, Floats]:
        """Points [P, 2] spacings and seconds [P - 1] of legs as they are; no points: no way."""
        points, legs = way(self.slow, self.field(_key(end)), *begin, *end)
        if self.real is not None:
            taken = [line_seconds(self.real, *a, *b) for a, b in itertools.pairwise(points)]
            # The way out of closed ground has seconds of its own.
            legs = np.where(np.isfinite(taken), taken, legs)
        return points, legs

    def seconds(self, begin: Floats, end: Floats) -> float:
        """As they are, along the way that is chosen; infinite without one."""
        ends = _key(begin), _key(end)
        if ends not in self.told:
            while len(self.told) >= MOST_TOLD:
                self.told.pop(next(iter(self.told)), None)
            points, legs = self.way(begin, end)
            self.told[ends] = float(legs.sum()) if len(points) else math.inf
        return self.told[ends]


@dataclass(frozen=True)
class Roads:
    """Seconds and ways of each kind over the map of a mission. Made by its class methods."""

    raster: Raster
    kinds: Mapping[str, Fields]

    @classmethod
    def over(cls, site: Site, size: tuple[int, int], cell_m: float,
             limits: Mapping[str, Limits], weights: Mapping[str, FloatMap] | None = None
             ) -> Roads:
        """Over a map of `size` (W, H) cells about the site's centre, for kinds by their name;
        `weights` as of `of_slowness`.
        """
        raster = Raster(size, cell_m)
        return cls.of_slowness(raster, {kind: slowness(site, raster, its)
                                        for kind, its in limits.items()}, weights)

    @classmethod
    def of_slowness(cls, raster: Raster, slow: Mapping[str, FloatMap],
                    weights: Mapping[str, FloatMap] | None = None) -> Roads:
        """Where seconds per metre [H, W] are known for each kind; infinite: closed.

        A kind that has `weights` [H, W] chooses its ways as if it took so many times as long.
        """
        return cls(raster, {kind: _fields(its * raster.spacing, (weights or {}).get(kind))
                            for kind, its in slow.items()})

    @classmethod
    def of_mission(cls, site: Site, mission: Mission, limits: Mapping[str, Limits]) -> Roads:
        """Over the mission's map; kinds of robots with a battery keep to the light as it says, and
        all save energy as its site says.
        """
        size, cell_m, sun = mission.map.size, mission.map.cell_m, mission.sun
        raster = Raster(size, cell_m)
        weights = {kind: costs(site, raster, its, mission.site.thrift)
                   for kind, its in limits.items() if its.joules and mission.site.thrift}
        if sun is not None and sun.dark != 1.0 and mission.powered():
            lit = lit_at(site, sun.position(), raster.points(), PANEL)
            for kind in {mission.robots[i].kind for i in mission.powered()}:
                weights[kind] = np.where(lit, 1.0, sun.dark) * weights.get(kind, 1.0)
        return cls.over(site, size, cell_m, limits, weights)

    def passable(self, kind: str, xy: Points) -> bool:
        """Whether a robot of the kind may be sent to xy [2] m."""
        place = self._placed([xy])[0]
        return bool(at(self._of(kind).slow, *place) < np.inf)

    def seconds(self, kind: str, start: Points, to: Points) -> float:
        """Seconds from start [2] m to [2] m; infinite where there is no way."""
        return float(self.matrix(kind, [start], [to])[0, 0])

    def matrix(self, kind: str, starts: Points, to: Points) -> Floats:
        """Seconds [F, T] from each of starts [F, 2] m to each of `to` [T, 2] m."""
        its, begin, ends = self._of(kind), self._placed(starts), self._placed(to)
        if its.real is not None:
            return np.array([[its.seconds(a, b) for b in ends] for a in begin]).reshape(
                len(begin), len(ends))
        if its.plain:
            return np.linalg.norm(begin[:, None] - ends[None], axis=-1) * its.slow[1, 1]
        columns = [look_ups(its.slow, its.field(_key(end)), end, begin) for end in ends]
        return np.stack(columns, axis=1) if columns else np.zeros((len(begin), 0))

    def field(self, kind: str, to: Points) -> FloatMap:
        """Seconds [H, W] from every point of the raster to `to` [2] m, weighed where the kind
        weighs them; infinite: no way.
        """
        return self._of(kind).field(_key(self._placed([to])[0]))[1:-1, 1:-1]

    def slowness(self, kind: str) -> FloatMap:
        """Seconds per metre [H, W] at every point of the raster; infinite where it is closed."""
        its = self._of(kind)
        return (its.slow if its.real is None else its.real)[1:-1, 1:-1] / self.raster.spacing

    def way(self, kind: str, start: Points, to: Points) -> Way:
        """The way from start [2] m to `to` [2] m. Raises InputError if there is none."""
        its, begin = self._of(kind), self._placed([start])[0]
        end = self._placed([to])[0]
        points, legs = its.way(begin, end)
        if len(points) == 0:
            raise InputError("way", f"there is no way for a {kind} robot from "
                             f"{_written(start)} to {_written(to)} over this ground")
        points = (points - self._middle) * self.raster.spacing
        points[0], points[-1] = start, to
        return Way(points, legs)

    def close(self, kind: str, xy: Points, half: float | None = None) -> Roads:
        """The roads once it is known that the kind cannot cross the square about xy [2] m.

        `half` is half its side, m: half a cell if not given. As about all closed ground, what is
        nearer than robots stray is closed too. Only fields that this changes are made again, from
        where it changes them, when they are asked for.
        """
        self._placed([xy])
        reach = (self.raster.cell_m / 2 if half is None else half) + self.raster.stray
        shut = self.raster.within(xy, (reach, reach))
        return replace(self, kinds={**self.kinds,
                                      kind: self._of(kind).closed(shut)})

    def close_cell(self, kind: str, cell: tuple[int, int]) -> Roads:
        """`close` for a cell (x, y) of the map, origin lower left."""
        return self.close(kind, self.centre(cell))

    def centre(self, cell: tuple[int, int]) -> Place:
        """The centre (x, y) m of a cell (x, y) of the map."""
        x, y = centre(np.array(cell, float), self.raster.size, self.raster.cell_m).tolist()
        return x, y

    @property
    def _middle(self) -> Floats:
        rows, columns = self.raster.shape
        return np.array([(columns - 1) / 2, (rows - 1) / 2])

    def _of(self, kind: str) -> Fields:
        if kind not in self.kinds:
            raise InputError("kind", f"no roads for {kind!r}; {meant(kind, self.kinds)}there are "
                             "for " + ", ".join(self.kinds))
        return self.kinds[kind]

    def _placed(self, xy: Points) -> Floats:
        """Points [P, 2] m in spacings from the raster's first. Raises InputError off the map.

        Half a cell off is still taken for its border, as elsewhere: robots stray.
        """
        points = np.asarray(xy, np.float64).reshape(-1, 2)
        half = np.array(self.raster.half)
        off = ~(np.abs(points) <= half + self.raster.cell_m / 2 + 1e-9).all(axis=1)
        if off.any():
            raise InputError("point", f"{_written(points[off][0])} m is off the map, which reaches "
                             f"{half[0]:g} m east and west, {half[1]:g} m north and south of its "
                             "centre")
        return np.clip(points, -half, half) / self.raster.spacing + self._middle


def _fields(slow: FloatMap, weight: FloatMap | None = None) -> Fields:
    real = np.pad(slow, 1, constant_values=np.inf)
    if weight is not None:
        return Fields(np.pad(slow * weight, 1, constant_values=np.inf), False, real=real)
    return Fields(real, bool(slow.min() == slow.max() < np.inf))


def _key(spacings: Floats) -> Place:
    return round(float(spacings[0]), 6), round(float(spacings[1]), 6)


def _written(xy: npt.ArrayLike) -> str:
    x, y = np.asarray(xy, np.float64)
    return f"({x:g}, {y:g})"


