"""What imitation and refinement have in common as something that a run trains, round by round.

Legend: E environments of a family, B states of a batch.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from moonteam.policies.entity import EntitySpec
from moonteam.policies.policy_file import PolicyFile
from training.run.families import mean
from training.run.trainee import Made, Position, Row, due
from training.sharding import everywhere, gather, mesh_for
from training.teacher.curve import draw_curve
from training.teacher.families import Family, Sample, Walk, begin, make_ground, spread_walk
from training.teacher.scores import HeldOut, family_row

SCENARIOS = 256
"""Held-out scenarios of a family; fewer of one that shrinks."""
EVAL_EVERY = 100
"""Rounds; more often in a short run, for a curve of eight points."""


class Learner(NamedTuple):
    """What learning changes."""

    params: Any
    mean: Any  # running mean of the parameters
    optimiser: optax.OptState

    @classmethod
    def begin(cls, params: Any, rule: optax.GradientTransformation) -> Learner:
        """Copies of the parameters, since a learner is donated, and a fresh optimiser."""
        params, mean = jax.tree.map(jnp.array, params), jax.tree.map(jnp.array, params)
        return cls(params, mean, rule.init(params))


class Memory:
    """The labelled states of one family: a ring, the oldest make room."""

    def __init__(self, capacity: int, like: Sample):
        """`capacity`: states kept; whole batches of additions must divide it. `like`: any states
        of the family.
        """
        self.capacity = capacity
        self.count = 0
        self.rows: Sample = jax.tree.map(
            lambda x: np.zeros((capacity, *x.shape[1:]), x.dtype), like)

    def add(self, batch: Sample) -> None:
        """Puts a labelled batch in."""
        size = len(batch.place)
        at = self.count % self.capacity
        for kept, new in zip(jax.tree.leaves(self.rows), jax.tree.leaves(batch), strict=True):
            kept[at : at + size] = new
        self.count += size

    def draw(self, rng: np.random.Generator, size: int) -> Sample:
        """`size` states at random, with replacement."""
        index = rng.integers(0, min(self.count, self.capacity), size)
        return jax.tree.map(lambda x: x[index], self.rows)


class Practice(Protocol):
    """What the recipes of both, frozen dataclasses, have in common."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def families(self) -> tuple[Family, ...]:
        """What is practised."""
        ...

    @property
    def spec(self) -> EntitySpec:
        """Size of the network."""
        ...

    @property
    def rounds(self) -> int:
        """Rounds of the whole run."""
        ...

    @property
    def seed(self) -> int:
        """Of everything random in the run."""
        ...


class Held(NamedTuple):
    """All that a resumed run needs; what is drawn on the host descends from seed and round."""

    learner: Learner
    walks: list[Walk]
    memories: list[Sample]
    counts: list[np.ndarray]  # [] int64 each, states ever put into the memory
    number: np.ndarray  # [] int64 rounds made


