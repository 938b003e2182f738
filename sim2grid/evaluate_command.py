"""`moonteam evaluate execution`: hundreds of missions in physics, and what came of them."""

from __future__ import annotations

import shlex
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import msgspec

from moonteam import __version__, files
from moonteam.errors import InputError

if TYPE_CHECKING:
    from sim2grid.evaluate import Evaluation, Row

PRESETS = ("mare", "highland", "crater_rim", "polar", "flat")


@dataclass(frozen=True)
class Args:
    """Execute random missions in physics and compare what they cost with the grid's promise.

    Each mission has a drone, a legged and a wheeled robot with random skills, random targets
    and, if asked for, random events; all missions of a site stand on the same ground. A row of
    the table is a loop with a planner and a mode: closed (the planner decides again at each
    step, from where the robots really are), open (the grid plan walked through blindly, all
    robots in lockstep), oracle (closed with the exact planner) and grid (no physics).
    Exit code 0 whatever the missions came to, 130 if interrupted, with what is done saved.

    Files in --out: report.html (one page), report.json, rows.csv, table.md, and rows.jsonl, to
    which each mission is added as it ends, so that --resume can go on. The same options give the
    same report.

    Examples:
      moonteam evaluate execution --site mare highland --count 100 --out runs/execution
      moonteam evaluate execution --planner exact --loop closed open grid --mode barrier async
      moonteam evaluate execution --site flat --count 8 --lose 1 --out runs/lose --resume
      moonteam evaluate execution --count 20 --new-targets 5 --slow 0.5 --silent 0.5 --json
    """

    site: tuple[Literal["mare", "highland", "crater_rim", "polar", "flat"], ...] = ("mare",)
    """Presets of the ground, one group of missions each."""
    site_seed: int = 0
    """Seed of the ground."""
    count: int = 20
    """Missions a site."""
    loop: tuple[Literal["closed", "open", "oracle", "grid"], ...] = ("closed",)
    """Which baselines stand in the table."""
    mode: tuple[Literal["barrier", "async"], ...] = ("barrier",)
    """barrier: all robots decide together; async: each when it arrives (closed, oracle)."""
    planner: tuple[Literal["policy", "exact", "greedy"], ...] = ("policy",)
    """Who decides: a learned policy, the exact planner, or greedy insertion."""
    policy: str = "any_team"
    """Policy file (.safetensors) or the name of a bundled policy, for --planner policy."""
    decode: str = "argmax"
    """How actions are read from the policy: argmax, sample or best-of-K such as best-of-16."""
    objective: Literal["makespan", "moves", "weighted"] = "makespan"
    """What the planner minimises (exact, greedy, and policy with best-of-K)."""
    targets: int = 5
    """Targets of each mission, before events."""
    side: int = 32
    """Cells of a side of the map."""
    cell: float = 1.0
    """Metres a side of a cell."""
    max_steps: int = 128
    """Joint decisions after which a mission has failed."""
    lose: float = 0.0
    """Chance for each mission that one robot is lost, at a random decision in mid-mission."""
    slow: float = 0.0
    """Chance for each mission that one robot is slowed to 0.3 to 0.7 of its speed."""
    silent: float = 0.0
    """Chance for each mission that one robot is silent for 5 to 14 decisions."""
    new_targets: int = 0
    """New targets that appear in mid-mission, each at a random decision."""
    seed: int = 0
    """Seed of the missions, their events and the planners."""
    backend: Literal["native", "mjx"] = "native"
    """Physics engine: C MuJoCo, or MJX for accelerators."""
    width: int = 25
    """Worlds that the engine advances together."""
    threads: int = 0
    """CPU threads of the native engine, 0 for all; the report is the same."""
    resume: bool = False
    """Go on with the run in --out; the options must be the same."""
    json: bool = False
    """Print the report as one JSON document and nothing else."""
    markdown: bool = False
    """Print the tables as Markdown and nothing else."""
    out: Path | None = None
    """Output folder."""


