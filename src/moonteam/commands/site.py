"""`moonteam site`: make or import a piece of lunar ground, measure it, draw it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from moonteam import files
from moonteam.commands.options import Elevation, Printed, Saved
from moonteam.errors import InputError

if TYPE_CHECKING:
    import numpy.typing as npt

    from moonteam.problem.sun import SunPosition
    from moonteam.terrain.site import Site

    Maps = dict[str, npt.NDArray[Any]]

FILES = ("site.json", "heights.npy", "heights.tif", "maps.npz", "hillshade.png", "slope.png",
         "roughness.png", "traversability.png", "travel.png", "light.png")
"""In --out."""


@dataclass(frozen=True)
class Args(Elevation, Saved, Printed):
    """Make a site from a preset, or import an elevation model, and preview it.

    Writes heights.npy and heights.tif, site.json (measured slopes, roughness, crater counts
    against the law), maps.npz (by kind the cells that are open and the seconds to cross each),
    and pictures: hillshade, slope, roughness, traversability by kind.
    With --travel also a map of a kind's seconds to a place, with ways to it; with --sun or
    --sun-at a map of light and shadow.

    Examples:
      moonteam site --preset mare --seed 3 --size 32 --out runs/site
      moonteam site --dem moon.tif --size 40 --centre 120 -35 --detrend --out runs/dem
      moonteam site --dem moon.tif --size 40 --units pixels --centre 512 300 --rotation 30
      moonteam site --dem heights.npy --pixel 1.0 --json
      moonteam site --preset highland --travel KIND --to 5 -3 --out runs/travel
      moonteam site --preset polar --size 48 --sun 135 4 --out runs/light
      moonteam site --preset polar --sun-at -89.5 12 2027-03-20T12:00
    """

    preset: Literal["mare", "highland", "crater_rim", "polar", "flat"] = "mare"
    """kind of ground to make; not used with --dem"""

    seed: int = 0
    """the same seed gives the same ground to the bit"""

    size: tuple[float, ...] = ()
    """side, or two sides, m; 32 for a preset, all of it for --dem, of which it is in --units:
    metres, pixels, or as long as degrees of latitude and longitude are there"""

    spacing: float = 0.25
    """between elevation samples, m"""

    cell: float = 1.0
    """side of a mission cell, m, for the traversability maps"""

    travel: str | None = None
    """a kind of robot: how many seconds it needs to --to, and ways (travel.png in --out)"""

    to: tuple[float, float] = (0.0, 0.0)
    """where --travel leads, m east and north of the site's centre"""

    start: tuple[float, float] | None = None
    """where the way of --travel begins; if not given, ways from about the four corners"""

    sun: tuple[float, float] | None = None
    """azimuth from north clockwise and elevation of the sun, degrees: which ground it lights
    (light.png in --out)"""

    sun_at: tuple[float, float, str] | None = None
    """the same for the sun over a latitude and longitude, degrees selenographic, at a time, UTC"""


def run(args: Args) -> int:
    """Makes, measures and draws; always 0, bad input raises InputError."""
    if args.seed < 0:
        raise InputError("--seed", f"{args.seed} is not allowed; at least 0")
    if not 0.25 <= args.cell <= 100:
        raise InputError("--cell", f"{args.cell:g} is not allowed; 0.25 to 100 metres")
    from moonteam.terrain.measure import measure

    if args.travel is not None:
        from moonteam.robots import KINDS

        KINDS.get(args.travel)  # before anything is made
    sun = _sun(args)
    site = _site(args)
    seconds = _seconds(site, args.cell)
    report = measure(site) | _summary(seconds)
    travel = None if args.travel is None else _travel(site, args, args.travel)
    if travel is not None:
        report["travel"] = travel.document
    light = None if sun is None else _light(site, sun)
    if light is not None:
        report["light"] = light.document
    if args.out is not None:
        report["files"] = _write(site, args.out, args.cell, seconds)
        if travel is not None:
            report["files"].append(str(travel.draw(args.out / "travel.png")))
        if light is not None:
            report["files"].append(str(light.draw(args.out / "light.png")))
        files.write_json(args.out / "site.json", report)
    if args.json:
        print(files.dump_json(report))
    else:
        _show(report)
    return 0


def _travel(site: Site, args: Args, kind: str) -> Any:
    """What --travel asks for. Raises InputError for an unknown kind or a place off the map."""
    from moonteam.robots import KINDS
    from moonteam.terrain.preview import grid_of
    from moonteam.terrain.travel.shown import show

    size = grid_of(site, args.cell)
    return show(site, size, args.cell, kind, KINDS.get(kind).limits, args.to, args.start)


def _sun(args: Args) -> SunPosition | None:
    """What --sun or --sun-at asks for. Raises InputError."""
    from moonteam.problem.sun import Sun

    if args.sun is not None and args.sun_at is not None:
        raise InputError("--sun", "give it or --sun-at, not both")
    if args.sun is not None:
        asked, option = Sun(azimuth=args.sun[0], elevation=args.sun[1]), "--sun"
    elif args.sun_at is not None:
        latitude, longitude, time = args.sun_at
        asked, option = Sun(latitude=latitude, longitude=longitude, time=time), "--sun-at"
    else:
        return None
    asked.check(lambda key, problem: InputError(option, f"{key} {problem}".strip()))
    return asked.position()


