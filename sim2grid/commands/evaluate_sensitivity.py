"""`moonteam evaluate sensitivity`: curves of success and seconds against what may go wrong."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import msgspec

from moonteam import files
from moonteam.commands.options import Missions, Planning, Reported, Resumable
from moonteam.report import command, journal
from moonteam.report.journal import Journal

if TYPE_CHECKING:
    from sim2grid.study.evaluation import Row
    from sim2grid.study.sensitivity import Setting

FILES = ("config.json", "rows.jsonl", "report.json", "report.html", "curves.png", "table.md")
"""In --out."""


@dataclass(frozen=True)
class Args(Planning, Missions, Resumable, Reported):
    """Draw success and mission seconds against slope, boulders, friction, noise and delay.

    One quantity is varied at a time over random missions of one site, as in `moonteam evaluate
    execution`; the missions keep their numbers from value to value (one that changed ground
    forbids is drawn anew).

    - slope: degrees added to the ground.
    - boulders: times the preset's.
    - friction: of the ground.
    - noise: m, error of the positions that the executor sees and steers by.
    - delay: s, until a command reaches the controllers.

    Files in --out: report.html, curves.png, table.md, report.json, and rows.jsonl, to which each
    mission is added as it ends, so that --resume can go on.

    Examples:
      moonteam evaluate sensitivity --out runs/sensitivity
      moonteam evaluate sensitivity --quantity slope friction --count 30 --out runs/grip
      moonteam evaluate sensitivity --site highland --planner policy --out runs/high --resume
    """

    quantity: tuple[Literal["slope", "boulders", "friction", "noise", "delay"], ...] = (
        "slope", "boulders", "friction", "noise", "delay")
    """What is varied."""
    site: Literal["mare", "highland", "crater_rim", "polar", "flat"] = "mare"
    """Preset of the ground."""
    count: int = 10
    """Missions for each value."""
    mode: tuple[Literal["barrier", "async"], ...] = ("async",)
    """barrier: all robots decide together; async: each when it arrives."""
    planner: str = "exact"
    """Who decides: a registered planner (policy, auto, exact, greedy, lns, guided, cpsat, routing,
    exhaustive, another package's), or FILE.py:OBJECT."""
    side: int = 16
    """Cells of a side of the map, each a metre."""
    backend: Literal["native", "mjx"] = "native"
    """Physics engine: C MuJoCo, or MJX for accelerators."""
    width: int = 25
    """Worlds that the engine advances together."""


def run(args: Args) -> int:
    """Runs what is not done yet, prints, saves."""
    _check(args)
    from moonteam.compilation import call_at_once, enable_cache

    enable_cache()
    call_at_once()
    from moonteam.report.tables import print_plain
    from sim2grid.study.evaluation import Contender, contenders, maker
    from sim2grid.study.fleet import Recipe
    from sim2grid.study.sensitivity import run_setting, settings

    who = Contender.of(args.planner, args.planner_options())
    maker(who)  # refuses a policy that is not there before anything is written
    chosen = contenders(("closed",), args.mode, [who], [args.backend])
    recipe = Recipe(args.site, args.site_seed, args.seed, args.targets, args.side,
                    max_steps=args.max_steps)
    rows = _Rows(args)
    interrupted, impossible = False, {}
    try:
        for setting in {s.key: s for s in settings(args.quantity)}.values():
            said = run_setting(
                setting, recipe, args.count, chosen, seed=args.seed, width=args.width,
                done=rows.of(setting),
                keep=lambda row, key=setting.key: rows.add(key, row))
            if said:
                impossible[setting.key] = said
    except KeyboardInterrupt:
        interrupted = True
    report = _document(args, rows.found, [c.name for c in chosen], impossible)
    if interrupted:
        report["interrupted"] = True
    if args.out:
        _save(args.out, report)
    print_plain(args, report, [_table(report)])
    return journal.interrupted(args.out) if interrupted else 0


def _check(args: Args) -> None:
    """Raises InputError for options out of range."""
    journal.check(args, (
        ("count", 1, 100_000), ("targets", 1, 64), ("side", 4, 128), ("max_steps", 1, 100_000),
        ("seed", 0, 2**31), ("site_seed", 0, 2**31), ("width", 1, 4096)),
        choices=("quantity", "mode"))


class _Rows:
    """Rows by setting and mission; kept in a journal where there is a folder."""

    def __init__(self, args: Args):
        from sim2grid.study.evaluation import Row

        self.found: dict[str, dict[tuple[str, int], Row]] = {}
        self._journal: Journal[tuple[str, Row]] | None = None
        if args.out:
            self._journal = Journal(args.out, args.resume, command.figures(args),
                                    tuple[str, Row], FILES)
            for key, row in self._journal.entries:
                self._put(key, row)

    def _put(self, key: str, row: Row) -> None:
        self.found.setdefault(key, {})[row.contender, row.number] = row

    def of(self, setting: Setting) -> dict[tuple[str, int], Row]:
        """What is done of a setting."""
        return self.found.get(setting.key, {})

    def add(self, key: str, row: Row) -> None:
        """Keeps a row."""
        self._put(key, row)
        if self._journal:
            self._journal.add((key, row))


def _document(args: Args, rows: dict[str, dict[tuple[str, int], Row]], names: list[str],
              impossible: dict[str, str]) -> dict[str, Any]:
    """The report: a curve for each quantity and contender, and the rows behind them."""
    from moonteam.report import provenance
    from sim2grid.study.sensitivity import SWEEPS, point, settings

    curves = [
        {"quantity": quantity, "label": SWEEPS[quantity].label, "contender": name,
         "points": [{"value": s.value, "impossible": impossible.get(s.key)} | point(
             [row for (who, _), row in sorted(rows.get(s.key, {}).items()) if who == name],
             args.seed) for s in settings([quantity])]}
        for quantity in args.quantity for name in names]
    return {"kind": "sensitivity", "title": "sensitivity of executions",
            "meta": provenance.meta(command.line("evaluate sensitivity", args), args.seed),
            "options": command.figures(args),
            "curves": curves, "notes": NOTES,
            "rows": [{"setting": key} | msgspec.to_builtins(row)
                     for key, found in rows.items() for _, row in sorted(found.items())]}


def _save(out: Path, report: dict[str, Any]) -> None:
    from moonteam.report.tables import plain_markdown
    from sim2grid.study.sensitivity_page import curves_figure, sensitivity_page

    files.write_json(out / "report.json", report)
    files.write_text(out / "report.html", sensitivity_page(report))
    files.write_text(out / "table.md", plain_markdown(report, [_table(report)]) + "\n")
    with files.replacing(out / "curves.png") as temporary:
        figure = curves_figure(report)
        figure.savefig(temporary, dpi=130, facecolor=figure.get_facecolor())


NOTES = ["In brackets: 95 % intervals, of success by Wilson, of seconds by bootstrap over the "
         "missions that succeeded."]


def _table(report: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """A row for each value and contender."""
    from sim2grid.study.summary import spread

    rows = []
    for curve in report["curves"]:
        for at in curve["points"]:
            causes = "; ".join(f"{cause}: {len(found)}" for cause, found in at["failures"].items())
            rows.append([curve["label"], f"{at['value']:g}", curve["contender"],
                         at["impossible"] or f"{at['solved']} of {at['missions']}",
                         spread(at, "success", 2), spread(at, "seconds", 1), causes or "-"])
    return ["quantity", "value", "contender", "solved", "success", "seconds", "failed"], rows
