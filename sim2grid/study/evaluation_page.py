"""The one-page HTML report of `moonteam evaluate execution`, from its report.json.

`evaluation_page` takes the document of `summary.document` as plain values; no other files.
"""

from __future__ import annotations

import html
from collections.abc import Callable
from typing import Any

from moonteam.report.markup import Raw, table
from sim2grid.show import plots
from sim2grid.show.page import folded, known, mean_interval, page, plot, tiles
from sim2grid.study.mission_cards import cards, optimum, rollout_command
from sim2grid.study.summary import (
    COMPARED,
    DIFFERENT,
    compared_rows,
    different_rows,
    first_seed,
    where,
)

MOST_FAILURES = 200
"""Failed missions that the page lists one by one; report.json has all."""

FIGURES = (("success", "success"), ("seconds", "mission seconds"),
           ("inflation", "decisions over the grid plan"), ("slowdown", "seconds over the ideal"))
"""Summary keys that are drawn with their intervals, and their titles."""

COLUMNS = (("success", "success", 3), ("seconds", "seconds", 1), ("decisions", "decisions", 1),
           ("inflation", "decisions / plan", 3), ("slowdown", "seconds / ideal", 2),
           ("wrong_cell_rate", "wrong cell", 4), ("timeout_rate", "time-outs", 4),
           ("cross_track_rms_m", "off track rms m", 3))
"""Summary keys that are tabled with their intervals: key, title, digits."""

Row = dict[str, Any]


def evaluation_page(document: dict[str, Any], source: str = "report.json") -> str:
    """The page. `source` is the path of report.json, as the rollout commands name it."""
    meta = document.get("meta", {})
    rows = document["rows"]
    won = sum(row["report"]["success"] for row in rows)
    return page(document["title"], [
        f"<h1>{html.escape(document['title'].capitalize())}</h1>",
        f'<p class="sub"><code>{html.escape(str(meta.get("command", "")))}</code></p>',
        tiles([("missions", len(document["missions"])), ("contenders", len(
            document["contenders"])), ("executions", len(rows)), ("succeeded", won),
            ("failed", len(rows) - won), ("commit", str(meta.get("commit", "-"))[:9])]),
        '<p class="bad">Interrupted: what is done so far.</p>' if document.get("interrupted")
        else "",
        "<h2>Means with 95 % intervals</h2>", summary_table(document), intervals_plot(document),
        *_section("One against another", comparisons_table(document)),
        *_section("Missions that went otherwise", differences_table(document)),
        *_section("Failures by cause", causes_table(document, source)),
        *_section("Every failed mission", failures_table(document, source)),
        "<h2>Distributions</h2>", histogram_plots(document),
        *_section("Mission by mission", cards(document, source)),
        *[f'<p class="dim">{html.escape(note)}.</p>' for note in document.get("notes", [])],
        folded("how it was made", _lines(meta | {"options": document.get("options")}))])


def summary_table(document: dict[str, Any]) -> str:
    """A row for each site and contender."""
    lines = []
    best = best_means(document)
    for line in document["summary"]:
        found = [_spread(line, key, digits) for key, _, digits in COLUMNS]
        lines.append([where(line), Raw(
            f"<b>{html.escape(line['contender'])}</b>"),
            f"{line['solved']} of {line['missions']}", *found, line.get("planned"),
            best.get((line["site"], line["site_seed"], line["contender"])), line["falls"],
            line["stuck"],
            "; ".join(f"{cause.replace('_', ' ')} {count}" for cause, count
                      in line["replans_by_cause"].items()) or None])
    return known(["site", "contender", "solved", *(title for _, title, _ in COLUMNS),
                  "planned s", "optimum s", "fell", "stuck", "causes of new plans"], lines)


def best_means(document: dict[str, Any]) -> dict[tuple[str, int, str], float]:
    """By the clock: the optimum's seconds, in the mean of the missions that a contender of a site
    solved; without those whose optimum is not known.
    """
    by_number: dict[int, list[Row]] = {}
    for row in document["rows"]:
        by_number.setdefault(row["number"], []).append(row)
    best = {number: optimum(rows, "seconds") for number, rows in by_number.items()}
    groups: dict[tuple[str, int, str], list[float]] = {}
    for row in document["rows"]:
        if row["report"]["success"] and (value := best[row["number"]]) is not None:
            first = first_seed(document.get("options", {}), row["site_seed"])
            groups.setdefault((row["site"], first, row["contender"]), []).append(value)
    return {key: sum(values) / len(values) for key, values in groups.items()}


