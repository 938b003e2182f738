"""`moonteam evaluate preference`: one policy from time to effort, beside the exact trade-off."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from moonteam import compilation, paths
from moonteam.commands.evaluate_grid import load_set
from moonteam.commands.options import Limited, Reported, Seeded
from moonteam.errors import InputError

FILES = ("report.json", "table.md", "preference.png")
"""In --out."""


@dataclass(frozen=True)
class Args(Seeded, Limited, Reported):
    """Sweep a policy's preference from 0 (time) to 1 (effort): mean makespan against mean moves.

    Beside it stand the exact planner's points for the same weights, certified optimal plans of
    the same scenarios (up to 12 targets).

    Files in --out: report.json, table.md and preference.png.

    Examples:
      moonteam evaluate preference 3x7 --policy any_team --limit 200 --out runs/preference
      moonteam evaluate preference 3x5 --policy any_team --decode best-of-16 --points 5 --json
    """

    set: tyro.conf.Positional[str]
    """Scenario set (.jsonl), scenario (.json), or the name of a bundled set."""
    policy: str
    """Policy file (.safetensors) or the name of a bundled policy; of kind entity."""
    decode: str = "argmax"
    """As in `evaluate grid`; best-of-K keeps what the preference asks for."""
    points: int = 11
    """Preferences, evenly from 0 to 1."""


def run(args: Args) -> int:
    """Evaluates, prints, saves."""
    if args.points < 2:
        raise InputError("--points", f"{args.points} is not allowed; at least 2")
    compilation.enable_cache()
    from moonteam.evaluation import figures, preference
    from moonteam.planners import decode
    from moonteam.policies.policy import Policy
    from moonteam.report import command, tables

    how = decode.parse(args.decode)
    found = load_set(args.set, args.limit)
    policy = Policy.load(paths.find(args.policy, "policies", ".safetensors"))
    if not policy.brain.prefers:
        raise InputError(policy.path, "takes no preference: its network is of kind "
                         f"{policy.source.kind}")
    wishes = [round(i / (args.points - 1), 6) for i in range(args.points)]
    title = f"{Path(args.set).stem}: {len(found)} scenarios, preference from time to effort"
    document = preference.evaluate(found, policy, how, wishes, args.seed, title,
                                   command.line("evaluate preference", args))
    shown = [preference.pivot(document)]
    if args.out:
        tables.save_plain(args.out, "report", document, shown)
        figures.preference(args.out / "preference.png", document)
    tables.print_plain(args, document, shown)
    return 0
