"""Options that several commands have, and the reading of a command's words.

A command's `Args` inherits the groups that it needs; tyro takes the help from here too. What no
figure depends on is marked `Aside`, so that printed command lines leave it out. The options of
the groups are given by name only, so that a command can have required ones of its own.
"""

from __future__ import annotations

import ast
import inspect
import sys
import textwrap
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import tyro

from moonteam import outputs
from moonteam.commands import refused
from moonteam.errors import InputError
from moonteam.problem.piece import Units
from moonteam.report.command import Aside, flag

if TYPE_CHECKING:
    from moonteam.planners.kind import PlannerOptions

T = TypeVar("T")

Many = tyro.conf.UseAppendAction
"""An option that is given again for each of several values."""


def parse(kind: type[T], name: str, words: Sequence[str], default: T | None = None) -> T:
    """The words after `moonteam NAME`, read into a command's `Args`.

    With a `default`, whose values then are the options' own, each flag has its opposite too.
    Raises InputError for words that it does not take, SystemExit for --help.
    """
    # PYTHONOPTIMIZE=2 leaves docstrings out, and dataclasses put something else in their place.
    about = _docstring(kind) if sys.flags.optimize > 1 else inspect.getdoc(kind)
    prog = f"moonteam {name}"

    def read(words: Sequence[str]) -> T:
        if default is not None:
            return tyro.cli(kind, prog=prog, args=words, default=default, description=about)
        return tyro.cli(kind, prog=prog, args=words, description=about,
                        config=(tyro.conf.FlagCreatePairsOff,))

    with refused.in_one_line(prog, lambda: read(["--help"])):
        return read(words)


