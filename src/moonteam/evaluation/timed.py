"""Planners by the clock side by side on a set: what `grid` is to scenarios in steps."""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np

from moonteam.cluster import Cluster
from moonteam.errors import InputError
from moonteam.evaluation import apart
from moonteam.evaluation.contenders import MAKESPAN, Options, policies
from moonteam.planners.base import Objective, check_objective
from moonteam.planners.kind import NO_THREADS, PlannerOptions
from moonteam.planners.seconds import base, registry
from moonteam.planners.seconds.base import MS, Moment, TimedPlan, TimedPlanner
from moonteam.planners.seconds.registry import TimedPlannerKind
from moonteam.problem.timed import Timed
from moonteam.report import provenance, tables
from moonteam.report.intervals import RESAMPLES, Bootstrap, Figure, share
from moonteam.report.journal import NOTHING, Kept
from moonteam.report.progress import track
from moonteam.report.tables import Column

PANELS = (("makespan_gap", "makespan over the optimum, %", 100.0),
          ("success", "success", 1.0))
COLUMNS = (
    Column("success", "success", lambda value: f"{value:.3f}"),
    Column("makespan", "mean makespan", lambda value: f"{value:.3f}"),
    Column("effort", "mean effort", lambda value: f"{value:.2f}"),
    Column("makespan_gap", "makespan gap", lambda value: f"{100 * value:+.2f} %"),
    Column("certified", "proved optimal", lambda value: f"{value:.3f}"),
    *tables.SECONDS)
PAGE = COLUMNS


@dataclass(frozen=True)
class Result:
    """One plan, judged: makespan and effort in the set's own unit of time."""

    id: str
    success: bool
    makespan: float | None
    effort: float | None
    status: str
    seconds: float
    wrong: str = ""
    """What the judge found wrong with it."""

    def row(self, planner: str, optimal: float | None) -> dict:
        """As the report holds it."""
        return {"id": self.id, "planner": planner, "success": self.success,
                "makespan": self.makespan, "effort": self.effort, "seconds": self.seconds,
                "status": self.status, "optimal": {"makespan": optimal}}


@dataclass(frozen=True)
class Contender:
    """One row of the table: a planner with an objective and perhaps a time limit."""

    name: str
    planner: TimedPlanner
    most_targets: int | None = None

    alone: bool = False
    """Problems are planned one at a time by planners that can take many at once, too."""

    @property
    def together(self) -> bool:
        """Whether it plans a whole set in one call."""
        return not self.alone and callable(getattr(self.planner, "plans", None))

    def plan(self, problem: Timed) -> Result:
        """One problem, planned and judged."""
        now = base.moment(problem)
        began = time.perf_counter()
        plan = self.planner.plan(now)
        return judged(problem, now, plan, time.perf_counter() - began)

    def plan_all(self, problems: Sequence[Timed]) -> list[Result]:
        """A whole set, planned in one call and judged; each has its share of the time."""
        moments = [base.moment(problem) for problem in problems]
        began = time.perf_counter()
        plans = cast(Any, self.planner).plans(moments)
        share = (time.perf_counter() - began) / max(len(problems), 1)
        return [judged(*one, share) for one in zip(problems, moments, plans, strict=True)]

    def parts(self, problems: Sequence[Timed], size: int, kept: Kept) -> list[apart.Part]:
        """What `run_all` would note and is not in `kept` yet, to be made apart, with at most `size`
        problems in each part; in one where a set is planned in one call.
        """
        own = kept.within(self.name)
        if self.together:
            return [] if own.has("all") else [
                apart.Part([(self.name, "all")], self._apart, (problems,))]
        left = [i for i in range(len(problems)) if not own.has(str(i))]
        return [apart.Part([(self.name, str(i)) for i in some], self._apart,
                           ([problems[i] for i in some],)) for some in apart.chunks(left, size)]

    def _apart(self, problems: Sequence[Timed]) -> list[Any]:
        self.warm(problems)
        if self.together:
            return [self.plan_all(problems)]
        return [self.plan(problem) for problem in problems]

    def warm(self, problems: Sequence[Timed]) -> float:
        """s of the first call, which loads and compiles."""
        began = time.perf_counter()
        if self.together:
            cast(Any, self.planner).plans([base.moment(problem) for problem in problems])
        elif self.alone:  # what is compiled, is for each size
            for problem in {(len(p.agents), len(p.targets)): p for p in problems}.values():
                self.planner.plan(base.moment(problem))
        else:
            self.planner.plan(base.moment(base.TRIAL))
        return time.perf_counter() - began


