"""The missions of an evaluation one by one: map, Gantt of the team against the plan, film.

A map is what the mission asks for, with the order in which each robot served targets; a Gantt has
a line a robot: on its way or waiting, in service, and hollow marks where the plan had a target
solved. A film is made when it is asked for: the card gives the command, and plays what the command
has written. SVG as text; all from report.json and the ground it names.
"""

from __future__ import annotations

import base64
import html
import io
import shlex
from collections.abc import Sequence
from pathlib import PurePath
from typing import Any

import msgspec
import numpy as np
from PIL import Image

from moonteam import files
from moonteam.errors import InputError
from moonteam.problem.mission import Map, Mission, Site, Target
from moonteam.report.markup import Raw
from moonteam.terrain.site import for_mission
from sim2grid.show.page import known
from sim2grid.show.picture import (
    GREY,
    INK,
    NIGHT,
    OPEN,
    SOLVED,
    Ground,
    hillshade,
    requirement,
    robot_color,
)
from sim2grid.show.plots import hexed

MOST_CARDS = 200
"""Missions that the page shows one by one; report.json has all."""

GROUND_PIXELS = 256
LINE, LEFT, TOP, WIDE = 24, 100, 22, 640  # of a Gantt, pixels
EXACT = "exact"

TITLES = ("contender", "solved", "seconds", "planned s", "optimum s", "decisions", "planned",
          "optimum")
KEY = ("Maps: starts (rings), targets by state, who served them in which order. Bars: on the way "
       "or waiting (pale), in service, solved (green); marks above them: when the plan had it "
       "solved. Dashed: the plan's end (white) and the optimum (green): the "
       "exact planner's plan, where the exact planner is among the contenders.")

Row = dict[str, Any]


def rollout_command(source: str, row: Row, out: str | None = None) -> str:
    """The command that shows one mission of the report."""
    words = ["moonteam", "rollout", "--from", source, "--mission", str(row["number"]),
             "--contender", row["contender"]]
    return shlex.join(words + (["--out", out] if out else []))


def cards(document: dict[str, Any], source: str) -> str:
    """A card a mission, in order of their numbers. Empty where the report holds no missions."""
    entries = [entry for entry in document["missions"] if "mission" in entry][:MOST_CARDS]
    if not entries:
        return ""
    rows: dict[int, list[Row]] = {}
    for row in document["rows"]:
        rows.setdefault(row["number"], []).append(row)
    physical = {c["name"] for c in document["contenders"] if c["loop"] != "grid"}
    grounds: dict[tuple[Site, Map], str] = {}
    symbols, shown = [], []
    for entry in entries:
        mission = msgspec.convert(entry["mission"], Mission)
        site = mission.site, mission.map
        if site not in grounds:
            grounds[site] = f"ground{len(grounds)}"
            symbols.append(_ground(mission, grounds[site]))
        shown.append(_card(entry["number"], mission, rows.get(entry["number"], []), grounds[site],
                           source, physical))
    more = len(document["missions"]) - len(entries)
    return (f'<svg width="0" height="0" style="position:absolute"><defs>{"".join(symbols)}</defs>'
            f'</svg><p class="dim">{KEY}</p><div class="cards">{"".join(shown)}</div>'
            + (f'<p class="dim">and {more} more in report.json</p>' if more > 0 else "")
            + f"<script>{FILM}</script>")


def optimum(rows: Sequence[Row], key: str) -> float | None:
    """What the exact planner plans for a mission, where it is among its rows: `seconds` by the
    clock, or `decisions`.
    """
    for row in rows:
        report = row["report"]
        if report.get("planner") != EXACT or report.get("objective") not in (None, "makespan"):
            continue
        plan = report.get("grid_plan")
        found = report.get("expected_s") if key == "seconds" else plan and plan["makespan"]
        if found is not None:
            return found
    return None


def _card(number: int, mission: Mission, rows: Sequence[Row], ground: str, source: str,
          physical: set[str]) -> str:
    best = {key: optimum(rows, key) for key in ("seconds", "decisions")}
    ends = [best["seconds"] or 0.0, 1.0]
    ends += [v for row in rows for v in (row["report"]["seconds"], _planned(row)) if v]
    lines = [_figures(row, best) for row in rows]
    parts = [f'<article><h3>mission {number} <span class="dim">{html.escape(mission.name)}</span>'
              "</h3>", known(TITLES, lines) if lines else ""]
    if not rows:
        parts.append(f'<div class="run">{mission_map(mission, {}, ground)}</div>')
    for row in rows:
        parts += [f'<div class="run">{mission_map(mission, row["report"], ground)}'
                  f'<div class="gantt"><b>{html.escape(row["contender"])}</b>',
                  gantt(mission, row, max(ends), best["seconds"]),
                  _film(row, source) if row["contender"] in physical else "", "</div></div>"]
    return "".join(parts) + "</article>"


