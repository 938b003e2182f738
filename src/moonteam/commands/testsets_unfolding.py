"""The test sets of missions that unfold, with everything that will happen written down."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from moonteam.commands.testsets_seconds import certify, judged
from moonteam.problem.timed import Known, Timed

COUNT = 1000


@dataclass(frozen=True)
class Recipe:
    """One set: a family of `moonteam.planners.unfolding.draw`."""

    family: str
    count: int = COUNT

    def name(self) -> str:
        """File name without suffix, e.g. unfolding/hidden."""
        return f"unfolding/{self.family}"


RECIPES = tuple(Recipe(family) for family in ("following", "arrivals", "hidden", "losses",
                                               "scatter", "lapsing"))
NAMES = tuple(recipe.name() for recipe in RECIPES)


def make(recipe: Recipe, count: int, seed: int, speeds: tuple[float, ...],
         update: Callable[[int, str], None]) -> list[Timed]:
    """One set; `update(done, words)` is told about progress."""
    from moonteam.planners.unfolding import draw

    return judged(recipe.name(), draw.draws(recipe.family, seed, speeds), bound, count, update)


def bound(problem: Timed) -> Known | None:
    """The least makespan in hindsight, all known from the start, how long ways take too, and nobody
    lost: nobody can be faster. Where targets lapse, the most worth that can be served, and how soon
    that can be done. None where that is more than the limit.
    """
    from moonteam.planners.unfolding.draw import in_hindsight

    known = certify(problem, in_hindsight)
    return None if known is None else Known(bound=known.makespan, worth=known.worth)


def describe(recipe: Recipe, seed: int, speeds: tuple[float, ...], problems: list[Timed]) -> dict:
    """What index.json says about a set."""
    bounds = [one.optimal.bound for one in problems
              if one.optimal is not None and one.optimal.bound is not None]
    most = [one.optimal.worth for one in problems if one.optimal is not None and one.optimal.worth]
    return {"agents": len(problems[0].agents), "targets": len(problems[0].targets), "skills": 2,
            "size": [32, 32], "clock": "seconds", "metric": problems[0].metric,
            "speeds": [1.0] if recipe.family == "following" else list(speeds),
            "count": len(problems), "seed": seed, "unfolds": recipe.family,
            "optima": "exact in hindsight, a bound",
            "mean_bound_makespan": round(sum(bounds) / len(bounds), 3)} | (
        {"mean_bound_worth": round(sum(most) / len(most), 3)} if most else {})
