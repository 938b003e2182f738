"""`moonteam check planner`: what a planner must keep, one line a check."""

from __future__ import annotations

from dataclasses import dataclass

import tyro

from moonteam.commands.options import Planning, Printed, Seeded
from moonteam.files import dump_json


@dataclass(frozen=True)
class Args(Planning, Seeded, Printed):
    """Try a planner: legal actions, whole plans, lost robots, new targets, closed ground, seeds.

    PLANNER is a registered one, or FILE.py:OBJECT. Exit code 0 if it keeps every promise, 1 if
    it breaks one.

    Examples:
      moonteam check planner lns
      moonteam check planner examples/nearest_planner.py:NearestPlanner --json
    """

    planner: tyro.conf.Positional[str]
    """A registered planner, or FILE.py:OBJECT."""


def run(args: Args) -> int:
    """Prints a line a check; 1 if one failed."""
    from moonteam.compilation import enable_cache
    from moonteam.planners import contract, registry

    enable_cache()
    results = contract.check(args.planner, args.planner_options(args.seed))
    kept = sum(result.passed for result in results)
    passed = kept == len(results)
    if args.json:
        print(dump_json({"planner": registry.shown(args.planner), "passed": passed, "checks": [
            {"name": r.name, "passed": r.passed, "problem": r.problem} for r in results]}))
        return 0 if passed else 1
    wide = max(len(result.name) for result in results)
    for result in results:
        print(f"{'passed' if result.passed else 'FAILED'}  {result.name:<{wide}}  "
              f"{result.problem}".rstrip())
    print(f"{registry.shown(args.planner)}: {kept} of {len(results)} promises kept")
    return 0 if passed else 1
