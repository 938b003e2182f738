"""`moonteam bench physics`: physics steps a second of both backends."""

from __future__ import annotations

import os
import platform
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from moonteam import files
from moonteam.errors import InputError


@dataclass(frozen=True)
class Args:
    """Steps a second and real-time factor of the three-robot scene on both backends.

    Every pair of a backend and a number of worlds is one row. Compilation is timed apart,
    controllers apart, and for native the physics without controllers too. steps_per_s counts
    the steps of all worlds, controllers included; the real-time factor adds up all worlds.

    Examples:
      moonteam bench physics
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

    samples: int = 129
    """elevation samples along each side of the ground, 0.25 m apart"""

    seconds: float = 3.0
    """of wall clock a measurement"""

    seed: int = 0
    """of the ground"""

    cache: bool = True
    """use the compilation cache on disk; --no-cache times a cold compilation"""

    json: bool = False
    """print one JSON document and nothing else"""

    out: Path | None = None
    """folder for bench_physics.json"""


def run(args: Args) -> int:
    """Measures and prints; 0."""
    if min(args.worlds, default=0) < 1:
        raise InputError("--worlds", "at least one number, each at least 1")
    if not 33 <= args.samples <= 1025:
        raise InputError("--samples", f"{args.samples} is not allowed; 33 to 1025")
    if args.cache:
        from moonteam.compilation import enable_cache

        enable_cache()
    from moonteam.physics import bench

    scene = bench.three_robots(args.site, args.seed, args.samples)
    cpus = len(os.sched_getaffinity(0))
    threads = args.threads or tuple(dict.fromkeys((1, cpus)))
    rows = []
    for name in dict.fromkeys(args.backend):
        for batch in dict.fromkeys(args.worlds):
            for count in threads if name == "native" and batch > 1 else threads[:1]:
                rows.append(bench.measure(scene, name, batch, args.seconds, count))
                if not args.json:
                    _show(rows[-1])
    report = {
        "command": "bench physics", "device": bench.device_name(),
        "cpu": platform.processor() or platform.machine(), "cpus": cpus,
        "site": args.site, "seed": args.seed, "samples": args.samples, "cache": args.cache,
        "nv": scene.model.nv, "dt": scene.model.opt.timestep, "seconds": args.seconds,
        "boulders": len(scene.site.boulders), "rows": rows}
    if args.out is not None:
        files.write_json(args.out / "bench_physics.json", report)
    if args.json:
        print(files.dump_json(report))
    return 0


def _show(row: dict[str, Any]) -> None:
    threads = f", {row['threads']} threads" if "threads" in row else ""
    print(f"{row['backend']}, {row['worlds']} worlds{threads}: {row['steps_per_s']:,.0f} steps/s, "
          f"{row['real_time_factor']:,.1f} times real time, compiled in {row['compile_s']:.1f} s; "
          f"controllers {row['controllers_s']:.4f} s a simulated second"
          + (f"; physics alone {row['physics_steps_per_s']:,.0f} steps/s"
             if "physics_steps_per_s" in row else ""), flush=True)