class Pupil(ABC):
    """A training in progress; `learner.mean` is the policy. A `training.run.trainee.Trainee`."""

    unit = "round"
    phase: str
    method: str
    """How it is trained, for the report."""

    def __init__(self, config: Practice, name: str, source: str, learner: Learner, keys: Array,
                 envs: Sequence[int], rows: Iterable[int]):
        """`source`: what the parameters come from, if not from the seed. `keys` [families] and
        `envs`: of the environments of each. `rows`: what the devices must share out evenly.
        """
        self.config, self.name, self.seed, self.source = config, name, config.seed, source
        self.mesh = mesh_for(rows)
        self.number = 0
        self.learner = everywhere(self.mesh, learner)
        self.grounds = [everywhere(self.mesh, make_ground(f, config.seed + i))
                        for i, f in enumerate(config.families)]
        self.walks = [spread_walk(self.mesh, begin(f, g, k, count)) for f, g, k, count in
                      zip(config.families, self.grounds, keys, envs, strict=True)]
        self.memories: list[Memory] = []

    @abstractmethod
    def round(self) -> Any:
        """Makes one; returns its figures, a named tuple of numbers."""

    @property
    @abstractmethod
    def states_a_round(self) -> int:
        """States visited and labelled in a round."""

    @property
    @abstractmethod
    def steps_a_round(self) -> int:
        """Env steps of a round."""

    @property
    def recipe(self) -> dict[str, Any]:
        """Preset, method and all numbers of the run; in the policy's header too."""
        numbers = {"preset": self.name, "method": self.method, **dataclasses.asdict(self.config)}
        return numbers | ({"source": self.source} if self.source else {})

    @property
    def network(self) -> dict[str, Any]:
        """Size of the network."""
        return dataclasses.asdict(self.config.spec)

    @property
    def phases(self) -> tuple[tuple[str, int], ...]:
        """One."""
        return ((self.phase, self.config.rounds),)

    @property
    def env_steps(self) -> int:
        """Of all rounds."""
        return self.config.rounds * self.steps_a_round

    def enter(self, phase: str) -> None:
        """There is no other."""
        return

    def chunk(self, at: Position) -> Made:
        """One round."""
        figures = {name: float(value) for name, value in self.round()._asdict().items()}
        return Made(1, self.steps_a_round, figures)

    @cached_property
    def scenarios(self) -> list[HeldOut]:
        """Of each family, with their optima."""
        return [HeldOut(f, SCENARIOS // f.shrink) for f in self.config.families]

    def held_out(self, at: Position) -> dict[str, Any]:
        """Success and gaps of each family; before the first round too, and after the last."""
        config = self.config
        if not due(at, config.rounds, EVAL_EVERY):
            return {}
        return {"round": at.update, "labelled": at.update * self.states_a_round,
                "families": [family_row(f, h, config.spec, self.learner.mean)
                             for f, h in zip(config.families, self.scenarios, strict=True)]}

    def weights(self) -> Any:
        """The parameters and their running mean."""
        return self.learner.params, self.learner.mean

    def state(self) -> Held:
        """Learner, environments, memories, where it is."""
        return Held(self.learner, self.walks, [m.rows for m in self.memories],
                    [np.asarray(m.count) for m in self.memories], np.asarray(self.number))

    def shapes(self, phase: str) -> Held:
        """They are always the same."""
        return self.state()

    def restore(self, phase: str, state: Held) -> None:
        """Spreads it over the devices; memories stay on the host."""
        self.number = int(state.number)
        self.learner = everywhere(self.mesh, state.learner)
        self.walks = [spread_walk(self.mesh, walk) for walk in state.walks]
        for memory, rows, count in zip(self.memories, state.memories, state.counts, strict=True):
            memory.rows, memory.count = jax.tree.map(np.array, rows), int(count)

    def score(self, row: Row) -> float | None:
        """Mean success over the families."""
        return mean(row, "success") if "families" in row else None

    def fallen(self, rows: list[Row]) -> str:
        """Not looked for: a teacher is there."""
        return ""

    def words(self, rows: list[Row]) -> str:
        """Where it is, and how it did when last looked at."""
        row, look = rows[-1], next(r for r in reversed(rows) if "families" in r)
        return (f"round {row['update']:,} of {self.config.rounds:,}, loss {row['loss']:.3f}\n"
                f"held out {mean(look, 'success'):.3f} success, gaps of makespan "
                f"{mean(look, 'makespan_gap'):.1%}, moves {mean(look, 'moves_gap'):.1%}")

    def policy(self, at: Position, commit: str) -> PolicyFile:
        """The running mean with network, recipe and commit in the header."""
        return PolicyFile("entity", self.network, gather(self.learner.mean), self.recipe, commit)

    def report(self, rows: list[Row]) -> dict[str, Any]:
        """The last evaluation."""
        left_out = {field.name for field in dataclasses.fields(Position)} | {"rate"}
        last = {k: v for k, v in rows[-1].items() if k not in left_out}
        return {"method": self.method, "scenarios": SCENARIOS} | last

    def lines(self, report: dict[str, Any]) -> list[str]:
        """A line a family."""
        return [*(f"{row['family']}: success {row['success']:.3f}, makespan gap "
                  f"{row['makespan_gap']:.1%}, moves gap {row['moves_gap']:.1%}"
                  for row in report["families"]),
                f"{report['labelled']:,} labelled states in {report['seconds']:.0f} s"]

    def draw_curve(self, path: Path, rows: list[Row]) -> None:
        """Success and gaps of every family over labelled states."""
        draw_curve(path, {self.name: rows})
