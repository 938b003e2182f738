"""The test sets by the clock: unlike speeds, straight ways, certified optima."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec

from moonteam.problem.timed import Agent, Known, Target, Timed

if TYPE_CHECKING:
    from moonteam.planners.seconds.base import Moment

T = TypeVar("T", bound=msgspec.Struct)

SPEEDS = (1.5, 0.36, 0.47)
"""m/s that our three kinds make over open ground, measured in physics."""


@dataclass(frozen=True)
class Recipe:
    """How one set is drawn: places and skills as in the sets in steps, 32 x 32 m."""

    agents: int
    fewest: int
    most: int
    count: int

    def name(self) -> str:
        """File name without suffix, e.g. seconds/3x5-7."""
        return f"seconds/{self.agents}x{self.fewest}-{self.most}"


RECIPES = (Recipe(3, 5, 7, 1000),)
NAMES = tuple(recipe.name() for recipe in RECIPES)


def draws(recipe: Recipe, seed: int, speeds: tuple[float, ...]) -> Iterator[Timed]:
    """Endless problems of a set; each robot draws one of the speeds."""
    import numpy as np

    from moonteam.grid.scenarios import generate

    rng = np.random.default_rng([seed, zlib.crc32(recipe.name().encode())])
    while True:
        count = int(rng.integers(recipe.fewest, recipe.most + 1))
        found = generate(rng, num_agents=recipe.agents, num_targets=count, num_skills=2)
        pace = rng.choice(speeds, recipe.agents).tolist()
        yield Timed("seconds", tuple(
            Agent((float(a.at[0]), float(a.at[1])), a.skills, speed)
            for a, speed in zip(found.agents, pace, strict=True)), tuple(
            Target((float(t.at[0]), float(t.at[1])), t.skills, t.type) for t in found.targets))


def certify(problem: Timed, known: Callable[[Timed], Moment] | None = None) -> Known | None:
    """The least makespan by the exact planner, of what is expected or else `known`; None if it is
    not proved.
    """
    from moonteam.planners.seconds.base import MS, moment
    from moonteam.planners.seconds.exact import ExactPlanner
    from moonteam.planners.seconds.leaving import served

    now = (known or moment)(problem)
    plan = ExactPlanner("makespan").plan(now)
    if plan.status != "optimal" or plan.makespan is None:
        return None
    worth = None if now.worth is None else round(served(now, plan.services), 6)
    return Known(makespan=plan.makespan / MS, worth=worth)


def make(recipe: Recipe, count: int, seed: int, speeds: tuple[float, ...],
         update: Callable[[int, str], None]) -> list[Timed]:
    """One set; `update(done, words)` is told about progress."""
    return judged(recipe.name(), draws(recipe, seed, speeds), certify, count, update)


def judged(name: str, source: Iterator[T], judge: Callable[[T], Any], count: int,
           update: Callable[[int, str], None]) -> list[T]:
    """The first `count` scenarios or problems of a source that `judge` knows an optimum of.

    They are numbered, and hold what it said; it is asked on all cores.
    """
    from moonteam.compilation import cores

    found: list[T] = []
    with ThreadPoolExecutor(cores()) as pool:
        while len(found) < count:
            batch = [next(source) for _ in range(min(count - len(found), 50))]
            for one, optimal in zip(batch, pool.map(judge, batch), strict=True):
                if optimal is not None:
                    found.append(msgspec.structs.replace(
                        one, id=f"{name}-{len(found):04d}", optimal=optimal))
            update(len(found), f"{len(found)} of {count}")
    return found


def describe(recipe: Recipe, seed: int, speeds: tuple[float, ...], problems: list[Timed]) -> dict:
    """What index.json says about a set."""
    optima = [problem.optimal.makespan for problem in problems
              if problem.optimal is not None and problem.optimal.makespan is not None]
    return {"agents": recipe.agents, "targets": [recipe.fewest, recipe.most], "skills": 2,
            "size": [32, 32], "clock": "seconds", "metric": problems[0].metric,
            "speeds": list(speeds), "count": len(problems), "seed": seed, "optima": "exact",
            "mean_makespan": round(sum(optima) / len(optima), 3)}
