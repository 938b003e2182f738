"""Who decides best where not everything is known: missions that unfold, side by side.

Every row meets the same futures, which stand in the set. Rows are compared with the first, exact
replanning where it is among them, mission by mission.
"""

from __future__ import annotations

import itertools
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from moonteam.errors import InputError
from moonteam.evaluation import timed as by_clock
from moonteam.planners.seconds.base import MS, TimedPlanner, enough, moment
from moonteam.planners.seconds.policy import PolicyPlanner
from moonteam.planners.unfolding.deciding.ahead import LookingAhead
from moonteam.planners.unfolding.deciding.deciders import (
    GOALS,
    Choose,
    Decider,
    Goal,
    Replanning,
    planned,
    play,
    play_together,
)
from moonteam.planners.unfolding.deciding.make import (
    ALL_AT_ONCE,
    PLACES,
    STAY,
    check_futures,
    decider_of,
    pointing,
    searching,
    stands,
)
from moonteam.planners.unfolding.state import Outcome
from moonteam.planners.unfolding.world import World
from moonteam.problem.timed import Known, Timed
from moonteam.report import provenance, tables
from moonteam.report.intervals import RESAMPLES, Bootstrap, Figure, share
from moonteam.report.journal import NOTHING, Kept
from moonteam.report.progress import track
from moonteam.report.tables import Column

PANELS = (("worth_gap", "worth served over the first row, %", 100.0),
          ("gap", "seconds over the first row, %", 100.0),
          ("waited_gap", "waiting over the first row, %", 100.0),
          ("success", "success", 1.0))
COVERAGE = 61
"""Points of the line that says how much of the ground has been seen."""
COLUMNS = (
    Column("success", "success", lambda value: f"{value:.3f}"),
    Column("worth", "worth served", lambda value: f"{100 * value:.1f} %"),
    Column("worth_gap", "worth over the first row", lambda value: f"{100 * value:+.2f} %"),
    Column("worth_bound_gap", "worth over hindsight", lambda value: f"{100 * value:+.1f} %"),
    Column("seconds", "mean seconds", lambda value: f"{value:.2f}"),
    Column("gap", "over the first row", lambda value: f"{100 * value:+.2f} %"),
    Column("bound_gap", "over hindsight", lambda value: f"{100 * value:+.1f} %"),
    Column("waited", "a target waits, s", lambda value: f"{value:.2f}"),
    Column("waited_gap", "waiting over the first row", lambda value: f"{100 * value:+.2f} %"),
    Column("effort", "s under way", lambda value: f"{value:.1f}"),
    Column("decisions", "decisions", lambda value: f"{value:.1f}"),
    Column("decision_seconds", "a decision takes", tables.duration))
PAGE = COLUMNS
"""Columns of the Markdown table."""


@dataclass(frozen=True)
class Row:
    """One row of the table."""

    contender: by_clock.Contender
    futures: int = 0
    pattern: str = ""
    goal: Goal = "makespan"
    ahead: bool = False
    """A policy that looks ahead in the macro world."""

    @property
    def name(self) -> str:
        """Such as exact(makespan) over 16 futures, nearest; or ... over 16 futures, waiting."""
        over = f" over {self.futures} futures" if self.futures else (
            ", then planned" if self.ahead else "")
        aims = f", {self.goal}" if self.futures and self.goal != GOALS[0] else ""
        return f"{self.contender.name}{over}{aims}" + (f", {self.pattern}" if self.pattern else "")

    @property
    def planner(self) -> TimedPlanner:
        """The contender's."""
        return self.contender.planner

    @property
    def together(self) -> bool:
        """Whether it decides in many missions in one call, as it says last."""
        return self.ahead or (self.contender.together and not self.futures)

    def _replanning(self) -> Replanning:
        return Replanning(self.planner, searching(self.pattern), self.pattern == PLACES,
                          posts=stands(self.planner))

    def decider(self, number: int, seed: int) -> Decider:
        """Who decides in mission `number`."""
        if not self.futures:
            return self._replanning()
        return decider_of(self.planner, search=self.pattern, futures=self.futures, goal=self.goal,
                          seed=seed * 1_000_003 + number, certain=self.ahead)

    def play(self, problem: Timed, number: int, seed: int) -> Played:
        """One mission."""
        world, decider = World(problem), self.decider(number, seed)
        began = time.perf_counter()
        play(world, decider)
        return Played.of(problem, world.outcome, time.perf_counter() - began)

    def _choose(self, seed: int) -> Choose:
        """Who decides in many missions in one call."""
        if not isinstance(self.planner, PolicyPlanner) or not self.ahead:
            return pointing(self.planner) or partial(planned, self.planner)
        return LookingAhead(self.planner.policy, self.futures, self.goal, seed,
                            self.planner.preference).choose

    def play_all(self, problems: Sequence[Timed], seed: int) -> list[Played]:
        """All missions, side by side."""
        worlds = [World(problem) for problem in problems]
        deciders = [self._replanning() for _ in problems]
        choose = self._choose(seed)
        began = time.perf_counter()
        play_together(worlds, choose, deciders)
        each = (time.perf_counter() - began) / max(len(problems), 1)
        return [Played.of(problem, world.outcome, each)
                for problem, world in zip(problems, worlds, strict=True)]


