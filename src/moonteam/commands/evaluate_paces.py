"""`moonteam evaluate paces`: how soil slows each kind, as travel fields then believe it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from moonteam.commands.options import Reported, Seeded
from moonteam.errors import InputError
from moonteam.problem.mission import SoilName

FILES = ("paces.json", "table.md")
"""In --out."""


@dataclass(frozen=True)
class Args(Reported, Seeded):
    """Speed, slip, sinkage and energy a metre of each kind on planes of regolith, by slope.

    From them come the numbers that travel fields, planners and policies believe of a kind on that
    soil: paces.json in --out has both. The bundled ones are in assets/robots/paces.json.

    Examples:
      moonteam evaluate paces --soil nominal --kind my_rover.py:ROVER
      moonteam evaluate paces --out runs/paces
    """

    kind: tuple[str, ...] = ()
    """which kinds of robot, by name or FILE.py:OBJECT; default: all registered that do not fly"""

    soil: tuple[SoilName, ...] = ("nominal", "loose", "dense", "lunar", "grc1")
    """which soils"""

    degrees: tuple[float, ...] = (0.0, 4.0, 8.0, 12.0, 16.0, 20.0)
    """slopes of the plane; 0 must be among them"""

    count: int = 3
    """drives of each kind, slope and way"""


def run(args: Args) -> int:
    """Measures; always 0, since to fail on a slope is a result."""
    if 0.0 not in args.degrees or any(not 0.0 <= d <= 40.0 for d in args.degrees):
        raise InputError("--degrees", "0 to 40, and 0 must be among them")
    if args.count < 1:
        raise InputError("--count", "must be at least 1")
    from moonteam.compilation import call_at_once, enable_cache

    enable_cache()
    call_at_once()
    from moonteam.physics.trials import paces
    from moonteam.report import command, progress, provenance, tables
    from moonteam.robots import KINDS
    from moonteam.terrain.soil import SOILS

    names = args.kind or tuple(n for n in KINDS.names() if not KINDS.get(n).flies)
    kinds = {kind.name: kind for kind in (KINDS.get(n, "--kind") for n in names)}
    found: dict[str, dict[str, list[paces.Drive]]] = {}
    pairs = [(soil, name) for soil in dict.fromkeys(args.soil) for name in kinds]
    for soil, name in progress.track(pairs, "drives on regolith", len(pairs)):
        found.setdefault(soil, {})[name] = paces.measure(
            kinds[name], SOILS[soil], args.degrees, args.count, args.seed)
    table = paces.table(found, kinds)
    meta = provenance.meta(command.line("evaluate paces", args), args.seed)
    report = {"soils": table, "notes": NOTES, "meta": meta}
    shown = [(PACES, [_pace(soil, name, of["pace"]) for soil, its in table.items()
                      for name, of in its.items()]),
             (DRIVES, [_drive(soil, name, d) for soil, its in table.items()
                       for name, of in its.items() for d in of["drives"]])]
    if args.out:
        tables.save_plain(args.out, "paces", report, shown)
    tables.print_plain(args, report, shown)
    return 0


PACES = ["soil", "kind", "level, m/s", "steepest, deg", "lost there"]
DRIVES = ["soil", "kind", "slope, deg", "way", "through", "m/s", "slip", "sinkage, mm", "J/m"]
NOTES = ["Steepest: where it climbs at two fifths of its speed on the level, at most what rigid "
         "ground allows it; lost there: of its speed, the mean of up, down and across."]


def _pace(soil: str, kind: str, pace: dict[str, Any]) -> list[str]:
    return [soil, kind, f"{pace['speed']:.2f}", f"{math.degrees(pace['max_slope']):.1f}",
            f"{100 * pace['slowing']:.0f} %"]


def _drive(soil: str, kind: str, drive: dict[str, Any]) -> list[str]:
    head = [soil, kind, f"{drive['degrees']:g}", drive["way"],
            f"{drive['through']} of {drive['count']}"]
    if not drive["through"]:
        return [*head, "-", "-", "-", "-"]
    slip = "-" if drive["slip"] is None else f"{drive['slip']:.2f}"
    return [*head, f"{drive['speed_mps']:.2f}", slip, f"{1e3 * drive['sinkage_m']:.1f}",
            f"{drive['energy_j_per_m']:.1f}"]
