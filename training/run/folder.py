"""A run in one folder, resumable: `config.json`, `metrics.jsonl`, `checkpoints/state.npz`
(everything a resumed run needs) and, at the end, `policy.safetensors`, `report.json`, `curve.png`.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any, Protocol
from zipfile import BadZipFile

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from jax.sharding import Mesh

from moonteam import files
from moonteam.errors import InputError
from moonteam.policies.policy_file import PolicyFile, save_policy
from moonteam.report.progress import track
from moonteam.report.provenance import commit
from training.run.loop import Stop, describe_device
from training.sharding import everywhere
from training.teacher.imitation import Imitation, Learner, Memory, Sample, Walk, spread_walk
from training.teacher.refinement import Refinement
from training.teacher.scores import HeldOut, family_row

CHECKPOINT_SECONDS = 60.0
SCENARIOS = 256
EVAL_EVERY = 100  # rounds; more often in a short run, for a curve of eight points


class Round(Protocol):
    """What a round reports."""

    def _asdict(self) -> dict[str, Any]:
        """Figures by name, some still on the devices."""
        ...


class Work(Protocol):
    """A training in progress: `Dagger` or `Refiner`."""

    number: int
    mesh: Mesh
    learner: Learner
    walks: list[Walk]
    memories: list[Memory]

    @property
    def config(self) -> Imitation | Refinement:
        """What is trained."""
        ...

    @property
    def done(self) -> bool:
        """All rounds are made."""
        ...

    @property
    def states_a_round(self) -> int:
        """States visited and labelled in a round."""
        ...

    def round(self) -> Round:
        """Makes one."""
        ...


class Run:
    """One training in one folder."""

    def __init__(self, name: str, method: str, work: Work, out: Path, resume: bool,
                 source: str | None = None):
        """`source`: what the parameters it begins with come from, if not from the seed.

        Raises InputError if the folder holds a run that this one may not go on with.
        """
        self.name, self.method, self.work, self.out = name, method, work, out
        self.state_file = out / "checkpoints" / "state.npz"
        plain = self._recipe = msgspec.json.decode(files.dump_json(
            dataclasses.asdict(work.config) | ({"source": source} if source else {})))
        stored = out / "config.json"
        if stored.exists() and (resume or self.state_file.exists()):
            if not resume:
                raise InputError(out, "already holds a run; --resume goes on with it, or choose "
                                 "another --out")
            if msgspec.json.decode(stored.read_bytes()) != plain:
                raise InputError(stored, "was started with other numbers; a resumed run must keep "
                                 "them")
        files.write_json(stored, plain)
        self.seconds = 0.0
        self.rows: list[dict[str, Any]] = []
        if resume and self.state_file.exists():
            self._load()
        self.held_out = [HeldOut(f, SCENARIOS // f.shrink) for f in work.config.families]

    def train(self, stop: Stop) -> bool:
        """Runs to the end or until asked to stop; True when it reached the end."""
        work, saved = self.work, time.monotonic()
        often = max(1, min(EVAL_EVERY, work.config.rounds // 8))
        if not self.rows:
            self._record(None)
        for _ in track(range(work.number, work.config.rounds), self.name,
                       work.config.rounds - work.number):
            if stop.asked:
                break
            begun = time.monotonic()
            report = work.round()
            self.seconds += time.monotonic() - begun
            if work.number % often == 0 or work.done:
                self._record(report)
            if time.monotonic() - saved > CHECKPOINT_SECONDS:
                self.save()
                saved = time.monotonic()
        self.save()
        return work.done

    def _record(self, report: Round | None) -> None:
        work = self.work
        row = {"round": work.number, "seconds": self.seconds,
               **({k: float(v) for k, v in report._asdict().items()} if report else {}),
               "labelled": work.number * work.states_a_round,
               "families": [family_row(f, h, work.config.spec, work.learner.mean)
                            for f, h in zip(work.config.families, self.held_out, strict=True)]}
        self.rows.append(row)
        files.write_text(self.out / "metrics.jsonl",
                         "".join(files.dump_json(r) + "\n" for r in self.rows))

    def save(self) -> None:
        """Everything a resumed run needs, whole or not at all."""
        arrays = {f"leaf{i}": leaf for i, leaf in enumerate(_leaves(self.work))}
        about = {"number": self.work.number, "seconds": self.seconds, "rows": self.rows,
                 "counts": [m.count for m in self.work.memories]}
        with files.replacing(self.state_file) as temporary, temporary.open("wb") as out:
            arrays["about"] = np.frombuffer(files.dump_json(about).encode(), np.uint8)
            np.savez(out, allow_pickle=False, **arrays)

    def _load(self) -> None:
        work = self.work
        try:
            with self.state_file.open("rb") as raw, np.load(raw) as stored:
                about = msgspec.json.decode(stored["about"].tobytes())
                arrays = [stored[f"leaf{i}"] for i in range(len(stored.files) - 1)]
        except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
            raise InputError(self.state_file, f"is torn ({error}); delete it to start again"
                             ) from None
        work.number, self.seconds, self.rows = about["number"], about["seconds"], about["rows"]
        _restore(work, arrays, about["counts"])

    def finish(self) -> dict[str, Any]:
        """Writes policy, curve and report of a run that reached its end; returns the report."""
        config = self.work.config
        recipe = {"preset": self.name, "method": self.method, **self._recipe}
        params = jax.device_get(self.work.learner.mean)
        save_policy(self.out / "policy.safetensors",
                    PolicyFile("entity", dataclasses.asdict(config.spec), params, recipe,
                               commit() or "unknown"))
        report = {"preset": self.name, "method": self.method, "seed": config.seed,
                  "seconds": self.seconds, "device": describe_device(), "commit": commit(),
                  **self.rows[-1]}
        files.write_json(self.out / "report.json", report)
        draw_curve(self.out / "curve.png", {self.name: self.rows})
        return report


def _leaves(work: Work) -> list[np.ndarray]:
    """Learner, environments and memories as host arrays, keys as their raw words."""
    walks = [w._replace(key=jax.random.key_data(w.key)) for w in work.walks]
    tree = (work.learner, walks, [m.rows for m in work.memories])
    return [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]


def _restore(work: Work, arrays: list[np.ndarray], counts: list[int]) -> None:
    """Puts the leaves back; memories take the shapes of what they hold."""
    walks = [w._replace(key=jax.random.key_data(w.key)) for w in work.walks]
    fixed, shape = jax.tree.flatten((work.learner, walks))
    learner, walks = jax.tree.unflatten(shape, [jnp.asarray(a) for a in arrays[:len(fixed)]])
    work.learner = everywhere(work.mesh, learner)
    work.walks = [spread_walk(work.mesh, w._replace(key=jax.random.wrap_key_data(w.key)))
                  for w in walks]
    rest = arrays[len(fixed):]
    for memory, walk, count in zip(work.memories, work.walks, counts, strict=False):
        sample = Sample(walk.states, walk.place, walk.preference, walk.place)
        like = jax.tree.structure(sample)
        size = like.num_leaves
        memory.rows, rest = jax.tree.unflatten(like, rest[:size]), rest[size:]
        memory.count = count


def draw_curve(path: Path, runs: dict[str, list[dict[str, Any]]]) -> None:
    """Success and gaps over labelled states: every family of one run, or the mean of each of
    several runs.
    """
    from matplotlib import colormaps
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import PercentFormatter

    figure = Figure(figsize=(13, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 3)
    colours = colormaps["tab20"]([*range(0, 20, 2), *range(1, 20, 2)])
    keys = ("success", "makespan_gap", "moves_gap")
    for number, (name, rows) in enumerate(runs.items()):
        states = [row["labelled"] / 1e6 for row in rows]
        for axis, key in zip(axes, keys, strict=True):
            table = np.array([[family[key] for family in row["families"]] for row in rows])
            if len(runs) > 1:
                axis.plot(states, table.mean(axis=1), color=colours[number], label=name)
                continue
            for i, family in enumerate(rows[-1]["families"]):
                axis.plot(states, table[:, i], color=colours[i], label=family["family"])
    for axis, title in zip(axes, ("success, argmax, preference 0", "makespan gap, preference 0",
                                  "moves gap, preference 1"), strict=True):
        axis.set_title(title)
        axis.set_xlabel("labelled states, millions")
        axis.grid(alpha=0.3)
        axis.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes[0].set_ylim(min(axes[0].get_ylim()[0], 0.9), 1.005)
    for axis in axes[1:]:
        axis.set_ylim(top=min(axis.get_ylim()[1], 0.5))  # the first looks dwarf the rest
    figure.legend(*axes[0].get_legend_handles_labels(), fontsize=7, ncols=4,
                  loc="outside lower center")
    with files.replacing(path) as temporary:
        figure.savefig(temporary, dpi=110)