def _figures(row: Row, best: dict[str, float | None]) -> list[object]:
    report = row["report"]
    solved = sum(target["solved"] for target in report["targets"])
    plan = report.get("grid_plan")
    clock = report.get("expected_s") is not None
    return [Raw(f"<b>{html.escape(row['contender'])}</b>"),
            f"{solved} of {len(report['targets'])}", round(report["seconds"], 1),
            _rounded(_planned(row)), _rounded(best["seconds"]), report["decisions"],
            None if clock or not plan else plan["makespan"], None if clock else best["decisions"]]


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 1)


def _planned(row: Row) -> float | None:
    """Seconds as first planned: by the clock all told, else at travelling speed."""
    report = row["report"]
    return report["expected_s"] if report.get("expected_s") else row.get("nominal_s")


def _ground(mission: Mission, name: str) -> str:
    """The ground under a map, to be used again: shaded, or grey where it cannot be made."""
    wide, high = mission.map.size
    inside = f'<rect width="{wide}" height="{high}" fill="{hexed(GREY)}"/>'
    try:
        site = for_mission(mission)
    except InputError:
        return f'<g id="{name}">{inside}</g>'
    shade = hillshade(Ground.of(site))
    half = np.array(mission.map.size) * mission.map.cell_m / 2 / site.spacing
    middle = (np.array(shade.shape[::-1]) - 1) / 2
    (left, low), (right, top) = np.rint(middle - half), np.rint(middle + half) + 1
    picture = Image.fromarray(shade[int(low):int(top), int(left):int(right)][::-1])
    picture.thumbnail((GROUND_PIXELS, GROUND_PIXELS))
    held = io.BytesIO()
    picture.save(held, "JPEG", quality=80)
    address = "data:image/jpeg;base64," + base64.b64encode(held.getvalue()).decode()
    return (f'<image id="{name}" width="{wide}" height="{high}" preserveAspectRatio="none" '
            f'href="{address}"/>')


def mission_map(mission: Mission, report: dict[str, Any], ground: str) -> str:
    """The map: targets by state with what they need, starts, and who went where in which order."""
    wide, high = mission.map.size
    unit = max(wide, high) / 32  # so that lines and letters are alike on every map

    def place(at: Sequence[float]) -> tuple[float, float]:
        return at[0] + 0.5, high - at[1] - 0.5

    parts = [f'<svg class="map" viewBox="0 0 {wide} {high}" role="img" aria-label="map">'
             f'<use href="#{ground}"/>']
    results = report.get("targets", ())
    for i, robot in enumerate(mission.robots):
        color, at = hexed(robot_color(i)), place(robot.start)
        way = [at, *(place(t["at"]) for t in _served(results, robot.name))]
        points = " ".join(f"{x:g},{y:g}" for x, y in way)
        parts.append(f'<polyline points="{points}" fill="none" stroke="{color}" '
                     f'stroke-width="{0.35 * unit:g}" opacity="0.9"/>'
                     f'<circle cx="{at[0]:g}" cy="{at[1]:g}" r="{0.6 * unit:g}" '
                     f'fill="{hexed(NIGHT)}" stroke="{color}" stroke-width="{0.35 * unit:g}">'
                     f"<title>{html.escape(robot.name)} starts</title></circle>")
    targets = [(t.at, mission.target_name(j), requirement(t))
               for j, t in enumerate(mission.targets)]
    events = [event.target for event in mission.events if event.target is not None]
    targets += [(t.at, name, requirement(t)) for t, name in zip(
        events, _late_names(mission, results, events), strict=True)]
    state = {t["name"]: t["solved"] for t in results}
    for at, name, needs in targets:
        color = hexed(SOLVED if state.get(name) else OPEN)
        x, y = place(at)
        r = max(0.45, 0.6 * unit)
        parts.append(f'<rect x="{x - r:g}" y="{y - r:g}" width="{2 * r:g}" height="{2 * r:g}" '
                     f'fill="none" stroke="{color}" stroke-width="{0.3 * unit:g}">'
                     f"<title>{html.escape(name)} {html.escape(needs)}</title></rect>"
                     f'<text x="{min(max(x, 2 * unit), wide - 2 * unit):g}" '
                     f'y="{y - r - 0.3 * unit if y > 4 * unit else y + r + 1.6 * unit:g}" '
                     f'font-size="{1.6 * unit:g}" fill="{color}" stroke-width="{0.5 * unit:g}">'
                     f"{html.escape(needs)}</text>")
    return "".join(parts) + "</svg>"


def _late_names(mission: Mission, results: Sequence[Row], events: Sequence[Target]) -> list[str]:
    """Names of the targets that events bring: as the report has them, else as they will be."""
    told = {tuple(t["at"]): t["name"] for t in results[len(mission.targets):]}
    return [told.get(tuple(t.at), t.name or "new") for t in events]


