"""`moonteam evaluate soak`: unlike missions in physics for as long as one likes."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from moonteam import files
from moonteam.commands.options import Reported, Resumable, Seeded
from moonteam.report import command, journal
from moonteam.report.command import Aside
from moonteam.report.journal import Journal

if TYPE_CHECKING:
    from moonteam.problem.mission import Mission
    from sim2grid.study.soak import Entry, Who

FAILED = "failed"
FILES = ("config.json", "rows.jsonl", "report.json", "table.md", "soak.png", FAILED)
"""In --out."""


@dataclass(frozen=True)
class Args(Seeded, Resumable, Reported):
    """Run random unlike missions in physics, ten at a time in one process.

    Grounds (mare, highland) of 8 to 64 m, teams of 1 to 6 robots in every mixture of our kinds,
    1 to 8 targets, events of every kind, in steps (barrier, async) and by the clock, decided by
    exact, greedy, lns and policy. Mission N depends on --seed and N alone.
    Exit code 0 whatever the missions came to, 1 if one ended in an exception, 130 if interrupted,
    with what is done saved.

    Files in --out: report.json (failures by cause, the line through resident memory), table.md,
    soak.png (memory), rows.jsonl, to which each mission is added as it ends, so that --resume
    can go on, and failed/N.yaml for each mission that failed; table.md has the command that
    runs it again.

    Examples:
      moonteam evaluate soak --count 2000 --out runs/soak
      moonteam evaluate soak --count 20000 --seconds 3600 --out runs/hour
    """

    count: int = 100
    """Missions."""
    seconds: Aside[float | None] = None
    """No mission is begun after so many; --resume goes on."""


def run(args: Args) -> int:
    """Runs what is not done yet, prints, saves."""
    journal.check(args, (("count", 1, 1_000_000), ("seed", 0, 2**31)))
    from moonteam.compilation import call_at_once, enable_cache

    enable_cache()
    call_at_once()
    from moonteam.report.tables import print_plain
    from sim2grid.study.soak import Entry, Soak

    out, held = args.out, None
    if out:
        held = Journal[Entry](out, args.resume, command.figures(args), Entry, FILES)
    entries: list[Entry] = held.entries if held else []

    def keep(entry: Entry, mission: Mission | None) -> None:
        if out and not entry.success and mission is not None:
            _write(_file(out, entry.number), mission)
        entries.append(entry)
        if held:
            held.add(entry)

    begun, interrupted = time.perf_counter(), False
    soak = Soak(args.seed, args.count, keep, {entry.number for entry in entries}, args.seconds)
    try:
        soak.run()
    except KeyboardInterrupt:
        interrupted = True
    report = _document(args, entries, time.perf_counter() - begun)
    if interrupted:
        report["interrupted"] = True
    if out:
        _save(out, report, entries)
    print_plain(args, report, _tables(entries))
    if interrupted:
        return journal.interrupted(out)
    return int(any(entry.traceback for entry in entries))


def _file(out: Path | None, number: int) -> Path:
    return (out or Path()) / FAILED / f"{number:04d}.yaml"


def _write(path: Path, mission: Mission) -> None:
    import yaml

    path.parent.mkdir(exist_ok=True)
    files.write_text(path, yaml.safe_dump(msgspec.to_builtins(mission), sort_keys=False))


def again(path: Path, who: Who, row: int) -> str:
    """The command that runs a mission again, in the row that it had."""
    from sim2grid.commands import rollout
    from sim2grid.study.soak import BLOCK

    return command.line("rollout", rollout.Args(
        mission=(str(path),), planner=who.planner, time_limit=who.time_limit, mode=who.mode,
        backend="native", seed=who.seed, row=(row, BLOCK))) + " --no-video"


def _document(args: Args, entries: list[Entry], seconds: float) -> dict[str, Any]:
    from moonteam.report import provenance
    from sim2grid.study.soak import BLOCK, FORGET, failures, memory, who_decides

    line = memory(entries)
    wall = sum(entry.wall_s for entry in entries)
    notes = [f"Resident memory: {line['first_mib']} MiB after the first mission, "
             f"{line['last_mib']} after the last, {line['most_mib']} at most; the line through it "
             f"rises by {line['slope']} MiB a 1000 missions, over the second half by "
             f"{line['slope_second_half']}. What was compiled is dropped every {BLOCK * FORGET} "
             f"missions; lowest of each: {_mib(line['lowest_mib'])}; highest: "
             f"{_mib(line['highest_mib'])}.",
             f"{3600 * len(entries) / max(wall, 1e-9):.0f} missions an hour."]
    return {"kind": "soak", "title": f"soak: {len(entries)} missions",
            "meta": provenance.meta(command.line("evaluate soak", args), args.seed),
            "options": command.figures(args), "memory": line, "seconds": seconds,
            "failures": failures(entries), "notes": notes,
            "commands": {entry.number: again(_file(args.out, entry.number),
                                             who_decides(args.seed, entry.number),
                                             entry.number % BLOCK)
                         for entry in entries if not entry.success},
            "tracebacks": {entry.number: entry.traceback for entry in entries if entry.traceback}}


def _mib(values: list[float]) -> str:
    return ", ".join(f"{value:.0f}" for value in values)


def _tables(entries: list[Entry]) -> list[tuple[list[str], list[list[str]]]]:
    from sim2grid.study.soak import failures, table

    heads = ["missions", "solved", "failed", "s a mission"]
    keys = {"mode": lambda e: e.mode, "planner": lambda e: f"{e.mode} {e.planner}",
            "map": lambda e: f"{e.side:2d} m", "robots": lambda e: str(len(e.kinds)),
            "site": lambda e: e.site}
    causes = [[cause, str(len(numbers)), " ".join(map(str, numbers[:10]))]
              for cause, numbers in failures(entries).items()]
    return [([name, *heads], table(entries, key)) for name, key in keys.items()] + [
        (["cause", "missions", "the first, in report.json with commands"], causes)]


def _save(out: Path, report: dict[str, Any], entries: list[Entry]) -> None:
    from moonteam.report.tables import plain_markdown
    from sim2grid.study.soak import figure

    files.write_json(out / "report.json", report)
    files.write_text(out / "table.md", plain_markdown(report, _tables(entries)) + "\n")
    with files.replacing(out / "soak.png") as temporary:
        figure(entries).savefig(temporary, dpi=110)
