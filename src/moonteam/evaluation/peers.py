"""Our planners beside what others published, problem by problem."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from moonteam.evaluation import timed
from moonteam.evaluation.contenders import Options
from moonteam.evaluation.timed import Contender, Outcomes
from moonteam.problem.timed import Timed
from moonteam.report.intervals import RESAMPLES, Bootstrap, Figure
from moonteam.report.journal import NOTHING, Kept
from moonteam.report.tables import duration

FloatArray = npt.NDArray[np.float64]

EQUAL = 0.01
"""Makespans that differ by no more count as equal: plans of ours are in thousandths of a set's
unit of time, a rounding for each leg of a way, and theirs are printed with a few digits."""

MOST_EXACT = 10
"""Targets up to which the exact planner is asked where no planner is named."""

NOTES = [
    "Difference: ours less theirs, over the problems that both solved; in brackets 95 % paired "
    f"bootstrap intervals, {RESAMPLES} resamples. Negative: ours is shorter.",
    f"Shorter, equal, longer: problems in which our plan is so, equal meaning within {EQUAL:g}.",
    "Published figures were measured by their authors, on their machines, under their time limits."]


def contenders(problems: Sequence[Timed], options: Options) -> list[Contender]:
    """The rows of one set, of the usual planners if none is named. Raises InputError."""
    small = max(len(problem.targets) for problem in problems) <= MOST_EXACT
    usual = ("exact", "lns") if small else ("lns",)
    found = timed.contenders(replace(options, planners=options.planners or usual))
    timed.check(problems, found)
    return [replace(row, name=row.name.replace("(makespan)", "").replace("makespan, ", ""))
            for row in found]


def run_all(sets: Mapping[str, Sequence[Timed]], rows: Mapping[str, Sequence[Contender]],
            seed: int, kept: Kept = NOTHING) -> tuple[list[dict], list[str]]:
    """One part a set (summary, rows, notes), and what an interruption left out.

    Raises KeyboardInterrupt if nothing was done before it.
    """
    parts: list[dict] = []
    for n, (name, problems) in enumerate(sets.items()):
        try:
            found = timed.run_all(problems, rows[name], name, kept.within(name))
        except KeyboardInterrupt:
            if not parts:
                raise
            return parts, list(sets)[n:]
        parts.append(part(name, problems, found, seed))
        whole = timed.whole(found, len(problems))
        lacking = [f"{name}: {row.name}" for row in rows[name] if row.name not in whole]
        if lacking:
            return parts, lacking + list(sets)[n + 1:]
    return parts, []


def part(name: str, problems: Sequence[Timed], found: Sequence[Outcomes], seed: int) -> dict:
    """What one set adds to the report."""
    bootstrap = Bootstrap(len(problems), seed)
    theirs = published(problems)
    ours = {done.planner: _column(done, len(problems)) for done in found}
    times = {done.planner: sum(r.seconds for r in done.results) / max(len(done.results), 1)
             for done in found}
    summary = {
        "set": name, "problems": len(problems),
        "source": "; ".join(dict.fromkeys(problem.source for problem in problems)),
        "published": [_mean(key, values, bootstrap) for key, values in theirs.items()],
        "planners": [_mean(done.planner, ours[done.planner], bootstrap)
                     | {"seconds": times[done.planner],
                        "certified": sum(r.success and r.status == "optimal"
                                         for r in done.results)} for done in found],
        "against": [compared(planner, mine, key, values, bootstrap)
                    for planner, mine in ours.items() for key, values in theirs.items()]}
    rows = [{"set": name, "id": problem.id, "optimal": timed.best_of(problem),
             "published": {key: _plain(values[i]) for key, values in theirs.items()},
             "makespan": {planner: _plain(mine[i]) for planner, mine in ours.items()}}
            for i, problem in enumerate(problems)]
    return {"summary": summary, "rows": rows,
            "notes": [f"{name}: {summary['source']}.",
                      *(f"{name}: {line}" for line in timed.faults(found))]}


def published(problems: Sequence[Timed]) -> dict[str, FloatArray]:
    """Method -> makespans [S], best mean first; not-a-number where a problem has none."""
    said = [problem.optimal.published if problem.optimal else {} for problem in problems]
    names = dict.fromkeys(key for one in said for key in one)
    found = {key: np.array([one.get(key, np.nan) for one in said]) for key in names}
    return dict(sorted(found.items(), key=lambda item: float(np.nanmean(item[1]))))


def compared(planner: str, ours: FloatArray, name: str, theirs: FloatArray,
             bootstrap: Bootstrap) -> dict:
    """One planner of ours against one published column, problem by problem."""
    difference = ours - theirs
    known = difference[np.isfinite(difference)]
    figure = bootstrap.mean(difference)
    share = bootstrap.ratio(np.where(np.isfinite(theirs), ours, np.nan),
                            np.where(np.isfinite(ours), theirs, np.nan))
    return {"planner": planner, "published": name, "problems": len(known),
            "difference": _figure(figure), "share": _figure(Figure(*(v - 1.0 for v in share))),
            "shorter": int((known < -EQUAL).sum()),
            "equal": int((np.abs(known) <= EQUAL).sum()), "longer": int((known > EQUAL).sum())}


def tables(document: dict) -> list[tuple[list[str], list[list[str]]]]:
    """The means, then the differences, as plain tables."""
    means, against = [], []
    for one in document["sets"]:
        for row in one["planners"]:
            means.append([one["set"], row["name"], "ours", str(row["problems"]),
                          _written(row["makespan"]), duration(row["seconds"]),
                          str(row["certified"])])
        for row in one["published"]:
            means.append([one["set"], row["name"], "published", str(row["problems"]),
                          _written(row["makespan"]), "-", "-"])
        for row in one["against"]:
            against.append([
                one["set"], row["planner"], row["published"], _written(row["difference"], sign="+"),
                f"{100 * row['share']['mean']:+.1f}",
                *(str(row[key]) for key in ("shorter", "equal", "longer"))])
    return [(["set", "method", "whose", "problems", "mean makespan", "planning", "proved optimal"],
             means),
            (["set", "ours", "published", "difference", "in %", "shorter", "equal", "longer"],
             against)]


def flat(rows: Sequence[dict]) -> list[dict]:
    """One row a set, problem and method."""
    return [{"set": row["set"], "id": row["id"], "method": name, "published": kind == "published",
             "makespan": value, "optimal": row["optimal"]}
            for row in rows for kind in ("makespan", "published")
            for name, value in row[kind].items()]


def _column(done: Outcomes, count: int) -> FloatArray:
    """Makespans [S]; not-a-number where there is no plan, or none yet."""
    values = [np.nan if r.makespan is None else r.makespan for r in done.results]
    return np.array(values + [np.nan] * (count - len(values)))


def _mean(name: str, values: FloatArray, bootstrap: Bootstrap) -> dict:
    return {"name": name, "problems": int(np.isfinite(values).sum()),
            "makespan": _figure(bootstrap.mean(values))}


def _figure(figure: Figure) -> dict:
    return {"mean": figure.value, "low": figure.low, "high": figure.high}


def _plain(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _written(figure: dict, sign: str = "") -> str:
    mean, low, high = (format(figure[key], f"{sign}.3f") for key in ("mean", "low", "high"))
    return f"{mean} [{low}, {high}]"
