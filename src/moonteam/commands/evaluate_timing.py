"""`moonteam evaluate timing`: how long planners think, against the number of targets."""

from __future__ import annotations

from dataclasses import dataclass

from moonteam import compilation, files, paths
from moonteam.commands.options import Many, Reported, Seeded

FILES = ("report.json", "timing.csv", "table.md", "timing.png")
"""In --out."""


@dataclass(frozen=True)
class Args(Seeded, Reported):
    """Measure planning time on this machine: exact, greedy and exhaustive search, and a policy.

    Whole plans and single decisions are kept apart, and first calls (compiling) from later
    ones. The text under the table says where the exact planner is faster; it is computed from
    the measurements. The process is kept on one core. Run it on a quiet machine.

    Files in --out: report.json, timing.csv, table.md and timing.png.

    Examples:
      moonteam evaluate timing
      moonteam evaluate timing --planner lns --planner my_planner.py:Mine --time-limit 0.1
      moonteam evaluate timing --policy small --targets 5 --targets 7 --count 20 --json
    """

    targets: Many[tuple[int, ...]] = ()
    """Number of targets; again for more sizes. Default: 3 to 10 and 12."""
    planner: Many[tuple[str, ...]] = ()
    """A registered planner or FILE.py:OBJECT; again for more. Default: exact, greedy,
    exhaustive and policy."""
    objective: Many[tuple[str, ...]] = ()
    """makespan, moves or weighted; again for more. Default: all of exact's, else makespan."""
    time_limit: float | None = None
    """Seconds a plan that anytime planners (exact, lns, guided, cpsat, ...) may take. Default:
    theirs."""
    policy: str | None = None
    """Policy file or bundled policy. A recurrent network is rebuilt, untrained, for each number
    of targets; without a file it is the paper's."""
    count: int = 50
    """Random scenarios a size."""
    agents: int = 3
    """Agents of each scenario."""
    side: int = 32
    """Cells of a side of the map."""
    best_of: int = 16
    """K of the policy's best-of-K plan."""
    budget: float = 10.0
    """Seconds that a planner may spend on a size; it then has fewer calls to take a median of."""


def run(args: Args) -> int:
    """Measures, prints, saves."""
    from moonteam.report import clock

    with clock.one_core() as cores:
        document = _measured(args, cores)
    from moonteam.evaluation import figures
    from moonteam.evaluation.speed import timing
    from moonteam.report import tables

    shown = [timing.pivot(document)]
    if args.out:
        tables.save_plain(args.out, "report", document, shown)
        files.write_text(args.out / "timing.csv", tables.plain_csv(document["rows"]))
        figures.timing(args.out / "timing.png", document)
    tables.print_plain(args, document, shown)
    return 0


def _measured(args: Args, cores: str) -> dict:
    """The report."""
    compilation.enable_cache()
    from moonteam.evaluation.speed import timing
    from moonteam.policies.policy import Policy
    from moonteam.report import command

    sizes = timing.Sizes(args.targets or (3, 4, 5, 6, 7, 8, 9, 10, 12), args.count, args.agents,
                         args.side, budget=args.budget, best_of=args.best_of, seed=args.seed,
                         planners=args.planner or timing.USUAL, objectives=args.objective,
                         time_limit=args.time_limit)
    sizes.check()
    policy = Policy.load(paths.find(args.policy, "policies", ".safetensors")) \
        if args.policy else None
    return timing.evaluate(policy, sizes, command.line("evaluate timing", args), cores)