def _served(results: Sequence[Row], robot: str) -> list[Row]:
    """Targets that a robot helped to solve, in order."""
    mine = [t for t in results if robot in t["robots"] and t["time_s"] is not None]
    return sorted(mine, key=lambda t: t["time_s"])


def gantt(mission: Mission, row: Row, end: float, best: float | None) -> str:
    """A line a robot over the seconds up to `end`, with the plan's marks and the optimum's line."""
    report = row["report"]
    names = [robot.name for robot in mission.robots]
    high = TOP + LINE * len(names) + 16
    service = {mission.target_name(j): t.service for j, t in enumerate(mission.targets)}

    def x(seconds: float) -> float:
        return round(LEFT + (WIDE - LEFT - 14) * min(seconds / end, 1.0), 1)

    parts = [f'<svg viewBox="0 0 {WIDE} {high}" role="img" aria-label="who did what when">']
    for line, seconds, color in (("plan", _planned(row), INK), ("optimum", best, SOLVED)):
        if seconds:
            parts.append(f'<line x1="{x(seconds)}" x2="{x(seconds)}" y1="{TOP - 6}" '
                         f'y2="{high - 14}" stroke="{hexed(color)}" stroke-dasharray="4 3">'
                         f"<title>{line}: {seconds:.1f} s</title></line>")
    for i, robot in enumerate(report.get("robots", ())):
        color, y = hexed(robot_color(i)), TOP + LINE * i
        stop = robot["lost_s"] if robot["lost"] else report["seconds"]
        parts.append(f'<text x="{LEFT - 6}" y="{y + 12}" class="who" fill="{color}">'
                     f"{html.escape(robot['name'][:10])}</text>"
                     f'<rect x="{LEFT}" y="{y + 7}" width="{x(stop) - LEFT:g}" height="2" '
                     f'fill="{color}" opacity="0.35"/>')
        begun = 0.0
        for target in _served(report["targets"], robot["name"]):
            done, takes = target["time_s"], service.get(target["name"], 0.0)
            parts.append(_bar(x(begun), x(done - takes), y, color, 0.55, f"to {target['name']}")
                         + _bar(x(done - takes), x(done), y, color, 1.0,
                                f"{target['name']} solved at {done:.1f} s")
                         + f'<rect x="{x(done) - 2:g}" y="{y}" width="3" height="16" '
                           f'fill="{hexed(SOLVED)}"/><text x="{x(done) - 5:g}" y="{y + 12}" '
                           f'class="what">{html.escape(target["name"])}</text>')
            if target.get("expected_s") is not None:
                at = x(target["expected_s"])
                parts.append(f'<path d="M{at} {y + 2} l-4 -6 h8 z" fill="none" '
                             f'stroke="{hexed(INK)}"><title>planned '
                             f"{target['expected_s']:.1f} s</title></path>")
            begun = done
        if robot["lost"]:
            parts.append(f'<text x="{x(stop):g}" y="{y + 13}" fill="{hexed(OPEN)}">lost: '
                         f"{html.escape(robot['lost'].replace('_', ' '))}</text>")
    parts += [f'<text x="{x(s):g}" y="{high - 2}" class="axis">{s:g} s</text>'
              for s in _ticks(end)]
    return "".join(parts) + "</svg>"


def _bar(left: float, right: float, y: float, color: str, opacity: float, words: str) -> str:
    if right - left < 0.2:
        return ""
    return (f'<rect x="{left:g}" y="{y + 2}" width="{right - left:.1f}" height="12" '
            f'fill="{color}" opacity="{opacity:g}"><title>{html.escape(words)}</title></rect>')


def _ticks(end: float) -> list[float]:
    """Four or so round numbers from 0 up to `end`."""
    power = 10.0 ** np.floor(np.log10(end / 4))
    step = next(power * n for n in (1, 2, 5, 10) if power * n >= end / 4)
    return [float(s) for s in np.arange(0.0, end + 1e-9, step)]


def _film(row: Row, source: str) -> str:
    """A button that plays the mission's film, where it has been made, else says how."""
    name = f"{row['number']}-{files.safe_name(row['contender'], 'contender')}"
    out = PurePath(source).parent / "films" / name
    command = html.escape(rollout_command(source, row, str(out)))
    return (f'<details class="film" data-film="films/{html.escape(name)}"><summary>film</summary>'
            f"<p>Made by</p><pre>{command}</pre></details>")


FILM = """
for (const one of document.querySelectorAll('.film')) one.addEventListener('toggle', () => {
  if (!one.open || one.querySelector('video')) return;
  const film = document.createElement('video'), link = document.createElement('a');
  film.controls = film.muted = true;
  film.src = one.dataset.film + '/video.mp4';
  film.addEventListener('error', () => { film.src = one.dataset.film + '/map.mp4'; },
                        { once: true });  // where no 3-D pictures could be made
  link.href = one.dataset.film + '/report.html';
  link.textContent = 'its page, with the replay in 3-D';
  film.addEventListener('loadeddata', () => one.append(film, link), { once: true });
});
"""
