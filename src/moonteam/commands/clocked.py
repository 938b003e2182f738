"""What `moonteam plan` does with missions and problems by the clock."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
import numpy.typing as npt

from moonteam import compilation, files
from moonteam.errors import InputError
from moonteam.planners.seconds.base import MS, Moment, TimedPlan, moment, timed_again
from moonteam.planners.seconds.leaving import served
from moonteam.problem.mission import Mission
from moonteam.problem.timed import Metric, Timed, distance

if TYPE_CHECKING:
    from moonteam.onground import OnGround
    from moonteam.planners.kind import PlannerOptions
    from moonteam.planners.seconds.figure import Panel
    from moonteam.terrain.site import Site
    from moonteam.terrain.travel import Roads

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Ground:
    """A mission's ground: what it is asked, its site and its roads."""

    asked: OnGround
    site: Site
    roads: Roads


@dataclass(frozen=True)
class Case:
    """What is to be planned, with the names to print."""

    title: str
    now: Moment
    agents: tuple[str, ...]
    targets: tuple[str, ...]
    places: tuple[tuple[float, float], ...]
    unit: str = "s"
    ground: Ground | None = None


def case_of(found: Mission | Timed) -> Case:
    """The case of a mission on its ground, or of a problem. Raises InputError."""
    if isinstance(found, Timed):
        return Case(found.id or "problem", moment(found),
                    tuple(f"R{i + 1}" for i in range(len(found.agents))),
                    tuple(f"T{j + 1}" for j in range(len(found.targets))),
                    tuple(target.at for target in found.targets),
                    "s" if not found.source else "units")
    ground = ground_of(found)
    return Case(found.name, ground.asked.first(ground.roads), tuple(r.name for r in found.robots),
                tuple(ground.asked.names), tuple(target.at for target in found.targets),
                ground=ground)


def ground_of(mission: Mission) -> Ground:
    """The mission's site, and every kind's ways over it. Raises InputError."""
    from moonteam.onground import OnGround
    from moonteam.robots import team
    from moonteam.terrain.site import for_mission
    from moonteam.terrain.travel import Roads

    if not mission.targets:
        raise InputError(mission.name, "nothing to plan: no target is known at the start; "
                         "moonteam rollout drives it and decides as they come", "targets")
    named, kinds = team.resolve(mission, mission.name)
    if named.clock == "steps" and named.events:
        named = msgspec.structs.replace(named, events=())
    named = msgspec.structs.replace(named, clock="seconds")
    site = for_mission(named, source=mission.name)
    roads = Roads.of_mission(site, named, team.limits(kinds, site))
    its = [kinds[robot.kind] for robot in named.robots]
    asked = OnGround(named, [kind.speed for kind in its], [kind.settle for kind in its])
    return Ground(asked, site, roads)


def make_plan(name: str, options: PlannerOptions, now: Moment) -> TimedPlan:
    """The plan of a planner by the clock. Raises InputError."""
    from moonteam.planners.seconds import registry

    kind = registry.find(name)
    if kind.wants_policy:
        compilation.enable_cache()
    count = int((~now.solved).sum())
    if kind.most_targets is not None and count > kind.most_targets:
        raise InputError(f"--planner {name}", f"{count} targets; it takes up to "
                         f"{kind.most_targets}; use lns")
    return kind.make(options).plan(now)


def document(case: Case, plan: TimedPlan) -> dict[str, Any]:
    """The JSON document: as that of a plan in steps, times in seconds, and the ways."""
    schedule = [{"target": one.target, "agents": list(one.agents), "start": one.start / MS,
                 "end": one.end / MS} for one in plan.services]
    out: dict[str, Any] = {
        "planner": plan.planner, "objective": plan.objective, "status": plan.status,
        "clock": "seconds", "makespan": None if plan.makespan is None else plan.makespan / MS,
        "effort": None if plan.effort is None else plan.effort / MS,
        "bound": None if plan.bound is None else plan.bound / MS, "seconds": plan.seconds,
        "schedule": schedule}
    if plan.status != "infeasible" and len(case.now.optional):
        left, worth, offered = left_out(case.now, plan)
        out |= {"left_out": left, "worth": worth, "offered": offered}
    if case.ground is not None and plan.status != "infeasible":
        out["ways"] = [[{"target": None if one is None else one.target,
                         "points": np.round(points, 3).tolist(), "leaves": leaves,
                         "arrives": arrives}
                        for one, points, leaves, arrives in ways_of(case, plan, i)]
                       for i in range(len(case.agents))]
    return out | ({"reason": plan.reason} if plan.reason else {})