def intervals_plot(document: dict[str, Any]) -> str:
    """The summary's main figures, drawn."""
    lines = document["summary"]
    many = len({(line["site"], line["site_seed"]) for line in lines}) > 1
    names = [line["contender"] + (f", {where(line)}" if many else "")
             for line in lines]
    panels = [(title, [mean_interval(line, key) for line in lines]) for key, title in FIGURES]
    panels = [panel for panel in panels if any(panel[1])]
    return plot(plots.intervals(names, panels), "means with intervals") if panels else ""


def comparisons_table(document: dict[str, Any]) -> str:
    """Async against barrier, engine against engine, on the missions that both solved."""
    return "" if not document.get("comparisons") else table(
        COMPARED, compared_rows(document, _spread))


def differences_table(document: dict[str, Any]) -> str:
    """Missions in which another engine led to another outcome or number of decisions."""
    return "" if not document.get("differences") else table(DIFFERENT, different_rows(document))


def causes_table(document: dict[str, Any], source: str) -> str:
    """Cause by cause, with the mission numbers; each number shows its command."""
    lines = []
    for group in document["failures"]:
        for cause, numbers in group["causes"].items():
            shown = ", ".join(
                f'<span title="{html.escape(rollout_command(source, group | {"number": n}))}">'
                f"{n}</span>" for n in numbers)
            lines.append([where(group), group["contender"], cause,
                          len(numbers), Raw(shown)])
    return table(["site", "contender", "cause", "missions", "numbers"], lines) if lines else ""


def failures_table(document: dict[str, Any], source: str) -> str:
    """Each failed mission with what the executor said, and the command that shows it."""
    failed = [row for row in document["rows"] if not row["report"]["success"]]
    physical = {c["name"] for c in document["contenders"] if c["loop"] != "grid"}
    lines = []
    for row in failed[:MOST_FAILURES]:
        report = row["report"]
        command = rollout_command(source, row)
        lines.append([
            row["number"], where(row), row["contender"],
            (report["cause"] or "").replace("_", " "), report["detail"], report["seconds"],
            Raw(f"<code>{html.escape(command)}</code>") if row["contender"] in physical else None])
    more = len(failed) - MOST_FAILURES
    return (table(["mission", "site", "contender", "cause", "what happened", "seconds",
                   "to see it"], lines) if lines else "") + (
        f'<p class="dim">and {more} more in report.json</p>' if more > 0 else "")


def histogram_plots(document: dict[str, Any]) -> str:
    """Seconds and inflation of the missions that succeeded, contender by contender."""
    options = document.get("options", {})
    many = len({(line["site"], line["site_seed"]) for line in document["summary"]}) > 1

    def by_contender(read: Callable[[Row], float | None]) -> dict[str, list[float]]:
        groups: dict[str, list[float]] = {}
        for row in document["rows"]:
            value = read(row) if row["report"]["success"] else None
            if value is not None:
                place = {"site": row["site"], "sites": options.get("sites", 1),
                         "site_seed": first_seed(options, row["site_seed"])}
                site = f", {where(place)}" if many else ""
                groups.setdefault(row["contender"] + site, []).append(value)
        return groups

    shown = [plots.histograms("mission seconds", by_contender(lambda r: r["report"]["seconds"])),
             plots.histograms("decisions over the grid plan",
                              by_contender(lambda r: r["report"]["inflation"]))]
    return '<div class="two">' + "".join(plot(svg, "histogram") for svg in shown) + "</div>"


def _section(title: str, text: str) -> list[str]:
    return [f"<h2>{html.escape(title)}</h2>", text] if text else []


def _spread(line: dict[str, Any], key: str, digits: int) -> Raw | None:
    """A figure, its interval small beside it."""
    value = mean_interval(line, key)
    if value is None:
        return None
    mean, low, high = value
    around = "" if low is None or high is None else (
        f' <span class="dim">[{low:.{digits}f}, {high:.{digits}f}]</span>')
    return Raw(f"{mean:.{digits}f}{around}")


def _lines(values: dict[str, Any]) -> str:
    return "\n".join(f"{key}: {value}" for key, value in values.items())
