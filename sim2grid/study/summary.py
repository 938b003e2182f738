"""Rows of an evaluation to a document: means with intervals, failures by cause, tables.

The document is `report.json` of `moonteam evaluate execution`:

- `meta`: command, seed, commit, versions, machine.
- `options`: everything that the missions and their executions depend on.
- `contenders`: `name` with loop, mode, planner, policy, decode, objective.
- `summary`: a row for each site and contender, figures with `intervals` of 95 %.
- `comparisons`: async over barrier, one engine over the other, and by the clock each contender over
  the first, on missions that both solved.
- `differences`: missions that went otherwise on another engine, and what differed.
- `ways`: by the clock, how long ways took over what was reckoned, by kind and steepness.
- `failures`: for each site and contender, cause -> mission numbers.
- `missions`: number, draws and the whole mission as in its file.
- `rows`: a row for each mission and contender; `report` is that of `moonteam rollout`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import msgspec
import numpy as np

from moonteam.report.intervals import Bootstrap, Figure, share
from moonteam.report.tables import Plain
from sim2grid.loop.fused.whole import LACKS
from sim2grid.measure.metrics import Report, RobotReport
from sim2grid.measure.scatter import scatter
from sim2grid.study.evaluation import Contender, Entry, Row
from sim2grid.study.fleet import GIVEN

ALL = "all"
"""What stands for all sites together."""


def document(rows: Sequence[Row], entries: Sequence[Entry], contenders: Sequence[Contender],
             options: dict[str, Any], meta: dict[str, Any], seed: int) -> dict[str, Any]:
    """The whole report, plain values only. `rows` as `Evaluation.sorted_rows` gives them."""
    groups: dict[tuple[str, int, str], list[Row]] = {}
    for row in rows:
        seed_of = first_seed(options, row.site_seed)
        groups.setdefault((row.site, seed_of, row.contender), []).append(row)
    by_name = {contender.name: contender for contender in contenders}
    used = {key: group for key, group in groups.items() if key[2] in by_name}
    many = {"sites": options["sites"]} if "sites" in options else {}
    heads = {key: {"site": key[0], "site_seed": key[1], **many, "contender": key[2]}
             for key in used}
    return {
        "kind": "execution",
        "title": "executions in physics",
        "meta": meta,
        "options": options,
        "contenders": [{"name": c.name, **msgspec.to_builtins(c)} for c in contenders],
        "summary": [heads[key] | _about(by_name[key[2]]) | summarise(group, seed)
                    for key, group in used.items()],
        "comparisons": [line | many for line in compare(used, by_name, seed)],
        "differences": differences(used, by_name),
        "ways": scatter([row.report for row in rows if row.contender in by_name]),
        "failures": [heads[key] | {"causes": failures(group)} for key, group in used.items()],
        "notes": notes(options),
        "missions": [msgspec.to_builtins(entry) for entry in entries],
        "rows": [msgspec.to_builtins(row) for row in rows if row.contender in by_name],
    }


def first_seed(options: dict[str, Any], site_seed: int) -> int:
    """The seed of the first of the sites whose missions stand in one line."""
    return int(options["site_seed"]) if options.get("sites", 1) > 1 else site_seed


def _about(contender: Contender) -> dict[str, str]:
    return {"loop": contender.loop, "planner": contender.who, "mode": contender.mode,
            "backend": contender.backend}


def summarise(rows: Sequence[Row], seed: int) -> dict[str, Any]:
    """Means of one group. Seconds, decisions and gaps are over the missions that succeeded."""
    boot = Bootstrap(len(rows), seed)
    won = np.array([row.report.success for row in rows])
    able = np.array([row.solvable for row in rows])

    def values(read: Callable[[Row], float | None], only: np.ndarray | None = None) -> np.ndarray:
        found = np.array([math.nan if (v := read(row)) is None else v for row in rows], float)
        return found if only is None else np.where(only, found, math.nan)

    seconds = values(lambda row: row.report.seconds, won)
    decisions = values(lambda row: row.report.decisions, won)
    sent = values(lambda row: sum(map(legs_sent, row.report.robots)))
    figures = {
        "success": share(won),
        "success_solvable": share(won & able, able),
        "seconds": boot.mean(seconds),
        "decisions": boot.mean(decisions),
        "moves": boot.mean(values(lambda row: row.report.moves, won)),
        "inflation": boot.ratio(decisions, values(
            lambda row: row.report.grid_plan.makespan if row.report.grid_plan else None, won)),
        "slowdown": boot.ratio(seconds, values(lambda row: row.nominal_s, won)),
        "planned": boot.mean(values(lambda row: row.report.expected_s, won)),
        "optimum": boot.mean(values(
            lambda row: row.nominal_s if row.report.expected_s else None, won)),
        **{key: boot.mean(values(partial(_a_robot, key=key), won))
           for key in ("driving_s", "slower_s", "service_s")},
        "over_plan": boot.ratio(seconds, values(lambda row: row.report.expected_s, won)),
        "wrong_cell_rate": share(values(
            lambda row: sum(robot.wrong_cells for robot in row.report.robots)), sent),
        "timeout_rate": share(values(
            lambda row: sum(robot.timeouts for robot in row.report.robots)), sent),
        "replans": boot.mean(values(lambda row: sum(row.report.replans.values()))),
        "cross_track_rms_m": boot.mean(values(lambda row: _mean(
            [robot.cross_track_rms_m for robot in row.report.robots]))),
        "energy_kj": boot.mean(values(lambda row: sum(
            robot.energy_j for robot in row.report.robots) / 1e3, won)),
        "propellant_kg": boot.mean(values(lambda row: sum(
            robot.propellant_kg for robot in row.report.robots), won)),
        "worth": boot.ratio(values(lambda row: worth_of(row.report)),
                            values(lambda row: worth_of(row.report, False))),
        **{key: boot.mean(values(partial(_on_soil, key=key), won)) for key in ON_SOIL_KEYS},
    }
    causes = Counter(cause for row in rows for cause, n in row.report.replans.items()
                     for _ in range(n))
    robots = [robot for row in rows for robot in row.report.robots]
    return {
        "missions": len(rows), "solved": int(won.sum()), "solvable": int(able.sum()),
        **{key: _plain(figure.value) for key, figure in figures.items()},
        "falls": sum(robot.falls for robot in robots),
        "stuck": sum(robot.stuck for robot in robots),
        "replans_by_cause": dict(sorted(causes.items())),
        "intervals": {key: _ends(figure) for key, figure in figures.items()},
    }


def worth_of(report: Report, served: bool = True) -> float | None:
    """What the targets that may lapse count, those served or all that came; None without any."""
    found = [(t.worth, t.solved) for t in report.targets
             if not isinstance(t.worth, msgspec.UnsetType)]
    return sum(worth for worth, solved in found if solved or not served) if found else None


def _a_robot(row: Row, key: str) -> float | None:
    """A figure of the robots' reports, in the mean of the robots."""
    return _mean([getattr(robot, key) for robot in row.report.robots])


