"""A whole run: chunks of updates, looked at from outside between two of them.

Everything random descends from the seed and travels in the learner, so a run that was
stopped and resumed, at any chunk, ends with the same bits as one that never stopped.
"""

from __future__ import annotations

import dataclasses
import itertools
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import msgspec
import numpy as np

from moonteam import files
from moonteam.errors import InputError
from moonteam.policies.policy_file import PolicyFile, save_policy
from moonteam.report.provenance import commit
from training.mappo import held_out, networks, update
from training.mappo.grid_task import GridTask
from training.mappo.networks import Networks, Pair
from training.mappo.update import Learner, Report
from training.run import checkpoints, record
from training.run.checkpoints import About
from training.run.config import Config, Phase
from training.sharding import anywhere, gather, mesh_for

FINAL_SCENARIOS = 500


class Diverged(Exception):
    """Training produced something that is not a number, or a policy that lost what it could;
    says which checkpoint is good.
    """


@dataclass
class Stop:
    """Set by Ctrl-C or SIGTERM; looked at between chunks."""

    asked: bool = False


@dataclass
class Position:
    """Where the run is; what `about.json` records."""

    phase: str
    update: int = 0
    total_updates: int = 0
    env_steps: int = 0
    seconds: float = 0.0


@contextmanager
def stop_on_signals() -> Iterator[Stop]:
    """Turns Ctrl-C and SIGTERM into a request, so that the running chunk is finished first."""
    stop = Stop()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def ask(number: int, frame: object) -> None:
        stop.asked = True

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class Run:
    """One training run in one folder.

    `config.json`, `metrics.jsonl`, `checkpoints/` and, at the end, `policy.safetensors`,
    `report.json` and `curve.png`.
    """

    def __init__(self, config: Config, out: Path, resume: bool, checkpoint_seconds: float = 30.0,
                 stop_on_collapse: bool = True, tensorboard: bool = False,
                 begin: Path | None = None):
        """`begin`: a checkpoint of another run, to go on from with this one's numbers.

        Raises InputError if the folder holds a run that this one may not go on with, or `begin`
        is no checkpoint that it could begin with.
        """
        self.config, self.out, self.checkpoint_seconds = config, out, checkpoint_seconds
        self.stop_on_collapse = stop_on_collapse
        # Of the code that is loaded now, whatever is checked out later.
        self.commit = commit() or "unknown"
        self.nets: Networks = networks.for_spec(config.spec, config.precision)
        self.mesh = mesh_for(p.num_envs // p.num_minibatches for _, p in config.phases)
        self.folder = out / "checkpoints"
        self.position, arrays = (self._find(resume) if begin is None
                                 else self._begun(begin, resume))
        self.learner = self._resumed(arrays)
        self.metrics = record.Metrics(out / "metrics.jsonl", self.position.total_updates,
                                      tensorboard, begin and begin.parent.parent / "metrics.jsonl")
        self.last_saved = time.monotonic()
        self.last_good = checkpoints.newest(self.folder)
        if begin is not None:
            self.save()
        files.write_json(out / "config.json", config)

    def _find(self, resume: bool) -> tuple[Position, dict[str, np.ndarray] | None]:
        stored = self.out / "config.json"
        held = stored.exists() or checkpoints.newest(self.folder) is not None
        if held and not resume:
            raise InputError(self.out, "already holds a run; --resume goes on with it, or choose "
                             "another --out")
        if stored.exists():
            plain = msgspec.json.decode(files.dump_json(self.config))
            before = msgspec.json.decode(stored.read_bytes())
            odd = sorted(k for k in {**plain, **before} if plain.get(k) != before.get(k))
            if odd:
                raise InputError(stored, "was started with other numbers; a resumed run must keep "
                                 f"them ({before.get(odd[0])!r}, now {plain.get(odd[0])!r})",
                                 odd[0])
        found = checkpoints.load(self.folder)
        if found is None:
            return Position(self.config.phases[0][0]), None
        about, arrays = found
        return self._position(about, self.folder), arrays

    def _begun(self, begin: Path, resume: bool) -> tuple[Position, dict[str, np.ndarray]]:
        if resume:
            raise InputError("--begin", "is for a new run; --resume alone goes on with one")
        self._find(resume)  # refuses a folder that holds a run
        about, arrays = checkpoints.read(begin)
        return self._position(about, begin), arrays

    def _position(self, about: About, source: Path) -> Position:
        """Where a checkpoint stands. Raises InputError if this run never comes there."""
        if about.network != self._network:
            raise InputError(source, "is of another network")
        made = {name: phase.updates for name, phase in self.config.phases}.get(about.phase, 0)
        if about.update > made:
            raise InputError(source, f"stands after {about.update} updates of {about.phase}; this "
                             f"run makes {made}", f"{about.phase}.updates")
        return Position(about.phase, about.update, about.total_updates, about.env_steps,
                        about.seconds)

    @property
    def _network(self) -> dict[str, Any]:
        return dataclasses.asdict(self.config.spec) | {"size": list(self.config.size)}

    def task(self, phase: Phase) -> GridTask:
        """The phase's grid world."""
        return GridTask(self.config.env(phase))

    def begin(self, index: int, params: Pair | None) -> Learner:
        """The first state of phase number `index`."""
        phase = self.config.phases[index][1]
        key = jax.random.fold_in(jax.random.key(self.config.seed), index)
        return update.begin(self.nets, self.task(phase), self.config.hyper(phase),
                            phase.num_envs, key, params)

    def _resumed(self, arrays: dict[str, np.ndarray] | None) -> Learner | None:
        if arrays is None:
            return None
        index = self.phase_names.index(self.position.phase)
        like = jax.eval_shape(lambda: self.begin(index, None))
        return update.shared(self.mesh, checkpoints.unflatten(arrays, like, self.folder))

    @property
    def phase_names(self) -> list[str]:
        """Names of the phases that have updates."""
        return [name for name, _ in self.config.phases]

    def train(self, stop: Stop, stop_after: int | None = None) -> bool:
        """Runs to the end, or until asked to stop; True when it reached the end.

        `stop_after` is a number of updates over all phases, for tests and trials.
        """
        progress = record.Progress(self.config, self.position.env_steps)
        try:
            first = self.phase_names.index(self.position.phase)
            with networks.matmul_precision(self.config.precision):
                phases = range(first, len(self.config.phases))
                done = all(self._train_phase(i, stop, stop_after, progress) for i in phases)
            self.save()
            return done
        finally:
            progress.stop()
            self.metrics.close()

    def _train_phase(self, index: int, stop: Stop, stop_after: int | None,
                     progress: record.Progress) -> bool:
        name, phase = self.config.phases[index]
        if self.learner is None or name != self.position.phase:
            params = gather(self.learner.params) if self.learner is not None else None
            self.learner = update.shared(self.mesh, self.begin(index, params))
            self.position.phase, self.position.update = name, 0
        while self.position.update < phase.updates:
            enough = stop_after is not None and self.position.total_updates >= stop_after
            if enough or anywhere(stop.asked):
                return False
            count = min(self.config.chunk_updates, phase.updates - self.position.update)
            row = self._chunk(phase, count)
            progress.show(row)
            if self.stop_on_collapse:
                self._check_standing()
            due = time.monotonic() - self.last_saved > self.checkpoint_seconds
            ended = self.position.update >= phase.updates
            if anywhere(due or ended or row is record.best(self.metrics.rows)):
                self.save()
        return True

    def _chunk(self, phase: Phase, count: int) -> dict[str, Any]:
        """Trains `count` updates, checks and records them."""
        config, position = self.config, self.position
        assert self.learner is not None
        begun = time.monotonic()
        self.learner, report = update.chunk(self.nets, self.task(phase), config.hyper(phase),
                                            self.learner, count)
        report = gather(report)
        seconds = time.monotonic() - begun
        _check_finite((report, gather(self.learner.params)), position, self.last_good)
        steps = count * phase.num_envs * config.num_steps
        position.update += count
        position.total_updates += count
        position.env_steps += steps
        position.seconds += seconds
        row = dataclasses.asdict(position) | {"rate": steps / seconds} | _summary(report)
        at_end = position.update >= phase.updates
        if at_end or position.update // count % config.eval_every == 0:
            row |= self.evaluate(phase, config.eval_scenarios)
        self.metrics.add(row)
        return row

    def _check_standing(self) -> None:
        """Raises Diverged if the policy has lost what it could; see `record.collapsed`."""
        rows, position = self.metrics.rows, self.position
        if "sample" not in rows[-1] or not record.collapsed(rows, self.config.eval_scenarios):
            return
        best = record.best(rows)
        assert best is not None
        place = checkpoints.place_of(self.folder, best["total_updates"])
        good = f"the last good checkpoint is {place}" if place.exists() else "no checkpoint is left"
        raise Diverged(
            f"training collapsed by update {position.total_updates} ({position.phase}): sampled "
            f"actions solve {rows[-1]['sample']['success']:.3f} of the held-out scenarios, after "
            f"update {best['total_updates']} it was {best['sample']['success']:.3f}; {good} "
            "(--no-stop-on-collapse goes on regardless)")

    def evaluate(self, phase: Phase, scenarios: int) -> dict[str, dict[str, float]]:
        """Held-out scores, argmax and sampled."""
        assert self.learner is not None
        key = jax.random.key(held_out.HELD_OUT_SEED)
        actor, scores = gather(self.learner.params.actor), {}
        for decode in ("argmax", "sample"):
            score = held_out.score(self.nets, self.task(phase), actor, key, scenarios,
                                   decode == "sample")
            scores[decode] = {k: float(v) for k, v in score._asdict().items()}
        return scores

    def save(self) -> None:
        """Checkpoint now."""
        if self.learner is not None:
            about = About(**dataclasses.asdict(self.position), files={}, network=self._network)
            whole = gather(self.learner._replace(key=jax.random.key_data(self.learner.key)))
            # Where a phase ended stays too: other refinements can begin there.
            ends = set(itertools.accumulate(phase.updates for _, phase in self.config.phases))
            best = record.best(self.metrics.rows)
            self.last_good = checkpoints.save(self.folder, whole, about,
                                              ends | ({best["total_updates"]} if best else set()))
        self.last_saved = time.monotonic()

    def finish(self) -> dict[str, Any]:
        """Writes policy, curve and report of a run that reached its end; returns the report."""
        assert self.learner is not None
        phase = self.config.phases[-1][1]
        report = {
            "preset": self.config.name, "seed": self.config.seed,
            "env_steps": self.position.env_steps, "seconds": self.position.seconds,
            "device": describe_device(), "commit": self.commit,
            "scenarios": FINAL_SCENARIOS, **self.evaluate(phase, FINAL_SCENARIOS)}
        self.write_policy(self.out / "policy.safetensors")
        record.draw_curve(self.out / "curve.png", {f"seed {self.config.seed}": [self.metrics.rows]})
        files.write_json(self.out / "report.json", report)
        return report

    def write_policy(self, path: Path) -> None:
        """The shipped form: parameters with network, recipe and commit in the header."""
        assert self.learner is not None
        params = gather(self.learner.params)._asdict()
        recipe = dataclasses.asdict(self.config) | {"env_steps": self.position.env_steps}
        save_policy(path, PolicyFile("recurrent", dataclasses.asdict(self.config.spec), params,
                                     recipe, self.commit))


def _summary(report: Report) -> dict[str, float]:
    """Means over a chunk's updates; episode figures over the episodes that ended in it."""
    tally = report.tally
    episodes = max(int(tally.episodes.sum()), 1)
    ended = {"success": tally.solved, "makespan": tally.steps, "moves": tally.moves}
    row = {key: float(value.sum()) / episodes for key, value in ended.items()}
    row |= {key: float(value.mean()) for key, value in report.actor._asdict().items()}
    return row | {"value_loss": float(report.value_loss.mean()),
                  "mean_reward": float(report.mean_reward.mean())}


def _check_finite(tree: Any, position: Position, last_good: Path | None) -> None:
    """The weights too: the last step of a chunk can spoil them after its loss was taken."""
    for leaf in jax.tree.leaves(tree):
        if not np.isfinite(leaf).all():
            good = f"the last good checkpoint is {last_good}" if last_good else "none was saved yet"
            raise Diverged(f"training diverged after update {position.total_updates} "
                           f"({position.phase}): a loss or weight is not a number; {good}")


def describe_device() -> str:
    """Kind and number of the devices that JAX sees."""
    devices = jax.devices()
    return f"{len(devices)} x {devices[0].device_kind} ({devices[0].platform})"
