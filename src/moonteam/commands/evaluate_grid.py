"""`moonteam evaluate grid`: planners and policies side by side on a set of scenarios."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

import tyro

from moonteam import compilation, files, paths, scenario
from moonteam.errors import InputError
from moonteam.scenario import Scenario

Many = tyro.conf.UseAppendAction


@dataclass(frozen=True)
class Args:
    """Play a set of scenarios with any number of planners and compare them with the optimum.

    One row a planner and objective, or a policy and decoding: success, slack metrics and
    their ratios, true gaps in makespan and moves, planning time, with bootstrap intervals.
    Every plan is played in the grid environment; what it says counts, not the planner's
    promise. Failures count with T = max_steps and the moves they made. Options marked "again"
    may be given several times.

    Examples:
      moonteam evaluate grid 3r5t --planner exact --planner greedy --limit 200
      moonteam evaluate grid set.jsonl --planner exact --objective makespan --objective moves
      moonteam evaluate grid small --planner policy --policy small --decode argmax
      --decode best-of-16 --out runs/small
    """

    set: tyro.conf.Positional[str]
    """Scenario set (.jsonl), scenario (.json), or the name of a bundled set."""
    planner: Many[tuple[str, ...]] = ()
    """exact, greedy, lns, exhaustive, cpsat or policy; again for more rows. Default: exact."""
    objective: Many[tuple[str, ...]] = ()
    """makespan, moves or weighted; again for more rows. Default: makespan."""
    policy: Many[tuple[str, ...]] = ()
    """Policy file (.safetensors) or the name of a bundled policy; again for more."""
    preference: Many[tuple[float, ...]] = ()
    """0 (time) to 1 (effort), for policies that take one; again for more rows."""
    decode: Many[tuple[str, ...]] = ()
    """argmax, plain-argmax (without the deadlock watch), sample, best-of-K such as best-of-16;
    again for more rows. Default: argmax."""
    temperature: float = 1.0
    """Of sampling: below 1 is bolder, above 1 more random."""
    alpha: float = 1.0
    """Weight of the makespan in the objective weighted."""
    beta: float = 0.05
    """Weight of the moves in the objective weighted."""
    time_limit: float | None = None
    """Seconds a scenario that anytime planners may take; theirs by default."""
    seed: int = 0
    """Seed of sampling and of the bootstrap."""
    limit: int | None = None
    """Only the first so many scenarios of the set."""
    json: bool = False
    """Print the report as one JSON document and nothing else."""
    markdown: bool = False
    """Print the table as Markdown and nothing else."""
    out: Path | None = None
    """Folder for report.json, summary.csv, rows.csv, table.md and gaps.png."""


def command_line(name: str, words: list[str], options: dict[str, object]) -> str:
    """The command that makes this report again; options at their default are left out."""
    for key, value in options.items():
        for one in value if isinstance(value, tuple) else (value,):
            if one is not None:
                words += [f"--{key}", str(one)]
    return shlex.join(["moonteam", *name.split(), *words])


def load_set(name: str, limit: int | None) -> list[Scenario]:
    """The scenarios of a file or bundled set. Raises InputError naming file and line."""
    if limit is not None and limit < 1:
        raise InputError("--limit", f"{limit} is not allowed; at least 1")
    suffix = ".json" if name.endswith(".json") else ".jsonl"
    found = scenario.load_set(paths.find(name, "testsets", suffix))
    return found[:limit]


def run(args: Args) -> int:
    """Evaluates, prints, saves; 0 whatever the planners achieved."""
    compilation.enable_cache()
    from moonteam.evaluation import figures, grid, report
    from moonteam.evaluation.contenders import Options, contenders

    found = load_set(args.set, args.limit)
    options = Options(
        planners=args.planner or ("exact",), objectives=args.objective or ("makespan",),
        policies=[paths.find(p, "policies", ".safetensors") for p in args.policy],
        preferences=args.preference, decodes=args.decode or ("argmax",),
        temperature=args.temperature, alpha=args.alpha, beta=args.beta,
        time_limit=args.time_limit, seed=args.seed)
    rows = contenders(options)
    command = command_line("evaluate grid", [args.set], {
        "planner": options.planners, "objective": args.objective, "policy": args.policy,
        "preference": args.preference, "decode": args.decode,
        "temperature": args.temperature if args.temperature != 1.0 else None,
        "time-limit": args.time_limit, "seed": args.seed or None, "limit": args.limit})
    title = f"{Path(args.set).stem}: {len(found)} scenarios"
    document = grid.evaluate(found, rows, args.seed, title, command)
    if args.out:
        report.save(args.out, document, grid.PAGE)
        figures.bars(args.out / "gaps.png", document, grid.PANELS)
    if args.json:
        print(files.dump_json(document))
    elif args.markdown:
        print(report.markdown(document, grid.PAGE))
    else:
        report.show(document, grid.COLUMNS)
    return 0