def _on_soil(row: Row, key: str) -> float | None:
    """A figure of those robots of which it is known what to expect on the mission's soil."""
    return _mean([getattr(robot, key) for robot in row.report.robots
                  if robot.expected_energy_j is not None
                  and (robot.expected_slip is not None or "energy" in key)])


def legs_sent(robot: RobotReport) -> int:
    """Moves to another cell that ended in arrival or time-out."""
    return robot.arrivals + robot.timeouts


def failure_label(row: Row) -> str:
    """Cause of a failed mission, with what was lost on the way: `unsolvable: KIND stuck`."""
    return cause_of(row.report)


def cause_of(report: Report) -> str:
    """The same of the report alone."""
    losses = sorted(f"{robot.kind} {robot.lost.replace('_', ' ')}" for robot in report.robots
                    if robot.lost)
    cause = (report.cause or "").replace("_", " ")
    return f"{cause}: {', '.join(losses)}" if losses else cause


def failures(rows: Sequence[Row]) -> dict[str, list[int]]:
    """Cause -> numbers of the missions that failed for it, the most frequent first."""
    found: dict[str, list[int]] = {}
    for row in rows:
        if not row.report.success:
            found.setdefault(failure_label(row), []).append(row.number)
    return dict(sorted(found.items(), key=lambda item: (-len(item[1]), item[0])))


