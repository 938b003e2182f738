"""From a record to the report: who solved what, how well each robot drove, what it cost.

All figures come from logged poses and never from what a controller believes. Nothing here
depends on wall-clock time: the same record gives the same report.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
import numpy.typing as npt

from moonteam.problem.mission import Mission, Place
from moonteam.problem.scenario import Cell
from moonteam.robots.base import Height, RobotKind
from moonteam.terrain import soil as soils
from sim2grid.frame import Frame, tilt
from sim2grid.loop.record import Leg, Record
from sim2grid.measure.slip import expected, slip
from sim2grid.measure.ways import WayReport, ways_driven

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Track:
    """One robot's motion. `power` and `propellant_rate` hold over the step that ended then."""

    times: Floats  # [T] s
    xyz: Floats  # [T, 3] m
    tilt: Floats  # [T] rad, between the body's up and the world's
    power: Floats  # [T] W
    propellant_rate: Floats  # [T] kg/s
    qpos: Floats | None = None  # [T, 7 + joints] the robot's own, for its slip


def tracks(record: Record, bases: Sequence[int]) -> list[Track]:
    """Each robot's track; `bases` holds the index of each robot's free joint in qpos."""
    times = np.concatenate(record.times)
    qpos = np.concatenate(record.qpos).astype(np.float64)
    power = np.concatenate(record.power).astype(np.float64)
    rate = np.concatenate(record.propellant).astype(np.float64)
    ends = [min((c for c in bases if c > b), default=qpos.shape[1]) for b in bases]
    return [Track(times, qpos[:, b:b + 3], tilt(qpos[:, b + 3:b + 7]), power[:, i], rate[:, i],
                  qpos[:, b:end])
            for i, (b, end) in enumerate(zip(bases, ends, strict=True))]


def cross_track(track: Track, legs: Sequence[Leg]) -> Floats:
    """Distances [S] m from the straight line of each leg (true start to waypoint).

    One value for each logged moment of each leg that went to another cell.
    """
    parts = []
    for leg in legs:
        along = leg.waypoint - leg.start_xy
        length = float(np.hypot(*along))
        if not leg.moving or length < 1e-9 or leg.end_s is None:
            continue
        during = (track.times > leg.start_s + 1e-9) & (track.times <= leg.end_s + 1e-9)
        offset = track.xyz[during, :2] - leg.start_xy
        parts.append(np.abs(along[0] * offset[:, 1] - along[1] * offset[:, 0]) / length)
    return np.concatenate(parts) if parts else np.zeros(0)


class TargetReport(msgspec.Struct, frozen=True):
    """One target. `distance_m[k]` is how far `robots[k]` stood from the centre when solved."""

    name: str
    at: Place  # in cells
    skills: tuple[str, ...]
    type: str
    solved: bool
    decision: int | None
    time_s: float | None
    robots: tuple[str, ...]
    distance_m: tuple[float, ...]
    expected_s: float | None = None  # by the clock, when the first plan had it solved
    worth: float | msgspec.UnsetType = msgspec.UNSET  # of one that may lapse


class BatteryReport(msgspec.Struct, frozen=True):
    """One robot's power, until the end or until it was lost: start + from_sun - used = end."""

    start_wh: float
    lowest_wh: float
    end_wh: float
    from_sun_wh: float
    used_wh: float
    in_shadow: float | None  # share of the time; null where none passed


class SoilReport(msgspec.Struct, frozen=True):
    """What a robot's way on regolith was to take, by what is known of its kind on that soil
    (`moonteam evaluate paces`) and the slopes along it.
    """

    expected_slip: float | None  # None: it has no wheels
    expected_energy_j: float | None  # None: it did not move


class RobotReport(msgspec.Struct, frozen=True):
    """One robot. Rates and means are null where there was nothing to measure."""

    name: str
    kind: str
    skills: tuple[str, ...]
    final_cell: Cell
    lost: str | None  # the cause
    lost_s: float | None
    moves: int  # joint actions other than stay, as the grid counts them
    arrivals: int
    seconds_per_move: float | None
    cross_track_rms_m: float | None
    cross_track_p95_m: float | None
    timeouts: int
    wrong_cells: int
    wrong_cell_rate: float | None
    max_tilt_deg: float
    slip: float | None  # see sim2grid.slip; null for flyers
    falls: int
    stuck: int
    distance_m: float
    energy_j: float
    propellant_kg: float
    driving_s: float | None = None  # by the clock: on its ways,
    slower_s: float | None = None  # of which so much more than the ground says,
    service_s: float | None = None  # and in services
    ways: tuple[WayReport, ...] | msgspec.UnsetType = msgspec.UNSET  # not in the file without any
    battery: BatteryReport | msgspec.UnsetType = msgspec.UNSET  # not in the file without one
    soil: SoilReport | msgspec.UnsetType = msgspec.UNSET  # nor on rigid ground

    @property
    def expected_slip(self) -> float | None:
        """On regolith, of a robot with wheels."""
        return None if self.soil is msgspec.UNSET else self.soil.expected_slip

    @property
    def expected_energy_j(self) -> float | None:
        """On regolith, of a robot on the ground."""
        return None if self.soil is msgspec.UNSET else self.soil.expected_energy_j


