"""`moonteam evaluate soil`: the regolith model beside published experiments with single wheels."""

from __future__ import annotations

from dataclasses import dataclass, fields

from moonteam.commands.options import Reported
from moonteam.problem.mission import SoilName

FILES = ("soil.json", "table.md", "soil.png")
"""In --out."""


@dataclass(frozen=True)
class Args(Reported):
    """Slip, sinkage and pull of the soil model beside what others have measured on Earth.

    Files in --out: soil.json, table.md and soil.png with the published points.

    Examples:
      moonteam evaluate soil
      moonteam evaluate soil --soil dense nominal --out runs/soil
      moonteam evaluate soil --fit
    """

    soil: tuple[SoilName, ...] = ("nominal", "loose", "dense", "lunar", "grc1")
    """which soils; the first is also driven in the engine, and GRC-1 shown as two have it"""

    fit: bool = False
    """Fit the first soil to VIPER's slip and Rashid-1's sinkage again, from its own numbers on
    (some seconds), and print what comes out instead."""


def run(args: Args) -> int:
    """Works them out; always 0."""
    from moonteam.compilation import call_at_once, enable_cache

    enable_cache()
    call_at_once()
    from moonteam.physics.regolith import validation
    from moonteam.physics.regolith.published import GRC1
    from moonteam.report import command, provenance, tables
    from moonteam.terrain.soil import SOILS

    soils = [SOILS[name] for name in dict.fromkeys(args.soil)]
    soils += [GRC1] if "grc1" in args.soil else []
    meta = provenance.meta(command.line("evaluate soil", args), 0)
    if args.fit:
        soil = validation.fitted(soils[0])
        numbers = {f.name: getattr(soil, f.name) for f in fields(soil)
                   if isinstance(getattr(soil, f.name), float)}
        report = {"soil": soil.name, "fitted": numbers, "worst": validation.worst(soil),
                  "meta": meta, "notes": ["Friction in rad; the rest in SI units."]}
        shown = [(["number", "fitted"], [[k, f"{v:.6g}"] for k, v in
                                         (numbers | report["worst"]).items()])]
    else:
        report = {"soil": soils[0].name} | validation.report(soils) | {"meta": meta}
        report["notes"] = validation.notes(report)
        shown = validation.tables(report)
    if args.out:
        tables.save_plain(args.out, "soil", report, shown)
        if not args.fit:
            validation.draw(args.out / "soil.png", report, soils)
    tables.print_plain(args, report, shown)
    return 0
