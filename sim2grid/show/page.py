"""One-page HTML reports that open anywhere: no network, no other files but a very large video.

Plain functions from data to text; every word from outside goes through `html.escape`.
"""

from __future__ import annotations

import html
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import msgspec

from moonteam import files
from moonteam.problem.skills import held, needed
from moonteam.report.markup import Raw, cell, data_uri, table
from sim2grid.measure.metrics import Optimum, Report
from sim2grid.show.picture import robot_color
from sim2grid.show.plots import hexed

LARGEST_VIDEO = 20_000_000
"""Bytes up to which a video is put into the page; a larger one is linked."""

STYLE = """
:root{color-scheme:dark}
body{background:#0e111a;color:#ebeef5;font:15px/1.45 system-ui,'DejaVu Sans',sans-serif;
 margin:0 auto;max-width:1180px;padding:24px}
h1{font-size:26px;margin:0 0 4px}h2{font-size:18px;margin:32px 0 10px;color:#9fb4d8}
.sub{color:#aab2c3;margin:0 0 18px}.good{color:#46d76e}.bad{color:#ff6a4c}.dim{color:#8a93a6}
.tiles{display:flex;flex-wrap:wrap;gap:10px}.tile{background:#181d2b;border-radius:8px;
 padding:10px 14px;min-width:96px}.tile b{display:block;font-size:20px}.tile span{color:#8a93a6;
 font-size:12px}
table{border-collapse:collapse;width:100%;font-size:13px;font-variant-numeric:tabular-nums}
.wide{overflow-x:auto}th{color:#8a93a6;font-weight:600;text-align:left;vertical-align:bottom}
th,td{padding:5px 9px;border-bottom:1px solid #262d3f}td.n,th.n{text-align:right}
video,img{max-width:100%;border-radius:8px}.plot img{display:block;width:100%}
.two{display:grid;grid-template-columns:1fr 1fr;gap:12px}
pre,code{background:#181d2b;border-radius:6px;font-size:12px;overflow-wrap:anywhere}
pre{padding:10px;white-space:pre-wrap}code{padding:1px 5px}summary{cursor:pointer;color:#9fb4d8}
.replay canvas{display:block;width:100%;border-radius:8px;touch-action:none}
.stage{position:relative}.told{position:absolute;left:10px;top:8px;right:10px;font-size:13px;
 font-weight:600;text-shadow:0 0 4px #000,0 0 4px #000;pointer-events:none}
.ticks{position:relative;height:12px;margin:6px 8px 0}.ticks i{position:absolute;width:3px;
 height:12px;margin-left:-1px;border-radius:1px;cursor:pointer}.clock{width:100%;margin:2px 0 6px}
.keys{display:flex;flex-wrap:wrap;gap:10px;align-items:center;font-size:13px}.keys output{
 font-variant-numeric:tabular-nums;min-width:110px}button,select{background:#181d2b;color:inherit;
 border:1px solid #262d3f;border-radius:6px;padding:4px 10px;font:inherit;cursor:pointer}
.team{display:flex;flex-wrap:wrap;gap:6px}.events li{cursor:pointer;opacity:.5;font-size:13px}
.events li.past{opacity:1}
.cards{display:grid;gap:14px}article{background:#131826;border-radius:10px;padding:10px 14px;
 min-width:0;content-visibility:auto;contain-intrinsic-size:auto 320px}h3{margin:0 0 6px;
 font-size:15px}.run{display:grid;grid-template-columns:170px minmax(0,1fr);gap:14px;
 margin-top:10px}
svg.map{width:100%;border-radius:6px}.gantt text{font-size:11px}.map text{font-weight:700;
 text-anchor:middle;paint-order:stroke;stroke:#0e111a}.gantt .who{text-anchor:end;font-weight:600}
.gantt .what{text-anchor:end;fill:#0e111a;font-size:10px;font-weight:700}
.gantt .axis{text-anchor:middle;font-size:10px;fill:#aab2c3}
.film p{margin:6px 0 0}
@media(max-width:640px){body{padding:12px}.two,.run{grid-template-columns:1fr}h1{font-size:21px}
 svg.map{max-width:240px}.gantt text{font-size:17px}.gantt .what,.gantt .axis{font-size:14px}
 thead{display:none}table,tbody,tr,td{display:block}tr{padding:6px 0;
  border-bottom:1px solid #262d3f}
 td,td.n{border:0;padding:1px 0;text-align:left;overflow-wrap:anywhere}
 td::before{content:attr(data-title) " ";color:#8a93a6}}
"""


