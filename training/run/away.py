"""Runs on a cluster: each in a worker, stretch by stretch, its folder kept here.

A worker trains in a folder of its own and hands over what has changed there; only this process
writes the run folder, as the worker's run would have. A worker that is lost costs the work since
its last stretch: the next one is given the folder and goes on, to the same bits.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from moonteam import files, interrupts, outputs
from moonteam.cluster import Cluster, Held
from moonteam.errors import InputError
from moonteam.interrupts import Stop
from moonteam.report.progress import bar
from training.run.machine import FILES, Diverged, Run
from training.run.trainee import Trainee

Files = dict[str, bytes | None]
"""By path in the run folder; None: it is no more."""
_FIRST = ("config.json", "metrics.jsonl")
"""Written before a checkpoint, whose run needs them; the others after all checkpoints."""
_LOOK = 0.5  # s between two looks at whether the command is to stop
_ALIVE = 10.0  # s in which a worker that has begun says so


@dataclass(frozen=True)
class Keeping:
    """How a run is kept; see `training.run.machine.Run`."""

    resume: bool
    checkpoint_seconds: float
    force: bool = False


class Stretch(NamedTuple):
    """What a worker has come to."""

    changed: Files
    updates: int  # over all phases
    env_steps: int
    total: int  # env steps of the whole run
    words: str  # where it is, for people
    report: dict[str, Any] | None = None  # of a run at its end, as printed
    lines: tuple[str, ...] = ()
    failed: str = ""  # why it cannot go on


class Lost(NamedTuple):
    """The worker is new, and does not hold what the run has come to."""


class _Handed(Run):
    """A run that stops whenever it has saved, to be handed over."""

    def __init__(self, stop: Stop, *given: Any):
        self._asked_to = stop
        super().__init__(*given)

    def save(self) -> None:
        """See `Run`."""
        super().save()
        self._asked_to.asked = True


class Worker:
    """In a worker: one run in a folder of its own.

    Args:
      make: the trainee, of `arguments`.
      arguments: its numbers.
      keeping: how the run is kept.
      out: the run folder, for messages alone.
    """

    def __init__(self, make: Callable[..., Trainee], arguments: tuple, keeping: Keeping, out: str):
        self._make, self._arguments, self._keeping, self._out = make, arguments, keeping, out
        self._folder = Path(tempfile.mkdtemp(prefix="moonteam-run-"))
        self._run: Run | None = None
        self._seen: dict[str, tuple[int, int]] = {}
        self._stop = Stop()

    def stretch(self, updates: int, held: Files | None) -> Stretch | Lost:
        """Trains until a checkpoint is saved, or to the end.

        Args:
          updates: that the run has come to, as far as is known; 0: it may begin.
          held: the run folder, where this worker is to take it over.
        """
        if self._run is not None and self._run.position.total_updates != updates:
            self._run = None  # what it answered last never came home
        if self._run is None:
            if updates and held is None:
                return Lost()
            self._run = self._begun(updates, held or {})
        return self._trained(self._run)

    def stop(self) -> bool:
        """Ends the stretch after the running chunk."""
        self._stop.asked = True
        return True

    def close(self) -> bool:
        """Removes the worker's own folder."""
        shutil.rmtree(self._folder, ignore_errors=True)
        return True

    def _begun(self, updates: int, held: Files) -> Run:
        shutil.rmtree(self._folder, ignore_errors=True)
        write(self._folder, held)
        self._seen = self._looked()
        keeping = self._keeping
        try:
            return _Handed(self._stop, self._make(*self._arguments), self._folder,
                           keeping.resume or updates > 0, keeping.checkpoint_seconds)
        except InputError as error:
            raise InputError(self._said(error.source), self._said(error.problem), error.key
                             ) from None

    def _trained(self, run: Run) -> Stretch:
        try:
            done = run.train(self._stop)
        except Diverged as error:
            return self._told(run)._replace(failed=self._said(str(error)))
        finally:
            self._stop.asked = False
        if not done:
            return self._told(run)
        report = run.finish()
        shown = report | {"out": self._out, "config": run.trainee.recipe}
        return self._told(run)._replace(report=shown, lines=tuple(run.trainee.lines(report)))

    def _told(self, run: Run) -> Stretch:
        seen, before = self._looked(), self._seen
        changed: Files = {name: (self._folder / name).read_bytes() for name, mark in seen.items()
                          if before.get(name) != mark}
        changed |= dict.fromkeys(before.keys() - seen.keys())
        self._seen = seen
        at, rows = run.position, run.metrics.rows
        words = run.trainee.words(rows).splitlines()[0] if rows else ""
        return Stretch(changed, at.total_updates, at.env_steps, run.trainee.env_steps, words)

    def _looked(self) -> dict[str, tuple[int, int]]:
        """Every file with what tells that it has changed."""
        found = {}
        for path in self._folder.rglob("*"):
            if path.is_file():
                name, about = path.relative_to(self._folder).as_posix(), path.stat()
                found[name] = about.st_mtime_ns, about.st_size
        return found

    def _said(self, text: str) -> str:
        return text.replace(str(self._folder), self._out)


