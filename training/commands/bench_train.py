"""`moonteam bench train`: how fast this machine trains, and what share of its peak that is."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from moonteam.commands.options import Reported
from moonteam.errors import InputError
from training.bench.measure import Wanted

FILES = ("bench_train.json", "table.md")
"""In --out."""


@dataclass(frozen=True)
class Args(Reported):
    """Training throughput: collection, update and both in env steps a second, compilation apart.

    Times are the best of several repeats of one update from fresh parameters, spread over all
    devices; on a CPU each core counts as one (JAX_NUM_CPU_DEVICES=1 goes back to one). The
    share of peak counts matrix products only, against the fastest square product measured here.

    A preset of macro-decisions (quick, paper_team, any_team) is measured on its first family, once
    by branches and once by the critic; the unit is a decision of the team.

    With --jaxmarl the learner runs beside JaxMARL's published mappo_rnn_mpe loop instead: on its
    env, with its numbers and networks of its shapes, in turns, each in a process of its own. With a
    preset of macro-decisions too, our side is that preset by the critic, on its own problems:
    what can be compared then is the network's work done in a second.

    Files in --out: bench_train.json and table.md.

    Examples:
      moonteam bench train
      moonteam bench train pi_5t --num-envs 256 --num-minibatches 4 --json
      git clone https://github.com/FLAIROx/JaxMARL
      moonteam bench train --jaxmarl JaxMARL --repeats 3
      moonteam bench train quick
      moonteam bench train quick --jaxmarl JaxMARL --repeats 3
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
    precision: Literal["float32", "tf32", "bfloat16"] | None = None
    """Of matrix products, if not the preset's."""
    updates: int = 2
    """Updates in one timed run beside JaxMARL."""
    repeats: int = 5
    """Timed repeats; the best counts."""
    @property
    def wanted(self) -> Wanted:
        """What is measured."""
        return Wanted(**{f.name: getattr(self, f.name) for f in dataclasses.fields(Wanted)})


def run(args: Args) -> int:
    """Measures and prints; returns the exit code."""
    from moonteam.report import command, tables
    from training.bench import macro, ours, peer
    from training.mappo.macro.config import PRESETS

    if args.repeats < 1:
        raise InputError("repeats", f"{args.repeats} is not allowed; at least 1")
    made_by = command.line("bench train", args)
    if args.jaxmarl is None and args.preset in PRESETS:
        document = macro.measure(args.wanted, made_by)
        shown = [macro.table(document)]
    elif args.jaxmarl is None:
        document = ours.measure(args.wanted, made_by)
        shown = [ours.table(document)]
    else:
        document = peer.measure(args.wanted, args.jaxmarl, made_by)
        shown = [peer.table(document)]
    if args.out is not None:
        tables.save_plain(args.out, "bench_train", document, shown)
    tables.print_plain(args, document, shown)
    return 0
