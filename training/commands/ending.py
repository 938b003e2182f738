"""What the commands that train share: the options of a run, and its end."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from moonteam import files, interrupts, outputs
from moonteam.commands.options import Printed, RunFolder, Seeded
from moonteam.report.command import Aside
from training.run.machine import FILES, Diverged, Run
from training.sharding import join, use_all_cores


@dataclass(frozen=True, kw_only=True)
class Watched(RunFolder, Printed):
    """How a run is kept and watched."""

    checkpoint_seconds: Aside[float] = 30.0
    """Seconds from one checkpoint to the next, at most; a chunk of updates is never cut."""
    tensorboard: Aside[bool] = False
    """Write the metrics as TensorBoard events into the run folder too; needs
    pip install 'moonteam[tensorboard]'."""
    wandb: Aside[bool] = False
    """Hand the metrics to Weights & Biases too; needs pip install 'moonteam[wandb]'. With
    WANDB_MODE=offline in the environment they stay in the run folder, for `wandb sync`."""
    dry_run: Aside[bool] = False
    """Print what would be trained, its numbers and files; train and compile nothing."""

    def folder(self, name: str, seed: int) -> Path:
        """That given, or the one that this run is known by.

        Raises InputError if TensorBoard or Weights & Biases is asked for and missing, before
        anything is written.
        """
        if self.tensorboard:
            from training.run.metrics import tensorboard_writer

            tensorboard_writer()
        if self.wandb:
            from training.run.metrics import wandb_module

            wandb_module()
        return self.out or Path("runs") / f"{name}-{seed}"

    def holding(self, out: Path) -> AbstractContextManager[None]:
        """Holds the run folder for this process. Raises InputError if it holds another run."""
        return outputs.folder(out, FILES, force=self.force, resume=self.resume)


@dataclass(frozen=True, kw_only=True)
class Together:
    """Several processes that train as one."""

    coordinator: str = ""
    """host:port of process 0, to train on several hosts; each runs this command."""
    processes: int = 1
    """Processes that train together."""
    process: int = 0
    """Number of this one, from 0; others than 0 write to OUT/process-N."""

    def join(self) -> None:
        """Makes all cores devices and meets the other processes, if there are to be any.

        Raises InputError if they do not come together.
        """
        use_all_cores()
        if self.coordinator:
            join(self.coordinator, self.processes, self.process)

    def own(self, out: Path) -> Path:
        """The folder that this process writes to."""
        return out / f"process-{self.process}" if self.coordinator and self.process else out


@dataclass(frozen=True, kw_only=True)
class Taught(Seeded, Watched):
    """The same for imitation and refinement."""

    checkpoint_seconds: Aside[float] = 60.0
    """Seconds from one checkpoint to the next, at most; it holds all labelled states, and a round
    is never cut."""


def complete(run: Run, json: bool) -> int:
    """Trains to the end, or until stopped, and reports; returns the exit code."""
    try:
        with interrupts.postponed() as stop:
            finished = run.train(stop)
    except KeyboardInterrupt:
        following = run.position.total_updates + 1
        print(f"moonteam: interrupted before {run.trainee.unit} {following} was done; {run.kept}; "
              f"go on with --out {run.out} --resume", file=sys.stderr)
        return interrupts.CODE
    except Diverged as error:
        print(f"moonteam: {error}", file=sys.stderr)
        return 1
    if not finished:
        return interrupted(run.trainee.unit, run.position.total_updates, run.out)
    report = run.finish()
    shown = report | {"out": str(run.out), "config": run.trainee.recipe}
    return ended(shown, run.trainee.lines(report), run.out, json)


def interrupted(unit: str, updates: int, out: Path) -> int:
    """Says where a run stands that was stopped; returns the exit code."""
    print(f"moonteam: interrupted after {unit} {updates}, saved; go on with --out {out} --resume",
          file=sys.stderr)
    return interrupts.CODE


def ended(report: dict[str, Any], lines: Sequence[str], out: Path, json: bool) -> int:
    """Prints what a run came to; returns the exit code."""
    if json:
        print(files.dump_json(report))
    *before, spent = lines
    print(*before, f"{spent}; policy, curve and report in {out}", sep="\n",
          file=sys.stderr if json else sys.stdout)
    return 0
