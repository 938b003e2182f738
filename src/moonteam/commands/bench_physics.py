"""`moonteam bench physics`: physics steps a second of both backends."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from moonteam import compilation
from moonteam.commands.options import Reported
from moonteam.errors import InputError

if TYPE_CHECKING:
    from moonteam.physics.scene import Scene

FILES = ("bench_physics.json", "table.md")
"""In --out."""


@dataclass(frozen=True)
class Args(Reported):
    """Steps a second and real-time factor of the three-robot scene on both backends.

    Every pair of a backend and a number of worlds is one row. steps_per_s counts the steps of
    all worlds, controllers included, physics_steps_per_s without them; the real-time factor
    adds up all worlds. With --compilation the time to compile is taken in fresh processes too,
    without and with the cache. Run it on a quiet machine.

    Files in --out: bench_physics.json and table.md.

    Examples:
      moonteam bench physics
      moonteam bench physics --compilation --markdown
      moonteam bench physics --backend native --worlds 1 64 --threads 1 2 --json
      moonteam bench physics --backend mjx --worlds 1 1024 --out runs/bench
    """

    backend: tuple[Literal["native", "mjx"], ...] = ("native", "mjx")
    """which engines"""

    worlds: tuple[int, ...] = (1, 32)
    """how many worlds at once"""

    threads: tuple[int, ...] = ()
    """of the native engine; default: one, and all CPUs"""

    site: str = "mare"
    """preset of the ground"""

    ground: tuple[Literal["rigid", "regolith"], ...] = ("rigid",)
    """rigid, or regolith that wheels and feet sink into; or both, in turn"""

    samples: int = 129
    """elevation samples along each side of the ground, 0.25 m apart"""

    sites: int = 1
    """sites that the worlds go round, with seeds from --seed on; 1: all worlds on one ground"""

    seconds: float = 3.0
    """of wall clock a measurement"""

    seed: int = 0
    """of the ground"""

    compilation: bool = False
    """time the compilation for one world in fresh processes, cold and from the cache"""



def run(args: Args) -> int:
    """Measures and prints; 0."""
    if min(args.worlds, default=0) < 1:
        raise InputError("--worlds", "at least one number, each at least 1")
    if not 1 <= args.sites <= 4096:
        raise InputError("--sites", f"{args.sites} is not allowed; 1 to 4096")
    if not 33 <= args.samples <= 1025:
        raise InputError("--samples", f"{args.samples} is not allowed; 33 to 1025")
    if min(args.threads, default=1) < 1:
        raise InputError("--threads", "each at least 1")
    compilation.enable_cache()
    compilation.call_at_once()
    from moonteam.physics.trials import speed
    from moonteam.report.tables import plain_markdown, print_as, save_plain

    scenes = {ground: speed.own_robots(args.site, args.seed, args.samples, args.sites, ground)
              for ground in dict.fromkeys(args.ground)}
    rows = []
    for name, batch, threads in _loads(args):
        for ground, scene in scenes.items():
            rows.append({"ground": ground}
                        | speed.measure(scene, name, batch, args.seconds, threads))
            if not (args.json or args.markdown):
                _show(rows[-1])
    site = ["--site", args.site, "--samples", str(args.samples), "--seed", str(args.seed)]
    compiled = [speed.compile_times(name, 1, site)
                for name in dict.fromkeys(args.backend)] if args.compilation else []
    report = _document(args, next(iter(scenes.values())), rows, compiled)
    if args.out is not None:
        save_plain(args.out, "bench_physics", report, tables(report))
    print_as(args, report, lambda: plain_markdown(report, tables(report)),
             lambda: _show_compiled(compiled))
    return 0


def _loads(args: Args) -> Iterator[tuple[str, int, int]]:
    """Backend, worlds and threads of each row."""
    threads = args.threads or tuple(dict.fromkeys((1, len(os.sched_getaffinity(0)))))
    for name in dict.fromkeys(args.backend):
        for batch in dict.fromkeys(args.worlds):
            for count in threads if name == "native" and batch > 1 else threads[:1]:
                yield name, batch, count


def _document(args: Args, scene: Scene, rows: list[dict], compiled: list[dict]) -> dict[str, Any]:
    from moonteam.physics.trials import speed
    from moonteam.report import command, provenance
    from moonteam.robots.base import CONTROL_PERIOD

    model, most = scene.model, max(len(site.boulders) for site in scene.sites)
    notes = [
        f"Three robots (nv {model.nv}) driving on "
        + (f"{args.sites} sites of " if args.sites > 1 else "")
        + f"{args.site}, {args.samples} x {args.samples} "
        f"heights, {most} boulders, physics step "
        f"{1000 * model.opt.timestep:g} ms, controllers every {1000 * CONTROL_PERIOD:g} ms, "
        f"{args.seconds:g} s a row.",
        "Steps and real-time factor of all worlds together. CPU: processor seconds for one "
        "simulated second of one world. Memory: most that the process had so far."]
    return {
        "title": "physics speed", "command": "bench physics", "device": speed.device_name(),
        "cpus": len(os.sched_getaffinity(0)), "site": args.site, "seed": args.seed,
        "samples": args.samples, "nv": model.nv, "dt": model.opt.timestep,
        "seconds": args.seconds, "sites": args.sites, "boulders": most, "rows": rows,
        "compilation": compiled, "notes": notes,
        "meta": provenance.meta(command.line("bench physics", args), args.seed)}


def tables(document: dict[str, Any]) -> list[tuple[list[str], list[list[str]]]]:
    """Titles and rows: speeds, and times to compile if they were taken."""
    grounds = len({row["ground"] for row in document["rows"]}) > 1
    titles = ["engine", *(["ground"] if grounds else []), "worlds", "threads", "steps/s",
              "physics alone", "controllers add", "times real time", "CPU", "memory, MB"]
    rows = [[row["backend"], *([row["ground"]] if grounds else []), str(row["worlds"]),
             str(row.get("threads", "")),
             f"{row['steps_per_s']:,.0f}", f"{row['physics_steps_per_s']:,.0f}",
             f"{100 * row['controllers_add']:.0f} %", f"{row['real_time_factor']:,.1f}",
             f"{row['cpu_s']:.4f} s", f"{row['peak_memory_mb']:,.0f}"]
            for row in document["rows"]]
    out = [(titles, rows)]
    if document["compilation"]:
        out.append((["compilation, one world", "cold", "from the cache"],
                    [[row["backend"], f"{row['cold_s']:.1f} s", f"{row['cached_s']:.1f} s"]
                     for row in document["compilation"]]))
    return out


def _show_compiled(compiled: list[dict[str, Any]]) -> None:
    for row in compiled:
        print(f"{row['backend']}, {row['worlds']} worlds: compiled in {row['cold_s']:.1f} s, "
              f"from the cache in {row['cached_s']:.1f} s")


def _show(row: dict[str, Any]) -> None:
    threads = f", {row['threads']} threads" if "threads" in row else ""
    print(f"{row['backend']}, {row['ground']}, {row['worlds']} worlds{threads}: "
          f"{row['steps_per_s']:,.0f} steps/s, "
          f"{row['real_time_factor']:,.1f} times real time, compiled in {row['compile_s']:.1f} s; "
          f"physics alone {row['physics_steps_per_s']:,.0f} steps/s, controllers add "
          f"{100 * row['controllers_add']:.0f} %; {row['cpu_s']:.4f} s of CPU a simulated second "
          f"of a world; memory {row['peak_memory_mb']:,.0f} MB", flush=True)