def judged(problem: Timed, now: Moment, plan: TimedPlan, seconds: float) -> Result:
    """A plan's result; nothing of the planner's promise is believed."""
    wrong = "; ".join(base.problems(now, plan.services)) if plan.status != "infeasible" else ""
    if wrong or plan.status == "infeasible":
        return Result(problem.id, False, None, None, plan.status, seconds, wrong)
    return Result(problem.id, True, base.makespan(now, plan.services) / MS,
                  base.effort(now, plan.services) / MS, plan.status, seconds)


@dataclass
class Outcomes:
    """What one contender did on a set, as far as it came."""

    planner: str
    first_call: float = 0.0
    results: list[Result] = field(default_factory=list)


def contenders(options: Options) -> list[Contender]:
    """All rows asked for. Raises InputError at the first wrong name or number."""
    given = ["moves" if one == "effort" else one for one in options.objectives]
    objectives: Sequence[Objective] = [
        check_objective(one, options.alpha, options.beta) for one in dict.fromkeys(given)]
    kinds = [registry.find(name) for name in dict.fromkeys(options.planners)]
    _check_options(options, kinds)
    found = []
    for kind in kinds:
        found += _policies(kind, options, objectives) if kind.wants_policy else _planned(
            kind, options, objectives or MAKESPAN)
    names = [one.name for one in found]
    if len(set(names)) < len(names):
        raise InputError("--planner", "two rows would have the same name; rename one")
    return found


def _check_options(options: Options, kinds: Sequence[TimedPlannerKind]) -> None:
    """Raises InputError for options that would have no effect."""
    if options.threads > 1 and not any(kind.parallel for kind in kinds):
        raise InputError("--threads", NO_THREADS)
    if any(kind.wants_policy for kind in kinds):
        return
    for option, given in (("--policy", options.policies), ("--preference", options.preferences),
                          ("--decode", tuple(options.decodes) != ("argmax",)),
                          ("--alone", options.alone)):
        if given:
            raise InputError(option, "has no effect without --planner policy")


def _planned(kind: TimedPlannerKind, options: Options, objectives: Sequence[Objective]
             ) -> list[Contender]:
    """The rows of a planner: every objective and, if it is anytime, limit."""
    limits = [*dict.fromkeys(options.time_limits)] if kind.anytime else []
    found = []
    for objective, limit in itertools.product(objectives, limits or [None]):
        words = ["effort" if objective == "moves" else objective]
        words += [f"{limit:g} s"] if len(limits) > 1 else []
        words += [f"{options.threads} threads"] if options.threads > 1 and kind.parallel else []
        found.append(Contender(f"{kind.name}({', '.join(words)})", kind.make(
            options.of(objective, limit)), kind.most_targets))
    return found


def _policies(kind: TimedPlannerKind, options: Options, objectives: Sequence[Objective]
              ) -> list[Contender]:
    """The rows of a planner that decides by a policy, as for scenarios in steps."""
    return [Contender(row.name, kind.make(PlannerOptions(
        row.objective, options.alpha, options.beta, seed=options.seed, policy=row.policy,
        decode=row.decode.asked, preference=row.preference)), alone=options.alone)
        for row in policies(options, objectives)]


def check(problems: Sequence[Timed], rows: Sequence[Contender]) -> None:
    """Raises InputError for a planner that takes on fewer targets than a problem has."""
    largest = max(problems, key=lambda problem: len(problem.targets))
    for row in rows:
        if row.most_targets is not None and len(largest.targets) > row.most_targets:
            raise InputError(f"--planner {row.name}", f"takes at most {row.most_targets} targets; "
                             f"{largest.id or 'a problem'} has {len(largest.targets)}")


