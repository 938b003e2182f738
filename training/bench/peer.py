"""Our learner beside the mappo_rnn_mpe loop of a JaxMARL checkout: same env, network, numbers.

The numbers come from the checkout's own config. Each side lives in a process of its own, so that
devices, memory and what one of them imports do not touch the other; they run in turns, and the
process that waits does nothing. Nothing of JaxMARL is kept here: its file is loaded and called.
"""

from __future__ import annotations

import contextlib
import multiprocessing
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from moonteam import files
from moonteam.errors import InputError
from training.bench import peer_process
from training.bench.measure import Wanted
from training.bench.peer_process import LOOP, Load, Recipe
from training.mappo.macro.config import PRESETS

CONFIG = Path("baselines/MAPPO/config/mappo_homogenous_rnn_mpe.yaml")
OURS, THEIRS = "moonteam", "JaxMARL mappo_rnn_mpe"
NUM_ENVS = 256
"""Where their config has 16: too few for either side to fill a machine."""


@dataclass
class Side:
    """A process that waits to run its updates."""

    name: str
    process: Any
    pipe: Any

    def ask(self, word: str) -> Any:
        """What it answers. Raises InputError if it cannot go on."""
        try:
            self.pipe.send(word)
            kind, answer = self.pipe.recv()
        except (EOFError, BrokenPipeError):
            self.process.join()
            raise InputError(self.name, f"its process ended with {self.process.exitcode}") from None
        if kind == "problem":
            raise InputError(*answer)
        return answer


def recipe(checkout: Path, num_envs: int | None, num_minibatches: int | None) -> Recipe:
    """The numbers of the checkout's config. Raises InputError if they, or the loop, are missing."""
    import yaml

    if not (checkout / LOOP).is_file():
        raise InputError(checkout, f"not a checkout of JaxMARL: {LOOP} is missing; get one with "
                         "git clone https://github.com/FLAIROx/JaxMARL", "--jaxmarl")
    source = checkout / CONFIG
    try:  # its floats are written as 2e-3, which YAML takes for text
        found = msgspec.convert(yaml.safe_load(files.read_text(source)), Recipe, strict=False)
    except (msgspec.ValidationError, yaml.YAMLError) as error:
        raise InputError(source, " ".join(str(error).split())) from None
    found = msgspec.structs.replace(
        found, num_envs=NUM_ENVS if num_envs is None else num_envs,
        num_minibatches=found.num_minibatches if num_minibatches is None else num_minibatches)
    if min(found.num_envs, found.num_minibatches) < 1 or found.num_envs % found.num_minibatches:
        raise InputError("num_minibatches", f"{found.num_envs} environments do not divide into "
                         f"{found.num_minibatches} minibatches")
    if found.fc_dim_size != found.gru_hidden_dim or not found.anneal_lr:
        raise InputError(source, "layers of one width and an annealed rate are what can be matched")
    return found


def measure(args: Wanted, checkout: Path, command: str) -> dict[str, Any]:
    """The JSON document. Raises InputError for what is missing or does not fit."""
    from moonteam.report import provenance
    from moonteam.report.progress import say, track

    macro = args.preset in PRESETS
    for name in ("phase", "precision") if macro else ("preset", "phase", "precision"):
        if getattr(args, name) != getattr(Wanted(), name):
            raise InputError(name, "has no meaning beside JaxMARL, whose shapes are taken")
    if args.updates < 1:
        raise InputError("updates", f"{args.updates} is not allowed; at least 1")
    numbers = recipe(checkout, args.num_envs, args.num_minibatches)
    load = Load(checkout.resolve(), numbers, args.updates, args.preset if macro else "")
    with _sides(load) as sides:
        rows = []
        for side in sides:  # one after the other, so that compilation has the machine
            say(f"compiling {side.name}")
            rows.append({"name": side.name, **side.ask("begin"), "seconds_of_each": []})
        for i in track(range(args.repeats), "updates", args.repeats):
            turns = list(zip(sides, rows, strict=True))
            for side, row in reversed(turns) if i % 2 else turns:  # who goes first alternates
                row["seconds_of_each"].append(side.ask("run"))
        for side, row in zip(sides, rows, strict=True):
            row["peak_bytes"], row["peak_of"] = side.ask("end")
    for row in rows:
        _add_rates(row, args.updates, numbers)
    make = _beside_macro if macro else _document
    return make(rows, numbers, load, args.repeats) | {"meta": provenance.meta(command, 0)}


@contextlib.contextmanager
def _sides(load: Load) -> Iterator[list[Side]]:
    """Both processes, ended on the way out."""
    context, sides = multiprocessing.get_context("spawn"), []
    try:
        own = peer_process.macro if load.preset else peer_process.ours
        for name, serve in ((OURS, own), (THEIRS, peer_process.theirs)):
            here, there = context.Pipe()
            process = context.Process(target=peer_process.serve, args=(there, serve, load),
                                      daemon=True)
            process.start()
            there.close()
            sides.append(Side(name, process, here))
        yield sides
    finally:
        for side in sides:
            side.pipe.close()
            side.process.join(5.0)
            if side.process.is_alive():
                side.process.terminate()


