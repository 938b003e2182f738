"""An evolution strategy over the weights of a guide: the separable CMA-ES of evosax.

Legend: P candidates of a generation, D weights that may move.

Nothing of a search can be differentiated, and what a removal was good for shows only many
removals later; so a guide is judged by where whole searches end, every candidate by the same
fresh problems, each searched until so many places were tried. The guide is the mean of the
candidates' distribution; generation and seed alone say what comes next.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from evosax.algorithms import Sep_CMA_ES

from moonteam import grid
from moonteam.compilation import cores
from moonteam.planners.base import Snapshot
from moonteam.planners.lns import Events, Weights, best_insertion, measure, searched
from moonteam.planners.search.guides import KIND, PLAIN, Floats, parts_of
from moonteam.planners.search.task import Task
from moonteam.planners.search.travel import travel_times
from moonteam.policies.policy_file import PolicyFile
from training.guide.curve import draw_curve
from training.guide.recipe import STEPS, Guiding, Practice
from training.run.trainee import Made, Position, Row, due

EVAL_EVERY = 25
"""Generations; more often in a short run, for a curve of eight points."""
_FRESH, _HELD, _APART = 1_000_000, 900_000_000, 10_000_000  # where seeds of problems begin
_HORIZON = 256
_LONG = 700_000  # places of a search of which but an eighth as many are held out


class Problem(NamedTuple):
    """Something to be planned, and the plan that the search begins with."""

    task: Task
    goal: Weights
    first: Events

    @classmethod
    def drawn(cls, practice: Practice, seed: int) -> Problem:
        """That of a seed."""
        start = Snapshot.start(grid.generate(
            seed, num_agents=practice.agents, num_targets=practice.targets, max_steps=_HORIZON))
        task = Task.of(start, travel_times(start))
        goal = Weights.of("makespan", 1.0, 0.05, task)
        return cls(task, goal, best_insertion(task, goal, hurry=True))

    def makespan(self, guide: Floats, places: int, seed: int) -> int:
        """Steps of the plan that the guided search finds."""
        found = searched(self.task, self.goal, self.first, seed, places, guide)
        return measure(self.task, found)[0]


class Guider:
    """A guide in training. A `training.run.trainee.Trainee`."""

    unit = "generation"

    def __init__(self, config: Guiding, name: str = "guide"):
        self.config, self.name, self.seed = config, name, config.seed
        self.moving = STEPS > 0
        like = jnp.zeros(int(self.moving.sum()))
        self.rule = Sep_CMA_ES(population_size=config.population, solution=like)
        self.numbers = self.rule.default_params.replace(std_init=config.sigma)
        self.searcher: Any = self.rule.init(jax.random.key(config.seed), like, self.numbers)

    def guide(self, weights: Any) -> Floats:
        """The guide of moved weights [D]."""
        vector = PLAIN.copy()
        vector[self.moving] += STEPS[self.moving] * np.asarray(weights, np.float64)
        return vector

    @property
    def searches(self) -> int:
        """Of a generation."""
        return self.config.population * sum(p.problems for p in self.config.practices)

    @property
    def recipe(self) -> dict[str, Any]:
        """Preset, method and all numbers of the run; in the guide's header too."""
        return {"preset": self.name, "method": "separable CMA-ES over whole searches",
                **dataclasses.asdict(self.config)}

    @property
    def network(self) -> dict[str, Any]:
        """How many weights there are, and how many candidates."""
        return {"weights": len(PLAIN), "moving": int(self.moving.sum()),
                "population": self.config.population}

    @property
    def phases(self) -> tuple[tuple[str, int], ...]:
        """One."""
        return (("evolution", self.config.rounds),)

    @property
    def env_steps(self) -> int:
        """Searches of the whole run."""
        return self.config.rounds * self.searches

    def enter(self, phase: str) -> None:
        """There is no other."""
        return

    def chunk(self, at: Position) -> Made:
        """One generation."""
        config, number = self.config, at.total_updates
        drawing, telling = jax.random.split(jax.random.fold_in(jax.random.key(config.seed), number))
        with jax.numpy_rank_promotion("allow"):  # evosax relies on it
            candidates, asked = self.rule.ask(drawing, self.searcher, self.numbers)
        guides = [self.guide(one) for one in np.asarray(candidates)]
        costs = np.zeros(len(guides) + 1)
        with ThreadPoolExecutor(cores()) as pool:
            for i, practice in enumerate(config.practices):
                first = _FRESH + (number * len(config.practices) + i) * 100
                problems = [Problem.drawn(practice, config.seed * _APART + first + k)
                            for k in range(practice.problems)]
                cost = partial(_cost, problems, practice.places, first)
                costs += practice.weight * np.array(list(pool.map(cost, [*guides, PLAIN])))
        costs /= sum(p.weight for p in config.practices)
        fitness = costs[:-1] - costs[-1]
        with jax.numpy_rank_promotion("allow"):
            self.searcher, _ = self.rule.tell(
                telling, candidates, jnp.asarray(fitness, jnp.float32), asked, self.numbers)
        return Made(1, self.searches, {
            "candidates": float(fitness.mean()), "best": float(fitness.min()),
            "sigma": float(self.searcher.std)})

    @cached_property
    def _held(self) -> list[tuple[Practice, list[Problem], Floats]]:
        """Practices, their problems held out, and the makespans by the plain guide."""
        out = []
        for i, practice in enumerate(self.config.practices):
            few = practice.places > _LONG or practice.targets > 100
            count = max(1, self.config.held_out // (8 if few else 1))
            problems = [Problem.drawn(practice, _HELD + 1000 * i + k) for k in range(count)]
            out.append((practice, problems, _all_cores(problems, PLAIN, practice.places, i)))
        return out

    def held_out(self, at: Position) -> dict[str, Any]:
        """Makespans against those by the plain guide; before the first generation too."""
        if not due(at, self.config.rounds, EVAL_EVERY):
            return {}
        guide, rows = self.guide(self.searcher.mean), []
        for i, (practice, problems, plain) in enumerate(self._held):
            found = _all_cores(problems, guide, practice.places, i)
            rows.append({"practice": practice.name, "weight": practice.weight,
                         "makespan": float(found.mean()), "plain": float(plain.mean()),
                         "over_plain": float(np.log(found / plain).mean())})
        return {"generation": at.update, "practices": rows}

    def weights(self) -> Any:
        """The mean."""
        return self.searcher.mean

    def state(self) -> Any:
        """The strategy's."""
        return self.searcher

    def shapes(self, phase: str) -> Any:
        """They are always the same."""
        return self.searcher

    def restore(self, phase: str, state: Any) -> None:
        """Puts it back."""
        self.searcher = jax.tree.map(jnp.asarray, state)

    def score(self, row: Row) -> float | None:
        """How much the makespans are under those by the plain guide."""
        return -over_plain(row) if "practices" in row else None

    def fallen(self, rows: list[Row]) -> str:
        """A mean of many does not fall."""
        return ""

    def words(self, rows: list[Row]) -> str:
        """Where it is, and how it did when last looked at."""
        row, look = rows[-1], next(r for r in reversed(rows) if "practices" in r)
        return (f"generation {row['update']:,} of {self.config.rounds:,}, its candidates "
                f"{row['candidates']:+.2%} over the plain guide\n"
                f"held out {over_plain(look):+.2%}, in as much time")

    def policy(self, at: Position, commit: str) -> PolicyFile:
        """The guide, with recipe and commit in the header."""
        parts = {name: part.astype(np.float32)
                 for name, part in parts_of(self.guide(self.searcher.mean)).items()}
        return PolicyFile(KIND, {}, parts, self.recipe, commit)

    def report(self, rows: list[Row]) -> dict[str, Any]:
        """The last evaluation."""
        last = next(r for r in reversed(rows) if "practices" in r)
        return {"over_plain": over_plain(last), "practices": last["practices"]}

    def lines(self, report: dict[str, Any]) -> list[str]:
        """A line a practice."""
        return [*(f"{row['practice']}: {row['makespan']:.2f} steps, {row['over_plain']:+.2%} over "
                  f"the plain guide's" for row in report["practices"]),
                f"{report['env_steps']:,} searches in {report['seconds']:.0f} s"]

    def draw_curve(self, path: Path, rows: list[Row]) -> None:
        """Held-out makespans of every practice over minutes."""
        draw_curve(path, rows)


def over_plain(row: Row) -> float:
    """Mean over practices, by their weights, of an evaluation."""
    rows = row["practices"]
    return (sum(r["weight"] * r["over_plain"] for r in rows)
            / sum(r["weight"] for r in rows))


def _makespans(problems: list[Problem], guide: Floats, places: int, seed: int,
               each: Callable[..., Iterable[int]] = map) -> Floats:
    """[problems] by searches of so many places; `each` is `map`, or a pool's."""
    return np.array(list(each(lambda problem, k: problem.makespan(guide, places, seed + k),
                              problems, range(len(problems)))), np.float64)


def _all_cores(problems: list[Problem], guide: Floats, places: int, seed: int) -> Floats:
    """The same on all cores."""
    with ThreadPoolExecutor(cores()) as pool:
        return _makespans(problems, guide, places, seed, pool.map)


def _cost(problems: list[Problem], places: int, seed: int, guide: Floats) -> float:
    """Mean logarithm of the makespans, in one thread."""
    return float(np.log(_makespans(problems, guide, places, seed)).mean())