def run_all(problems: Sequence[Timed], rows: Sequence[Contender], title: str = "",
            kept: Kept = NOTHING) -> list[Outcomes]:
    """What each contender did; after Ctrl-C what was done before it, if that is anything."""
    found: list[Outcomes] = []
    try:
        for row in rows:
            own = kept.within(row.name)
            numbers = range(len(problems))
            left = not own.has("all") if row.together else any(
                not own.has(str(i)) for i in numbers)
            done = Outcomes(row.name, row.warm(problems) if left else 0.0)
            found.append(done)
            if row.together:
                done.results += own.once(
                    ("all",), list[Result], lambda row=row: row.plan_all(problems))
                continue
            for i in track(numbers, f"{title} {row.name}".strip(), len(problems)):
                done.results.append(own.once(
                    (str(i),), Result, lambda i=i, row=row: row.plan(problems[i])))
    except KeyboardInterrupt:
        found = [done for done in found if done.results]
        if not found:
            raise
    return found


def evaluate(problems: Sequence[Timed], rows: Sequence[Contender], seed: int, title: str,
             command: str, kept: Kept = NOTHING, cluster: Cluster | None = None) -> dict:
    """The whole report as a JSON-able document, of work done here or on a cluster; interrupted,
    it reports what is done.

    Raises InputError before anything is run.
    """
    check(problems, rows)
    own, kept = apart.done(cluster, rows, len(problems), kept,
                           lambda row, size, kept: row.parts(problems, size, kept))
    found = run_all(problems, own, kept=kept)
    bootstrap = Bootstrap(len(problems), seed)
    optimal = [best_of(problem) for problem in problems]
    known = sum(one is not None for one in optimal)
    notes = [f"Measured against the optimum of {known} of {len(problems)} problems, which their "
             "file states." if known else "No optimum is known: no gaps.",
             "Makespan: when the last service has ended and everybody with a home is there; "
             "effort: the team's time under way; both in the set's own unit of time.",
             f"In brackets: 95 % intervals over {len(problems)} problems: of shares by Wilson, "
             f"else bootstrap, {RESAMPLES} resamples.",
             *(f"{row.name}: planning time is the whole set's, planned in one call, over its "
               "problems; --alone plans one at a time." for row in rows if row.together),
             *faults(found)]
    lacking = [row.name for row in rows if row.name not in whole(found, len(problems))]
    return {
        "title": title, "summary": [summary(one, optimal, bootstrap) for one in found],
        "rows": [result.row(one.planner, best) for one in found
                 for result, best in zip(one.results, optimal, strict=False)],
        "notes": notes, "meta": provenance.meta(command, seed),
    } | ({"interrupted": lacking} if lacking else {})


def whole(found: Sequence[Outcomes], count: int) -> list[str]:
    """Names of those that came to the end of a set."""
    return [one.planner for one in found if len(one.results) == count]


def faults(found: Sequence[Outcomes]) -> list[str]:
    """One line for each planner whose plans the judge would not have, with the first of them."""
    lines = []
    for one in found:
        wrong = [result for result in one.results if result.wrong]
        if wrong:
            lines.append(f"{one.planner}: {len(wrong)} plans break the rules, counted as failures; "
                         f"{wrong[0].id}: {wrong[0].wrong}")
    return lines


def best_of(problem: Timed) -> float | None:
    """The makespan that is proved the least, where one is known."""
    return None if problem.optimal is None else problem.optimal.makespan


def summary(done: Outcomes, optimal: Sequence[float | None], bootstrap: Bootstrap) -> dict:
    """A row of the report. Failures have no makespan and are left out of its mean.

    What an interruption left out is left out everywhere.
    """
    def column(values: Sequence[float | None]) -> np.ndarray:
        padded = [*values, *[None] * (bootstrap.count - len(values))]
        return np.array([np.nan if value is None else value for value in padded])

    results = done.results
    makespan = column([r.makespan for r in results])
    gap = bootstrap.ratio(makespan, column(optimal))
    found = {
        "success": share([float(r.success) for r in results]),
        "makespan": bootstrap.mean(makespan),
        "effort": bootstrap.mean(column([r.effort for r in results])),
        "makespan_gap": Figure(*(value - 1.0 for value in gap)),
        "certified": share([float(r.success and r.status == "optimal") for r in results])}
    return {"planner": done.planner, "scenarios": len(results),
            **{key: figure.value for key, figure in found.items()},
            "intervals": {key: [figure.low, figure.high] for key, figure in found.items()},
            "seconds": sum(r.seconds for r in results) / max(len(results), 1),
            "first_call_seconds": done.first_call}
