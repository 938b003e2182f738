"""How fast our learner trains on this machine, and what share of its peak that is."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

from moonteam.errors import InputError, not_one_of
from training.bench.measure import Wanted, matmul_peak, peak_bytes, timed

if TYPE_CHECKING:
    from training.mappo.update import Learner


def table(document: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Titles and rows: collection, update, both."""
    rows = [[part, f"{document[part]['env_steps_per_s']:,.0f}",
             f"{document[part]['seconds'] * 1e3:.1f}", f"{document[part]['compile_s']:.1f}"]
            for part in ("collection", "update", "total")]
    return [document["title"], "env steps/s", "ms", "compiled in, s"], rows


def measure(args: Wanted, command: str) -> dict[str, Any]:
    """The JSON document; `command` are the words that measure it again.

    Raises InputError for an unknown preset, phase or division.
    """
    import jax

    from moonteam.compilation import enable_cache
    from moonteam.report import provenance
    from training import sharding
    from training.bench import account
    from training.mappo import config, networks, rollout, update
    from training.mappo.grid_task import GridTask
    from training.mappo.macro.config import PRESETS as MACRO

    chosen = config.preset(args.preset, tuple(MACRO))
    if args.phase not in dict(chosen.phases):
        raise InputError("phase", not_one_of(args.phase, dict(chosen.phases)))
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
        "device": sharding.describe_device(), "meta": provenance.meta(command, 0)}
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
