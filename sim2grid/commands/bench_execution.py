"""`moonteam bench execution`: missions in physics a second."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from moonteam import compilation
from moonteam.commands.options import Missions, Reported
from moonteam.errors import InputError

if TYPE_CHECKING:
    from sim2grid.loop.fused.deciders import Decider

FILES = ("bench_execution.json", "table.md")
"""In --out."""


@dataclass(frozen=True)
class Args(Missions, Reported):
    """Time random missions in physics, from the policy's decision to the last target.

    fused: decisions, waypoints, controllers and physics of all missions are one jitted program
    on MJX, for accelerators. native and mjx: the executor of `moonteam rollout`, step by step.
    Barrier mode, no events. The real-time factor adds up all missions, each until it was over.
    Compilation is timed apart. Run it on a quiet machine.

    Files in --out: bench_execution.json and table.md.

    Examples:
      moonteam bench execution
      moonteam bench execution --engine fused --missions 1 256 1024 --json
      moonteam bench execution --site flat --side 8 --targets 2 --planner first --markdown
    """

    engine: tuple[Literal["fused", "native", "mjx"], ...] = ("fused", "native")
    """How missions are executed."""
    missions: tuple[int, ...] = (1, 8)
    """How many missions at once."""
    planner: Literal["policy", "network", "first"] = "policy"
    """A policy, an untrained network of the same kind, or all to the first open target."""
    policy: str = "any_team"
    """Policy file (.safetensors) or the name of a bundled policy, for --planner policy."""
    site: Literal["mare", "highland", "crater_rim", "polar", "flat"] = "mare"
    """Preset of the ground."""
    sites: int = 1
    """Sites, with seeds from --site-seed on, that the missions go round; 1: all on one ground."""
    cell: float = 1.0
    """Metres a side of a cell."""
    seconds: float = 600.0
    """Mission seconds after which fused cuts a mission off."""


def run(args: Args) -> int:
    """Measures and prints; 0."""
    if min(args.missions, default=0) < 1:
        raise InputError("--missions", "at least one number, each at least 1")
    if not 1 <= args.sites <= 4096:
        raise InputError("--sites", f"{args.sites} is not allowed; 1 to 4096")
    if not 1.0 <= args.seconds <= 36000.0:
        raise InputError("--seconds", f"{args.seconds:g} is not allowed; 1 to 36000")
    compilation.enable_cache()
    compilation.call_at_once()
    from moonteam.report import tables
    from sim2grid.study import bench
    from sim2grid.study.fleet import Recipe, make_fleet

    decider, params = _decider(args)
    recipe = Recipe(args.site, args.site_seed, args.seed, num_targets=args.targets,
                    side=args.side, cell_m=args.cell, max_steps=args.max_steps,
                    sites=args.sites)
    rows = []
    for count in dict.fromkeys(args.missions):
        fleet = make_fleet(recipe, count)
        rows += [bench.measure(fleet, engine, decider, params, args.max_steps, args.seconds)
                 for engine in dict.fromkeys(args.engine)]
    report = _document(args, rows)
    if args.out is not None:
        tables.save_plain(args.out, "bench_execution", report, [table(report)])
    tables.print_plain(args, report, [table(report)])
    return 0


def _decider(args: Args) -> tuple[Decider, Any]:
    """Who decides, and its parameters. Raises InputError for no such policy."""
    from sim2grid.loop.fused.deciders import FirstOpen, PolicyDecider

    if args.planner == "first":
        return FirstOpen(), None
    if args.planner == "policy":
        from moonteam import paths
        from moonteam.policies.policy import Policy

        policy = Policy.load(paths.find(args.policy, "policies", ".safetensors"))
        return PolicyDecider(policy.brain), policy.params
    import jax

    from moonteam.policies import entity
    from moonteam.policies.brain import EntityBrain

    spec = entity.EntitySpec()
    return PolicyDecider(EntityBrain(spec)), entity.init(spec, jax.random.key(args.seed))


def _document(args: Args, rows: list[dict[str, Any]]) -> dict[str, Any]:
    from moonteam.physics.trials.speed import device_name
    from moonteam.report import command, provenance
    from sim2grid.study.fleet import TEAM

    notes = [
        f"Robots: {', '.join(kind for _, kind in TEAM)}; {args.targets} targets, {args.side} x "
        f"{args.side} cells "
        f"of {args.cell:g} m on "
        + (f"{args.sites} sites of " if args.sites > 1 else "")
        + f"{args.site}; decisions by {args.planner}"
        + (f" {Path(args.policy).stem}." if args.planner == "policy" else "."),
        "fused: one program on MJX for decisions, control and physics. native, mjx: step by step."]
    return {"title": "execution speed", "command": "bench execution", "device": device_name(),
            "rows": rows, "notes": notes,
            "meta": provenance.meta(command.line("bench execution", args), args.seed)}


def table(document: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Titles and rows."""
    titles = ["engine", "missions", "solved", "missions/s", "mission time", "times real time",
              "wall", "CPU", "compiled in", "memory, MB"]
    return titles, [
        [row["engine"], str(row["missions"]), str(row["solved"]), f"{row['missions_per_s']:.3g}",
         f"{row['simulated_s']:,.0f} s", f"{row['real_time_factor']:,.1f}",
         f"{row['wall_s']:.1f} s", f"{row['cpu_s']:.1f} s", f"{row['compile_s']:.1f} s",
         f"{row['peak_memory_mb']:,.0f}"] for row in document["rows"]]
