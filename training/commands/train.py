"""`moonteam train PRESET`."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from moonteam.commands.options import parse as parse_words
from moonteam.errors import InputError
from moonteam.report.command import Aside
from training.commands import dry
from training.commands.ending import Together, Watched, complete
from training.mappo import config as configs
from training.mappo.config import Config

if TYPE_CHECKING:
    from training.commands import compare, guide, imitate, macro, refine

MACRO = ("quick", "paper_team", "any_team", "any_team_further", "unfolding", "lapsing", "searching",
         "crews")
"""Presets of MAPPO on macro-decisions; see `training.commands.macro`."""
IMITATE = "imitate"
"""Imitation of the exact planner; see `training.commands.imitate`."""
REFINE = "refine"
"""MAPPO from an imitated policy; see `training.commands.refine`."""
COMPARE = "compare"
"""Runs side by side; see `training.commands.compare`."""
GUIDE = "guide"
"""A guide of local search; see `training.commands.guide`."""
ELSEWHERE = dict.fromkeys(MACRO, "macro") | {
    name: name for name in (IMITATE, REFINE, COMPARE, GUIDE)}
"""First words with options of their own, and the modules that read them."""
NAMES = (*MACRO, f"{IMITATE} quick", f"{IMITATE} any_team", REFINE, GUIDE)
"""What else there is to train."""


@dataclass(frozen=True)
class Args(Together, Watched):
    """Train a grid policy from a preset.

    quick, paper_team, any_team: MAPPO from scratch, a target a decision, for teams of any size
    (quick takes five minutes on two cores; any_team is what ships). The rest is what it is held
    against: pi_5t, pi_6t, pi_7t, pi_5t5r, small and laptop, the paper's network a cell a decision;
    imitate quick|any_team, the exact planner's pupil, and refine, which goes on from one by MAPPO.
    guide trains what steers local search for large teams.
    They have options of their own: moonteam train quick --help, moonteam train imitate --help.
    compare puts runs side by side: moonteam train compare --help.

    The first word after `train` is the preset; every number of it can be changed by an option.

    Examples:
      moonteam train quick
      moonteam train any_team --out runs/any
      moonteam train small
      moonteam train small --out runs/trial --seed 3 --bootstrap.updates 50
      moonteam train small --out runs/trial --seed 3 --bootstrap.updates 50 --resume
      moonteam train small --begin runs/small-0/checkpoints/00001000 --refinement.lr 1e-3
      moonteam train pi_5t --dry-run --compiled
    """

    config: Annotated[Config, tyro.conf.arg(name="")]
    """The run's numbers, from the preset."""
    begin: Path | None = None
    """A checkpoint of another run, RUN/checkpoints/NUMBER: a new run that goes on from there with
    its own numbers. Network and environments must be as they were."""
    stop_on_collapse: bool = True
    """Stop, with exit code 1, when held-out success has fallen to half of its best for three
    evaluations in a row."""
    compiled: Aside[bool] = False
    """With --dry-run: also compile both phases, without running them, and print what memory XLA
    sets aside for them."""


if TYPE_CHECKING:
    Trained = Args | guide.Args | imitate.Args | macro.Args | refine.Args


def parse(words: list[str]) -> Any:
    """Arguments of the command; the preset's numbers are the defaults of all options.

    Raises InputError for a preset that does not exist.
    """
    if words and (module := ELSEWHERE.get(words[0])):
        found = importlib.import_module(f"training.commands.{module}")
        return found.parse(words if words[0] in MACRO else words[1:])
    named = bool(words) and not words[0].startswith("-")
    asks_help = any(word in ("-h", "--help") for word in words)
    if not named and not asks_help:
        configs.preset("" if not words else words[0], NAMES)
    name, rest = (words[0], words[1:]) if named else ("small", words)
    default = Args(configs.preset(name, NAMES, ELSEWHERE))
    return parse_words(Args, f"train {name if named else 'PRESET'}", rest, default)


def run(args: Trained | compare.Args) -> int:
    """Trains, describes or compares; returns the exit code."""
    from moonteam.compilation import enable_cache

    enable_cache()
    if not isinstance(args, Args):
        return importlib.import_module(type(args).__module__).run(args)
    if args.compiled and not args.dry_run:
        raise InputError("--compiled", "is for --dry-run")
    if args.dry_run:
        from training.bench import account

        document = account.describe(args.config, args.compiled)
        return dry.show(document, account.as_text(args.config, document), _place(args), args.json)
    return _train(args)


def folder(args: Trained | compare.Args) -> Path:
    """The run folder of a training. Raises InputError for a command that trains nothing."""
    from training.commands import compare

    if isinstance(args, compare.Args) or args.dry_run:
        raise InputError("train", "trains nothing so, and has no run folder")
    return _place(args)


def _place(args: Trained) -> Path:
    """The run folder."""
    from training.commands import imitate, macro, refine

    if isinstance(args, Args):
        return args.folder(args.config.name, args.config.seed)
    if isinstance(args, macro.Args):
        return args.folder(args.config.macro, args.config.seed)
    if isinstance(args, imitate.Args):
        return args.folder(f"{IMITATE}-{args.preset}", args.seed)
    return args.folder(REFINE if isinstance(args, refine.Args) else GUIDE, args.seed)


def _train(args: Args) -> int:
    from training.mappo.trainee import Mappo
    from training.run.machine import Run

    out = args.own(folder(args))
    args.join()
    with args.holding(out):
        return complete(Run(Mappo(args.config), out, args.resume, args.checkpoint_seconds,
                            args.stop_on_collapse, args.tensorboard, args.begin, args.force,
                            args.wandb and not args.process), args.json)
