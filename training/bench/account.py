"""What a run will take, from its numbers alone: parameters, memory, floating-point operations.

Nothing is allocated: shapes come from `jax.eval_shape`.
"""

from __future__ import annotations

import dataclasses
import io
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from moonteam.errors import InputError
from moonteam.policies import recurrent
from training.mappo import networks, rollout, update
from training.mappo.config import Config, Phase
from training.mappo.grid_task import GridTask
from training.mappo.hyper import Hyper
from training.mappo.networks import Networks
from training.mappo.update import Learner

GIB = 2**30


def describe(config: Config, compiled: bool = False) -> dict[str, Any]:
    """The dry run's document: the run's numbers, and what they add up to.

    `compiled` adds what XLA sets aside, for which both phases are compiled.
    """
    params = jax.eval_shape(lambda: recurrent.init(config.spec, jax.random.key(0)))
    phases = {name: phase_account(config, phase) for name, phase in config.phases}
    for name, phase in config.phases if compiled else ():
        phases[name]["compiled_bytes"] = compiled_bytes(config, phase)
    return {
        "config": dataclasses.asdict(config), "phases": phases,
        "h100": {p: roofline(config, list(phases.values()), p) for p in PEAK_FLOPS},
        "env_steps": sum(row["env_steps"] for row in phases.values()),
        "flops": sum(row["env_steps"] * row["flops_per_env_step"] for row in phases.values()),
        "kernel_parameters": {name: recurrent.kernel_count(tree) for name, tree in params.items()}
        | {"total": recurrent.kernel_count(params)},
        "parameters": sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(params))}


def phase_account(config: Config, phase: Phase) -> dict[str, Any]:
    """Totals, work and memory of one phase."""
    return {
        "env_steps": config.env_steps(phase),
        "gradient_steps": phase.updates * config.update_epochs * phase.num_minibatches,
        "environments_per_minibatch": phase.num_envs // phase.num_minibatches,
        "flops_per_env_step": flops_per_env_step(config),
        "memory_bytes": memory(config, phase)}


def flops_per_env_step(config: Config) -> int:
    """Matrix products of all agents for one env step: once to act, thrice an epoch to learn.

    A forward pass is two operations a kernel parameter; its gradient costs two more passes.
    """
    params = jax.eval_shape(lambda: recurrent.init(config.spec, jax.random.key(0)))
    forward = 2 * recurrent.kernel_count(params) * config.num_agents
    return forward * (1 + 3 * config.update_epochs)


def memory(config: Config, phase: Phase) -> dict[str, int]:
    """Bytes of each large buffer, each counted in full as if none were ever reused.

    rollout: what collection stores. targets: advantages, value targets and next values.
    minibatch: one gathered part with the activations that its gradient keeps, of both networks,
    since nothing makes one wait for the other. learner: parameters, gradients, both Adam moments,
    environment states, memory.
    """
    nets, task, _, learner = _shapes(config, phase)
    batch = jax.eval_shape(lambda held: rollout.collect(
        nets, task, held.params, held.carry, jax.random.key(0), config.num_steps)[1], learner)
    stored = _bytes(batch)
    scalars = 4 * config.num_steps * phase.num_envs * config.num_agents
    rows = config.num_steps * phase.num_envs // phase.num_minibatches * config.num_agents
    inputs = config.spec.obs_size * (1 + config.num_agents)
    kept = rows * 4 * (inputs + 2 * ACTIVATIONS * config.width)
    parts = {"rollout": stored, "targets": 4 * scalars,
             "minibatch": (stored + 4 * scalars) // phase.num_minibatches + kept,
             "learner": 2 * _bytes(learner)}
    return parts | {"total": sum(parts.values())}


ACTIVATIONS = 18
"""Width-sized float32 arrays a row at the height of one network's gradient. Kept from the way
forth: embedding (2), memory before, r, z, n and the candidate's product (5), output (1), mix (2).
Made on the way back: the gradients of the output (1), of the recurrent products (3), of n (1) and
of the gates (3)."""


def compiled_bytes(config: Config, phase: Phase) -> int:
    """What XLA sets aside for a chunk of updates on one device of this machine.

    Compiles the chunk, runs nothing and allocates nothing: arguments, results and everything
    between, as its buffer assignment has it. Raises InputError where XLA does not say.
    """
    nets, task, hyper, learner = _shapes(config, phase)
    with networks.matmul_precision(config.precision):
        found = set_aside(update.compiled(nets, task, hyper, learner, config.chunk_updates))
    if found is None:
        raise InputError("--compiled", "XLA does not say what it sets aside on "
                         f"{jax.default_backend()}; leave it out")
    return found


def set_aside(program: jax.stages.Compiled) -> int | None:
    """Bytes of a program's arguments, results and all between, what it is donated counted once;
    None where XLA does not say.
    """
    found = program.memory_analysis()
    return None if found is None else (
        found.argument_size_in_bytes + found.output_size_in_bytes
        - found.alias_size_in_bytes + found.temp_size_in_bytes)


def _shapes(config: Config, phase: Phase) -> tuple[Networks, GridTask, Hyper, Learner]:
    """What the learner of a phase is made of, itself as shapes alone."""
    nets = networks.for_spec(config.spec, config.precision)
    task, hyper = GridTask(config.env(phase)), config.hyper(phase)
    return nets, task, hyper, jax.eval_shape(
        lambda: update.begin(nets, task, hyper, phase.num_envs, jax.random.key(0)))