@dataclass(frozen=True)
class Played:
    """A mission as one row played it."""

    id: str
    success: bool
    reason: str
    seconds: float  # failures count with the limit
    solved: int
    waited: float
    effort: float
    decisions: int
    lost: int
    took: float  # s of the machine
    worth: float = 0.0
    missed: float = 0.0
    seen: list[tuple[float, float]] = field(default_factory=list)

    @classmethod
    def of(cls, problem: Timed, out: Outcome, took: float) -> Played:
        """From what came of it."""
        limit = problem.max_seconds if problem.max_seconds is not None else out.seconds
        return cls(problem.id, out.success, out.reason, out.seconds if out.success else limit,
                   out.solved, out.waited, out.effort, out.decisions, out.lost, took, out.worth,
                   out.missed, out.seen)


def rows_of(contenders: Sequence[by_clock.Contender], futures: Sequence[int],
            patterns: Sequence[str], goals: Sequence[Goal] = (), ahead: bool = False,
            foresee: Sequence[str] = ()) -> list[Row]:
    """Every planner alone, then over so many futures, by every pattern of search.

    `ahead`: ways take what is expected, so that policies can look ahead in the macro world. Where
    targets are hidden and places to look from are asked for, rows are repeated over futures by
    them alone; what is agreed on there (`consensus`) is for the makespan.
    `foresee` says whose rows are repeated over each number of futures: all, those of policies, or
    of other planners; one word holds for every number. Over none only policies are repeated that
    can look ahead: alone until all is known, then with a plan.

    Raises InputError for a number of futures that is none, and words that are more or fewer.
    """
    for count in filter(None, futures):
        check_futures(count)
    if len(foresee) not in (0, 1, len(futures)):
        raise InputError("--foresee", f"given {len(foresee)} times; once, or as often as --futures")
    whose = foresee if len(foresee) > 1 else list(foresee or ["all"]) * len(futures)
    found = []
    for one in contenders:
        points = pointing(one.planner) is not None
        kind = "policies" if isinstance(one.planner, PolicyPlanner) else "planners"
        over = [count for count, who in zip(futures, whose, strict=True)
                if who in ("all", kind) and (not one.together or points)]
        for pattern in ["" if name == STAY else name for name in patterns] or [""]:
            found += [Row(one, 0, pattern)]
            looks = ahead and points and pattern in ALL_AT_ONCE
            aims: Sequence[Goal] = goals or GOALS[:1]
            if pattern == PLACES:
                aims = [goal for goal in aims if goal == GOALS[0]]
            elif PLACES in patterns:
                # By a pattern every mission is imagined by itself, which takes much longer.
                aims = []
            found += [Row(one, count, pattern, goal, looks) for count in over for goal in aims
                      if count or (looks and goal == GOALS[0])]
    if 0 in futures and not any(row.ahead and not row.futures for row in found):
        raise InputError("--futures", "0 is for policies by argmax that can look ahead, where "
                         "nothing is hidden and ways take what is expected")
    return found


def evaluate(problems: Sequence[Timed], rows: Sequence[Row], seed: int, title: str, command: str,
             kept: Kept = NOTHING) -> dict:
    """The report; interrupted, of the rows that are done. Raises InputError, nothing run yet."""
    by_clock.check(problems, [row.contender for row in rows])
    found: list[tuple[Row, list[Played]]] = []
    try:
        for row in rows:
            found.append((row, _played(problems, row, seed, kept.within(row.name))))
    except KeyboardInterrupt:
        if not found:
            raise
    bootstrap = Bootstrap(len(problems), seed)
    known = [problem.optimal or Known() for problem in problems]
    first = found[0][1]
    notes = [f"Mission by mission against the first row, {found[0][0].name}, in the same futures. "
             "Missions that fail count with their limit.",
             f"In brackets: 95 % intervals over {len(problems)} missions: of success by Wilson, "
             f"else bootstrap, {RESAMPLES} resamples.",
             "Hindsight: " + (
                 "the most worth that could have been served if all had been known from the start. "
                 "Time is second to worth." if any(one.worth for one in known) else
                 "the least makespan if all had been known from the start and nobody were lost; "
                 "nobody can be faster."),
             "A target waits from when there is one until its service starts; hidden ones from the "
             "mission's start.", *_solvable(problems, found), *_causes(found)]
    lacking = [row.name for row in rows[len(found):]]
    return {"title": title, "summary": [summary(row, played, first, known, bootstrap)
                                        for row, played in found],
            "rows": [_row(row, one, p) for row, played in found
                     for one, p in zip(played, problems, strict=True)],
            "notes": notes, "meta": provenance.meta(command, seed)} | (
        {"interrupted": lacking} if lacking else {})