def compare(groups: dict[tuple[str, int, str], list[Row]], by_name: dict[str, Contender],
            seed: int) -> list[dict[str, Any]]:
    """Async over barrier, another engine over the native one, and by the clock each over the first:
    seconds, their difference mission by mission, and moves on the missions that both solved.

    By the clock of all sites together too, where there are several.
    """
    found, together = [], dict[tuple[str, int, str], list[Row]]()
    if len({key[:2] for key in groups}) > 1:
        for (_, _, name), rows in groups.items():
            if by_name[name].mode == "clock":
                together.setdefault((ALL, 0, name), []).extend(rows)
    groups = groups | together
    for (site, site_seed, name), rows in groups.items():
        for other in _others(by_name[name], by_name):
            before = {row.number: row for row in groups.get((site, site_seed, other), [])}
            pairs = [(row.report, before[row.number].report) for row in rows
                     if row.number in before]
            both = [(a, b) for a, b in pairs if a.success and b.success]
            if not both:
                continue
            boot = Bootstrap(len(both), seed)
            figures = {key: boot.ratio(*zip(*((getattr(a, key), getattr(b, key))
                                              for a, b in both), strict=True))
                       for key in ("seconds", "moves")}
            figures["seconds_more"] = boot.mean([a.seconds - b.seconds for a, b in both])
            worth = [(worth_of(a), worth_of(b)) for a, b in pairs]
            worth = [two for two in worth if None not in two]
            if worth:
                figures["worth"] = Bootstrap(len(worth), seed).ratio(*zip(*worth, strict=True))
            found.append({
                "site": site, "site_seed": site_seed, "contender": name, "over": other,
                "missions": len(pairs), "both_solved": len(both),
                "only_this": sum(a.success and not b.success for a, b in pairs),
                "only_other": sum(b.success and not a.success for a, b in pairs),
                **{key: _plain(figure.value) for key, figure in figures.items()},
                "intervals": {key: _ends(figure) for key, figure in figures.items()}})
    return found


def _others(one: Contender, by_name: dict[str, Contender]) -> list[str]:
    """Names of the contenders that one is held against: by the clock, all those in steps that
    decide robot by robot, and the first by the clock.
    """
    if one.mode == "clock" and one.backend == "native":
        first = next(name for name, other in by_name.items()
                     if (other.mode, other.backend) == ("clock", "native"))
        return [*(name for name, other in by_name.items()
                  if (other.loop, other.mode, other.backend) == ("closed", "async", "native")),
                *([first] if first != one.name else [])]
    changes = [{"mode": "barrier"}] if one.mode == "async" else []
    changes += [{"backend": "native"}] if one.backend != "native" else []
    return [msgspec.structs.replace(one, **change).name for change in changes]


def differences(groups: dict[tuple[str, int, str], list[Row]], by_name: dict[str, Contender]
                ) -> list[dict[str, Any]]:
    """Missions in which success or decisions are not those of the native engine."""
    found = []
    for (site, site_seed, name), rows in groups.items():
        if by_name[name].backend == "native":
            continue
        other = msgspec.structs.replace(by_name[name], backend="native").name
        before = {row.number: row for row in groups.get((site, site_seed, other), [])}
        for row in rows:
            twin = before.get(row.number)
            if twin is None or _course(row) == _course(twin):
                continue
            found.append({"site": site, "site_seed": row.site_seed, "number": row.number,
                          "contender": name, "over": other, "this": _told(row),
                          "other": _told(twin), "why": _why(row, twin)})
    return found


def _course(row: Row) -> tuple[bool, int]:
    return row.report.success, row.report.decisions


def _told(row: Row) -> str:
    report = row.report
    end = "solved" if report.success else failure_label(row)
    return f"{end}, {report.decisions} decisions, {report.seconds:.1f} s"


def _why(row: Row, twin: Row) -> str:
    """What the robots' logs say otherwise."""
    said = [f"{a.name}: {key.replace('_', ' ')} {getattr(a, key)} against {getattr(b, key)}"
            for a, b in zip(row.report.robots, twin.report.robots, strict=True)
            for key in ("timeouts", "wrong_cells", "falls", "stuck", "lost")
            if getattr(a, key) != getattr(b, key)]
    return "; ".join(said) or "the same time-outs and wrong cells; one more or one less move"


def notes(options: dict[str, Any]) -> list[str]:
    """What must be known to read the tables."""
    found = ["seconds, decisions, energy: means over the missions that succeeded; brackets: 95 % "
             "intervals, of rates by Wilson, else by bootstrap over missions",
             "decisions / plan: over those of the same planner on the grid alone; seconds / ideal: "
             "over the grid plan at travelling speed"]
    found += [LACKS] if "fused" in options.get("backend", ()) else []
    drawn = {key: value for key, value in options.get("rates", {}).items() if value}
    if drawn:
        found.append("events drawn: " + ", ".join(f"{k} {v:g}" for k, v in drawn.items())
                     + "; success of solvable leaves out missions that the events themselves "
                     "made unsolvable")
    return found


BY_THE_CLOCK = ["site", "planner", "s by ways alone", "s as planned", "s driven",
                "driven / planned", "driven / ways alone"]
"""Ways alone: the same planner's makespan where setting out and coming to rest cost nothing."""
TIME_SPENT = ["site", "planner", "s of a mission", "a robot drives, by the ground",
              "slower than that", "in service", "standing", "replans"]