PEAK_FLOPS = {"float32": 66.9e12, "tf32": 494.7e12, "bfloat16": 989.4e12}
"""Dense matrix products of an H100 SXM, operations a second, from its data sheet."""
BANDWIDTH = 3.35e12
"""Of its memory, bytes a second, from the same."""
LAUNCH_S, KERNELS = 3e-6, 12
"""What a kernel launched in a loop costs at least, and how many a recurrent step of both networks
takes, forth (2 each) and back (4 each): assumed, not measured."""


def roofline(config: Config, phases: list[dict[str, Any]], precision: str) -> dict[str, float]:
    """Seconds that a whole run cannot be under on an H100 SXM, part by part; an estimate.

    compute: matrix products at the data sheet's peak. traffic: each minibatch with its
    activations written and read once. launches: of the recurrent steps of every gradient step,
    which follow one another.
    """
    steps = sum(row["gradient_steps"] for row in phases)
    return {
        "compute": sum(row["env_steps"] * row["flops_per_env_step"] for row in phases)
        / PEAK_FLOPS[precision],
        "traffic": sum(row["gradient_steps"] * 2 * row["memory_bytes"]["minibatch"]
                       for row in phases) / BANDWIDTH,
        "launches": steps * config.num_steps * KERNELS * LAUNCH_S}


def _bytes(tree: Any) -> int:
    total = 0
    for leaf in jax.tree.leaves(tree):
        kind = leaf.dtype
        size = 8 if jnp.issubdtype(kind, jax.dtypes.prng_key) else np.dtype(kind).itemsize
        total += math.prod(leaf.shape) * size
    return total


def as_text(config: Config, table: dict[str, Any]) -> str:
    """The dry run as a table for people."""
    from rich.console import Console
    from rich.table import Table

    console = Console(width=100, record=True, file=io.StringIO())
    grid = Table(title=f"moonteam train {config.name}")
    grid.add_column("")
    for name, _ in config.phases:
        grid.add_column(name, justify="right")
    for label, values in _rows(config, table):
        grid.add_row(label, *values)
    console.print(grid)
    return console.export_text() + "\n".join(_totals(config, table))


def _rows(config: Config, table: dict[str, Any]) -> list[tuple[str, list[str]]]:
    phases = [phase for _, phase in config.phases]
    accounts = list(table["phases"].values())
    weights = [dataclasses.asdict(phase.weights) for phase in phases]
    rows = [
        ("updates", [f"{p.updates:,}" for p in phases]),
        ("environments", [f"{p.num_envs:,}" for p in phases]),
        ("minibatches", [f"{p.num_minibatches}" for p in phases]),
        ("environments a minibatch", [f"{a['environments_per_minibatch']:,}" for a in accounts]),
        ("steps between updates", [f"{config.num_steps}" for _ in phases]),
        ("learning rate, to 0", [f"{p.lr:g}" for p in phases]),
        ("entropy bonus", [f"{p.ent_coef:g}" for p in phases]),
        ("seeds in the paper", [f"{p.seeds}" for p in phases]),
        *((f"weight {term}", [f"{w[term]:g}" for w in weights]) for term in weights[0]),
        ("env steps", [f"{a['env_steps']:.4g}" for a in accounts]),
        ("gradient steps", [f"{a['gradient_steps']:,}" for a in accounts])]
    for part in accounts[0]["memory_bytes"]:
        rows.append((f"memory: {part}, GiB",
                     [f"{a['memory_bytes'][part] / GIB:.3f}" for a in accounts]))
    if "compiled_bytes" in accounts[0]:
        rows.append((f"set aside by XLA ({jax.default_backend()}), GiB",
                     [f"{a['compiled_bytes'] / GIB:.3f}" for a in accounts]))
    return rows


def _totals(config: Config, table: dict[str, Any]) -> list[str]:
    kernels = table["kernel_parameters"]
    work = next(iter(table["phases"].values()))["flops_per_env_step"]
    later = f", {config.replanning} more later" if config.replanning else ""
    return [
        f"team: {config.num_agents} agents, {config.num_targets} targets{later}, "
        f"{config.num_skills} skills, map {config.size[0]} x {config.size[1]}, "
        f"{config.max_steps} steps, C_AR {config.approach_decay:g}",
        f"learner: gamma {config.gamma:g}, lambda {config.gae_lambda:g}, clip {config.clip_eps:g}, "
        f"{config.update_epochs} epochs, value {config.vf_coef:g}, gradient norm "
        f"{config.max_grad_norm:g}, {config.precision}",
        f"env steps: {table['env_steps']:,} ({table['env_steps']:.4g})",
        f"kernel parameters: actor {kernels['actor']:,} + critic {kernels['critic']:,} = "
        f"{kernels['total']:,}; all parameters {table['parameters']:,}",
        f"floating-point operations: {work / 1e6:.1f} M an env step, {table['flops']:.3g} in all",
        *(f"H100 SXM, {precision}, estimated and not measured: {parts['compute'] / 60:.1f} min of "
          f"products at peak, {parts['traffic'] / 60:.1f} of memory traffic, "
          f"{parts['launches'] / 60:.1f} of kernel launches" for precision, parts
          in table["h100"].items())]
