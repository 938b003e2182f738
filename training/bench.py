"""`moonteam bench train`: how fast this machine trains, and what share of its peak that is."""

from __future__ import annotations

import dataclasses
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from moonteam import files
from moonteam.errors import InputError


@dataclass(frozen=True)
class Args:
    """Training throughput: collection, update and both in env steps a second, compilation apart.

    Times are the best of several repeats of one update from fresh parameters. The share of
    peak counts matrix products only, against the fastest square product measured here.

    Examples:
      moonteam bench train
      moonteam bench train pi_5t --num-envs 256 --num-minibatches 4 --json
    """

    preset: tyro.conf.Positional[str] = "small"
    """Shapes to train with: a preset of `moonteam train`."""
    phase: str = "refinement"
    """bootstrap or refinement."""
    num_envs: int | None = None
    """Environments, if not the preset's."""
    num_minibatches: int | None = None
    """Minibatches, if not the preset's."""
    precision: str | None = None
    """float32, tf32 or bfloat16, if not the preset's."""
    repeats: int = 5
    """Timed repeats; the best counts."""
    json: bool = False
    """One JSON document on standard output."""
    out: Path | None = None
    """Folder for bench_train.json."""


def run(args: Args) -> int:
    """Measures and prints; returns the exit code."""
    row = measure(args)
    if args.out is not None:
        files.write_json(args.out / "bench_train.json", row)
    if args.json:
        print(files.dump_json(row))
        return 0
    shape = row["shape"]
    print(f"{args.preset}, {args.phase}: {shape['num_envs']} environments x {shape['num_steps']} "
          f"steps, {shape['num_agents']} agents, {shape['num_minibatches']} minibatches, "
          f"{shape['update_epochs']} epochs, width {shape['width']}, {shape['precision']}")
    for part in ("collection", "update", "total"):
        timed = row[part]
        print(f"{part:<11}{timed['env_steps_per_s']:>12,.0f} env steps/s"
              f"{timed['seconds'] * 1e3:>10.1f} ms, compiled in {timed['compile_s']:.1f} s")
    print(f"{row['flops_per_env_step'] / 1e6:.2f} MFLOP an env step: {row['achieved_gflops']:.1f} "
          f"of {row['matmul_peak_gflops']:.0f} GFLOP/s measured, "
          f"{100 * row['share_of_peak']:.1f} %")
    print(f"memory: {row['compiled_bytes'] / 2**20:.0f} MiB compiled, peak "
          f"{row['peak_bytes'] / 2**20:.0f} MiB ({row['peak_of']})")
    return 0


