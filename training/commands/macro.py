"""`moonteam train quick|paper_team|any_team|any_team_further|..`: MAPPO on macro-decisions."""

from __future__ import annotations

import contextlib
import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from moonteam import interrupts, outputs, paths
from moonteam.cluster import cluster
from moonteam.commands.options import Apart
from moonteam.commands.options import parse as parse_words
from moonteam.errors import InputError
from moonteam.report.progress import say
from training.commands import dry
from training.commands.ending import Together, Watched, complete, ended, interrupted
from training.mappo.macro import config as configs
from training.mappo.macro.config import MacroConfig
from training.run.away import Stretch
from training.run.machine import Run
from training.sharding import devices_here


@dataclass(frozen=True)
class Args(Together, Apart, Watched):
    """Train a policy for any team by multi-agent PPO, from scratch, no teacher: quick (5 minutes
    on two cores), paper_team (3 robots, 5 to 7 targets) or any_team (the shipped one, begun from
    paper_team), whose last step is any_team_further; unfolding where not everything is known; crews
    for many robots of few kinds, needed several at once.

    A decision is a target, held until something happens. Every number of the preset can be
    changed by an option.

    Examples:
      moonteam train quick
      moonteam train any_team --dry-run
      moonteam train paper_team --seed 1 --out runs/team-1
      moonteam train paper_team --seeds 0 1 2 --out runs/team
      moonteam train paper_team --seeds 0 1 2 --out runs/team --on ray://head:10001
      moonteam train any_team --policy paper_team --out runs/any --resume
      moonteam train any_team_further --policy runs/any/policy.safetensors --out runs/further
    """

    config: Annotated[MacroConfig, tyro.conf.arg(name="")]
    """The run's numbers, from the preset."""
    seeds: tuple[int, ...] = ()
    """Several runs one after the other, or side by side with --on, each in OUT/SEED, then put side
    by side in OUT."""
    policy: tuple[str, ...] = ()
    """Policy file (.safetensors) or the name of a bundled policy, of kind pointer, to go on from
    instead of fresh weights; of several of one size, the mean of their weights. With more
    --spec.layers than it has, blocks are added that change nothing at first."""


def parse(words: list[str]) -> Args:
    """Arguments; the preset's numbers are the defaults of all options."""
    default = Args(configs.PRESETS[words[0]])
    return parse_words(Args, f"train {words[0]}", words[1:], default)


def run(args: Args) -> int:
    """Trains; returns the exit code."""
    if len(set(args.seeds)) < len(args.seeds):
        raise InputError("--seeds", f"{' '.join(map(str, args.seeds))}: a seed is given twice")
    for option, given in (("--coordinator", args.coordinator), ("--tensorboard", args.tensorboard),
                          ("--wandb", args.wandb)):
        if args.on and given:
            raise InputError(option, "is for runs in this process, not for those --on a cluster")
    if args.dry_run:
        return _dry(args)
    if not args.seeds:
        return _train_each(args, [args])
    from training.commands import compare

    base = args.out or args.folder(args.config.macro, args.seeds[0]).parent / args.config.macro
    outs = [base / str(seed) for seed in args.seeds]
    runs = [dataclasses.replace(args, out=out, resume=args.resume and out.exists(),
                                config=dataclasses.replace(args.config, seed=seed))
            for seed, out in zip(args.seeds, outs, strict=True)]
    if args.process:
        return _train_each(args, runs)
    with outputs.folder(base, compare.FILES, force=args.force, resume=args.resume):
        return _train_each(args, runs) or compare.run(compare.Args(tuple(outs), out=base))


def _dry(args: Args) -> int:
    config, _, source = _numbers(args)
    document, text = dry.macro(config, source)
    out = args.folder(config.macro, (args.seeds or (config.seed,))[0])
    if args.seeds:
        out = (args.out or out.parent / config.macro) / "SEED"
        text += f"\nseeds: {' '.join(map(str, args.seeds))}, each the same"
        document["seeds"] = list(args.seeds)
    return dry.show(document, text, out, args.json)


