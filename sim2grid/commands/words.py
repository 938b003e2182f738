"""A rollout's report in words, for the terminal."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from moonteam.problem.sun import SunPosition
    from sim2grid.measure.metrics import Report


def difference(before: Report, now: Report) -> str:
    """The first figure in which two reports differ."""
    for name in before.__struct_fields__:
        if getattr(before, name) != getattr(now, name):
            if isinstance(getattr(now, name), tuple):
                return f"{name} differ"
            return f"{name} was {getattr(before, name)}, is {getattr(now, name)}"
    return "nothing"


def sunlight(sun: SunPosition | None) -> str:
    """Where the sun stands, to be added to what is said of the ground."""
    if sun is None:
        return ""
    return (f", sun {math.degrees(sun.elevation):.1f} degrees high at azimuth "
            f"{math.degrees(sun.azimuth) % 360:.0f}")


def show(report: Report, timing: dict[str, float], out: Path, video: Path | None) -> None:
    """The report for a person."""
    print(f"{report.mission}: {'success' if report.success else 'FAILED'}"
          + (f" ({report.cause}: {report.detail})" if not report.success else ""))
    grid = report.grid_plan.makespan if report.grid_plan else None
    print(f"  {report.seconds:.1f} s of mission, {report.decisions} decisions"
          + (f" (grid plan: {grid})" if grid is not None else "")
          + f", {report.moves} moves, {report.planner}, {report.mode}, {report.backend}")
    if report.optimum is not None:
        from sim2grid.measure import optimum

        print(f"  at the start: {optimum.words(report.optimum)}")
    for target in report.targets:
        by = ", ".join(f"{name} at {distance:.2f} m" for name, distance
                       in zip(target.robots, target.distance_m, strict=True))
        print(f"  target {target.name:<10} " + (
            f"solved at decision {target.decision}, {target.time_s:.1f} s, by {by}"
            if target.solved else "not solved"))
    for robot in report.robots:
        per_move = "-" if robot.seconds_per_move is None else f"{robot.seconds_per_move:.1f} s"
        print(f"  robot {robot.name:<11} {robot.kind:<8} {robot.moves} moves, {per_move} each, "
              f"{robot.distance_m:.1f} m, tilt to {robot.max_tilt_deg:.0f} deg"
              + (f", LOST: {robot.lost} at {robot.lost_s:.1f} s" if robot.lost else ""))
        if robot.battery:
            its = robot.battery
            print(f"    battery {its.start_wh:.2f} Wh at the start, lowest {its.lowest_wh:.2f}, "
                  f"{its.end_wh:.2f} at the end; {its.from_sun_wh:.2f} from the sun, "
                  f"{its.used_wh:.2f} used"
                  + ("" if its.in_shadow is None else f", {100 * its.in_shadow:.0f} % of the time "
                     "in shadow"))
    if "real_time_factor" in timing:
        print(f"  {timing['compile_s']:.1f} s to compile, then "
              f"{timing['real_time_factor']:.1f} times real time")
    print(f"  {out / 'report.html'}" + (f", {video}" if video else ""))