def measure(args: Args) -> dict[str, Any]:
    """The JSON document. Raises InputError for an unknown preset, phase or division."""
    import jax

    from moonteam.compilation import enable_cache
    from moonteam.evaluation.provenance import commit
    from training import account, config, loop, networks, rollout, update
    from training.grid_task import GridTask

    chosen = config.preset(args.preset)
    if args.phase not in dict(chosen.phases):
        raise InputError("phase", f"{args.phase!r} is not one of "
                         + ", ".join(name for name, _ in chosen.phases))
    if args.repeats < 1:
        raise InputError("repeats", f"{args.repeats} is not allowed; at least 1")
    given = {"num_envs": args.num_envs, "num_minibatches": args.num_minibatches}
    phase = dataclasses.replace(getattr(chosen, args.phase),
                                **{k: v for k, v in given.items() if v is not None})
    chosen = dataclasses.replace(chosen, **{args.phase: phase})
    if args.precision is not None:
        chosen = dataclasses.replace(chosen, precision=args.precision)
    enable_cache()
    nets = networks.for_spec(chosen.spec, chosen.precision)
    task, hyper = GridTask(chosen.env(phase)), chosen.hyper(phase)
    steps = phase.num_envs * chosen.num_steps

    def begin() -> update.Learner:
        return update.begin(nets, task, hyper, phase.num_envs, jax.random.key(0))

    with networks.matmul_precision(chosen.precision):
        whole = timed(lambda held: update.update(nets, task, hyper, held), begin, args.repeats)
        collect = timed(lambda held: rollout.collect(
            nets, task, held.params, held.carry, held.key, hyper.num_steps), begin, args.repeats)
    peak, peak_of = peak_bytes()
    work = account.flops_per_env_step(chosen)
    parts = {"collection": collect, "total": whole,
             "update": whole | {"seconds": max(whole["seconds"] - collect["seconds"], 1e-9),
                                "compile_s": whole["compile_s"]}}
    for part in parts.values():
        part["env_steps_per_s"] = steps / part["seconds"]
    achieved = work * parts["total"]["env_steps_per_s"] / 1e9
    best = matmul_peak(chosen.precision) / 1e9
    return {
        "preset": args.preset, "phase": args.phase,
        "shape": {"num_envs": phase.num_envs, "num_minibatches": phase.num_minibatches,
                  "num_steps": chosen.num_steps, "num_agents": chosen.num_agents,
                  "num_targets": chosen.num_targets, "obs_size": chosen.spec.obs_size,
                  "update_epochs": chosen.update_epochs, "width": chosen.width,
                  "precision": chosen.precision},
        **{name: {k: v for k, v in part.items() if k != "compiled_bytes"}
           for name, part in parts.items()},
        "compiled_bytes": whole["compiled_bytes"], "peak_bytes": peak, "peak_of": peak_of,
        "flops_per_env_step": work, "achieved_gflops": achieved, "matmul_peak_gflops": best,
        "share_of_peak": achieved / best, "repeats": args.repeats,
        "device": loop.describe_device(), "commit": commit(), "versions": versions()}


def timed(work: Callable[[Any], Any], begin: Callable[[], Any], repeats: int) -> dict[str, Any]:
    """Compiles and runs `work`: seconds of the best repeat, compilation apart."""
    import jax

    held = jax.block_until_ready(begin())
    start = time.perf_counter()
    compiled = jax.jit(work).lower(held).compile()
    compile_s = time.perf_counter() - start
    best = float("inf")
    jax.block_until_ready(compiled(held))
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(compiled(held))
        best = min(best, time.perf_counter() - start)
    memory = compiled.memory_analysis()
    bytes_ = sum(getattr(memory, f"{kind}_size_in_bytes", 0)
                 for kind in ("argument", "output", "temp"))
    return {"seconds": best, "compile_s": compile_s, "compiled_bytes": bytes_}


def matmul_peak(precision: str) -> float:
    """Floating-point operations a second of this device's fastest square product, as measured."""
    import jax
    import jax.numpy as jnp

    from training import networks

    kind = jnp.bfloat16 if precision == "bfloat16" else jnp.float32
    sides = (512, 1024, 2048) if jax.devices()[0].platform == "cpu" else (4096, 8192)
    best = 0.0
    with networks.matmul_precision(precision):
        for side in sides:
            square = jnp.ones((side, side), kind)
            product = jax.jit(lambda a: a @ a)
            jax.block_until_ready(product(square))
            for _ in range(5):
                start = time.perf_counter()
                jax.block_until_ready(product(square))
                best = max(best, 2.0 * side**3 / (time.perf_counter() - start))
    return best


def peak_bytes() -> tuple[int, str]:
    """Peak memory in use so far, and whose: the accelerator's, else the process's."""
    import jax

    stats = jax.devices()[0].memory_stats() or {}
    if "peak_bytes_in_use" in stats:
        return stats["peak_bytes_in_use"], "accelerator"
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit, "process"


def versions() -> dict[str, str]:
    """Versions of what the figures depend on."""
    from importlib.metadata import version

    names = ("moonteam", "jax", "jaxlib", "flax", "optax")
    return {name: version(name) for name in names} | {"python": sys.version.split()[0]}
