"""One run of whatever is trained: chunk by chunk, looked at from outside between two of them.

Everything random descends from the seed and travels in the trainee's state, so a run that was
stopped and resumed, at any chunk, ends with the same bits as one that never stopped.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import msgspec
import numpy as np

from moonteam import compilation, files, interrupts, outputs
from moonteam.errors import InputError
from moonteam.interrupts import Stop
from moonteam.policies.policy_file import save_policy
from moonteam.report.progress import bar
from moonteam.report.provenance import commit
from training.run import checkpoints
from training.run.checkpoints import About
from training.run.metrics import Metrics, best
from training.run.trainee import Position, Row, Trainee
from training.sharding import anywhere, describe_device, gather

FILES = ("config.json", "metrics.jsonl", "checkpoints", "policy.safetensors", "report.json",
         "curve.png", "beside.png", "events.out.tfevents.*",
         "wandb")
"""Of a run folder."""


class Diverged(Exception):
    """Training produced something that is not a number, or a policy that lost what it could;
    says which checkpoint is good.
    """


class Run:
    """One training in one folder.

    `config.json`, `metrics.jsonl`, `checkpoints/` and, at the end, `policy.safetensors`,
    `report.json` and `curve.png`.
    """

    def __init__(self, trainee: Trainee, out: Path, resume: bool,
                 checkpoint_seconds: float = 30.0, stop_on_collapse: bool = True,
                 tensorboard: bool = False, begin: Path | None = None, force: bool = False,
                 wandb: bool = False):
        """`begin`: a checkpoint of another run, to go on from with this one's numbers. `force`: an
        earlier run in the folder is removed. `tensorboard`, `wandb`: the metrics go there too.

        Raises InputError if the folder holds a run that this one may not go on with, or `begin`
        is no checkpoint that it could begin with.
        """
        self.trainee, self.out, self.checkpoint_seconds = trainee, out, checkpoint_seconds
        self.stop_on_collapse = stop_on_collapse
        # Of the code that is loaded now, whatever is checked out later.
        self.commit = commit() or "unknown"
        self.folder = out / "checkpoints"
        if force and begin is not None and begin.resolve().is_relative_to(out.resolve()):
            raise InputError("--begin", f"{begin} is in the folder that --force would empty")
        self.position = self._find(resume, force) if begin is None else self._begun(
            begin, resume, force)
        if force:
            outputs.clear(out, FILES)
        self.metrics = Metrics(out / "metrics.jsonl", self.position.total_updates, tensorboard,
                               begin and begin.parent.parent / "metrics.jsonl",
                               trainee.recipe if wandb else None)
        self.last_saved, self.saved = time.monotonic(), self.position.total_updates
        self.last_good = checkpoints.newest(self.folder)
        if begin is not None:
            self.save()
        files.write_json(out / "config.json", trainee.recipe)

    @property
    def kept(self) -> str:
        """What is on the disk, in words."""
        if self.last_good is None:
            return "no checkpoint is saved yet"
        return f"{self.trainee.unit} {self.saved} is saved, {self.last_good}"

    def _find(self, resume: bool, force: bool) -> Position:
        self._check_folder(resume, force)
        found = None if force else checkpoints.load(
            self.folder, lambda about: self._expected(about, self.folder))
        if found is None:
            return Position(self.trainee.phases[0][0])
        return self._restored(*found, self.folder)

    def _begun(self, begin: Path, resume: bool, force: bool) -> Position:
        if resume:
            raise InputError("--begin", "is for a new run; --resume alone goes on with one")
        self._check_folder(resume, force)
        return self._restored(
            *checkpoints.read(begin, lambda about: self._expected(about, begin)), begin)

    def _check_folder(self, resume: bool, force: bool) -> None:
        """Raises InputError if the folder holds a run, and not one to be resumed as it is."""
        if force:
            return
        stored, earlier = self.out / "config.json", self.folder / "state.npz"
        held = stored.exists() or earlier.exists() or checkpoints.newest(self.folder) is not None
        if held and not resume:
            raise InputError(self.out, "already holds a run; --resume goes on with it, --force "
                             "replaces it, or choose another --out")
        if earlier.exists():
            raise InputError(earlier, "is a checkpoint of an earlier version, which can no longer "
                             "be gone on with; choose another --out")
        if stored.exists():
            plain = msgspec.json.decode(files.dump_json(self.trainee.recipe))
            before = files.read_json(stored, dict[str, Any])
            odd = sorted(k for k in {**plain, **before} if plain.get(k) != before.get(k))
            if odd:
                raise InputError(stored, "was started with other numbers; a resumed run must keep "
                                 f"them ({before.get(odd[0])!r}, now {plain.get(odd[0])!r})",
                                 odd[0])

    def _expected(self, about: About, source: Path) -> Any:
        """The state that a checkpoint must hold, in shapes.

        Raises InputError if this run never comes there.
        """
        trainee = self.trainee
        if about.network != msgspec.json.decode(files.dump_json(trainee.network)):
            raise InputError(source, "is of another network")
        made = dict(trainee.phases).get(about.phase)
        if made is None:
            raise InputError(source, f"stands in {about.phase!r}; this run has "
                             + ", ".join(phase for phase, _ in trainee.phases))
        if about.update > made:
            raise InputError(source, f"stands after {about.update} {trainee.unit}s of "
                             f"{about.phase}; this run makes {made}", f"{about.phase}.updates")
        return trainee.shapes(about.phase)

    def _restored(self, about: About, arrays: dict[str, np.ndarray], source: Path) -> Position:
        """Where a checkpoint stands, its arrays with the trainee."""
        trainee = self.trainee
        state = checkpoints.unflatten(arrays, trainee.shapes(about.phase), source)
        trainee.restore(about.phase, state)
        return Position(about.phase, about.update, about.total_updates, about.env_steps,
                        about.seconds)

    def train(self, stop: Stop, stop_after: int | None = None) -> bool:
        """Runs to the end, or until asked to stop; True when it reached the end.

        `stop_after` is a number of updates over all phases, for tests and trials.
        """
        trainee, position = self.trainee, self.position
        interrupts.saved(self.kept)
        try:
            with bar(trainee.name, trainee.env_steps, position.env_steps) as show:
                show(position.env_steps, "compiling")
                phases = itertools.dropwhile(lambda p: p[0] != position.phase, trainee.phases)
                done = all(self._train_phase(*phase, stop, stop_after, show) for phase in phases)
            if position.total_updates != self.saved:
                self.save()
            return done
        finally:
            interrupts.saved("")
            self.metrics.close()

    def _train_phase(self, phase: str, updates: int, stop: Stop, stop_after: int | None,
                     show: Callable[[int, str], None]) -> bool:
        position = self.position
        if phase != position.phase:
            position.phase, position.update = phase, 0
        self.trainee.enter(phase)
        if not self.metrics.rows and (scores := self.trainee.held_out(position)):
            self.metrics.add(dataclasses.asdict(position) | scores)
        while position.update < updates:
            enough = stop_after is not None and position.total_updates >= stop_after
            if enough or anywhere(stop.asked):
                return False
            begun = time.monotonic()
            row = self._chunk()
            show(position.env_steps, self.trainee.words(self.metrics.rows))
            if self.stop_on_collapse:
                self._check_standing()
            now = time.monotonic()  # another chunk would make it later than that
            due = now - self.last_saved + (now - begun) > self.checkpoint_seconds
            ended = position.update >= updates
            if anywhere(due or ended or row is self.best()):
                self.save()
        return True

    def _chunk(self) -> Row:
        """Makes, checks and records the next updates."""
        trainee, position = self.trainee, self.position
        begun = compilation.working_time()
        made = trainee.chunk(position)
        seconds = max(compilation.working_time() - begun, 1e-9)
        self._check_finite(made.figures)
        position.update += made.updates
        position.total_updates += made.updates
        position.env_steps += made.env_steps
        position.seconds += seconds
        row = dataclasses.asdict(position) | {"rate": made.env_steps / seconds} | made.figures
        row |= trainee.held_out(position)
        self.metrics.add(row)
        interrupts.hold()
        return row

    def _check_finite(self, figures: dict[str, float]) -> None:
        """The weights too: the last step of a chunk can spoil them after its loss was taken."""
        whole = all(map(math.isfinite, figures.values())) and all(
            np.isfinite(leaf).all() for leaf in jax.tree.leaves(gather(self.trainee.weights())))
        if not whole:
            good = (f"the last good checkpoint is {self.last_good}" if self.last_good
                    else "none was saved yet")
            raise Diverged(f"training diverged after {self._reached}: a loss or weight is not a "
                           f"number; {good}")

    def _check_standing(self) -> None:
        """Raises Diverged if the policy has lost what it could."""
        fall = self.trainee.fallen(self.metrics.rows)
        if not fall:
            return
        top = self.best()
        place = checkpoints.place_of(self.folder, top["total_updates"] if top else 0)
        good = f"the last good checkpoint is {place}" if place.exists() else "no checkpoint is left"
        raise Diverged(f"training collapsed by {self._reached}: {fall}; {good} "
                       "(--no-stop-on-collapse goes on regardless)")

    @property
    def _reached(self) -> str:
        return f"{self.trainee.unit} {self.position.total_updates} ({self.position.phase})"

    def best(self) -> Row | None:
        """The line of the best evaluation so far."""
        return best(self.metrics.rows, self.trainee.score)

    def save(self) -> None:
        """Checkpoint now."""
        trainee = self.trainee
        about = About(**dataclasses.asdict(self.position), files={}, network=trainee.network)
        # Where a phase ended stays too: other runs can begin there.
        keep = set(itertools.accumulate(updates for _, updates in trainee.phases))
        if top := self.best():
            keep.add(top["total_updates"])
        self.last_good = checkpoints.save(self.folder, gather(checkpoints.raw(trainee.state())),
                                          about, keep)
        self.last_saved, self.saved = time.monotonic(), self.position.total_updates
        interrupts.saved(self.kept)

    def finish(self) -> dict[str, Any]:
        """Writes policy, curve and report of a run that reached its end; returns the report."""
        trainee, rows = self.trainee, self.metrics.rows
        report = {
            "preset": trainee.name, "seed": trainee.seed, "env_steps": self.position.env_steps,
            "seconds": self.position.seconds, "device": describe_device(), "commit": self.commit,
            **trainee.report(rows)}
        save_policy(self.out / "policy.safetensors", trainee.policy(self.position, self.commit))
        trainee.draw_curve(self.out / "curve.png", rows)
        files.write_json(self.out / "report.json", report)
        return report
