"""`moonteam evaluate traverse`: random straight traverses of each kind over a site."""

from __future__ import annotations

import csv
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from moonteam.commands.options import Reported, check_soil
from moonteam.errors import InputError
from moonteam.files import replacing
from moonteam.problem.mission import SoilName
from moonteam.report.command import Aside
from moonteam.report.progress import busy

if TYPE_CHECKING:
    from moonteam.physics.trials.film import Shot
    from moonteam.physics.trials.traverse import Recording, Traverse
    from moonteam.robots import RobotKind

EXTENT = 26.0
"""Side of the sites beyond the length of a traverse, m."""

FILES = ("traverse.json", "traverse.csv", "table.md", "sheet.png",
         "*-rim.mp4", "*-boulders.mp4", "*-slope.mp4")
"""In --out."""


@dataclass(frozen=True)
class Args(Reported):
    """Random straight traverses: arrivals, falls, cross-track error, speed, energy, tilt.

    Routes are drawn at random on seeded sites; those that cross ground the kind may not enter
    (slope over its footprint, boulders) are drawn again, and the number of draws is reported.
    Means are over traverses that arrived, intervals are 95 %.

    Files in --out: traverse.json, traverse.csv and table.md; with --video sheet.png and the films.

    Examples:
      moonteam evaluate traverse --kind my_rover.py:ROVER --site mare
      moonteam evaluate traverse --site highland --count 50 --out runs/traverse
      moonteam evaluate traverse --site crater_rim --count 20 --video --out runs/rim
    """

    kind: tuple[str, ...] = ()
    """which kinds of robot, by name or FILE.py:OBJECT; default: all registered"""

    site: str = "mare"
    """preset of the ground"""

    ground: Literal["rigid", "regolith"] = "rigid"
    """rigid, or regolith that wheels and feet sink into"""

    soil: SoilName = "nominal"
    """of regolith; its strength is drawn anew for each site"""

    count: int = 50
    """traverses a kind"""

    sites: int = 5
    """how many sites the traverses are spread over, seeds counting up from --seed"""

    seed: int = 0
    """of the first site and of the routes"""

    length: float = 20.0
    """of a traverse, m"""

    backend: Literal["native", "mjx"] = "native"
    """physics engine"""

    video: Aside[bool] = False
    """film each kind on the highest rim, by the most boulders and on the steepest slope, as
    KIND-rim.mp4 and so on, with a contact sheet; needs --out"""


def run(args: Args) -> int:
    """Runs the traverses; exit code 1 if any robot failed to arrive."""
    if args.count < 1 or args.sites < 1:
        raise InputError("--count and --sites", "must be at least 1")
    if not 1.0 <= args.length <= 200.0:
        raise InputError("--length", f"{args.length:g} m; allowed: 1 to 200")
    check_soil(args)
    if args.video and not args.out:
        raise InputError("--video", "needs a folder to write into: --out DIR")
    from moonteam.compilation import call_at_once, enable_cache

    enable_cache()
    call_at_once()
    from moonteam.physics.trials.traverse import summarise
    from moonteam.report import command, provenance, tables
    from moonteam.robots import KINDS

    args = replace(args, kind=tuple(dict.fromkeys(args.kind)) or KINDS.names())
    summaries, rows, stills = [], [], []
    for kind in [KINDS.get(name, "--kind") for name in args.kind]:
        mine, draws = _run_kind(args, kind, stills)
        summaries.append(summarise(mine) | {"route_draws": draws})
        rows += mine
    seeds = list(_seeds(args))
    report = {"site": args.site, "seeds": seeds, "length_m": args.length,
              "backend": args.backend, "summary": summaries, "rows": [asdict(r) for r in rows],
              "notes": [f"Site seeds {', '.join(map(str, seeds))}; means are over arrivals."],
              "meta": provenance.meta(command.line("evaluate traverse", args), args.seed)}
    shown = [_page(summaries)]
    if args.out:
        tables.save_plain(args.out, "traverse", report, shown)
        _write_csv(args.out / "traverse.csv", rows)
        if stills:
            from moonteam.physics.trials.film import contact_sheet

            contact_sheet(stills, args.out / "sheet.png")
    tables.print_as(args, report, lambda: tables.plain_markdown(report, shown),
                    lambda: print(_table(summaries)))
    return 0 if all(r.outcome == "arrived" for r in rows) else 1


def _seeds(args: Args) -> range:
    return range(args.seed, args.seed + min(args.sites, args.count))