def summary(row: Row, played: Sequence[Played], first: Sequence[Played],
            known: Sequence[Known], bootstrap: Bootstrap) -> dict:
    """A row of the report."""
    def column(key: str, of: Sequence[Played] = played) -> np.ndarray:
        return np.array([float(getattr(one, key)) for one in of])

    def over(key: str) -> Figure:
        return bootstrap.ratio(column(key) - column(key, first), column(key, first))

    def over_hindsight(values: np.ndarray, least: str) -> Figure:
        best = np.array([getattr(one, least) or np.nan for one in known])
        return Figure(*(v - 1 for v in bootstrap.ratio(values, best)))

    offered = column("worth") + column("missed")
    found = {"success": share(column("success")), "seconds": bootstrap.mean(column("seconds")),
             "gap": over("seconds"),
             "waited": bootstrap.mean(column("waited")), "waited_gap": over("waited"),
             "effort": bootstrap.mean(column("effort")),
             "decisions": bootstrap.mean(column("decisions"))}
    if offered.any():
        found |= {"worth": bootstrap.ratio(column("worth"), offered), "worth_gap": over("worth"),
                  "worth_bound_gap": over_hindsight(column("worth"), "worth")}
    else:
        found["bound_gap"] = over_hindsight(column("seconds"), "bound")
    return {"planner": row.name, "missions": len(played),
            **{key: figure.value for key, figure in found.items()},
            "intervals": {key: [figure.low, figure.high] for key, figure in found.items()},
            "decision_seconds": column("took").sum() / max(column("decisions").sum(), 1.0),
            **({"seen": coverage(played)} if any(one.seen for one in played) else {})}


def coverage(played: Sequence[Played]) -> dict[str, list[float]]:
    """Mean share of the ground that has been seen, at even seconds until nine missions of ten are
    over; what one has seen at its end stays.
    """
    seconds = np.linspace(0.0, float(np.quantile([one.seconds for one in played], 0.9)), COVERAGE)
    known = (np.array(one.seen).T for one in played)
    each = [np.interp(seconds, at, share) for at, share in known]
    return {"seconds": seconds.round(2).tolist(), "share": np.mean(each, 0).round(4).tolist()}


def _played(problems: Sequence[Timed], row: Row, seed: int, kept: Kept) -> list[Played]:
    if row.together:
        return kept.once(("all",), list[Played], lambda: row.play_all(problems, seed))
    return [kept.once((str(i),), Played, lambda i=i: row.play(problems[i], i, seed))
            for i in track(range(len(problems)), row.name, len(problems))]


def hopeless(problem: Timed) -> bool:
    """Whether a robot is lost before it could have been where the team needs it, by any plan."""
    lost = [(i, agent.lost) for i, agent in enumerate(problem.agents) if agent.lost is not None]
    first, everybody = moment(problem), range(len(problem.agents))
    for i, at in lost:
        rest = [k for k in everybody if k != i]
        for j in range(len(problem.targets)):
            if enough(rest, j, first):
                continue
            teams = (team for size in everybody for team in itertools.combinations(rest, size)
                     if enough([i, *team], j, first))
            if min(int(first.start[[i, *team], j].max()) for team in teams) > MS * at:
                return True
    return False


def _solvable(problems: Sequence[Timed], found: Sequence[tuple[Row, list[Played]]]) -> list[str]:
    """How many missions nobody could have solved, and the rate among the others."""
    never = np.array([hopeless(problem) for problem in problems])
    if not never.any():
        return []
    return [f"{never.sum()} missions nobody could have solved: a robot is lost before it could "
            "have been where the team needs it. Of the others: " + ", ".join(
                f"{row.name} {np.mean([one.success for one in played], where=~never):.3f}"
                for row, played in found) + "."]


def _causes(found: Sequence[tuple[Row, list[Played]]]) -> list[str]:
    """A line for each row with failures: why, and how often."""
    lines = []
    for row, played in found:
        counts: dict[str, int] = {}
        for one in played:
            if not one.success:
                words = re.sub(r"target \d+", "target", one.reason)
                counts[words] = counts.get(words, 0) + 1
        if counts:
            lines.append(f"{row.name}: " + "; ".join(
                f"{count} x {why}" for why, count in sorted(counts.items())))
    return lines


def _row(row: Row, one: Played, problem: Timed) -> dict[str, Any]:
    bound = None if problem.optimal is None else problem.optimal.bound
    return {"id": one.id, "planner": row.name, "success": one.success, "reason": one.reason,
            "seconds": one.seconds, "solved": one.solved, "waited": one.waited,
            "effort": one.effort, "decisions": one.decisions, "lost": one.lost,
            **({"worth": one.worth, "missed": one.missed} if one.worth or one.missed else {}),
            "optimal": {"bound": bound}}
