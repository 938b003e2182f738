"""Straight drives, walks and flights of one robot over a site: does it arrive, and how well?

All traverses of a site run as the worlds of one batch: same scene, each its own start, goal
and heading. Routes are drawn at random and kept where the kind may go.

Letters: B traverses, T log samples.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np

from moonteam.errors import InputError
from moonteam.physics.backends import Log, WorldState, make_backend
from moonteam.physics.scene import Placement, Scene, build_scene, start_pose
from moonteam.report.intervals import wilson
from moonteam.robots.base import CONTROL_PERIOD, Command, RobotKind
from moonteam.terrain.site import Site
from moonteam.terrain.traversability import POINT_SPACING, STRAY, passable

ARRIVAL = 0.25  # m from the goal: what the executor calls arrived on cells of 1 m
FALLEN_SECONDS = 2.0  # that long over the kind's fall tilt
STUCK_PROGRESS, STUCK_SECONDS = 0.3, 20.0  # less than that far in that long
REST_SECONDS = 3.0  # still watched after the arrival, to see where it comes to rest
PATIENCE = 4.0  # times the time at the kind's own speed
LOG_EVERY = 5  # control steps
SAMPLE_SECONDS = CONTROL_PERIOD * LOG_EVERY
BEARS = 0.1  # N on a wheel or foot
MARGIN = 3.0  # m from the site's border
BATCHES, BATCH = 20, 100  # routes drawn at most, routes judged at once

Outcome = Literal["arrived", "fallen", "stuck", "late", "diverged"]


@dataclass(frozen=True)
class Route:
    """A straight way. `yaw` rad is the heading at the start, drawn at random too."""

    start: tuple[float, float]  # m
    goal: tuple[float, float]  # m
    yaw: float


@dataclass(frozen=True)
class Traverse:
    """One traverse as it went."""

    kind: str
    site: str
    site_seed: int
    start: tuple[float, float]  # m
    goal: tuple[float, float]  # m
    yaw: float  # rad
    outcome: Outcome
    seconds: float  # until the outcome
    progress_m: float  # along the line
    speed_mps: float  # progress over seconds
    cross_track_rms_m: float
    cross_track_p95_m: float
    cross_track_max_m: float
    rest_error_m: float  # from the goal, REST_SECONDS after arriving; nan where it did not
    energy_j_per_m: float
    propellant_g: float
    tilt_p95_deg: float
    tilt_max_deg: float
    slip: float | None = None  # on regolith: of its wheels, in the mean of those that bear
    sinkage_m: float | None = None  # on regolith: of what bears


class Recording(NamedTuple):
    """One traverse to look at."""

    scene: Scene
    route: Route
    qpos: np.ndarray  # [T, nq], one each SAMPLE_SECONDS


def draw_routes(
    kind: RobotKind, site: Site, count: int, length: float, rng: np.random.Generator
) -> tuple[list[Route], int]:
    """`count` passable routes of `length` m, and how many draws it took.

    Raises InputError if the site is too small, or has hardly any.
    """
    half = np.array(site.extent) - MARGIN
    if math.hypot(*(2 * half)) < length or (half <= 0).any():
        raise InputError(f"site {site.name}", f"too small for {length:g} m traverses", "extent")
    routes: list[Route] = []
    for batch in range(BATCHES):
        start = rng.uniform(-half, half, (BATCH, 2))
        heading, yaw = rng.uniform(-math.pi, math.pi, (2, BATCH))
        goal = start + length * np.stack([np.cos(heading), np.sin(heading)], axis=1)
        able = (np.abs(goal) <= half).all(axis=1) & _passable(kind, site, start, goal)
        for draw in np.flatnonzero(able):
            routes.append(Route(_pair(start[draw]), _pair(goal[draw]), float(yaw[draw])))
            if len(routes) == count:
                return routes, batch * BATCH + int(draw) + 1
    raise InputError(f"site {site.name} {site.seed}", f"only {len(routes)} of {count} routes of "
                     f"{length:g} m that a {kind.name} robot may take in {BATCHES * BATCH} draws")


def _pair(xy: np.ndarray) -> tuple[float, float]:
    return float(xy[0]), float(xy[1])


def _passable(kind: RobotKind, site: Site, start: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Which lines from start [D, 2] to goal [D, 2] m traversability opens to the kind: [D].

    The robot may stray to either side, and it must be able to stand at both ends.
    """
    limits = kind.limits_on(site.soil.name if site.soil else None)
    way = goal - start
    length = float(np.linalg.norm(way[0]))
    aside = STRAY / length * np.stack([-way[:, 1], way[:, 0]], axis=1)
    share = np.linspace(0.0, 1.0, math.ceil(length / POINT_SPACING) + 1)
    line = start[:, None] + share[:, None] * way[:, None]  # [D, S, 2]
    points = np.concatenate([line - aside[:, None], line, line + aside[:, None]], axis=1)
    ends = passable(site, np.stack([start, goal], axis=1), replace(limits, flies=False))
    return np.all(passable(site, points, limits), axis=1) & np.all(ends, axis=1)