def _docstring(kind: type) -> str | None:
    """Of a class, from its source."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(kind)))
    body = tree.body[0]
    return ast.get_docstring(body) if isinstance(body, ast.ClassDef) else None


def keeping(args: Any, names: Sequence[str]) -> AbstractContextManager[None]:
    """Holds the folder of `--out` for the files `names`, if there are any and it is given."""
    if not names or args.out is None:
        return nullcontext()
    return outputs.folder(args.out, names, force=args.force,
                          resume=getattr(args, "resume", None))


def check_soil(args: Any) -> None:
    """Raises InputError for options of regolith where the `ground` of `args` is rigid."""
    usual = type(args)()
    for name in ("soil", "fields"):
        if args.ground == "rigid" and getattr(args, name, None) != getattr(usual, name, None):
            raise InputError(flag(name), "is of --ground regolith, which is not given")


@dataclass(frozen=True, kw_only=True)
class Printed:
    """How a result is printed."""

    json: Aside[bool] = False
    """Print one JSON document and nothing else."""


@dataclass(frozen=True, kw_only=True)
class Forced:
    """What is done about files that are there already."""

    force: Aside[bool] = False
    """Replace files that are there already; without it nothing is written over."""


@dataclass(frozen=True, kw_only=True)
class Saved(Forced):
    """Where a result is written to."""

    out: Aside[Path | None] = None
    """Folder to write files to; without it nothing is written."""


@dataclass(frozen=True, kw_only=True)
class Reported(Saved, Printed):
    """How a report is printed and saved."""

    markdown: Aside[bool] = False
    """Print the tables as Markdown, with command, commit and machine, and nothing else."""


@dataclass(frozen=True, kw_only=True)
class Seeded:
    """The seed of a command that has one."""

    seed: int = 0
    """Seed of everything random."""


@dataclass(frozen=True, kw_only=True)
class Resumable:
    """Going on with what was interrupted."""

    resume: Aside[bool] = False
    """Go on with the run in the folder; the options must be the same."""


@dataclass(frozen=True, kw_only=True)
class RunFolder(Resumable, Forced):
    """Where a training run lives."""

    out: Aside[Path | None] = None
    """Run folder; runs/NAME-SEED if not given, NAME being the word after `train`."""


@dataclass(frozen=True, kw_only=True)
class Apart:
    """Where the work is done."""

    on: Aside[str] = ""
    """Compute on a Ray cluster: ray (the cores of this machine), HOST:PORT of a cluster that this
    machine is part of, or ray://HOST:PORT; needs pip install 'moonteam[ray]'. Without it, in this
    process. See docs/cluster.md."""


@dataclass(frozen=True, kw_only=True)
class Limited:
    """The beginning of a set."""

    limit: int | None = None
    """Only the first so many scenarios of a set."""


@dataclass(frozen=True, kw_only=True)
class Drawn(Seeded):
    """Scenarios drawn where no set is given."""

    count: int = 200
    """Without SET: scenarios to draw."""
    agents: int = 3
    """Without SET: agents of each scenario drawn."""
    targets: int = 5
    """Without SET: targets of each scenario drawn."""
    side: int = 32
    """Without SET: cells of a side of the map."""
    max_steps: int = 128
    """Without SET: steps in which a scenario must be solved."""


@dataclass(frozen=True, kw_only=True)
class Missions(Seeded):
    """Random missions in physics."""

    site_seed: int = 0
    """Seed of the ground; --seed is that of the rest."""
    targets: int = 5
    """Targets of each mission, before events."""
    side: int = 32
    """Cells of a side of the map."""
    max_steps: int = 128
    """Joint decisions after which a mission has failed."""


@dataclass(frozen=True, kw_only=True)
class Elevation:
    """Ground from an elevation model."""

    dem: Path | None = None
    """Elevation model: GeoTIFF, ISIS cube or another raster in metres, or .npy [rows, columns] m
    with north first."""
    centre: tuple[float, float] | None = None
    """Of the window in --dem, in --units; the model's centre if not given."""
    units: Units = "metres"
    """What --centre is in: metres east and north of the model's centre, column and row of pixels
    counted from 0 in the upper left, or latitude and longitude."""
    rotation: float = 0.0
    """Degrees from the model's north, clockwise, to that of the window."""
    pixel: float | None = None
    """Metres a pixel of --dem; needed where the file does not say."""
    band: int = 0
    """Of --dem, counted from 0."""
    scale: float | None = None
    """Metres a unit of elevation of --dem, if the file is wrong or does not say."""
    detrend: bool = False
    """Take the plane of best fit out of --dem."""
    detail: bool = True
    """Add relief finer than the pixels of --dem, continuing its power spectrum."""

    def model_options(self) -> dict[str, Any]:
        """The options of a model that are not their defaults, by field."""
        usual = Elevation()
        return {field.name: value for field in fields(Elevation)
                if (value := getattr(self, field.name)) != getattr(usual, field.name)}


@dataclass(frozen=True, kw_only=True)
class Planning:
    """What one planner, or each of several, is made from."""

    objective: Literal["makespan", "moves", "weighted"] = "makespan"
    """Least makespan (and then few moves), fewest moves, or alpha * makespan + beta * moves; of a
    policy only where it decodes best-of-K."""
    alpha: float = 1.0
    """Weight of the makespan in the objective weighted."""
    beta: float = 0.05
    """Weight of the moves in the objective weighted."""
    time_limit: float | None = None
    """Seconds after which exact, lns, guided, cpsat and routing return the best plan they have."""
    policy: str = "any_team"
    """Policy file (.safetensors) or the name of a bundled policy, for --planner policy."""
    decode: str = "argmax"
    """How actions are read from the policy: argmax, sample or best-of-K such as best-of-16."""
    preference: float = 0.0
    """0 (time) to 1 (effort), for a policy that takes one."""

    def planner_options(self, seed: int = 0) -> PlannerOptions:
        """As planners take them. Raises InputError naming the option at fault."""
        from moonteam.planners.kind import PlannerOptions

        return PlannerOptions(self.objective, self.alpha, self.beta, self.time_limit, seed,
                              self.policy, self.decode, self.preference)
