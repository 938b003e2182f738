"""`moonteam bench grid`: speed of the exact planner and of the grid environment."""

from __future__ import annotations

from dataclasses import dataclass

from moonteam import compilation
from moonteam.commands.options import Many, Reported, Seeded
from moonteam.errors import InputError

FILES = ("bench.json", "table.md")
"""In --out."""


@dataclass(frozen=True)
class Args(Seeded, Reported):
    """Measure the exact planner's median on one core, and environment steps per second.

    The environment is stepped beside JaxMARL's MPE_simple_spread_v3 (if jaxmarl is installed)
    with as many environments and agents, in one interleaved run. Run it on a quiet machine.

    Files in --out: bench.json and table.md.

    Examples:
      moonteam bench grid
      moonteam bench grid --targets 7 --count 50 --envs 4096 --json
    """

    targets: Many[tuple[int, ...]] = ()
    """Number of targets for the planner, up to 12; again for more. Default: 5 to 10."""
    count: int = 200
    """Random scenarios a size: 3 agents, 32 x 32."""
    budget: float = 20.0
    """Seconds that one median may take; it then is of fewer scenarios."""
    envs: int = 1024
    """Environments stepped side by side."""
    agents: int = 3
    """Agents of each environment."""
    env_targets: int = 5
    """Targets of each of our environments."""
    steps: int = 128
    """Steps of one run."""
    repeats: int = 10
    """Runs of each environment, interleaved."""


def check(args: Args) -> None:
    """Raises InputError at the first number that makes no sense."""
    for name in ("count", "envs", "agents", "env_targets", "steps", "repeats"):
        if getattr(args, name) < 1:
            raise InputError(f"--{name.replace('_', '-')}", "at least 1")
    if any(not 1 <= t <= 12 for t in args.targets):
        raise InputError("--targets", "from 1 to 12")
    if args.budget <= 0:
        raise InputError("--budget", f"{args.budget} is not allowed; above 0")


def as_tables(document: dict) -> list[tuple[list[str], list[list[str]]]]:
    """The two tables: titles and rows."""
    from moonteam.report.tables import duration

    at = {(r["targets"], r["objective"], r["what"]): r for r in document["planner"]}
    kinds = list(dict.fromkeys((r["objective"], r["what"]) for r in document["planner"]))
    sizes = sorted({r["targets"] for r in document["planner"]})
    planner = [[f"{objective}, {what}", *(duration(at[size, objective, what]["seconds"])
                                          for size in sizes)] for objective, what in kinds]
    found = document["env"]
    steps = [[name, *(f"{rate[key]:.4g}" for key in ("median", "p10", "p90"))]
             for name, rate in found["env_steps_per_second"].items()]
    if found["ratio"]:
        steps.append(["ratio", *(f"{found['ratio'][key]:.2f}"
                                 for key in ("median", "p10", "p90"))])
    return [(["exact planner, median", *(f"{size} targets" for size in sizes)], planner),
            (["env steps per second", "median", "10 %", "90 %"], steps)]


def run(args: Args) -> int:
    """Measures, prints, saves."""
    check(args)
    compilation.enable_cache()
    from moonteam.evaluation.speed import env_speed, planner_speed
    from moonteam.report import command, provenance, tables

    load = env_speed.Load(args.envs, args.agents, args.steps, args.repeats, args.seed)
    planner = planner_speed.measure(args.targets or (5, 6, 7, 8, 9, 10), args.count, args.budget,
                                    args.seed)
    steps = env_speed.measure(load, args.env_targets)
    beside = (f"jaxmarl {steps['jaxmarl']}" if steps["jaxmarl"] else
              "jaxmarl is not installed, so there is nothing to compare with")
    notes = ["search finds the certified optimum and the routes; plan also writes the joint "
             "actions out and replays them. One core, single calls, first call apart.",
             f"{args.envs} environments of {args.agents} agents, {args.steps} steps a run, "
             f"{args.repeats} runs each, interleaved; ours with {args.env_targets} targets, "
             f"observation, all six rewards and renewal of ended episodes; {beside}."]
    document = {"title": "grid speed", "planner": planner, "env": steps, "notes": notes,
                "meta": provenance.meta(command.line("bench grid", args), args.seed)}
    if args.out:
        tables.save_plain(args.out, "bench", document, as_tables(document))
    tables.print_plain(args, document, as_tables(document))
    return 0
