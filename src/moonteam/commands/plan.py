"""`moonteam plan`: one scenario, one planner, the schedule as table, picture and JSON."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import tyro

from moonteam import files, loading
from moonteam.commands.options import Planning, Printed, Saved
from moonteam.errors import InputError
from moonteam.planners.base import Plan, Snapshot
from moonteam.problem import scenario, timed
from moonteam.problem.mission import Mission
from moonteam.problem.scenario import Scenario
from moonteam.problem.skills import held
from moonteam.problem.timed import Timed
from moonteam.report.progress import busy

if TYPE_CHECKING:
    from moonteam.planners.kind import PlannerOptions

FILES = ("plan.json", "plan.png")
"""In --out."""


@dataclass(frozen=True)
class Args(Planning, Saved, Printed):
    """Plan a scenario: who goes where, with whom and when; with a certificate if exact.

    SCENARIO is a scenario file (.json), one line of a set (set.jsonl:INDEX, counted from 0,
    or set.jsonl:ID), a mission (.yaml), or the name of a bundled set or mission.

    Missions and problems by the clock (clock: seconds) are planned in seconds: a mission on its
    ground, with ways at any angle.

    Files in --out: plan.json and plan.png; of a mission in steps planned in seconds, both plans
    side by side.

    Examples:
      moonteam plan scenario.json --objective moves
      moonteam plan 3x7:12 --planner exact --out runs/plan
      moonteam plan assets/testsets/8x40.jsonl:3 --planner lns --time-limit 10
      moonteam plan outpost --objective weighted --alpha 1 --beta 0.05 --json
      moonteam plan outpost --planner policy --decode best-of-16
      moonteam plan outpost --clock seconds --out runs/clock
    """

    scenario: tyro.conf.Positional[str]
    """Scenario, set.jsonl:INDEX or set.jsonl:ID, or mission."""
    planner: str = "exact"
    """auto (exact if that is certified in half of the time, else guided or lns; it says which and
    why), exact (proves its plan the best; up to 12 targets), greedy, lns (large-neighbourhood
    search), guided (in steps; lns that learned what to take out and how to put it back), cpsat and
    routing (need the extra ortools), exhaustive (up to 6 targets), policy, another package's, or
    FILE.py:OBJECT."""
    seed: int = 0
    """Seed of lns, of guided and of a policy that samples."""
    threads: int = 1
    """That lns, guided and auto search with side by side."""
    clock: Literal["steps", "seconds"] | None = None
    """steps: one cell a decision; seconds: a mission on its ground, at any angle, each kind at its
    own speed. Default: as the file says."""

    def planner_options(self, seed: int = 0) -> PlannerOptions:
        """With the threads. Raises InputError naming the option at fault."""
        return replace(super().planner_options(seed), threads=self.threads)


@dataclass(frozen=True)
class Case:
    """A scenario with the names to print."""

    scenario: Scenario
    title: str
    agents: tuple[str, ...]
    targets: tuple[str, ...]


def load_case(name: str) -> Case:
    """The scenario in steps that the command line names. Raises InputError."""
    return case_of(loading.load_one(name))


def case_of(found: Mission | Scenario) -> Case:
    """A scenario in steps with its names."""
    if isinstance(found, Mission):
        return Case(found.scenario(), found.name, tuple(r.name for r in found.robots),
                    tuple(found.target_name(j) for j in range(len(found.targets))))
    return _named(found)


def _named(found: Scenario) -> Case:
    return Case(found, found.id or "scenario",
                tuple(f"R{i + 1}" for i in range(len(found.agents))),
                tuple(f"T{j + 1}" for j in range(len(found.targets))))


def make_plan(args: Args, snapshot: Snapshot) -> Plan:
    """The plan that the chosen planner makes. Raises InputError."""
    from moonteam.planners import registry
    from moonteam.planners.kind import NO_THREADS

    kind = registry.find(args.planner)
    if args.threads > 1 and not kind.parallel:
        raise InputError("--threads", NO_THREADS)
    if kind.wants_policy:
        from moonteam import compilation

        compilation.enable_cache()
    return registry.make(args.planner, args.planner_options(args.seed)).plan(snapshot)


def print_plan(case: Case, plan: Plan, alpha: float, beta: float) -> None:
    """The schedule as a table, and one line about the plan."""
    from rich.console import Console

    from moonteam.report.tables import parts, show_rows

    console = Console()
    if plan.status == "infeasible":
        console.print(f"{case.title}: no plan: {plan.reason}", soft_wrap=True, highlight=False)
        return
    rows = []
    for visit in plan.schedule:
        target = case.scenario.targets[visit.target]
        team = [f"{case.agents[a]} ({held(case.scenario.agents[a].skills)})" for a in visit.agents]
        rows.append([str(visit.step), case.targets[visit.target],
                     f"{target.at[0]}, {target.at[1]}",
                     parts(dict.fromkeys(target.skills), target.type), parts(team, "with")])
    show_rows(console, ["step", "target", "cell", "needs", "solved by"], rows,
              f"{case.title}: {plan.planner}, {plan.objective}", ("step", "cell"))
    walks = (plan.actions != scenario.ACTIONS.index("stay")).sum(0).tolist()
    each = ", ".join(f"{name} {count}" for name, count in zip(case.agents, walks, strict=True))
    console.print(f"makespan {plan.makespan} steps, {plan.moves} moves ({each})",
                  soft_wrap=True, highlight=False)
    console.print(_verdict(plan, alpha, beta), soft_wrap=True, highlight=False)
    if plan.reason:
        console.print(f"{plan.planner}: {plan.reason}", soft_wrap=True, highlight=False)


def _verdict(plan: Plan, alpha: float, beta: float) -> str:
    """What the plan's status means, in words."""
    goal = str(plan.objective)
    if plan.objective == "weighted":
        goal = f"{alpha:g}·makespan + {beta:g}·moves"
    if plan.status == "optimal":
        return f"optimal: proved that no plan has less {goal}"
    if plan.bound is None:
        return f"feasible: nothing is proved about its {goal}"
    return f"feasible: proved that no plan has less than {plan.bound:g} of {goal}"


def run(args: Args) -> int:
    """Plans, prints, and draws; 1 if there is no plan."""
    args.planner_options(args.seed)
    found = loading.load_single(args.scenario)
    clock = args.clock or ("steps" if isinstance(found, Scenario) else found.clock)
    if clock == "seconds":
        from moonteam.commands import clocked

        return clocked.run(args, timed.of(found) if isinstance(found, Scenario) else found)
    if isinstance(found, Timed) or (isinstance(found, Mission) and found.clock == "seconds"):
        raise InputError("--clock steps", f"{args.scenario} is by the clock")
    case = case_of(found)
    with busy("planning; the first time on a machine it compiles for a minute"):
        plan = make_plan(args, Snapshot.start(case.scenario))
    if args.json:
        print(files.dump_json(plan.document()))
    else:
        print_plan(case, plan, args.alpha, args.beta)
    if args.out is not None:
        from moonteam.planners.plans.figure import draw_plan
        from moonteam.robots import shades

        files.write_json(args.out / "plan.json", plan.document(), indent=0)
        draw_plan(args.out / "plan.png", case.scenario, plan, case.title, case.agents,
                  case.targets, shades(case.scenario.blocked or {}))
    return 1 if plan.status == "infeasible" else 0
