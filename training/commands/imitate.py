"""`moonteam train quick|any_team`: imitation of the exact planner."""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from moonteam import files, paths
from moonteam.commands.options import Printed, RunFolder, Seeded
from moonteam.commands.options import parse as parse_words
from moonteam.errors import InputError
from moonteam.planners.learned import EntityBrain, Policy
from moonteam.policies.entity import EntitySpec
from moonteam.report.progress import say
from training.run.folder import Run
from training.run.loop import stop_on_signals
from training.sharding import use_all_cores
from training.teacher.imitation import Dagger, Family, Imitation

PAPER = (Family(3, 5), Family(3, 6), Family(3, 7))

PRESETS = {
    "quick": Imitation(families=PAPER, rounds=900, num_envs=256, batches=2),
    "any_team": Imitation(
        families=(
            *PAPER,
            Family(2, 6, sides=(8, 32)),
            Family(3, 9, sides=(16, 48)),
            Family(4, 7, num_skills=3, sides=(16, 64), max_steps=256),
            Family(5, 9, num_skills=3, sides=(16, 40)),
            Family(6, 11, sides=(16, 40), exact_to=9, iterations=100),
            Family(3, 6, grounds=1024),
            Family(4, 7, num_skills=3, grounds=512),
            Family(5, 18, exact_to=7, iterations=100, shrink=4),
            Family(7, 30, num_skills=3, exact_to=7, iterations=100, shrink=8),
        ),
        rounds=1300, batches=2),
}
"""Presets of `moonteam train` that imitate the exact planner."""


@dataclass(frozen=True)
class Args(Seeded, RunFolder, Printed):
    """Train the policy for any team by imitating the exact planner: quick or any_team.

    Examples:
      moonteam train quick
      moonteam train quick --seed 1 --out runs/quick-1
      moonteam train any_team --out runs/any --resume
      moonteam train any_team --begin any_team --lr 8e-4 --rounds 900 --out runs/further
    """

    preset: tyro.conf.Positional[Literal["quick", "any_team"]]
    """quick: 3 robots, 5 to 7 targets, 32 x 32; any_team: teams, maps and ground of all sizes."""
    rounds: int | None = None
    """Rounds of visiting, labelling and learning; the preset's number if not given."""
    begin: str = ""
    """Policy file (.safetensors) or the name of a bundled policy, of kind entity, to go on from
    instead of fresh weights."""
    lr: float | None = None
    """Learning rate after warm-up; the preset's number if not given."""


def parse(words: list[str]) -> Args:
    """Arguments of `moonteam train quick|any_team`."""
    return parse_words(Args, "train", words)


def run(args: Args) -> int:
    """Trains; returns the exit code."""
    preset = PRESETS[args.preset]
    rounds = preset.rounds if args.rounds is None else args.rounds
    if rounds < 1:
        raise InputError("--rounds", f"{rounds} is not allowed; at least 1")
    lr = preset.lr if args.lr is None else args.lr
    if not 0.0 < lr <= 0.1:
        raise InputError("--lr", f"{lr:g} is not allowed; above 0, at most 0.1")
    spec, params = entity_policy(args.begin) if args.begin else (preset.spec, None)
    config = dataclasses.replace(preset, seed=args.seed, rounds=rounds, lr=lr, spec=spec)
    out = args.out or Path("runs") / f"{args.preset}-{args.seed}"
    use_all_cores()
    say("moonteam: making grounds and held-out scenarios, compiling")
    run = Run(args.preset, "imitation (DAgger)", Dagger(config, params), out, args.resume,
              args.begin or None)
    return complete(run, args.json)


def entity_policy(name: str) -> tuple[EntitySpec, Any]:
    """Size and parameters of the entity policy of that file or name.

    Sees to it that JAX has its devices before the file is read into them. Raises InputError if
    it is no such policy.
    """
    use_all_cores()
    path = paths.find(name, "policies", ".safetensors")
    policy = Policy.load(path)
    if not isinstance(policy.brain, EntityBrain):
        raise InputError(path, "is a network for one team size; only entity policies go on")
    return policy.brain.spec, policy.source.params


def complete(run: Run, json: bool) -> int:
    """Trains to the end, or until stopped, and reports; returns the exit code."""
    with stop_on_signals() as stop:
        finished = run.train(stop)
    if not finished:
        print(f"moonteam: interrupted after round {run.work.number}, saved; go on with "
              f"--out {run.out} --resume", file=sys.stderr)
        return 130
    report = run.finish()
    if json:
        print(files.dump_json(report | {"out": str(run.out)}))
        return 0
    for row in report["families"]:
        print(f"{row['family']}: success {row['success']:.3f}, makespan gap "
              f"{row['makespan_gap']:.1%}, moves gap {row['moves_gap']:.1%}")
    print(f"{report['labelled']:,} labelled states in {report['seconds']:.0f} s; policy, curve "
          f"and report in {run.out}")
    return 0