class GridPlan(msgspec.Struct, frozen=True):
    """The same planner on the grid alone: what the mission would cost without physics."""

    success: bool
    makespan: int | None
    moves: int


class Optimum(msgspec.Struct, frozen=True):
    """The first plan beside the certified optimum, see `measure.optimum`."""

    plan_s: float
    optimum_s: float
    plan_steps: int | None = None  # None by the clock
    optimum_steps: int | None = None


class SoilDrawn(msgspec.Struct, frozen=True):
    """The soil of a mission's site, as its seed has drawn it."""

    name: str
    k_phi: float  # N/m^(n+2)
    cohesion_pa: float
    friction_deg: float
    shear_m: float


class Report(msgspec.Struct, frozen=True):
    """`report.json`: everything but wall-clock time, so equal seeds give equal reports."""

    mission: str
    success: bool
    cause: str | None  # of failure
    detail: str
    planner: str
    objective: str | None
    mode: str
    backend: str
    seed: int
    seconds: float
    decisions: int
    moves: int
    grid_plan: GridPlan | None
    inflation: float | None  # decisions over the grid plan's makespan
    replans: dict[str, int]
    targets: tuple[TargetReport, ...]
    robots: tuple[RobotReport, ...]
    expected_s: float | None = None  # by the clock, what the first plan took in all
    optimum: Optimum | None = None  # of a rollout, where it is proved in time
    soil: SoilDrawn | msgspec.UnsetType = msgspec.UNSET  # what it ran on; unset on rigid ground


def target_reports(record: Record, mission: Mission) -> tuple[TargetReport, ...]:
    """What became of each target, those brought by events at the end."""
    solves = {s.target: s for s in record.solves}
    rows = []
    for j, target in enumerate(record.targets):
        solve = solves.get(j)
        rows.append(TargetReport(
            name=record.target_names[j], at=target.at, skills=target.words(),
            type="OR" if target.either else "AND",
            solved=solve is not None,
            decision=solve.decision if solve else None,
            time_s=_round(solve.time_s) if solve else None,
            robots=tuple(mission.robots[i].name for i in solve.robots) if solve else (),
            distance_m=tuple(_round(d) for d in solve.distance_m) if solve else (),
            expected_s=_round(record.expected[j]) if j in record.expected else None,
            worth=target.worth or msgspec.UNSET))
    return tuple(rows)


def robot_report(mission: Mission, robot: int, track: Track, record: Record,
                 frame: Frame, kind: RobotKind | None = None, height: Height | None = None
                 ) -> RobotReport:
    """One robot's figures. Seconds per move are over moves that ended in arrival."""
    own = [leg for leg in record.legs if leg.robot == robot]
    sent = [leg for leg in own if leg.moving and leg.ended in ("arrived", "timeout")]
    arrived = [leg for leg in sent if leg.ended == "arrived"]
    spent = [leg.end_s - leg.start_s for leg in arrived if leg.end_s is not None]
    wrong = sum(leg.end_cell != leg.goal_cell for leg in sent)
    error = cross_track(track, own)
    loss = next((x for x in record.losses if x.robot == robot), None)
    steps = np.diff(track.times)
    x, y = (int(v) for v in frame.cell(np.nan_to_num(track.xyz[-1, :2])))
    spec = mission.robots[robot]
    slipped = None if track.qpos is None or kind is None else slip(kind, track.qpos, height)
    return RobotReport(
        name=spec.name, kind=spec.kind, skills=spec.skills, final_cell=(x, y),
        lost=loss.cause if loss else None, lost_s=_round(loss.time_s) if loss else None,
        moves=sum(leg.action != 4 for leg in own), arrivals=len(arrived),
        seconds_per_move=_round(float(np.mean(spent))) if spent else None,
        cross_track_rms_m=_round(float(np.sqrt(np.mean(error ** 2)))) if len(error) else None,
        cross_track_p95_m=_round(float(np.percentile(error, 95))) if len(error) else None,
        timeouts=sum(leg.ended == "timeout" for leg in sent), wrong_cells=wrong,
        wrong_cell_rate=_round(wrong / len(sent)) if sent else None,
        max_tilt_deg=_round(float(np.degrees(np.nanmax(track.tilt)))),
        slip=_round(slipped) if slipped is not None else None,
        falls=int(loss is not None and loss.cause == "fallen"),
        stuck=int(loss is not None and loss.cause == "stuck"),
        distance_m=_round(float(np.hypot(*np.diff(track.xyz[:, :2], axis=0).T).sum())),
        energy_j=_round(float((track.power[1:] * steps).sum())),
        propellant_kg=_round(float((track.propellant_rate[1:] * steps).sum()), 6),
        ways=(() if kind is None else ways_driven(record, robot, kind.settle, height))
        or msgspec.UNSET,
        battery=battery_report(record, robot), soil=soil_report(mission, kind, track, height),
        **time_spent(record, robot))