def page(title: str, parts: Iterable[str]) -> str:
    """A whole document."""
    return (f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            f"<title>{html.escape(title)}</title>\n<style>{STYLE}</style></head>\n<body>\n"
            + "\n".join(part for part in parts if part) + "\n</body></html>\n")


def known(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table of the columns in which something is known."""
    body = [list(row) for row in rows]
    kept = [k for k in range(len(head)) if any(row[k] is not None for row in body)]
    return table([head[k] for k in kept], [[row[k] for k in kept] for row in body])


def tiles(pairs: Iterable[tuple[str, object]]) -> str:
    """Figures in a row: (name, value)."""
    return '<div class="tiles">' + "".join(
        f'<div class="tile"><b>{cell(value)}</b><span>{html.escape(name)}</span></div>'
        for name, value in pairs) + "</div>"


def plot(svg: str, alt: str) -> str:
    """An SVG picture, as an image of its own so that its names meet no others."""
    if not svg:
        return ""
    address = data_uri(svg.encode(), "image/svg+xml")
    return f'<div class="plot"><img alt="{html.escape(alt)}" src="{address}"></div>'


def picture(path: str | os.PathLike[str], alt: str) -> str:
    """A PNG file put into the page; nothing if it does not exist."""
    path = Path(path)
    if not path.is_file():
        return ""
    return f'<img alt="{html.escape(alt)}" src="{data_uri(path.read_bytes(), "image/png")}">'


def video(path: Path | None, beside: Path) -> str:
    """An MP4 file put into the page, or linked from the folder `beside` if it is too large."""
    if path is None or not path.is_file():
        return '<p class="dim">No video was made.</p>'
    if path.stat().st_size > LARGEST_VIDEO:
        address = html.escape(os.path.relpath(path, beside))
        return f'<p><a href="{address}">{address}</a> is too large to stand in this page.</p>'
    address = data_uri(path.read_bytes(), "video/mp4")
    return f'<video controls muted loop playsinline src="{address}"></video>'


def folded(title: str, text: str) -> str:
    """Text that shows when it is asked for."""
    return f"<details><summary>{html.escape(title)}</summary><pre>{html.escape(text)}</pre>" \
           "</details>"


def name_of_robot(index: int, name: str) -> Raw:
    """A robot's name in its colour."""
    return Raw(f'<b style="color:{hexed(robot_color(index))}">{html.escape(name)}</b>')


def rollout_page(report: Report, *, command: str, made: Path | None, out: Path,
                 replans: Sequence[tuple[float, int, str]] = (),
                 plots: Sequence[tuple[str, str]] = (), timing: dict[str, float] | None = None,
                 mission: str = "", why: str = "", replay: str = "") -> str:
    """A rollout's page.

    Args:
      report: of the execution.
      command: that makes it again.
      made: the video, None if there is none.
      out: the folder that the page will lie in, with its paths.png.
      replans: (time s, decision, words) of each cause of a new plan.
      plots: (title, SVG).
      timing: wall-clock times.
      mission: the mission file's text.
      why: the engine is this one.
      replay: in 3-D, as `replay.replay` makes it.
    """
    verdict = '<span class="good">success</span>' if report.success else (
        f'<span class="bad">failed: {html.escape((report.cause or "").replace("_", " "))}</span>')
    who = report.planner + (f" ({report.objective})" if report.objective else "")
    grid = report.grid_plan
    solved = sum(target.solved for target in report.targets)
    return page(f"{report.mission}: moonteam rollout", [
        f"<h1>{html.escape(report.mission)}: {verdict}</h1>",
        f'<p class="sub">{html.escape(who)}, {html.escape(report.mode)}, '
        f"{html.escape(report.backend)}{html.escape(why and f' ({why})')}, seed {report.seed}"
        + (f". {html.escape(report.detail)}" if report.detail else "") + "</p>",
        tiles([
            ("targets solved", f"{solved} of {len(report.targets)}"),
            ("mission seconds", round(report.seconds, 1)), ("decisions", report.decisions),
            *([("planned seconds", report.expected_s)] if report.expected_s else
              [("of the grid plan", grid.makespan if grid else None),
               ("inflation", report.inflation)]),
            *([] if report.optimum is None else _beside(report.optimum)), ("moves", report.moves),
            ("causes of new plans", len(replans)),
            *([("times real time", timing["real_time_factor"])]
              if timing and "real_time_factor" in timing else [])]),
        *(["<h2>Replay in 3-D</h2>", replay] if replay else []),
        "<h2>Video</h2>", video(made, out),
        "<h2>Targets</h2>", _targets(report), "<h2>Robots</h2>", _robots(report),
        *_power(report), *_soil(report),
        *([] if not replans else ["<h2>New plans</h2>", table(
            ["time s", "decision", "cause"], replans)]),
        *[part for title, svg in plots for part in (
            f"<h2>{html.escape(title)}</h2>", plot(svg, title))],
        "<h2>Paths</h2>", picture(out / "paths.png", "paths on the map"),
        "<h2>Make it again</h2>", f"<pre>{html.escape(command)}</pre>",
        folded("mission file", mission) if mission else ""])


def _beside(best: Optimum) -> list[tuple[str, Any]]:
    """The plan and the certified optimum, as tiles."""
    steps = [] if best.plan_steps is None else [
        ("plan, steps", best.plan_steps), ("certified optimum, steps", best.optimum_steps)]
    at = "" if best.plan_steps is None else " at travelling speed"
    return [*steps, (f"plan, s{at}", round(best.plan_s, 1)),
            (f"certified optimum, s{at}", round(best.optimum_s, 1))]


def _soil(report: Report) -> list[str]:
    """What the ground was made of, where it gives way."""
    its = report.soil
    if its is msgspec.UNSET:
        return []
    return [f"<p>Regolith, {html.escape(its.name)}, as this site's seed draws it: friction "
            f"{its.friction_deg:.1f} deg, cohesion {its.cohesion_pa:.0f} Pa, stiffness "
            f"{its.k_phi:.3g} N/m^(n+2), shear {1e3 * its.shear_m:.0f} mm.</p>"]


def _targets(report: Report) -> str:
    return known(
        ["target", "cell", "needs", "solved", "decision", "time s", "planned s", "by",
         "distance m"],
        [(t.name, f"{t.at[0]}, {t.at[1]}", needed(t.skills, t.type == "OR"), t.solved, t.decision,
          t.time_s, t.expected_s, ", ".join(t.robots) or None,
          ", ".join(f"{d:.2f}" for d in t.distance_m) or None) for t in report.targets])


def _robots(report: Report) -> str:
    return known(
        ["robot", "kind", "skills", "moves", "s a move", "way m", "off track rms m", "95 % m",
         "tilt deg", "slip", "slip expected", "late", "wrong cell", "energy kJ",
         "propellant g", "lost"],
        [(name_of_robot(i, r.name), r.kind, held(r.skills), r.moves, r.seconds_per_move,
          r.distance_m, r.cross_track_rms_m, r.cross_track_p95_m, r.max_tilt_deg, r.slip,
          r.expected_slip, r.timeouts, r.wrong_cells, r.energy_j / 1000, r.propellant_kg * 1000,
          None if r.lost is None else f"{r.lost.replace('_', ' ')} at {r.lost_s:.1f} s")
         for i, r in enumerate(report.robots)])


def _power(report: Report) -> list[str]:
    """The batteries of the robots that have one; nothing where nobody has."""
    rows = [[name_of_robot(i, r.name), *msgspec.structs.astuple(r.battery)]
            for i, r in enumerate(report.robots) if r.battery]
    return ["<h2>Power</h2>", known(
        ["robot", "Wh at the start", "lowest", "at the end", "from the sun", "used",
         "share of the time in shadow"], rows)] if rows else []


def write(path: str | os.PathLike[str], text: str) -> None:
    """Writes a page, whole or not at all."""
    files.write_text(path, text)


def mean_interval(row: dict[str, Any], key: str) -> tuple[Any, Any, Any] | None:
    """(value, low, high) of a summary row that keeps its intervals under `intervals`."""
    if row.get(key) is None:
        return None
    low, high = (row.get("intervals") or {}).get(key) or (None, None)
    return row[key], low, high
