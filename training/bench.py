"""`moonteam bench train`: how fast this machine trains, and what share of its peak that is."""

from __future__ import annotations

import dataclasses
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from moonteam import files
from moonteam.errors import InputError

if TYPE_CHECKING:
    from training.update import Learner


@dataclass(frozen=True)
class Args:
    """Training throughput: collection, update and both in env steps a second, compilation apart.

    Times are the best of several repeats of one update from fresh parameters, spread over all
    devices; on a CPU each core counts as one (JAX_NUM_CPU_DEVICES=1 goes back to one). The
    share of peak counts matrix products only, against the fastest square product measured here.

    With --jaxmarl the learner runs beside JaxMARL's published mappo_rnn_mpe loop instead: on its
    env, with its numbers and networks of its shapes, in turns, each in a process of its own.

    Examples:
      moonteam bench train
      moonteam bench train pi_5t --num-envs 256 --num-minibatches 4 --json
      git clone https://github.com/FLAIROx/JaxMARL
      moonteam bench train --jaxmarl JaxMARL --repeats 3
    """

    preset: tyro.conf.Positional[str] = "small"
    """Shapes to train with: a preset of `moonteam train`."""
    phase: str = "refinement"
    """bootstrap or refinement."""
    jaxmarl: Path | None = None
    """A checkout of JaxMARL, whose loop is run beside ours instead of a preset."""
    num_envs: int | None = None
    """Environments, if not the preset's; beside JaxMARL 256 if not given."""
    num_minibatches: int | None = None
    """Minibatches, if not the preset's or JaxMARL's."""
    precision: str | None = None
    """float32, tf32 or bfloat16, if not the preset's."""
    updates: int = 2
    """Updates in one timed run beside JaxMARL."""
    repeats: int = 5
    """Timed repeats; the best counts."""
    json: bool = False
    """One JSON document on standard output."""
    markdown: bool = False
    """The table as Markdown and nothing else."""
    out: Path | None = None
    """Folder for bench_train.json."""


def run(args: Args) -> int:
    """Measures and prints; returns the exit code."""
    from moonteam.evaluation.report import print_plain
    from training import bench_peer

    if args.repeats < 1:
        raise InputError("repeats", f"{args.repeats} is not allowed; at least 1")
    if args.jaxmarl is None:
        document = measure(args)
        tables = [table(document)]
    else:
        document = bench_peer.measure(args, args.jaxmarl)
        tables = [bench_peer.table(document)]
    if args.out is not None:
        files.write_json(args.out / "bench_train.json", document)
    print_plain(args, document, tables)
    return 0


def command(args: Args) -> str:
    """The words that measure this again."""
    from moonteam.evaluation import provenance

    return provenance.command("bench train", args, ("json", "markdown", "out"), ("preset",))


