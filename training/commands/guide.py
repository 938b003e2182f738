"""`moonteam train guide`: a guide of local search, by an evolution strategy."""

from __future__ import annotations

from dataclasses import dataclass

from moonteam.commands.options import parse as parse_words
from moonteam.errors import InputError
from training.commands import dry
from training.commands.ending import Taught, complete
from training.guide.recipe import Guiding
from training.run.machine import Run


@dataclass(frozen=True)
class Args(Taught):
    """Train the guide of local search for large teams: what is taken out of a plan, and how it is
    put back.

    The planner `guided` takes the one that is bundled; one of your own by its Python class.

    Examples:
      moonteam train guide
      moonteam train guide --out runs/guide --rounds 800 --seed 1
      moonteam train guide --out runs/guide --rounds 800 --seed 1 --resume
    """

    rounds: int = Guiding.rounds
    """Generations."""
    population: int = Guiding.population
    """Candidates of a generation."""
    held_out: int = Guiding.held_out
    """Problems of each size that training never draws, to look at it by; an eighth of the large."""


def parse(words: list[str]) -> Args:
    """Arguments of `moonteam train guide`."""
    return parse_words(Args, "train guide", words)


def run(args: Args) -> int:
    """Trains; returns the exit code."""
    for name, least in (("rounds", 1), ("population", 4), ("held_out", 1)):
        if (value := getattr(args, name)) < least:
            raise InputError("--" + name.replace("_", "-"),
                             f"{value} is not allowed; at least {least}")
    config = Guiding(population=args.population, rounds=args.rounds, held_out=args.held_out,
                     seed=args.seed)
    out = args.folder("guide", args.seed)
    if args.dry_run:
        return dry.show(*dry.guiding(config), out, args.json)
    from training.guide.evolution import Guider

    with args.holding(out):
        return complete(Run(Guider(config), out, args.resume, args.checkpoint_seconds,
                            tensorboard=args.tensorboard, force=args.force, wandb=args.wandb),
                        args.json)