def soil_report(mission: Mission, kind: RobotKind | None, track: Track, height: Height | None
                ) -> SoilReport | msgspec.UnsetType:
    """What was to be expected of a robot's way on the mission's soil; unset on rigid ground."""
    pace = None if kind is None or mission.site.ground == "rigid" else (
        kind.paces.get(mission.site.soil))
    if pace is None or track.qpos is None or height is None:
        return msgspec.UNSET
    its, energy = expected(pace, track.qpos, height)
    return SoilReport(None if its is None else _round(its),
                      None if energy is None else _round(energy))


def battery_report(record: Record, robot: int) -> BatteryReport | msgspec.UnsetType:
    """One robot's power; unset where it has no battery."""
    its = record.charges.get(robot)
    if its is None:
        return msgspec.UNSET
    return BatteryReport(
        start_wh=_round(its.start_wh), lowest_wh=_round(its.lowest_wh), end_wh=_round(its.now_wh),
        from_sun_wh=_round(its.gained_wh), used_wh=_round(its.used_wh),
        in_shadow=_round(its.dark_s / its.counted_s) if its.counted_s else None)


def time_spent(record: Record, robot: int) -> dict[str, float | None]:
    """By the clock, where one robot's time went: driving, slower than expected, in services."""
    legs = [leg for leg in record.legs if leg.robot == robot and leg.expected_s is not None]
    if not record.expected:
        return {}
    took = [(leg.end_s or leg.start_s) - leg.start_s for leg in legs]
    slower = [t - leg.expected_s for t, leg in zip(took, legs, strict=True)
              if leg.ended == "arrived" and leg.expected_s is not None]
    served = [record.targets[s.target].service for s in record.solves if robot in s.robots]
    return {"driving_s": _round(sum(took)), "slower_s": _round(sum(slower)),
            "service_s": _round(sum(served))}


def make_report(record: Record, mission: Mission, frame: Frame, bases: Sequence[int], *,
                planner: str, objective: str | None, mode: str, backend: str, seed: int,
                grid_plan: GridPlan | None, kinds: Mapping[str, RobotKind] | None = None,
                height: Height | None = None) -> Report:
    """The whole report; `bases` as in `tracks`, `kinds` by name, `height` as in `slip.slip`.

    Without its kind a robot's slip is not told.
    """
    decisions = len(record.decisions)
    robots = tuple(robot_report(mission, i, track, record, frame,
                                (kinds or {}).get(mission.robots[i].kind), height)
                   for i, track in enumerate(tracks(record, bases)))
    inflation = None
    if record.success and grid_plan is not None and grid_plan.makespan:
        inflation = _round(decisions / grid_plan.makespan)
    return Report(
        mission=mission.name, success=record.success, cause=record.failure,
        detail=record.detail, planner=planner, objective=objective, mode=mode,
        backend=backend, seed=seed, seconds=_round(record.seconds()), decisions=decisions,
        moves=sum(r.moves for r in robots), grid_plan=grid_plan, inflation=inflation,
        replans=dict(sorted(Counter(cause for _, cause in record.replans).items())),
        targets=target_reports(record, mission), robots=robots,
        expected_s=_round(max(record.expected.values())) if record.expected else None,
        soil=soil_drawn(mission))


def soil_drawn(mission: Mission) -> SoilDrawn | msgspec.UnsetType:
    """What a mission's ground is made of; unset where it is rigid."""
    if mission.site.ground == "rigid":
        return msgspec.UNSET
    its = soils.drawn(soils.find(mission.site.soil), mission.site.seed)
    return SoilDrawn(its.name, _round(its.k_phi, 0), _round(its.cohesion, 1),
                     _round(math.degrees(its.friction), 2), _round(its.shear))


def _round(value: float, digits: int = 4) -> float:
    """Rounded for reading: a tenth of a millimetre, a tenth of a millisecond."""
    return round(float(value), digits)