"""Of the mean robot. Slower: speeding up, coming to rest, making way. Standing: waiting for others,
or done.
"""
ON_SOIL_KEYS = ("slip", "expected_slip", "energy_j", "expected_energy_j")
ON_SOIL = ["site", "planner", "slip of wheels", "expected", "energy of a robot, J", "expected"]
"""On regolith: of robots on the ground; expected: by `moonteam evaluate paces`, from the slopes of
the ways that they took.
"""
WAYS = ["kind", "steepness", "ways", "took / reckoned", "spread"]
"""Ways driven to their ends, of all contenders. Steepness: mean of the ground's slope along them.
Took / reckoned: the median; reckoned: by the travel field, and what setting out and coming to rest
cost the kind. Spread: standard deviation of its logarithm; of all kinds, about the medians above.
"""
WORTH = ["site", "planner", "worth served, of all that came"]
WORTHIER = ["site", "contender", "over", "missions", "worth served, ratio"]
"""Where targets may lapse: of all missions, solved or not."""
MISSIONS = ["mission", "contender", "came to", "s", "s at best, as planned", "decisions"]
COMPARED = ["site", "contender", "over", "both solved", "only this", "only the other",
            "seconds, ratio", "seconds more", "moves, ratio"]
DIFFERENT = ["site", "mission", "contender", "went", "over", "which went", "what differs"]
"""Titles of the comparisons and of the differences between engines."""


def where(line: dict[str, Any]) -> str:
    """The ground of a line: preset or model with its seed, or the first and last of many; nothing
    of missions that were given.
    """
    if line["site"] in (GIVEN, ALL):
        return line["site"]
    first = line["site_seed"]
    last = first + line.get("sites", 1) - 1
    return f"{line['site']} {first}" + (f" to {last}" if last > first else "")


def _steepness(line: dict[str, Any]) -> str:
    low, high = line["from_deg"], line["to_deg"]
    return "any" if low is None else f"over {low:g}°" if high is None else f"{low:g} to {high:g}°"


def tables(report: dict[str, Any]) -> list[Plain]:
    """Summary, missions that were given, comparisons, failures, for Markdown or a terminal."""
    events = any(report["options"].get("rates", {}).values())
    titles = ["site", "loop", "planner", "mode", "success"]
    titles += ["of solvable"] if events else []
    titles += ["seconds", "decisions", "decisions / plan", "seconds / ideal", "wrong cell",
               "time-outs", "replans", "fell", "stuck"]
    rows = []
    for line in report["summary"]:
        physical = line["loop"] != "grid"
        cells = [where(line), line["loop"], line["planner"],
                 _mode(line),
                 f"{line['solved']} of {line['missions']}, {spread(line, 'success', 3)}"]
        if events:
            cells.append(f"{line['solved']} of {line['solvable']}, "
                         + spread(line, "success_solvable", 3))
        cells += [spread(line, "seconds", 1), spread(line, "decisions", 1)]
        cells += [spread(line, "inflation", 3), spread(line, "slowdown", 2),
                  spread(line, "wrong_cell_rate", 4), spread(line, "timeout_rate", 4),
                  _value(line["replans"], 2), str(line["falls"]), str(line["stuck"])
                  ] if physical else ["-"] * 7
        rows.append(cells)
    found: list[Plain] = [(titles, rows)]
    clocked = [line for line in report["summary"] if line["mode"] == "clock"]
    if planned := [line for line in clocked if line["planned"] is not None]:
        found.append((BY_THE_CLOCK, [[
            where(line), line["planner"], spread(line, "optimum", 1),
            spread(line, "planned", 1), spread(line, "seconds", 1), spread(line, "over_plan", 3),
            spread(line, "slowdown", 3)] for line in planned]))
    if spent := [line for line in clocked if line["driving_s"] is not None]:
        found.append((TIME_SPENT, [[
            where(line), line["planner"], spread(line, "seconds", 1),
            _value(line["driving_s"] - line["slower_s"], 1), spread(line, "slower_s", 1),
            spread(line, "service_s", 1),
            _value(line["seconds"] - line["driving_s"] - line["service_s"], 1),
            _value(line["replans"], 2)] for line in spent]))
    if report["ways"]:
        found.append((WAYS, [[
            line["kind"], _steepness(line), str(line["ways"]), _value(line["ratio"], 3),
            _value(line["spread"], 3)] for line in report["ways"]]))
    if soft := [line for line in report["summary"] if line.get("expected_energy_j") is not None]:
        found.append((ON_SOIL, [[
            where(line), line["planner"], *(spread(line, key, 2) for key in ON_SOIL_KEYS[:2]),
            *(spread(line, key, 0) for key in ON_SOIL_KEYS[2:])] for line in soft]))
    if worthy := [line for line in report["summary"] if line.get("worth") is not None]:
        found.append((WORTH, [[where(line), line["planner"], spread(line, "worth", 3)]
                              for line in worthy]))
    if worthier := [line for line in report["comparisons"] if "worth" in line]:
        found.append((WORTHIER, [[where(line), line["contender"], line["over"],
                                  str(line["missions"]), spread(line, "worth", 3)]
                                 for line in worthier]))
    if report["options"].get("mission"):
        found.append((MISSIONS, [[
            f"{row['number']} {row['report']['mission']}", row["contender"],
            "solved" if row["report"]["success"] else str(row["report"]["cause"]).replace("_", " "),
            _value(row["report"]["seconds"], 1), _value(row["nominal_s"], 1),
            str(row["report"]["decisions"])] for row in report["rows"]]))
    if report["comparisons"]:
        found.append((COMPARED,
                      [[*map(str, row)] for row in compared_rows(report, spread)]))
    if report["differences"]:
        found.append((DIFFERENT, [[*map(str, row)] for row in different_rows(report)]))
    causes = [[where(line), line["contender"], cause, str(len(numbers)),
               _numbers(numbers)]
              for line in report["failures"] for cause, numbers in line["causes"].items()]
    if causes:
        found.append((["site", "contender", "cause of failure", "missions", "numbers"], causes))
    return found


