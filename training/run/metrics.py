"""What a run writes down while it goes: `metrics.jsonl`, and where else it is asked to.

TensorBoard's events, and a run of Weights & Biases, which is kept in the run folder where
WANDB_MODE is offline: that needs neither network nor account, and `wandb sync` hands it in later.
"""

from __future__ import annotations

import importlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from moonteam import files, interrupts
from moonteam.errors import InputError
from training.run.trainee import Row


class Metrics:
    """Appends one JSON object a chunk to `metrics.jsonl`, and its numbers to what else there is.

    `close` at the end.
    """

    def __init__(self, path: Path, resumed_updates: int, tensorboard: bool = False,
                 earlier: Path | None = None, recipe: dict[str, Any] | None = None):
        """Keeps the lines of an earlier stretch up to `resumed_updates`, drops later ones.

        `earlier`: where that stretch is, if in another file. `recipe`: the run's numbers, for
        Weights & Biases, which is used where it is given.
        Raises InputError if something is asked for whose writer is not installed.
        """
        writer = tensorboard_writer() if tensorboard else None
        self.path, self.events = path, None
        self.biases = None if recipe is None else _begun(path.parent, recipe)
        self.rows = [row for row in read(earlier or path)
                     if row["total_updates"] <= resumed_updates]
        files.write_text(path, "".join(files.dump_json(row) + "\n" for row in self.rows))
        if writer:
            done = self.rows[-1]["env_steps"] if self.rows else 0
            # What an earlier stretch wrote from here on is hidden: it is trained anew.
            self.events = writer(str(path.parent), purge_step=done + 1)

    def add(self, row: Row) -> None:
        """One more line, on disk at once."""
        self.rows.append(row)
        files.append(self.path, files.dump_json(row) + "\n")
        if self.events:
            for name, value in scalars(row).items():
                self.events.add_scalar(name, value, row["env_steps"])
            self.events.flush()
        if self.biases:
            self.biases.log(scalars(row))

    def close(self) -> None:
        """Nothing is added after this."""
        if self.events:
            self.events.close()
        if self.biases:
            with interrupts.kept():
                self.biases.finish()


def tensorboard_writer() -> Any:
    """The class that writes TensorBoard's events. Raises InputError if it is not installed."""
    try:
        from tensorboardX import SummaryWriter
    except ImportError:
        raise InputError("--tensorboard", "needs tensorboardX, which is not installed: "
                         "pip install 'moonteam[tensorboard]'") from None
    return SummaryWriter


def wandb_module() -> Any:
    """Weights & Biases. Raises InputError if it is not installed."""
    try:
        return importlib.import_module("wandb")
    except ImportError:
        raise InputError("--wandb", "needs wandb, which is not installed: pip install "
                         "'moonteam[wandb]'") from None


def _begun(out: Path, recipe: dict[str, Any]) -> Any:
    """A run of Weights & Biases: that of an earlier stretch in the folder goes on.

    Its figures stand over `env_steps`, not over its own counter: what is trained anew after a
    resume is written anew. Raises InputError where it cannot begin.
    """
    wandb = wandb_module()
    earlier = sorted((out / "wandb").glob("*run-*-*"))
    with interrupts.kept():
        try:
            run = wandb.init(
                project=os.environ.get("WANDB_PROJECT", "moonteam"), name=out.name, dir=str(out),
                config=recipe, id=earlier[-1].name.rpartition("-")[2] if earlier else None,
                resume="allow", settings=wandb.Settings(silent=True, console="off"))
        except (wandb.Error, OSError) as error:
            raise InputError("--wandb", f"cannot begin: {str(error).splitlines()[0]}; "
                             "WANDB_MODE=offline needs neither network nor account") from None
    run.define_metric("*", step_metric="env_steps")
    return run


def scalars(row: dict[Any, Any], prefix: str = "") -> dict[str, float]:
    """The numbers of a row by name; those of a held-out score as argmax/success and so on, those of
    a list families/0/success.
    """
    found: dict[str, float] = {}
    for key, value in row.items():
        if isinstance(value, list):
            value = dict(enumerate(value))
        if isinstance(value, dict):
            found |= scalars(value, f"{prefix}{key}/")
        elif isinstance(value, (int, float)):
            found[f"{prefix}{key}"] = value
    return found


def read(path: Path) -> list[Row]:
    """The rows of a metrics file; a half-written last line is left out."""
    rows = []
    for line in files.lines(files.read_text(path)) if path.exists() else []:
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            break
    return rows


def best(rows: list[Row], score: Callable[[Row], float | None]) -> Row | None:
    """The row of the highest score; the last of equals, None where no row has one."""
    scored = [(row, value) for row in rows if (value := score(row)) is not None]
    return max(reversed(scored), key=lambda pair: pair[1], default=(None, 0.0))[0]