def read(out: Path) -> Files:
    """What a run in that folder goes on from."""
    places = [out / name for name in _FIRST] + sorted((out / "checkpoints").rglob("*"))
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in places
            if path.is_file()}


def write(out: Path, changed: Files) -> None:
    """Writes what a run has changed in its folder: a checkpoint is whole or not there, and what it
    needs is there before it.
    """
    out.mkdir(parents=True, exist_ok=True)
    new: dict[str, dict[str, bytes]] = {}
    later: dict[str, bytes] = {}
    for name, data in changed.items():
        if data is None:
            continue
        if name in _FIRST:
            files.write_bytes(out / name, data)
        elif name.startswith("checkpoints/") and name.count("/") > 1:
            _, number, rest = name.split("/", 2)
            new.setdefault(number, {})[rest] = data
        else:
            later[name] = data
    for number, parts in new.items():
        _place(out / "checkpoints", number, parts)
    for name, data in later.items():
        files.write_bytes(out / name, data)
    for name in (name for name, data in changed.items() if data is None):
        (out / name).unlink(missing_ok=True)
    for folder in sorted((out / "checkpoints").rglob("*"), reverse=True):
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()


def _place(folder: Path, number: str, parts: dict[str, bytes]) -> None:
    """A checkpoint's folder under its name, all at once."""
    folder.mkdir(exist_ok=True)
    partial = Path(tempfile.mkdtemp(dir=folder, prefix=".part-"))
    for rest, data in parts.items():
        path = partial / rest
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    shutil.rmtree(folder / number, ignore_errors=True)
    partial.rename(folder / number)


@dataclass
class Away:
    """A run that is somewhere else."""

    out: Path
    held: Held
    force: bool = False
    known: Stretch | None = None
    asked: Any = None
    updates: int = field(init=False, default=0)

    def ask(self, folder: Files | None = None) -> None:
        """For the next stretch."""
        self.asked = self.held.call("stretch", self.updates, folder)

    def keep(self, answer: Stretch) -> None:
        """Writes what the run has come to; first, where told so, over an earlier one."""
        if self.force and self.known is None:
            outputs.clear(self.out, FILES)
        write(self.out, answer.changed)
        self.known, self.updates = answer._replace(changed={}), answer.updates


def train(cluster: Cluster, make: Callable[..., Trainee], numbers: list[tuple], outs: list[Path],
          keeping: list[Keeping], cpus: int, stop: Stop) -> list[Stretch | None]:
    """Trains all runs to their ends, or until asked to stop; where each stands then.

    Args:
      cluster: where.
      make: a trainee, of its arguments.
      numbers: the arguments of each run.
      outs: the folder of each run.
      keeping: how each is kept.
      cpus: JAX devices of a run, on which its bits depend, and CPUs that it takes.
      stop: looked at now and then; runs end their chunk and are saved.

    Raises InputError as a run does that cannot begin.
    """
    runs = []
    for given, out, how in zip(numbers, outs, keeping, strict=True):
        held = cluster.hold(Worker, make, given, how, str(out), cpus=cpus)
        runs.append(Away(out, held, how.force))
        runs[-1].ask({} if how.force else read(out))
    interrupts.hold()  # a worker's run is to be saved before the command ends
    going = list(runs)
    with bar(f"{len(runs)} runs on {cluster.name}", 1000) as show:
        while going:
            if stop.asked:
                _end(cluster, going)
                break
            for ready in cluster.ready([run.asked for run in going], _LOOK):
                run = next(run for run in going if run.asked is ready)
                if _took(cluster, run):
                    going.remove(run)
                    _close(cluster, run)
            show(*_progress(runs))
    return [run.known for run in runs]


def _took(cluster: Cluster, run: Away) -> bool:
    """Keeps what a run has come to and asks for more; True at its end."""
    answer = cluster.value(run.asked)
    if isinstance(answer, Lost):
        run.ask(read(run.out))
        return False
    run.keep(answer)
    if answer.report is not None or answer.failed:
        return True
    run.ask()
    return False


def _end(cluster: Cluster, going: list[Away]) -> None:
    """Has the runs under way end their chunk and keeps it; those that wait for a worker, wait."""
    for run in going:
        said = run.held.call("stop")
        if cluster.ready([said], _ALIVE):
            answer = cluster.value(run.asked)
            if isinstance(answer, Stretch):
                run.keep(answer)
            _close(cluster, run)


def _close(cluster: Cluster, run: Away) -> None:
    """Frees a run's worker, which tidies up first if it can."""
    cluster.ready([run.held.call("close")], _ALIVE)
    cluster.drop(run.held)


def _progress(runs: list[Away]) -> tuple[int, str]:
    """Thousandths of all env steps, and a line a run."""
    shares = [run.known.env_steps / run.known.total if run.known else 0.0 for run in runs]
    words = [f"{run.out.name}: {run.known.words if run.known else 'compiling'}" for run in runs]
    return int(1000 * sum(shares) / len(runs)), "\n".join(words)