def left_out(now: Moment, plan: TimedPlan) -> tuple[list[int], float, float]:
    """Targets that a plan does not serve, the worth of those that it does, and of all there is."""
    left = set(now.optional.tolist()) - {one.target for one in plan.services}
    assert now.worth is not None
    return sorted(left), served(now, plan.services), float(now.worth[now.optional].sum())


def ways_of(case: Case, plan: TimedPlan, agent: int) -> list[tuple[Any, Floats, float, float]]:
    """An agent's ways: service, points [P, 2] m, seconds at which it leaves and is there.

    The way home is last, with no service at its end.
    """
    assert case.ground is not None
    asked, roads = case.ground.asked, case.ground.roads
    at, place, leaves, found = None, asked.starts[agent], 0.0, []
    for one in plan.route(agent):
        goal = asked.points[one.target]
        way = roads.way(asked.kinds[agent], place, goal)
        took = (case.now.start[agent, one.target] if at is None
                else case.now.between[case.now.classes[agent], at, one.target])
        found.append((one, way.points, leaves, leaves + int(took) / MS))
        at, place, leaves = one.target, goal, one.end / MS
    home = asked.homes[agent]
    if home is not None:
        took = case.now.home_now[agent] if at is None else case.now.home[agent, at]
        points = roads.way(asked.kinds[agent], place, home).points
        found.append((None, points, leaves, leaves + int(took) / MS))
    return found


def show(case: Case, plan: TimedPlan) -> None:
    """The schedule as a table, and what is proved about it."""
    from rich.console import Console

    from moonteam.report.tables import parts, show_rows

    console, unit = Console(), case.unit
    if plan.status == "infeasible":
        console.print(f"{case.title}: no plan: {plan.reason}", soft_wrap=True, highlight=False)
        return
    rows = []
    for one in plan.services:
        x, y = case.places[one.target]
        rows.append([f"{one.start / MS:.1f}", f"{one.end / MS:.1f}", case.targets[one.target],
                     f"{x:g}, {y:g}", parts([case.agents[a] for a in one.agents], "with")])
    times = (f"starts, {unit}", f"ends, {unit}")
    show_rows(console, [*times, "target", "place", "served by"], rows,
              f"{case.title}: {plan.planner}, {plan.objective}, by the clock", times)
    assert plan.makespan is not None
    assert plan.effort is not None
    console.print(f"makespan {plan.makespan / MS:.1f} {unit}, {plan.effort / MS:.1f} {unit} of "
                  "travel in all", soft_wrap=True, highlight=False)
    if len(case.now.optional):
        left, worth, offered = left_out(case.now, plan)
        names = ", ".join(case.targets[j] for j in left) or "nothing"
        console.print(f"serves a worth of {worth:g} of {offered:g}; left out: {names}",
                      soft_wrap=True, highlight=False)
    console.print(verdict(case, plan), soft_wrap=True, highlight=False)
    if plan.reason:
        console.print(f"{plan.planner}: {plan.reason}", soft_wrap=True, highlight=False)


