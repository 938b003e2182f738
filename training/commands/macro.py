"""`moonteam train quick|paper_team|any_team`: MAPPO on macro-decisions, from scratch."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from moonteam import outputs, paths
from moonteam.commands.options import parse as parse_words
from moonteam.errors import InputError
from moonteam.report.progress import say
from training.commands.ending import Watched, complete
from training.mappo.macro import config as configs
from training.mappo.macro.config import MacroConfig
from training.run.machine import Run
from training.sharding import use_all_cores


@dataclass(frozen=True)
class Args(Watched):
    """Train a policy for any team by multi-agent PPO, from scratch, no teacher: quick (5 minutes
    on two cores), paper_team (3 robots, 5 to 7 targets) or any_team (the shipped one).

    A decision is a target, held until something happens. Every number of the preset can be
    changed by an option.

    Examples:
      moonteam train quick
      moonteam train paper_team --seed 1 --out runs/team-1
      moonteam train paper_team --seeds 0 1 2 --out runs/team
      moonteam train any_team --out runs/any --resume
      moonteam train any_team --policy any_team --lr 3e-4 --rounds 300 --out runs/further
    """

    config: Annotated[MacroConfig, tyro.conf.arg(name="")]
    """The run's numbers, from the preset."""
    seeds: tuple[int, ...] = ()
    """Several runs one after the other, each in OUT/SEED, then put side by side in OUT."""
    policy: str = ""
    """Policy file (.safetensors) or the name of a bundled policy, of kind pointer, to go on from
    instead of fresh weights."""


def parse(words: list[str]) -> Args:
    """Arguments; the preset's numbers are the defaults of all options."""
    default = Args(configs.PRESETS[words[0]])
    return parse_words(Args, f"train {words[0]}", words[1:], default)


def run(args: Args) -> int:
    """Trains; returns the exit code."""
    if not args.seeds:
        return _train(args)
    if len(set(args.seeds)) < len(args.seeds):
        raise InputError("--seeds", f"{' '.join(map(str, args.seeds))}: a seed is given twice")
    from training.commands import compare

    base = args.out or args.folder(args.config.macro, args.seeds[0]).parent / args.config.macro
    with outputs.folder(base, compare.FILES, force=args.force, resume=args.resume):
        return _train_all(args, base)


def _train_all(args: Args, base: Path) -> int:
    from training.commands import compare

    for seed in args.seeds:
        out = base / str(seed)
        one = dataclasses.replace(args, seeds=(), out=out, resume=args.resume and out.exists(),
                                  config=dataclasses.replace(args.config, seed=seed))
        if code := _train(one):
            return code
    return compare.run(compare.Args(tuple(base / str(seed) for seed in args.seeds), out=base))


def _train(args: Args) -> int:
    from training.mappo.macro.trainee import MacroMappo

    use_all_cores()
    config, params = args.config, None
    if args.policy:
        spec, params = _pointer(args.policy)
        config = dataclasses.replace(config, spec=spec)
    out = args.folder(config.macro, config.seed)
    with args.holding(out):
        say("moonteam: making grounds and held-out problems, compiling")
        trainee = MacroMappo(config, params, args.policy)
        return complete(Run(trainee, out, args.resume, args.checkpoint_seconds,
                            tensorboard=args.tensorboard, force=args.force), args.json)


def _pointer(name: str) -> tuple[Any, Any]:
    """Size and parameters of a pointer policy. Raises InputError if it is another."""
    from moonteam.policies.brain import PointerBrain
    from moonteam.policies.policy import Policy

    path = paths.find(name, "policies", ".safetensors")
    policy = Policy.load(path)
    if not isinstance(policy.brain, PointerBrain):
        raise InputError(path, f"is of kind {policy.source.kind}; only pointer policies go on here")
    return policy.brain.spec, policy.source.params