def _train_each(args: Args, runs: list[Args]) -> int:
    if args.on:
        return _train_apart(args.on, runs)
    args.join()
    return next((code for one in runs if (code := _train(one))), 0)


def _train(args: Args) -> int:
    """One run, in this process."""
    from training.mappo.macro.trainee import MacroMappo

    out = args.own(args.folder(args.config.macro, args.config.seed))
    numbers = _numbers(args)
    with args.holding(out):
        say("moonteam: making grounds and held-out problems, compiling")
        return complete(Run(MacroMappo(*numbers), out, args.resume, args.checkpoint_seconds,
                            tensorboard=args.tensorboard, force=args.force,
                            wandb=args.wandb and not args.process), args.json)


def _train_apart(on: str, runs: list[Args]) -> int:
    """Runs side by side on a cluster."""
    from training.mappo.macro.trainee import MacroMappo
    from training.run import away

    outs = [one.folder(one.config.macro, one.config.seed) for one in runs]
    keeping = [away.Keeping(one.resume, one.checkpoint_seconds, one.force) for one in runs]
    numbers = [_numbers(one) for one in runs]
    with contextlib.ExitStack() as stack:
        workers = stack.enter_context(cluster(on))
        assert workers is not None
        for one, out in zip(runs, outs, strict=True):
            stack.enter_context(one.holding(out))
        stop = stack.enter_context(interrupts.postponed())
        found = away.train(workers, MacroMappo, numbers, outs, keeping, devices_here(), stop)
    return max(_end(known, out, runs[0].json) for known, out in zip(found, outs, strict=True))


def _end(known: Stretch | None, out: Path, json: bool) -> int:
    """Says what a run on a cluster came to; returns the exit code."""
    if known is not None and known.failed:
        print(f"moonteam: {known.failed}", file=sys.stderr)
        return 1
    if known is None or known.report is None:
        return interrupted("round", known.updates if known else 0, out)
    return ended(known.report, known.lines, out, json)


def _numbers(args: Args) -> tuple[MacroConfig, Any, str]:
    """What a run is made from: numbers, weights to go on from if any, and where these are from."""
    if not args.policy:
        return args.config, None, ""
    from moonteam.policies import pointer

    spec, params = _mean(args.policy)
    sees = {key: True for key in ("unfolds", "worths", "posts")
            if getattr(args.config.spec, key) and not getattr(spec, key)}
    if sees:
        spec = dataclasses.replace(spec, **sees)
        params = pointer.grafted(spec, params)
    if args.config.spec.layers > spec.layers:
        params = pointer.deepened(spec, params, args.config.spec.layers)
        spec = dataclasses.replace(spec, layers=args.config.spec.layers)
    return dataclasses.replace(args.config, spec=spec), params, " ".join(args.policy)


def _mean(names: tuple[str, ...]) -> tuple[Any, Any]:
    """Size of pointer policies, and the mean of their parameters: those that went on from the same
    one are often better together than each (Wortsman et al. 2022, "Model soups").

    Raises InputError if they are of unlike sizes.
    """
    import jax
    import numpy as np

    found = [_pointer(name) for name in names]
    spec = found[0][0]
    for name, (other, _) in zip(names, found, strict=True):
        if other != spec:
            raise InputError(name, f"is of another size than {names[0]}: {other}, {spec}", "policy")
    return spec, jax.tree.map(lambda *each: np.mean(each, axis=0), *(params for _, params in found))


def _pointer(name: str) -> tuple[Any, Any]:
    """Size and parameters of a pointer policy. Raises InputError if it is another."""
    from moonteam.policies.brain import PointerBrain
    from moonteam.policies.policy import Policy

    path = paths.find(name, "policies", ".safetensors")
    policy = Policy.load(path)
    if not isinstance(policy.brain, PointerBrain):
        raise InputError(path, f"is of kind {policy.source.kind}; only pointer policies go on here")
    return policy.brain.spec, policy.source.params