def _add_rates(row: dict[str, Any], updates: int, numbers: Recipe) -> None:
    """Seconds of an update in the best run, without beginning, and what follows from them.

    An env step of macro-decisions is a decision; its side says how many, and their work.
    """
    row["seconds"] = max(min(row["seconds_of_each"]) - row["begin_s"], 1e-9) / updates
    row["env_steps_per_s"] = row.get("steps", numbers.num_envs * numbers.num_steps) / row["seconds"]
    row["flops_per_env_step"] = row["flops"] if "flops" in row else (
        2 * (1 + 3 * numbers.update_epochs) * sum(
            kernels * count for kernels, count in zip(
                row["kernel_parameters"].values(), row["networks_per_env_step"].values(),
                strict=True)))
    row["achieved_gflops"] = row["flops_per_env_step"] * row["env_steps_per_s"] / 1e9


def _document(rows: list[dict[str, Any]], numbers: Recipe, load: Load,
              repeats: int) -> dict[str, Any]:
    ours, theirs = rows
    each = [b / a for a, b in zip(ours["seconds_of_each"], theirs["seconds_of_each"], strict=True)]
    ratio = ours["env_steps_per_s"] / theirs["env_steps_per_s"]
    notes = [
        f"{numbers.env_name}, {ours['num_agents']} agents, observations of {ours['obs_size']}, "
        f"{numbers.num_envs} environments x {numbers.num_steps} steps, {numbers.update_epochs} "
        f"epochs, {numbers.num_minibatches} minibatches; actor and critic each Dense, GRU, Dense "
        f"of {numbers.gru_hidden_dim} and a head; critic input: all agents' observations in order.",
        f"env steps/s: {ratio:.2f} times theirs (best of {repeats} runs of {load.updates} updates "
        f"each; run by run {min(each):.2f} to {max(each):.2f}). Compilation apart, and so is what "
        "their loop does before its first update.",
        "The critic's input is the same for every agent: ours runs it once for the team, theirs "
        "once for each agent, which is all of the difference in MFLOP an env step.",
        "Ours deals fresh starts out of a pool drawn once a rollout, theirs resets every "
        "environment at every step. Running out of time counts as an end in both.",
        "Both keep freed memory (glibc's mallopt), which JaxMARL alone does not do.",
        *(f"{row['name']}: {note}" for row in rows for note in row["notes"])]
    return {"title": "training beside JaxMARL", "rows": rows, "ratio": ratio,
            "ratio_of_each_run": each, "repeats": repeats, "updates": load.updates,
            "shape": msgspec.to_builtins(numbers) | {
                "num_agents": ours["num_agents"], "obs_size": ours["obs_size"],
                "critic_input": ours["num_agents"] * ours["obs_size"],
                "num_actions": ours["num_actions"]},
            "jaxmarl_commit": theirs["commit"], "notes": notes}


def _beside_macro(rows: list[dict[str, Any]], numbers: Recipe, load: Load,
                  repeats: int) -> dict[str, Any]:
    """Unlike problems and networks: only the work of the networks can be put side by side."""
    ours, theirs = rows
    ratio = ours["achieved_gflops"] / theirs["achieved_gflops"]
    notes = [
        f"Ours decides for the team at an event, theirs for each agent at every step of "
        f"{numbers.env_name} ({numbers.num_envs} environments x {numbers.num_steps} steps, "
        f"{numbers.update_epochs} epochs, {numbers.num_minibatches} minibatches).",
        f"At the same network work, which is what GFLOP/s count, ours collects and learns "
        f"{ratio:.2f} times as much a second (best of {repeats} runs of {load.updates} updates).",
        *(f"{row['name']}: {note}" for row in rows for note in row["notes"])]
    return {"title": "training beside JaxMARL", "rows": rows, "ratio": ratio, "repeats": repeats,
            "updates": load.updates, "preset": load.preset, "shape": msgspec.to_builtins(numbers),
            "jaxmarl_commit": theirs["commit"], "notes": notes}


def table(document: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Titles and rows, a side a column."""
    sides = document["rows"]

    def line(title: str, write: Callable[[dict[str, Any]], str]) -> list[str]:
        return [title, *map(write, sides)]

    return ["", *(side["name"] for side in sides)], [
        line("env steps/s", lambda side: f"{side['env_steps_per_s']:,.0f}"),
        line("seconds an update", lambda side: f"{side['seconds']:.2f}"),
        line("MFLOP an env step", lambda side: f"{side['flops_per_env_step'] / 1e6:.2f}"),
        line("GFLOP/s", lambda side: f"{side['achieved_gflops']:.1f}"),
        line("compiled (or read from the cache) in, s", lambda side: f"{side['compile_s']:.1f}"),
        line("arrays of the program, MiB", lambda side: f"{side['compiled_bytes'] / 2**20:,.0f}"
             if side["compiled_bytes"] else "-"),
        line("peak of the " + sides[0]["peak_of"] + ", MiB",
             lambda side: f"{side['peak_bytes'] / 2**20:,.0f}"),
        line("devices", lambda side: side["device"])]