def _run_kind(args: Args, kind: RobotKind, stills: list) -> tuple[list[Traverse], int]:
    """All traverses of one kind and how many routes were drawn for them.

    Films some if asked to and adds their pictures to `stills`.
    """
    import numpy as np

    from moonteam.physics.trials.film import choose
    from moonteam.physics.trials.traverse import draw_routes, run_traverses
    from moonteam.terrain.site import make_site, with_soil

    places, total = [], 0
    seeds = _seeds(args)
    for index, seed in enumerate(seeds):
        share = args.count // len(seeds) + (index < args.count % len(seeds))
        site = make_site(args.site, seed, args.length + EXTENT)
        site = with_soil(site, args.soil) if args.ground == "regolith" else site
        rng = np.random.default_rng([args.seed, seed])
        routes, draws = draw_routes(kind, site, share, args.length, rng)
        places.append((site, routes))
        total += draws
    rows = []
    shots = choose(places) if args.video else []
    for place, (site, routes) in enumerate(places):
        mine = [shot for shot in shots if shot.place == place]
        label = f"{kind.name} on {args.site} {site.seed}"
        with busy(label) as say:
            found, recordings = run_traverses(
                kind, site, routes, backend=args.backend,
                watch=lambda s, label=label, say=say: say(f"{label}: {s:.0f} s simulated"),
                record=[shot.route for shot in mine])
        rows += found
        for shot, recording in zip(mine, recordings, strict=True):
            _film(args, kind.name, shot, recording, stills)
    return rows, total


def _film(args: Args, name: str, shot: Shot, recording: Recording, stills: list) -> None:
    """One film; a line on standard error where nothing can be rendered."""
    from moonteam.physics.render import RenderingUnavailable
    from moonteam.physics.trials.film import film

    assert args.out is not None
    try:
        stills.append(film(recording, args.out / f"{name}-{shot.event}.mp4",
                           event=shot.event, along=shot.along))
    except RenderingUnavailable as error:
        print(f"moonteam: no video: {error}", file=sys.stderr)


def _write_csv(path: Path, rows: list[Traverse]) -> None:
    with replacing(path) as temporary, temporary.open(
            "w", encoding="utf-8", newline="") as file:
        table = [asdict(row) for row in rows]
        writer = csv.DictWriter(file, list(table[0]))
        writer.writeheader()
        writer.writerows(table)


def _table(summaries: list[dict]) -> str:
    """The summaries as a text table."""
    head = (f"{'kind':<9}{'arrived':>9}{'95 %':>13}{'fall':>6}{'stuck':>6}{'late':>6}"
            f"{'m/s':>7}{'cross rms':>11}{'p95 m':>8}{'J/m':>9}{'fuel g':>8}{'tilt p95':>10}"
            f"{'max':>6}")
    lines = [head]
    for s in summaries:
        low, high = s["arrived_interval"]
        line = (f"{s['kind']:<9}{s['arrived']:>5}/{s['count']:<3}{low:>8.2f}-{high:<4.2f}"
                f"{s['fallen'] + s['diverged']:>6}{s['stuck']:>6}{s['late']:>6}")
        if s["arrived"]:
            line += (f"{s['speed_mps']:>7.2f}{s['cross_track_rms_m']:>11.3f}"
                     f"{s['cross_track_p95_m']:>8.3f}{s['energy_j_per_m']:>9.1f}"
                     f"{s['propellant_g']:>8.1f}{s['tilt_p95_deg']:>10.1f}"
                     f"{s['tilt_max_deg']:>6.1f}")
        lines.append(line)
    return "\n".join(lines)


def _page(summaries: list[dict]) -> tuple[list[str], list[list[str]]]:
    """The summaries as titles and rows of a page of docs."""
    columns = {
        "kind": "{kind}", "arrived": "{arrived} of {count}",
        "95 %": "{arrived_interval[0]:.3f} to {arrived_interval[1]:.3f}",
        "fell": "{fallen}", "stuck": "{stuck}", "late": "{late}", "diverged": "{diverged}"}
    means = {
        "speed, m/s": "{speed_mps:.2f}", "cross-track rms, m": "{cross_track_rms_m:.3f}",
        "p95, m": "{cross_track_p95_m:.3f}", "energy, J/m": "{energy_j_per_m:.1f}",
        "propellant, g": "{propellant_g:.1f}", "tilt p95, deg": "{tilt_p95_deg:.1f}",
        "tilt max, deg": "{tilt_max_deg:.1f}", "routes drawn": "{route_draws}"}
    if any(summary["sinkage_m"] is not None for summary in summaries):
        # Whoever sinks in has slipped, if it has wheels.
        means |= {"slip of wheels": "{slip_said}", "sinkage, mm": "{sinkage_said}"}
        summaries = [summary | {"slip_said": _said(summary["slip"], 1.0, 3),
                                "sinkage_said": _said(summary["sinkage_m"], 1e3, 1)}
                     for summary in summaries]
    rows = [[text.format(**summary) for text in columns.values()]
            + [text.format(**summary) if summary["arrived"] else "-" for text in means.values()]
            for summary in summaries]
    return [*columns, *means], rows


def _said(value: float | None, factor: float, digits: int) -> str:
    return "-" if value is None else f"{factor * value:.{digits}f}"