def compared_rows(report: dict[str, Any], write: Callable[[dict[str, Any], str, int], Any]
                  ) -> list[list[Any]]:
    """Cells under `COMPARED`; `write` makes one of a figure with its interval, as `spread` does."""
    return [[where(c), c["contender"], c["over"],
             f"{c['both_solved']} of {c['missions']}", c["only_this"], c["only_other"],
             write(c, "seconds", 3), write(c, "seconds_more", 2), write(c, "moves", 3)]
            for c in report["comparisons"]]


def different_rows(report: dict[str, Any]) -> list[list[Any]]:
    """Cells under `DIFFERENT`."""
    return [[where(d), d["number"], d["contender"], d["this"],
             d["over"], d["other"], d["why"]] for d in report["differences"]]


def _mode(line: dict[str, Any]) -> str:
    """The mode where there is one, and the engine where it is not the native one."""
    words = [line["mode"]] if line["loop"] in ("closed", "oracle") else []
    words += [line["backend"]] if line["backend"] != "native" else []
    return " ".join(words) or "-"


def flat_rows(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """One flat row a mission and contender, for rows.csv and for pandas."""
    found = []
    for row in rows:
        report = row.report
        plan = report.grid_plan
        flat: dict[str, Any] = {
            "number": row.number, "mission": row.report.mission, "site": row.site,
            "site_seed": row.site_seed, "seed": row.seed,
            "contender": row.contender, "success": report.success,
            "solvable": row.solvable, "cause": report.cause,
            "failure": None if report.success else failure_label(row), "detail": report.detail,
            "seconds": report.seconds, "nominal_s": row.nominal_s,
            "decisions": report.decisions, "plan_decisions": plan.makespan if plan else None,
            "moves": report.moves, "plan_moves": plan.moves if plan else None,
            "targets": len(report.targets), "solved": sum(t.solved for t in report.targets),
            "replans": sum(report.replans.values())}
        for robot in report.robots:
            for key in ("kind", "lost", "moves", "arrivals", "timeouts", "wrong_cells",
                        "seconds_per_move", "cross_track_rms_m", "cross_track_p95_m",
                        "max_tilt_deg", "slip", "expected_slip", "distance_m", "energy_j",
                        "propellant_kg"):
                flat[f"{robot.name}_{key}"] = getattr(robot, key)
        found.append(flat)
    return found


MOST_NUMBERS = 12
"""Mission numbers that a table names of each cause; report.json has all."""


def _numbers(numbers: Sequence[int]) -> str:
    more = len(numbers) - MOST_NUMBERS
    return ", ".join(map(str, numbers[:MOST_NUMBERS])) + (f" and {more} more" if more > 0 else "")


def spread(line: dict[str, Any], key: str, digits: int) -> str:
    """A figure with its interval in brackets."""
    low, high = line["intervals"][key]
    if low is None or high is None:
        return _value(line[key], digits)
    return f"{_value(line[key], digits)} [{low:.{digits}f}, {high:.{digits}f}]"


def _value(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _plain(value: float) -> float | None:
    return round(value, 6) if math.isfinite(value) else None


def _ends(figure: Figure) -> list[float | None]:
    return [_plain(figure.low), _plain(figure.high)]
