"""`moonteam check robot`: what a kind of robot must keep, one line a check."""

from __future__ import annotations

from dataclasses import dataclass

import tyro

from moonteam.commands.options import Printed
from moonteam.files import dump_json


@dataclass(frozen=True)
class Args(Printed):
    """Try a kind of robot: model, standing, 10 m on level ground, limits, batches, both engines.

    ROBOT is the name of a registered kind, or FILE.py:OBJECT. Takes about a minute, most of it
    compiling for MJX. Exit code 0 if all checks pass, 1 if one fails.

    Examples:
      moonteam check robot my-rover
      moonteam check robot examples/scout/scout.py:SCOUT --json
    """

    robot: tyro.conf.Positional[str]
    """Name of a registered kind, or FILE.py:OBJECT."""


def run(args: Args) -> int:
    """Prints a line a check as it ends; 1 if one failed."""
    from moonteam.robots import KINDS

    kind = KINDS.get(args.robot)
    from moonteam.compilation import call_at_once, enable_cache

    enable_cache()
    call_at_once()
    from moonteam.physics.trials.conformance import CHECKS, Check, check

    wide = max(map(len, CHECKS))

    def say(done: Check) -> None:
        if not args.json:
            print(f"{'passed' if done.passed else 'FAILED'}  {done.name:<{wide}}  {done.detail}",
                  flush=True)

    checks = check(kind, say)
    passed = all(done.passed for done in checks)
    if args.json:
        print(dump_json({"robot": kind.name, "passed": passed,
                         "checks": [done.document() for done in checks]}))
    else:
        print(f"{kind.name}: " + ("conforms" if passed else "does not conform"))
    return 0 if passed else 1