def run_traverses(
    kind: RobotKind, site: Site, routes: Sequence[Route], *, backend: str = "native",
    threads: int = 0, watch: Callable[[float], None] = lambda seconds: None,
    record: Sequence[int] = (),
) -> tuple[list[Traverse], list[Recording]]:
    """Runs all routes at once; returns a row each, and the poses of those in `record`.

    Args:
      kind: which robot.
      site: the ground.
      routes: where.
      backend: `native` or `mjx`.
      threads: of the native backend, 0 for all CPUs.
      watch: called with the simulated seconds so far.
      record: numbers of the routes whose poses are wanted.
    """
    length = max(math.dist(r.start, r.goal) for r in routes)
    scene, seconds = under_way(kind, site, routes, backend, threads)
    judge, poses = _Judge(kind, site, routes), []
    for _, (state, log) in zip(range(math.ceil(PATIENCE * length / kind.speed)), seconds,
                               strict=False):
        judge.add(np.asarray(log.qpos), np.asarray(log.power), np.asarray(log.propellant_rate),
                  np.asarray(log.treads), np.asarray(state.diverged))
        poses.append(np.asarray(log.qpos)[list(record)])
        watch(judge.seconds)
        if judge.done:
            break
    rows = judge.verdicts()
    whole = np.concatenate(poses, axis=1)
    until = [round((rows[r].seconds + REST_SECONDS) / SAMPLE_SECONDS) for r in record]
    return rows, [Recording(scene, routes[r], whole[i, :until[i]]) for i, r in enumerate(record)]


def under_way(kind: RobotKind, site: Site, routes: Sequence[Route], backend: str, threads: int
              ) -> tuple[Scene, Iterator[tuple[WorldState, Log]]]:
    """The scene of robots on their routes, a world each, and their worlds and log second by second,
    for ever; arguments as of `run_traverses`.
    """
    starts = [Placement("robot", kind, r.start, r.yaw) for r in routes]
    scene = build_scene(site, starts[:1])
    engine = make_backend(backend, scene, log_every=LOG_EVERY, threads=threads)
    goals = np.array([r.goal for r in routes], np.float32)
    command = (Command(jnp.asarray(goals), jnp.full(len(routes), kind.speed),
                       jnp.zeros(len(routes), bool)),)

    def seconds() -> Iterator[tuple[WorldState, Log]]:
        state = engine.reset(np.stack([start_pose(site, place) for place in starts]))
        while True:
            state, log = engine.advance(state, command, round(1.0 / SAMPLE_SECONDS) * LOG_EVERY)
            yield state, log

    return scene, seconds()