@dataclass(frozen=True)
class _Light:
    """The light on a site: what the report says of it, and its picture."""

    site: Site
    sun: SunPosition
    lit: npt.NDArray[Any]  # [ny, nx] of the ground
    panels: npt.NDArray[Any]  # [ny, nx] of robots' panels over it

    @property
    def document(self) -> dict[str, float]:
        """Where the sun stands, degrees, and the shares of ground and of panels in its light."""
        import numpy as np

        return {"azimuth_deg": round(float(np.degrees(self.sun.azimuth)) % 360, 3),
                "elevation_deg": round(float(np.degrees(self.sun.elevation)), 3),
                "lit": round(float(self.lit.mean()), 4),
                "panels_lit": round(float(self.panels.mean()), 4)}

    def draw(self, path: Path) -> Path:
        """The picture."""
        from moonteam.terrain.preview import draw_light

        return draw_light(self.site, path, self.sun, self.lit, self.panels)


def _light(site: Site, sun: SunPosition) -> _Light:
    from moonteam.terrain.light import PANEL, lit

    return _Light(site, sun, lit(site, sun), lit(site, sun, PANEL))


def _site(args: Args) -> Site:
    from moonteam.problem.piece import Piece
    from moonteam.terrain.site import import_dem, make_site

    if len(args.size) > 2:
        raise InputError("--size", f"{len(args.size)} numbers; one or two are allowed")
    size = args.size[0] if len(args.size) == 1 else (args.size[:2] or None)
    if args.dem is None:
        for name in args.model_options():
            raise InputError(f"--{name}", "is for an elevation model; give --dem too")
        return make_site(args.preset, args.seed, 32.0 if size is None else size, args.spacing)
    return import_dem(args.dem, Piece(size, args.centre, args.units, args.rotation),
                      pixel=args.pixel, band=args.band, scale=args.scale, detrend=args.detrend,
                      detail=args.detail, spacing=args.spacing, seed=args.seed)


def _seconds(site: Site, cell_m: float) -> Maps:
    """kind -> [H, W] s to cross each cell, infinite where the kind cannot be."""
    from moonteam.robots import KINDS
    from moonteam.terrain.preview import grid_of
    from moonteam.terrain.traversability import travel_times

    limits = {name: KINDS.get(name).limits for name in KINDS.names()}
    return travel_times(site, grid_of(site, cell_m), cell_m, limits)


def _summary(seconds: Maps) -> dict[str, Any]:
    """By kind, the share of cells that it can cross and how long these take it."""
    import numpy as np

    shares, times = {}, {}
    for kind, cells in seconds.items():
        able = cells[np.isfinite(cells)]
        shares[kind] = round(able.size / cells.size, 4)
        times[kind] = {"median": round(float(np.median(able)), 3),
                       "most": round(float(able.max()), 3)} if able.size else None
    return {"traversable": shares, "seconds_per_cell": times}


def _write(site: Site, out: Path, cell_m: float, seconds: Maps) -> list[str]:
    """Writes elevations, maps and pictures; the names of all files, site.json included."""
    import numpy as np

    from moonteam.terrain.generate import write_dem
    from moonteam.terrain.preview import draw_all

    arrays = {f"open_{kind}": np.isfinite(cells) for kind, cells in seconds.items()}
    arrays |= {f"seconds_{kind}": cells.astype(np.float32) for kind, cells in seconds.items()}
    with files.replacing(out / "maps.npz") as temporary:
        np.savez_compressed(temporary, allow_pickle=False, **arrays)
    with files.replacing(out / "heights.npy") as temporary:
        # North first, so that the file can be imported again.
        np.save(temporary, site.heights[::-1])
    with files.replacing(out / "heights.tif") as temporary:
        write_dem(temporary, site.heights, site.spacing)
    pictures = draw_all(site, out, cell_m, seconds)
    names = ("heights.npy", "heights.tif", "site.json", "maps.npz")
    return [str(name) for name in (*(out / name for name in names), *pictures)]


def _show(report: dict[str, Any]) -> None:
    slope = report["slope_deg"]
    print(f"{report['name']}, seed {report['seed']}: {report['size_m'][0]:g} by "
          f"{report['size_m'][1]:g} m, {report['samples'][0]} by {report['samples'][1]} samples")
    print(f"  relief {report['relief_m']:.2f} m; slope median {slope['p50']:.1f}, 95 % "
          f"{slope['p95']:.1f}, steepest {slope['p100']:.1f} degrees")
    print(f"  roughness exponent {report['roughness']['hurst']:.2f}; "
          f"{report['boulders']['obstacles']} boulders as obstacles, "
          f"{report['boulders']['in_ground']} small ones in the ground")
    for row in report["craters"]:
        to = f"to {row['to_m']:g} m" if row["to_m"] else "m and more"
        low, high = row["poisson_95"]
        print(f"  craters {row['from_m']:g} {to}: {row['counted']} "
              f"(law: {row['expected']:.1f}, 95 % of draws {low} to {high})")
    for kind, share in report["traversable"].items():
        times = report["seconds_per_cell"][kind]
        print(f"  {kind}: {100 * share:.1f} % of cells open" + (
            f", {times['median']:.2f} s to cross one (at most {times['most']:.2f})"
            if times else ""))
    if "travel" in report:
        its = report["travel"]
        print(f"  {its['kind']} to {its['to'][0]:g}, {its['to'][1]:g} m: from "
              f"{100 * its['reached']:.1f} % of the map, at most {its['most_seconds']:.1f} s")
        for way in its["ways"]:
            (x, y), corners = way["points"][0], len(way["points"]) - 2
            print(f"    from {x:g}, {y:g} m: {way['seconds']:.1f} s over {way['metres']:.1f} m, "
                  f"{corners} corner{'' if corners == 1 else 's'}")
    if "light" in report:
        its = report["light"]
        print(f"  sun {its['elevation_deg']:.2f} degrees high at azimuth {its['azimuth_deg']:.1f}: "
              f"{100 * its['lit']:.1f} % of the ground is lit, {100 * its['panels_lit']:.1f} % for "
              "a robot's panel")
    for name in report.get("files", []):
        print(f"  {name}")