def table(document: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Titles and rows: collection, update, both."""
    rows = [[part, f"{document[part]['env_steps_per_s']:,.0f}",
             f"{document[part]['seconds'] * 1e3:.1f}", f"{document[part]['compile_s']:.1f}"]
            for part in ("collection", "update", "total")]
    return [document["title"], "env steps/s", "ms", "compiled in, s"], rows


def measure(args: Args) -> dict[str, Any]:
    """The JSON document. Raises InputError for an unknown preset, phase or division."""
    import jax

    from moonteam.compilation import enable_cache
    from moonteam.evaluation import provenance
    from training import account, config, loop, networks, rollout, sharding, update
    from training.grid_task import GridTask

    chosen = config.preset(args.preset)
    if args.phase not in dict(chosen.phases):
        raise InputError("phase", f"{args.phase!r} is not one of "
                         + ", ".join(name for name, _ in chosen.phases))
    given = {"num_envs": args.num_envs, "num_minibatches": args.num_minibatches}
    phase = dataclasses.replace(getattr(chosen, args.phase),
                                **{k: v for k, v in given.items() if v is not None})
    chosen = dataclasses.replace(chosen, **{args.phase: phase})
    if args.precision is not None:
        chosen = dataclasses.replace(chosen, precision=args.precision)
    enable_cache()
    sharding.use_all_cores()
    nets = networks.for_spec(chosen.spec, chosen.precision)
    task, hyper = GridTask(chosen.env(phase)), chosen.hyper(phase)
    steps = phase.num_envs * chosen.num_steps
    mesh = sharding.mesh_for([phase.num_envs // phase.num_minibatches])

    def begin() -> Learner:
        return update.shared(mesh, update.begin(nets, task, hyper, phase.num_envs,
                                                jax.random.key(0)))

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
    document = {
        "title": f"{args.preset}, {args.phase}", "preset": args.preset, "phase": args.phase,
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
        "device": loop.describe_device(), "meta": provenance.meta(command(args), 0)}
    return document | {"notes": _notes(document)}


def _notes(document: dict[str, Any]) -> list[str]:
    shape = document["shape"]
    return [
        f"{shape['num_envs']} environments x {shape['num_steps']} steps, {shape['num_agents']} "
        f"agents, {shape['num_minibatches']} minibatches, {shape['update_epochs']} epochs, width "
        f"{shape['width']}, {shape['precision']}; {document['device']}; best of "
        f"{document['repeats']}",
        f"{document['flops_per_env_step'] / 1e6:.2f} MFLOP an env step: "
        f"{document['achieved_gflops']:.1f} of {document['matmul_peak_gflops']:.0f} GFLOP/s "
        f"measured, {100 * document['share_of_peak']:.1f} %",
        f"memory: {document['compiled_bytes'] / 2**20:.0f} MiB compiled, peak "
        f"{document['peak_bytes'] / 2**20:.0f} MiB ({document['peak_of']})"]


def compiled(work: Callable[[Any], Any], held: Any, spread: Any = None) -> tuple[Any, float, int]:
    """The program of `work(held)`, the seconds that it took to compile, the bytes it works in.

    `spread`: an array whose devices the program is for.
    """
    import jax

    from training import account, sharding

    with sharding.mesh_of(jax.numpy.zeros(()) if spread is None else spread):
        start = time.perf_counter()
        program = jax.jit(work).lower(held).compile()
        took = time.perf_counter() - start
    return program, took, account.set_aside(program) or 0


def timed(work: Callable[[Any], Any], begin: Callable[[], Learner],
          repeats: int) -> dict[str, Any]:
    """Compiles and runs `work`: seconds of the best repeat, compilation apart."""
    import jax

    held = jax.block_until_ready(begin())
    program, compile_s, bytes_ = compiled(work, held, held.carry.reset_before)
    jax.block_until_ready(program(held))
    best = min(seconds(lambda: program(held)) for _ in range(repeats))
    return {"seconds": best, "compile_s": compile_s, "compiled_bytes": bytes_}


def seconds(work: Callable[[], Any]) -> float:
    """How long `work` takes until its result is there."""
    import jax

    start = time.perf_counter()
    jax.block_until_ready(work())
    return time.perf_counter() - start


def matmul_peak(precision: str) -> float:
    """Floating-point operations a second of the fastest square product measured, all devices.

    On a CPU one product already has all cores; accelerators are taken to be alike.
    """
    import jax
    import jax.numpy as jnp

    from training import networks

    kind = jnp.bfloat16 if precision == "bfloat16" else jnp.float32
    on_cpu = jax.devices()[0].platform == "cpu"
    best = 0.0
    with networks.matmul_precision(precision):
        for side in (512, 1024, 2048) if on_cpu else (4096, 8192):
            square = jnp.ones((side, side), kind)
            product = jax.jit(lambda a: a @ a)
            jax.block_until_ready(product(square))
            best = max(best, *(2.0 * side**3 / seconds(lambda: product(square))  # noqa: B023
                               for _ in range(5)))
    return best if on_cpu else best * len(jax.devices())


def peak_bytes() -> tuple[int, str]:
    """Peak memory in use so far, and whose: the accelerator's, else the process's."""
    import jax

    stats = jax.devices()[0].memory_stats() or {}
    if "peak_bytes_in_use" in stats:
        return stats["peak_bytes_in_use"], "accelerator"
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit, "process"
