"""`moonteam testsets`: the scenario sets that every result is measured on, with their optima."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from moonteam import files, outputs
from moonteam.commands import testsets_seconds, testsets_unfolding
from moonteam.commands.options import Forced, Printed
from moonteam.errors import InputError, not_one_of
from moonteam.problem import timed
from moonteam.problem.scenario import Optimal, Scenario, load_set, save_set
from moonteam.report import progress

if TYPE_CHECKING:
    import numpy as np


@dataclass(frozen=True)
class Recipe:
    """How one set is drawn; the map is 32 x 32 cells, an episode 128 steps at most."""

    agents: int
    targets: int
    count: int
    skills: int = 2
    ground: tuple[float, ...] | None = None  # share of the map each kind of ours cannot enter
    certified: bool = True  # optima by the exact planner; else best known and a bound
    folder: str = ""

    def name(self) -> str:
        """File name without suffix, e.g. 3x5, 4x6-3skills, 3x6-blocked, large/20x100."""
        skills = f"-{self.skills}skills" if self.skills != 2 else ""
        blocked = "-blocked" if self.ground else ""
        return f"{self.folder}{self.agents}x{self.targets}{skills}{blocked}"

    @property
    def blocked(self) -> dict[str, float] | None:
        """kind -> share of the map that it cannot enter."""
        from moonteam.robots import OWN

        return dict(zip(OWN, self.ground, strict=True)) if self.ground else None


RECIPES = (
    Recipe(3, 5, 1000), Recipe(3, 6, 1000), Recipe(3, 7, 1000),
    Recipe(2, 3, 200), Recipe(2, 8, 200), Recipe(3, 10, 200), Recipe(3, 12, 200),
    Recipe(4, 8, 200), Recipe(5, 5, 200), Recipe(5, 10, 200), Recipe(6, 12, 200),
    Recipe(4, 6, 200, skills=3), Recipe(5, 8, 200, skills=3),
    Recipe(3, 6, 200, ground=(0.0, 0.12, 0.25)),
    Recipe(5, 20, 100, certified=False), Recipe(8, 40, 100, certified=False),
    Recipe(20, 100, 10, certified=False, folder="large/"),
    Recipe(50, 500, 3, certified=False, folder="large/"),
)
NAMES = tuple(recipe.name() for recipe in RECIPES)
ALL = NAMES + testsets_seconds.NAMES + testsets_unfolding.NAMES
INDEX = "index.json"


@dataclass(frozen=True)
class Args(Forced, Printed):
    """Makes the test sets, one .jsonl file each, with index.json that tells how.

    Every scenario can be solved within its 128 steps; draws that cannot are drawn again.
    Optima are those of the exact planner, makespan and moves each on its own and within 128
    steps. The sets too large for it hold the best values known (large-neighbourhood search
    with --iterations, from several starts) and lower bounds; the largest are in the folder large.

    The sets in the folder seconds are by the clock: robots of unlike speeds on straight ways,
    with the least makespan in seconds. Those in the folder unfolding are missions in which not
    everything is known from the start, with all that will happen written down.

    Examples:
      moonteam testsets --out assets/testsets --seed 0
      moonteam testsets --out /tmp/sets --sets 3x5 3x6-blocked --count 20
      moonteam testsets --out /tmp/sets --sets seconds/3x5-7 --speeds 2.0 0.4 0.5
      moonteam testsets --out /tmp/sets --sets 5x20 8x40 --better --iterations 400000 --starts 1
    """

    out: Path
    """Folder to write to."""

    seed: int = 0
    """Seed of the draws; each set has its own stream."""

    sets: tuple[str, ...] = ALL
    """Which sets to make."""

    count: int | None = None
    """Scenarios a set; default: 1000, 200, 100, 10 or 3 as the set asks."""

    iterations: int = 30_000
    """Large-neighbourhood iterations for each objective and start of the large sets."""

    starts: int = 2
    """Starts of the large-neighbourhood search."""

    better: bool = False
    """Leave the large sets in --out as they are but for plans that guided search finds shorter, so
    many iterations from so many starts each."""

    speeds: tuple[float, ...] = testsets_seconds.SPEEDS
    """m/s of which each robot of a set by the clock draws one: what our three kinds make
    over open ground."""


def draws(recipe: Recipe, seed: int) -> Iterator[Scenario]:
    """Endless scenarios of a set, not yet checked for time."""
    import numpy as np

    from moonteam.grid.scenarios import generate

    rng: np.random.Generator = np.random.default_rng([seed, zlib.crc32(recipe.name().encode())])
    while True:
        yield generate(rng, num_agents=recipe.agents, num_targets=recipe.targets,
                       num_skills=recipe.skills, blocked=recipe.blocked)


def certify(scenario: Scenario) -> Optimal | None:
    """Both optima by the exact planner; None if 128 steps are too few."""
    from moonteam.planners.base import Snapshot
    from moonteam.planners.exact import ExactPlanner

    snapshot = Snapshot.start(scenario)
    fastest = ExactPlanner("makespan").plan(snapshot)
    if fastest.status == "infeasible":
        return None
    return Optimal(makespan=fastest.makespan, moves=ExactPlanner("moves").plan(snapshot).moves)


def best_known(scenario: Scenario, iterations: int, starts: int) -> Optimal | None:
    """Best values of large-neighbourhood searches, and lower bounds; None if unsolved."""
    from moonteam.planners.base import Snapshot
    from moonteam.planners.lns import LnsPlanner
    from moonteam.planners.search.bounds import lower_bounds
    from moonteam.planners.search.task import Task
    from moonteam.planners.search.travel import travel_times

    snapshot = Snapshot.start(scenario)
    low_makespan, low_moves = lower_bounds(Task.of(snapshot, travel_times(snapshot)), parts=4)
    plans = {objective: [LnsPlanner(objective, iterations=iterations, seed=s).plan(snapshot)
                         for s in range(starts)] for objective in ("makespan", "moves")}
    everything = [plan for some in plans.values() for plan in some]
    makespans = [plan.makespan for plan in everything if plan.makespan is not None]
    moves = [plan.moves for plan in everything if plan.moves is not None]
    if not makespans:
        return None
    return Optimal(best_makespan=min(makespans), best_moves=min(moves),
                   bound_makespan=low_makespan, bound_moves=low_moves)


def bettered(scenario: Scenario, iterations: int, starts: int) -> Optimal:
    """What is known of a scenario once guided search for its makespan has had its turn."""
    from moonteam.planners.base import Snapshot
    from moonteam.planners.guided import GuidedPlanner

    known = scenario.optimal or Optimal()
    plans = [GuidedPlanner(iterations=iterations, seed=s).plan(Snapshot.start(scenario))
             for s in range(starts)]
    makespans = [value for value in (known.best_makespan, *(p.makespan for p in plans))
                 if value is not None]
    return msgspec.structs.replace(known, best_makespan=min(makespans, default=None))


def better(recipe: Recipe, args: Args, update: Callable[[int, str], None],
           before: dict[str, Any]) -> dict[str, Any]:
    """Searches a set again, on all cores; what the index says about it then."""
    path = args.out / f"{recipe.name()}.jsonl"
    known = load_set(path)
    out = testsets_seconds.judged(
        recipe.name(), iter(known), lambda one: bettered(one, args.iterations, args.starts),
        len(known), update)
    save_set(path, out)
    return before | {
        "optima": before.get("optima", "").replace(", with lower bounds", "") + f", then makespans "
        f"of {args.starts} x {args.iterations} iterations of guided, with lower bounds",
        "mean_best_makespan": describe(recipe, args, out)["mean_best_makespan"]}


def make(recipe: Recipe, args: Args, update: Callable[[int, str], None]) -> list[Scenario]:
    """One set; `update(done, words)` is told about progress."""
    def judge(scenario: Scenario) -> Optimal | None:
        if recipe.certified:
            return certify(scenario)
        return best_known(scenario, args.iterations, args.starts)

    return testsets_seconds.judged(recipe.name(), draws(recipe, args.seed), judge,
                                   args.count or recipe.count, update)


def run(args: Args) -> int:
    """Makes the sets asked for; returns 0."""
    unknown = [name for name in args.sets if name not in ALL]
    if unknown:
        raise InputError("--sets", not_one_of(unknown[0], ALL))
    slow = [speed for speed in args.speeds if not 0 < speed < math.inf]
    if slow or not args.speeds:
        raise InputError("--speeds", f"{slow or 'nothing'} is not allowed; m/s above 0")
    for option, value in (("--count", args.count), ("--iterations", args.iterations),
                          ("--starts", args.starts)):
        if value is not None and value < 1:
            raise InputError(option, f"{value} is not allowed; at least 1")
    if args.seed < 0:
        raise InputError("--seed", f"{args.seed} is not allowed; at least 0")
    if args.better:
        args = replace(args, sets=_searched(args))
    with outputs.folder(args.out, [f"{name}.jsonl" for name in args.sets], force=args.force,
                        resume=args.better or None, updates=(INDEX,), together=False):
        index = _make_all(args)
    if args.json:
        print(files.dump_json(index))
    return 0


def _searched(args: Args) -> tuple[str, ...]:
    """The sets to search again. Raises InputError for what cannot be, or is not there."""
    if args.force:
        raise InputError("--better", "leaves sets as they are that --force would replace")
    large = tuple(recipe.name() for recipe in RECIPES if not recipe.certified)
    chosen = large if args.sets == ALL else args.sets
    for name in chosen:
        if name not in large:
            raise InputError("--better", f"{name} holds certified optima; one of "
                             + ", ".join(large))
        if not (args.out / f"{name}.jsonl").exists():
            raise InputError(args.out, f"holds no {name}.jsonl to search again")
    return chosen


def _make_all(args: Args) -> dict[str, Any]:
    """Makes the sets; the index of the folder, with those that were there before."""
    index_path = args.out / INDEX
    index = files.read_json(index_path, dict[str, Any]) if index_path.exists() else {}
    for recipe in (*RECIPES, *testsets_seconds.RECIPES, *testsets_unfolding.RECIPES):
        name = recipe.name()
        if name not in args.sets:
            continue
        with progress.bar(name, args.count or recipe.count) as update:
            if args.better and isinstance(recipe, Recipe):
                index[name] = better(recipe, args, update, index.get(name, {}))
            else:
                index[name] = make_one(recipe, args, update)
        files.write_json(index_path, dict(sorted(index.items())))
        if not args.json:
            print(summary(name, index[name]), flush=True)
    return index


def make_one(recipe: Recipe | testsets_seconds.Recipe | testsets_unfolding.Recipe, args: Args,
             update: Callable[[int, str], None]) -> dict:
    """Makes and writes one set; what the index says about it."""
    path = args.out / f"{recipe.name()}.jsonl"
    if isinstance(recipe, Recipe):
        scenarios = make(recipe, args, update)
        save_set(path, scenarios)
        return describe(recipe, args, scenarios)
    module: Any = (testsets_seconds if isinstance(recipe, testsets_seconds.Recipe)
                   else testsets_unfolding)
    problems = module.make(recipe, args.count or recipe.count, args.seed, args.speeds, update)
    timed.save_set(path, problems)
    return module.describe(recipe, args.seed, args.speeds, problems)


def describe(recipe: Recipe, args: Args, scenarios: list[Scenario]) -> dict:
    """What index.json says about a set."""
    entry: dict = {
        "agents": recipe.agents, "targets": recipe.targets, "skills": recipe.skills,
        "size": [32, 32], "max_steps": scenarios[0].max_steps, "count": len(scenarios),
        "seed": args.seed, "blocked": recipe.blocked,
        "optima": "exact" if recipe.certified else
        f"best of {args.starts} x {args.iterations} iterations of lns, with lower bounds"}
    for key in ("makespan", "moves", "best_makespan", "best_moves", "bound_makespan",
                "bound_moves"):
        values = [getattr(s.optimal, key) for s in scenarios]
        if values[0] is not None:
            entry[f"mean_{key}"] = round(sum(values) / len(values), 3)
    return entry


def summary(name: str, entry: dict) -> str:
    """One line about a set."""
    means = ", ".join(f"{key[5:].replace('_', ' ')} {value}" for key, value in entry.items()
                      if key.startswith("mean_"))
    return f"{name}: {entry['count']} scenarios; means: {means}"