def run(args: Args) -> int:
    """Evaluates, prints, saves."""
    _check(args)
    from moonteam.compilation import call_at_once, enable_cache

    enable_cache()
    call_at_once()
    from moonteam.evaluation import provenance
    from sim2grid.summary import document

    evaluation = _evaluation(args)
    journal = _Journal.open(args) if args.out else None
    if journal:
        evaluation.rows |= {(row.contender, row.number): row for row in journal.rows}
        evaluation.keep = journal.add
    begun, interrupted = time.perf_counter(), False
    try:
        evaluation.run()
    except KeyboardInterrupt:
        interrupted = True
    rows = evaluation.sorted_rows()
    report = document(rows, evaluation.entries, evaluation.contenders, _options(args),
                      provenance.meta(_command(args), args.seed), args.seed)
    if interrupted:
        report["interrupted"] = True
    if args.out:
        _save(args.out, report, rows)
    _print(args, report)
    _say(f"{len(rows)} missions in the report; {time.perf_counter() - begun:.0f} s")
    if interrupted:
        more = ": --resume goes on" if args.out else ""
        print(f"moonteam: interrupted{more}", file=sys.stderr)
        return 130
    return 0


def _check(args: Args) -> None:
    """Raises InputError for options out of range."""
    for name, value, low, high in (
            ("count", args.count, 1, 100_000), ("targets", args.targets, 1, 64),
            ("side", args.side, 4, 128), ("max-steps", args.max_steps, 1, 100_000),
            ("seed", args.seed, 0, 2**31), ("site-seed", args.site_seed, 0, 2**31),
            ("width", args.width, 1, 4096), ("threads", args.threads, 0, 1024),
            ("new-targets", args.new_targets, 0, 64), ("cell", args.cell, 0.25, 10),
            ("lose", args.lose, 0, 1), ("slow", args.slow, 0, 1), ("silent", args.silent, 0, 1)):
        if not low <= value <= high:
            raise InputError(f"--{name}", f"{value} is not allowed; {low} to {high}")
    if args.resume and args.out is None:
        raise InputError("--resume", "needs the folder of the run to go on with: --out DIR")
    for name, chosen in (("site", args.site), ("loop", args.loop), ("mode", args.mode),
                         ("planner", args.planner)):
        if len(set(chosen)) < len(chosen) or not chosen:
            raise InputError(f"--{name}", "give each once, and at least one")


def _evaluation(args: Args) -> Evaluation:
    from sim2grid.evaluate import Contender, Evaluation, contenders
    from sim2grid.fleet import Rates, Recipe

    rates = Rates(args.lose, args.slow, args.silent, args.new_targets)
    recipes = [Recipe(site, args.site_seed, args.seed, args.targets, args.side, args.cell,
                      args.max_steps, rates) for site in args.site]
    who = [Contender("closed", "barrier", name, args.policy if name == "policy" else None,
                     args.decode if name == "policy" else "argmax", args.objective)
           for name in args.planner]
    return Evaluation(recipes, args.count, contenders(args.loop, args.mode, who), args.seed,
                      args.width, args.backend, args.threads, progress=_progress())


def _progress() -> Any:
    """A line on standard error that is written over, if that is a terminal."""
    watched = sys.stderr.isatty()

    def show(title: str, done: int, total: int) -> None:
        if watched:
            end = "\n" if done == total else ""
            print(f"\r\x1b[K{title}: {done} of {total} missions", end=end, file=sys.stderr,
                  flush=True)

    return show


def _options(args: Args) -> dict[str, Any]:
    """What the rows depend on; the same in a run and in what resumes it."""
    left_out = ("json", "markdown", "out", "resume", "threads", "lose", "slow", "silent",
                "new_targets")
    options = {key: value for key, value in asdict(args).items() if key not in left_out}
    rates = {"lose": args.lose, "slow": args.slow, "silent": args.silent,
             "new_targets": args.new_targets}
    return options | {"rates": rates}


