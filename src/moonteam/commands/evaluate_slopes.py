"""`moonteam evaluate slopes`: how steep each kind of robot can go, up, down and across."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from moonteam.commands.options import Reported
from moonteam.errors import InputError

if TYPE_CHECKING:
    from moonteam.robots import RobotKind

FILES = ("slopes.json", "table.md")
"""In --out."""


@dataclass(frozen=True)
class Args(Reported):
    """Straight drives up, down and across planes of a known slope, smooth and rough.

    Each drive is 13 m, 8 of them on the plane. A robot may refuse a slope by standing still
    before it, which counts as stuck. Means are over drives that arrived.

    Files in --out: slopes.json and table.md.

    Examples:
      moonteam evaluate slopes --degrees 15 20 --roughness 0 --json
      moonteam evaluate slopes --kind my_rover.py:ROVER --count 2
    """

    kind: tuple[str, ...] = ()
    """which kinds of robot, by name or FILE.py:OBJECT; default: all registered that do not fly"""

    degrees: tuple[float, ...] = (0.0, 12.0, 15.0, 20.0)
    """slopes of the plane"""

    roughness: tuple[float, ...] = (0.0, 0.04)
    """rms height of relief laid over the plane, m"""

    count: int = 8
    """drives of each kind, slope, way and roughness"""

    seed: int = 0
    """of the relief and of the drives' places"""


def run(args: Args) -> int:
    """Measures; always 0, since to refuse a slope is no failure."""
    _check(args)
    from moonteam.compilation import call_at_once, enable_cache

    enable_cache()
    call_at_once()
    from moonteam.physics.trials.slopes import measure
    from moonteam.report import command, provenance, tables

    args = replace(args, kind=tuple(dict.fromkeys(args.kind)) or _grounded())
    kinds = _kinds(args.kind)
    rows = [row for kind in kinds for roughness in args.roughness
            for degrees in args.degrees
            for row in measure(kind, degrees, roughness, args.count, args.seed)]
    meta = provenance.meta(command.line("evaluate slopes", args), args.seed)
    report = {"seed": args.seed, "rows": rows, "notes": NOTES, "meta": meta}
    shown = [([*COLUMNS], [_cells(row) for row in rows])]
    if args.out:
        tables.save_plain(args.out, "slopes", report, shown)
    tables.print_as(args, report, lambda: tables.plain_markdown(report, shown),
                    lambda: print(_table(rows)))
    return 0


def _grounded() -> tuple[str, ...]:
    """All registered kinds that do not fly."""
    from moonteam.robots import KINDS

    return tuple(name for name in KINDS.names() if not KINDS.get(name).flies)


def _kinds(names: tuple[str, ...]) -> list[RobotKind]:
    """Raises InputError for a kind that nobody knows."""
    from moonteam.robots import KINDS

    return [KINDS.get(name, "--kind") for name in names]


def _check(args: Args) -> None:
    if args.count < 1:
        raise InputError("--count", "must be at least 1")
    if args.seed < 0:
        raise InputError("--seed", f"{args.seed} is not allowed; at least 0")
    for name, values, most in (("--degrees", args.degrees, 40.0),
                               ("--roughness", args.roughness, 0.2)):
        for value in values:
            if not 0.0 <= value <= most:
                raise InputError(name, f"{value:g} is not allowed; 0 to {most:g}")


def _cells(row: dict[str, Any]) -> list[str]:
    """A row's entries, as text."""
    head = [row["kind"], f"{100 * row['roughness_m']:g}", f"{row['degrees']:g}", row["way"],
            f"{row['arrived']} of {row['count']}", str(row["fallen"] + row["diverged"]),
            str(row["stuck"] + row["late"]), f"{row['farthest_m']:.1f}"]
    if not row["arrived"]:
        return [*head, "-", "-", "-", "-"]
    return [*head, f"{row['speed_mps']:.2f}", f"{row['cross_track_p95_m']:.3f}",
            f"{row['tilt_max_deg']:.1f}", f"{row['energy_j_per_m']:.1f}"]


COLUMNS = ("kind", "rms, cm", "slope, deg", "way", "arrived", "fell", "stuck", "farthest, m",
           "speed, m/s", "cross p95, m", "tilt max, deg", "energy, J/m")
NOTES = ["Means are over arrivals; farthest: the most any drive got of its 13 m, whose slope "
         "begins at 2.5 m."]


def _table(rows: list[dict[str, Any]]) -> str:
    table = [list(COLUMNS), *(_cells(row) for row in rows)]
    widths = [max(len(line[i]) for line in table) for i in range(len(COLUMNS))]
    return "\n".join("  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True))
                     for line in table)