def verdict(case: Case, plan: TimedPlan) -> str:
    """What the plan's status means, in words."""
    where = "in seconds on this ground" if case.ground is not None else "by the clock"
    assert plan.makespan is not None
    if plan.status == "optimal" and len(case.now.optional):
        return f"optimal {where}, {plan.makespan / MS:.1f} {case.unit}: proved that no plan " \
               f"serves more worth, or as much with less {plan.objective}"
    if plan.status == "optimal":
        return f"optimal {where}, {plan.makespan / MS:.1f} {case.unit}: proved that no plan has " \
               f"less {plan.objective}"
    if plan.bound is None:
        return f"feasible {where}: nothing is proved about its {plan.objective}"
    return f"feasible {where}: proved that no plan has less than {plan.bound / MS:.1f} " \
           f"{case.unit} of {plan.objective}"


def draw(path: Path, case: Case, plan: TimedPlan, beside: Mission | None) -> None:
    """The plan as a picture; `beside` is the mission whose plan in steps stands next to it."""
    from moonteam.planners.seconds.figure import draw_panels

    assert case.ground is not None
    panels = [_panel(case, plan, "planned in seconds, driven straight")]
    if beside is not None:
        panels.insert(0, _in_steps(case, beside))
    draw_panels(path, case.title, panels, case.agents, case.targets)


def _panel(case: Case, plan: TimedPlan, title: str) -> Panel:
    from moonteam.planners.seconds.figure import Panel

    assert case.ground is not None
    ways = [[(points, leaves, arrives) for _, points, leaves, arrives in ways_of(case, plan, i)]
            for i in range(len(case.agents))]
    return Panel(title, *_map(case.ground), case.ground.asked.points, case.ground.asked.starts,
                 ways, plan.services, (plan.makespan or 0) / MS)


def _map(ground: Ground) -> tuple[Floats, tuple[float, float, float, float]]:
    """The shaded ground and its box (west, east, south, north) m."""
    from moonteam.terrain.preview import box, hillshade

    return hillshade(ground.site), box(ground.site)


def _in_steps(case: Case, mission: Mission) -> Panel:
    """The plan in steps, its order kept, on Manhattan ways at each kind's speed."""
    from moonteam.planners.base import Snapshot
    from moonteam.planners.exact import ExactPlanner

    assert case.ground is not None
    asked = case.ground.asked
    steps = ExactPlanner().plan(Snapshot.start(mission.scenario()))
    speeds = dict(zip(asked.kinds, asked.speeds.tolist(), strict=True))
    now = asked.first(_Manhattan(speeds))
    services = timed_again(now, [(visit.target, visit.agents) for visit in steps.schedule]) or ()
    plan = TimedPlan("exact", "makespan", "feasible", services,
                     max((one.end for one in services), default=0), 0.0, None, 0.0)
    panel = _panel(Case(case.title, now, case.agents, case.targets, case.places,
                        ground=case.ground), plan, "planned in steps, driven cell by cell")
    corners = [[(np.stack([p[0], [p[-1][0], p[0][1]], p[-1]]), a, b) for p, a, b in ways]
               for ways in panel.ways]
    return msgspec.structs.replace(panel, ways=corners)


@dataclass(frozen=True)
class _Manhattan:
    """Travel along the lattice, as if the ground were level and open."""

    speeds: dict[str, float]
    metric: Metric = "manhattan"

    def matrix(self, kind: str, starts: Floats, to: Floats) -> Floats:
        """Seconds [S, T]."""
        return np.array([[distance((a[0], a[1]), (b[0], b[1]), self.metric) for b in to]
                         for a in starts]) / self.speeds[kind]


def run(args: Any, found: Mission | Timed) -> int:
    """Plans, prints, and draws; 1 if there is no plan."""
    from moonteam.report.progress import busy

    with busy("ways over the ground, then planning; the first time on a machine it compiles"):
        case = case_of(found)
        plan = make_plan(args.planner, args.planner_options(args.seed), case.now)
    made = document(case, plan)
    if args.json:
        print(files.dump_json(made))
    else:
        show(case, plan)
    if args.out is not None:
        files.write_json(args.out / "plan.json", made, indent=0)
        if case.ground is not None and plan.status != "infeasible":
            steps = found if isinstance(found, Mission) and found.clock == "steps" else None
            draw(args.out / "plan.png", case, plan, steps)
    return 1 if plan.status == "infeasible" else 0