def _command(args: Args) -> str:
    """The command that makes this report again; options at their default are left out."""
    words = ["moonteam", "evaluate", "execution"]
    for key, value in asdict(args).items():
        if key in ("json", "markdown", "out", "resume", "threads") or value == getattr(Args, key):
            continue
        words += [f"--{key.replace('_', '-')}",
                  *(map(str, value) if isinstance(value, tuple) else [str(value)])]
    return shlex.join(words)


class _Journal:
    """The folder's rows.jsonl: a line is added as each mission ends."""

    def __init__(self, path: Path, rows: list[Row]):
        self.path, self.rows = path, rows

    @classmethod
    def open(cls, args: Args) -> _Journal:
        """Starts the folder, or reads what is done if it is to be resumed. Raises InputError."""
        assert args.out is not None
        if args.out.exists() and not args.out.is_dir():
            raise InputError("--out", f"{args.out} is a file; a folder is needed")
        path, config = args.out / "rows.jsonl", args.out / "config.json"
        options = {"moonteam": __version__, "options": _options(args)}
        plain = msgspec.json.decode(files.dump_json(options))
        if not args.resume:
            files.write_json(config, options)
            files.write_text(path, "")
            return cls(path, [])
        if not config.exists():
            raise InputError("--resume", f"{args.out} holds no run to go on with")
        before = msgspec.json.decode(files.read_text(config))
        if before != plain:
            changed = sorted(key for key in plain["options"]
                             if plain["options"][key] != before.get("options", {}).get(key))
            raise InputError("--resume", f"{args.out} was made with other options: "
                             + (", ".join(changed) or "another version of moonteam"))
        rows = _read(path)
        files.write_text(path, "".join(files.dump_json(row) + "\n" for row in rows))
        return cls(path, rows)

    def add(self, row: Row) -> None:
        """Adds a row; what an interruption cuts off is dropped when the run is resumed."""
        with self.path.open("a", encoding="utf-8") as file:
            file.write(files.dump_json(row) + "\n")


def _read(path: Path) -> list[Row]:
    """The whole rows of a journal; half a line at its end is left out."""
    from sim2grid.evaluate import Row

    rows = []
    text = files.read_text(path) if path.exists() else ""
    for number, line in enumerate(text.splitlines(keepends=True), 1):
        if not line.endswith("\n"):
            break
        try:
            rows.append(msgspec.json.decode(line, type=Row))
        except msgspec.DecodeError as error:
            raise InputError(path, f"line {number} is no row: {error}") from None
    return rows


def _save(out: Path, report: dict[str, Any], rows: list[Row]) -> None:
    from moonteam.evaluation.report import plain_csv, plain_markdown
    from sim2grid.evaluation_page import evaluation_page
    from sim2grid.summary import csv_rows, tables

    files.write_json(out / "report.json", report)
    files.write_text(out / "report.html", evaluation_page(report, str(out / "report.json")))
    files.write_text(out / "table.md", plain_markdown(report, tables(report)) + "\n")
    if rows:
        files.write_text(out / "rows.csv", plain_csv(csv_rows(rows)))


def _print(args: Args, report: dict[str, Any]) -> None:
    from moonteam.evaluation.report import plain_markdown, show_plain
    from sim2grid.summary import tables

    if args.json:
        print(files.dump_json(report))
    elif args.markdown:
        print(plain_markdown(report, tables(report)))
    else:
        (titles, rows), *more = tables(report)
        heads = ["\n".join([row[0], " ".join(word for word in row[1:4] if word != "-")])
                 for row in rows]
        turned = [[title, *(row[k] for row in rows)] for k, title in enumerate(titles) if k > 3]
        show_plain(report, [(["", *heads], turned), *more])


def _say(text: str) -> None:
    if sys.stderr.isatty():
        print(f"moonteam: {text}", file=sys.stderr)
