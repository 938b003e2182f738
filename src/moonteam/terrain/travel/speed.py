"""How fast and how exact travel in seconds is, beside shortest ways over the raster's graph.

The peer is Dijkstra's algorithm as SciPy has it, over the same raster with eight neighbours to a
point: the usual grid planner. Both are asked for the same fields, in turns.
"""

from __future__ import annotations

import importlib.metadata
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra

from moonteam.errors import InputError
from moonteam.report import clock
from moonteam.terrain.site import Site
from moonteam.terrain.travel.raster import Raster, fresh_slowness
from moonteam.terrain.travel.roads import Roads
from moonteam.terrain.traversability import FloatMap, Limits

OURS, PEER = "moonteam", "scipy dijkstra, 8 neighbours"
PAIRS = 100
"""Of places between which fields and ways are compared, a kind."""


def measure(site: Site, raster: Raster, limits: Mapping[str, Limits], targets: int, repeats: int,
            seed: int) -> dict[str, Any]:
    """The benchmark's document, without title, notes and meta."""
    rng = np.random.default_rng(seed)
    rasters, slow = _rasters(site, raster, limits, repeats)
    places = _open_places(rng, raster, slow, targets)
    calls: dict[str, Callable[[], Any]] = {
        OURS: lambda: _fields(Roads.of_slowness(raster, slow), places),
        PEER: lambda: _peer(raster, slow, places)}
    times = _in_turns(calls, repeats)
    errors = _on_flat_ground(raster, _on_points(raster, places))
    rows = [{"solver": name, "fields": len(slow) * targets, **times[name].document(),
             "error_mean": float(errors[name].mean()), "error_worst": float(errors[name].max())}
            for name in calls]
    network = Roads.of_slowness(raster, slow)
    _fields(network, places)
    known = _in_turns({"known": lambda: [network.matrix(k, places, places) for k in slow]},
                      repeats)["known"]
    return {"site": site.name, "points": list(raster.shape[::-1]), "spacing_m": raster.spacing,
            "kinds": list(slow), "targets": targets, "scipy": importlib.metadata.version("scipy"),
            "rows": rows, "matrices_again": known.document(), "rasters": rasters.document(),
            "ways": [_ways(rng, network, kind) for kind in slow]}


def _rasters(site: Site, raster: Raster, limits: Mapping[str, Limits], repeats: int
             ) -> tuple[clock.Times, dict[str, FloatMap]]:
    """What the rasters of all kinds take, nothing remembered, and these."""
    made: dict[str, FloatMap] = {}

    def call(_: int) -> None:
        made.update({kind: fresh_slowness(site, raster, its) for kind, its in limits.items()})

    return clock.measure(call, range(min(repeats, 5)), 20.0), made


def _fields(network: Roads, places: npt.NDArray[np.float64]) -> list[FloatMap]:
    return [network.field(kind, to) for kind in network.kinds for to in places]


def _in_turns(calls: Mapping[str, Callable[[], Any]], repeats: int) -> dict[str, clock.Times]:
    first, seconds = {}, {name: [] for name in calls}
    for turn in range(repeats + 1):
        for name, call in calls.items():
            began = time.perf_counter()
            call()
            took = time.perf_counter() - began
            if turn:
                seconds[name].append(took)
            else:
                first[name] = took
    return {name: clock.times_of(seconds[name], first[name]) for name in calls}


def _open_places(rng: np.random.Generator, raster: Raster, slow: Mapping[str, FloatMap],
                 count: int) -> npt.NDArray[np.float64]:
    """Points [count, 2] m that are open to all kinds."""
    able = np.logical_and.reduce([np.isfinite(its) for its in slow.values()])
    if not able.any():
        raise InputError("bench travel", "no ground of this site is open to all kinds")
    points = raster.points()[able]
    return points[rng.choice(len(points), count, replace=len(points) < count)]


def _on_points(raster: Raster, places: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    """Row and column [P, 2] of places [P, 2] m that are points."""
    middle = (np.array(raster.shape) - 1) / 2
    return np.rint(places[:, ::-1] / raster.spacing + middle).astype(np.int64)


def _graph(raster: Raster, slow: FloatMap) -> csr_array:
    """Seconds from each open point to its open neighbours of eight, as a sparse matrix."""
    rows, columns = raster.shape
    index = np.arange(rows * columns).reshape(rows, columns)
    begin, end, cost = [], [], []
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        left, right = max(0, -dx), columns - max(0, dx)
        a = (slice(0, rows - dy), slice(left, right))
        b = (slice(dy, rows), slice(left + dx, right + dx))
        seconds = np.hypot(dx, dy) * raster.spacing * (slow[a] + slow[b]) / 2
        able = np.isfinite(seconds)
        begin.append(index[a][able])
        end.append(index[b][able])
        cost.append(seconds[able])
    i, j, s = (np.concatenate(its) for its in (begin, end, cost))
    return coo_array((s, (i, j)), shape=(index.size, index.size)).tocsr()


def _peer(raster: Raster, slow: Mapping[str, FloatMap], places: npt.NDArray[np.float64]
          ) -> list[npt.NDArray[np.float64]]:
    """kind by kind [P, H W] s from every point to the places."""
    rows, columns = _on_points(raster, places).T
    return [dijkstra(_graph(raster, its), directed=False, indices=rows * raster.shape[1] + columns)
            for its in slow.values()]


def _on_flat_ground(raster: Raster, at: npt.NDArray[np.int64]) -> dict[str, FloatMap]:
    """How much longer than the straight line, as a share, each solver says it is [P, H W].

    One point in a corner is closed: on ground that is open everywhere nothing would be solved.
    """
    slow = np.ones(raster.shape)
    slow[0, 0] = np.inf
    xy = raster.points()
    places = xy[at[:, 0], at[:, 1]]
    straight = np.linalg.norm(xy.reshape(1, -1, 2) - places[:, None], axis=-1)
    ours = _fields(Roads.of_slowness(raster, {"": slow}), places)
    found = {OURS: np.stack([its.ravel() for its in ours]),
             PEER: _peer(raster, {"": slow}, places)[0]}
    asked = (straight > 0) & (np.arange(slow.size) > 0)[None, :]
    return {name: np.abs(its[asked] / straight[asked] - 1) for name, its in found.items()}


def _ways(rng: np.random.Generator, network: Roads, kind: str) -> dict[str, Any]:
    """Fields and ways between random places: how far apart, how long a way takes to find."""
    half, apart, took, corners, unreachable = np.array(network.raster.half), [], [], [], 0
    while len(apart) + unreachable < PAIRS:
        start, to = rng.uniform(-half, half, (2, 2))
        if not (network.passable(kind, start) and network.passable(kind, to)):
            continue
        told = network.seconds(kind, start, to)
        if np.isinf(told):
            unreachable += 1
            continue
        began = time.perf_counter()
        way = network.way(kind, start, to)
        took.append(time.perf_counter() - began)
        apart.append(told / way.seconds - 1)
        corners.append(len(way.points) - 2)
    if not apart:
        return {"kind": kind, "pairs": 0, "unreachable": unreachable}
    return {"kind": kind, "pairs": len(apart), "unreachable": unreachable,
            "field_over_way_median": float(np.median(apart)),
            "field_over_way_least": float(min(apart)), "field_over_way_most": float(max(apart)),
            "corners_mean": float(np.mean(corners)), "seconds": float(np.median(took)),
            "slowest_seconds": float(max(took[1:], default=took[0]))}
