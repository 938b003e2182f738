"""`moonteam evaluate replanning`: new targets appear while the team is under way."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from moonteam import compilation
from moonteam.commands.evaluate_grid import deliver, load_set, options_of
from moonteam.commands.options import Drawn, Limited, Many, Reported, Resumable
from moonteam.errors import InputError
from moonteam.problem.scenario import Scenario

FILES = ("report.json", "summary.csv", "rows.csv", "table.md", "replanning.png")
"""In --out."""


@dataclass(frozen=True)
class Args(Drawn, Limited, Resumable, Reported):
    """The paper's 5 + 5 experiment: each of the first five targets solved makes way for another.

    SET holds scenarios of ten targets, the last five of which appear later; without SET,
    --count scenarios are drawn from --seed (3 agents, 32 x 32). All planners meet the same new
    targets in the same order. The exact planner, which plans anew whenever a target appears,
    is always there to compare with. Options marked "again" may be given several times.

    Files in --out: report.json, summary.csv, rows.csv, table.md and replanning.png; and rows.jsonl,
    to which each plan is added as it is made (a policy's batch as a whole), so that --resume goes
    on.

    Examples:
      moonteam evaluate replanning --count 200
      moonteam evaluate replanning --count 1000 --planner greedy --planner policy --policy pi_5t
      moonteam evaluate replanning ten_targets.jsonl --planner exact --json
    """

    set: tyro.conf.Positional[str | None] = None
    """Scenario set (.jsonl) or the name of a bundled one."""
    planner: Many[tuple[str, ...]] = ()
    """auto, exact, greedy, lns, guided, policy, another package's, or FILE.py:OBJECT; again for
    more rows. Default: exact."""
    objective: Many[tuple[str, ...]] = ()
    """makespan, moves or weighted; again for more rows. Default: makespan."""
    policy: Many[tuple[str, ...]] = ()
    """Policy file (.safetensors) or the name of a bundled policy; again for more. Default:
    any_team."""
    preference: Many[tuple[float, ...]] = ()
    """0 (time) to 1 (effort), for policies that take one; again for more rows."""
    decode: Many[tuple[str, ...]] = ()
    """argmax, plain-argmax (without the deadlock watch) or sample, with @T as in `evaluate grid`;
    again for more rows. Default: argmax."""
    new: int = 5
    """How many of a scenario's targets appear later; without SET, that many more than --targets."""
    time_limit: Many[tuple[float, ...]] = ()
    """Seconds a plan that anytime planners (exact, lns, guided, cpsat, ...) may take; again for
    more rows. Default: theirs."""


def _scenarios(args: Args) -> tuple[list[Scenario], str]:
    """The scenarios and a title."""
    from moonteam.evaluation.draw import Draw

    if args.new < 1:
        raise InputError("--new", f"{args.new} is not allowed; at least 1")
    if args.set is not None:
        found = load_set(args.set, args.limit)
        return found, f"{Path(args.set).stem}, replanning: {len(found)} scenarios"
    found = Draw(args.count, args.seed, args.agents, args.targets + args.new, args.side,
                 args.max_steps).scenarios("replanning")[:args.limit]
    return found, (f"replanning {args.targets} + {args.new}, {args.agents} agents on "
                   f"{args.side}x{args.side}: {len(found)} scenarios")


def run(args: Args) -> int:
    """Evaluates, prints, saves; 0 whatever the planners achieved, 130 if interrupted."""
    compilation.enable_cache()
    from moonteam.evaluation import replanning
    from moonteam.evaluation.contenders import contenders
    from moonteam.report import command, journal

    if any(text.startswith("best-of") for text in args.decode):
        raise InputError("--decode", "best-of-K looks ahead, which nobody can where targets "
                         "appear unannounced; argmax or sample")
    found, title = _scenarios(args)
    rows = contenders(options_of(args))
    kept = journal.Kept.of(args.out, args.resume, command.figures(args))
    document = replanning.evaluate(found, rows, args.new, args.seed, title,
                                   command.line("evaluate replanning", args), kept)
    return deliver(args, document, replanning, "replanning.png")
