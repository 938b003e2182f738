"""`moonteam bench travel`: speed and exactness of travel in seconds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from moonteam import compilation
from moonteam.commands.options import Reported, Seeded
from moonteam.errors import InputError

FILES = ("bench_travel.json", "table.md")
"""In --out."""


@dataclass(frozen=True)
class Args(Seeded, Reported):
    """Measure the fields of seconds to targets, one for each kind of robot and target.

    Beside Dijkstra's algorithm of SciPy over the same raster with eight neighbours, in turns:
    time, first call apart, and what each says too much on flat open ground. On the site, how far
    the fields are from the time along the ways. One thread. Run it on a quiet machine.

    Files in --out: bench_travel.json and table.md.

    Examples:
      moonteam bench travel
      moonteam bench travel --preset highland --targets 20 --repeats 20 --json
    """

    preset: Literal["mare", "highland", "crater_rim", "polar", "flat"] = "highland"
    """Kind of ground."""
    site_seed: int = 3
    """Seed of the ground; --seed is that of targets and places."""
    side: int = 32
    """Metres of a side of the map."""
    targets: int = 10
    """Targets, each with a field for each kind of robot."""
    repeats: int = 20
    """Runs of each solver, in turns."""


def check(args: Args) -> None:
    """Raises InputError at the first number that makes no sense."""
    for name in ("targets", "repeats"):
        if getattr(args, name) < 1:
            raise InputError(f"--{name}", "at least 1")
    if not 4 <= args.side <= 200:
        raise InputError("--side", f"{args.side} is not allowed; 4 to 200 metres")
    for name in ("seed", "site_seed"):
        if getattr(args, name) < 0:
            raise InputError(f"--{name.replace('_', '-')}", "at least 0")


def as_tables(document: dict) -> list[tuple[list[str], list[list[str]]]]:
    """The two tables: titles and rows."""
    from moonteam.report.tables import duration

    solvers = [[row["solver"], duration(row["first_call_seconds"]), duration(row["seconds"]),
                duration(row["p10"]), duration(row["p90"]),
                duration(row["seconds"] / row["fields"]), f"{100 * row['error_mean']:.2f} %",
                f"{100 * row['error_worst']:.2f} %"] for row in document["rows"]]
    ways = [[row["kind"], str(row["pairs"]), str(row["unreachable"])] + (
        [f"{100 * row[f'field_over_way_{key}']:+.2f} %" for key in ("median", "least", "most")]
        + [f"{row['corners_mean']:.1f}", duration(row["seconds"])] if row["pairs"] else ["-"] * 5)
        for row in document["ways"]]
    fields = document["rows"][0]["fields"]
    return [(["solver", "first call", f"{fields} fields, median", "10 %", "90 %", "a field",
              "flat ground, mean error", "worst"], solvers),
            (["kind", "ways", "no way", "field over way, median", "least", "most", "corners",
              "finding a way"], ways)]


def run(args: Args) -> int:
    """Measures, prints, saves."""
    check(args)
    compilation.enable_cache()
    from moonteam.report import command, provenance, tables
    from moonteam.robots import KINDS
    from moonteam.terrain.site import MARGIN, make_site
    from moonteam.terrain.travel import speed
    from moonteam.terrain.travel.raster import Raster

    site = make_site(args.preset, args.site_seed, args.side + 2 * MARGIN)
    limits = {name: KINDS.get(name).limits for name in KINDS.names()}
    found = speed.measure(site, Raster((args.side, args.side), 1.0), limits, args.targets,
                          args.repeats, args.seed)
    points, rasters, again = found["points"], found["rasters"], found["matrices_again"]
    notes = [f"{len(limits)} kinds, {args.targets} targets, {args.side} x {args.side} m of "
             f"{args.preset} (seed {args.site_seed}) as {points[0]} x {points[1]} points; "
             f"{args.repeats} runs each, in turns; scipy {found['scipy']}, its graph included.",
             f"rasters of all kinds, once a site: {tables.duration(rasters['seconds'])} (first "
             f"{tables.duration(rasters['first_call_seconds'])}); matrices between all targets "
             f"from fields that are known: {tables.duration(again['seconds'])}."]
    document = {"title": "travel", **found, "notes": notes,
                "meta": provenance.meta(command.line("bench travel", args), args.seed)}
    if args.out:
        tables.save_plain(args.out, "bench_travel", document, as_tables(document))
    tables.print_plain(args, document, as_tables(document))
    return 0