class _Judge:
    """Looks at the logs as they come and says when and how each traverse ended."""

    def __init__(self, kind: RobotKind, site: Site, routes: Sequence[Route]):
        self._kind, self._site, self._routes = kind, site, routes
        self._start = np.array([r.start for r in routes])  # [B, 2] m
        self._goal = np.array([r.goal for r in routes])
        self._ends: list[tuple[Outcome, int] | None] = [None] * len(routes)
        self._xy: list[np.ndarray] = []
        self._tilt: list[np.ndarray] = []
        self._power: list[np.ndarray] = []
        self._propellant: list[np.ndarray] = []
        self._treads: list[np.ndarray] = []

    @property
    def seconds(self) -> float:
        """Simulated so far."""
        return sum(part.shape[1] for part in self._xy) * SAMPLE_SECONDS

    @property
    def done(self) -> bool:
        """Whether every traverse has ended, and those that arrived had time to rest."""
        now = round(self.seconds / SAMPLE_SECONDS)
        rest = round(REST_SECONDS / SAMPLE_SECONDS)
        return all(end is not None and (end[0] != "arrived" or end[1] + rest <= now)
                   for end in self._ends)

    def add(self, qpos: np.ndarray, power: np.ndarray, propellant: np.ndarray,
            treads: np.ndarray, diverged: np.ndarray) -> None:
        """A stretch of log: qpos [B, T, nq], power and propellant [B, T, 1], treads [B, T, C, 3];
        diverged [B].
        """
        x, y = qpos[..., 4], qpos[..., 5]
        self._xy.append(qpos[..., :2])
        self._tilt.append(np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0)))
        self._power.append(power[..., 0])
        self._propellant.append(propellant[..., 0])
        self._treads.append(treads)
        xy, tilt = np.concatenate(self._xy, axis=1), np.concatenate(self._tilt, axis=1)
        for b, end in enumerate(self._ends):
            if end is None:
                self._ends[b] = self._end(xy[b], tilt[b], self._goal[b], bool(diverged[b]))

    def _end(self, xy: np.ndarray, tilt: np.ndarray, goal: np.ndarray, diverged: bool
             ) -> tuple[Outcome, int] | None:
        """Outcome and sample of one traverse from all its xy [T, 2] and tilt [T] so far."""
        if diverged:
            return "diverged", len(xy)
        near = np.flatnonzero(np.linalg.norm(xy - goal, axis=1) < ARRIVAL)
        if near.size:
            return "arrived", int(near[0]) + 1
        fallen = round(FALLEN_SECONDS / SAMPLE_SECONDS)
        if len(tilt) >= fallen and (tilt[-fallen:] > self._kind.fall_tilt).all():
            return "fallen", len(xy)
        stuck = round(STUCK_SECONDS / SAMPLE_SECONDS)
        if len(xy) > stuck and np.linalg.norm(xy[-1] - xy[-1 - stuck]) < STUCK_PROGRESS:
            return "stuck", len(xy)
        return None

    def verdicts(self) -> list[Traverse]:
        """One row a traverse; what has not ended by now is late."""
        xy, tilt, power, propellant, treads = (np.concatenate(parts, axis=1) for parts in (
            self._xy, self._tilt, self._power, self._propellant, self._treads))
        return [replace(self._row(b, xy[b], np.degrees(tilt[b]), power[b], propellant[b]),
                        **self._on_soil(b, treads[b])) for b in range(len(self._routes))]

    def _on_soil(self, b: int, treads: np.ndarray) -> dict[str, float]:
        """Mean slip and sinkage of what bears, from treads [T, C, 3]; nothing on rigid ground."""
        _, end = self._ends[b] or ("late", len(treads))
        slip, depth, load = np.moveaxis(treads[:end], -1, 0)
        bears = load > BEARS
        if not bears.any():
            return {}
        wheels = {"slip": float(slip[bears].mean())} if self._kind.tread.rolls else {}
        return wheels | {"sinkage_m": float(depth[bears].mean())}

    def _row(self, b: int, xy: np.ndarray, tilt: np.ndarray, power: np.ndarray,
             propellant: np.ndarray) -> Traverse:
        outcome, end = self._ends[b] or ("late", len(xy))
        line = self._goal[b] - self._start[b]
        line = line / np.linalg.norm(line)
        away = xy[:end] - self._start[b]
        cross = np.abs(line[0] * away[:, 1] - line[1] * away[:, 0])
        progress, seconds = float(away[-1] @ line), end * SAMPLE_SECONDS
        rest = xy[min(len(xy), end + round(REST_SECONDS / SAMPLE_SECONDS)) - 1] - self._goal[b]
        route = self._routes[b]
        return Traverse(
            self._kind.name, self._site.name, self._site.seed, route.start, route.goal,
            route.yaw, outcome, seconds, progress, progress / seconds,
            cross_track_rms_m=float(np.sqrt(np.mean(cross**2))),
            cross_track_p95_m=float(np.percentile(cross, 95)),
            cross_track_max_m=float(cross.max()),
            rest_error_m=float(np.linalg.norm(rest)) if outcome == "arrived" else math.nan,
            energy_j_per_m=float(power[:end].sum() * SAMPLE_SECONDS / max(progress, 0.1)),
            propellant_g=float(propellant[:end].sum() * SAMPLE_SECONDS * 1000.0),
            tilt_p95_deg=float(np.percentile(tilt[:end], 95)), tilt_max_deg=float(tilt[:end].max()))


def summarise(rows: Sequence[Traverse]) -> dict[str, Any]:
    """Shares with Wilson intervals, means over arrived traverses with bootstrap intervals.

    Intervals are [low, high] at 95 %.
    """
    count = len(rows)
    outcomes = {name: sum(r.outcome == name for r in rows)
                for name in ("arrived", "fallen", "stuck", "late", "diverged")}
    summary: dict[str, Any] = {"kind": rows[0].kind, "site": rows[0].site, "count": count}
    summary |= outcomes
    summary["arrived_share"] = outcomes["arrived"] / count
    summary["arrived_interval"] = wilson(outcomes["arrived"], count)
    arrived = [asdict(r) for r in rows if r.outcome == "arrived"]
    for key in ("speed_mps", "energy_j_per_m", "propellant_g", "rest_error_m",
                "cross_track_rms_m", "cross_track_p95_m", "tilt_p95_deg", "slip", "sinkage_m"):
        values = np.array([r[key] for r in arrived if r[key] is not None])
        power = 2 if key == "cross_track_rms_m" else 1
        summary[key], summary[key + "_interval"] = _mean(values, power)
    summary["cross_track_max_m"] = max((r["cross_track_max_m"] for r in arrived), default=None)
    summary["tilt_max_deg"] = max((r["tilt_max_deg"] for r in arrived), default=None)
    return summary


def _mean(values: np.ndarray, power: int) -> tuple[float | None, list[float] | None]:
    """Power mean of values [n] and its bootstrap interval over traverses, seed 0."""
    if not values.size:
        return None, None
    drawn = np.random.default_rng(0).integers(0, values.size, (2000, values.size))
    means = np.mean(values[drawn] ** power, axis=1) ** (1.0 / power)
    low, high = np.percentile(means, [2.5, 97.5])
    return float(np.mean(values**power) ** (1.0 / power)), [float(low), float(high)]
