"""`moonteam train imitate quick|any_team`: imitation of the exact planner."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

import tyro

from moonteam import paths
from moonteam.commands.options import parse as parse_words
from moonteam.errors import InputError
from moonteam.policies.brain import EntityBrain
from moonteam.policies.entity import EntitySpec
from moonteam.policies.policy import Policy
from moonteam.report.progress import say
from training.commands import dry
from training.commands.ending import Taught, complete
from training.run.machine import Run
from training.sharding import use_all_cores
from training.teacher.imitation import Dagger
from training.teacher.presets import PRESETS


@dataclass(frozen=True)
class Args(Taught):
    """Train the policy for any team by imitating the exact planner: quick or any_team.

    Examples:
      moonteam train imitate quick
      moonteam train imitate quick --seed 1 --out runs/pupil-1
      moonteam train imitate any_team --out runs/pupil --resume
      moonteam train imitate any_team --begin any_team_imitated --lr 8e-4 --rounds 900
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
    """Arguments of `moonteam train imitate`."""
    return parse_words(Args, "train imitate", words)


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
    out = args.folder(f"imitate-{args.preset}", args.seed)
    if args.dry_run:
        return dry.show(*dry.taught(
            f"moonteam train imitate {args.preset}", config, args.begin,
            f"{config.batches} batches of {config.batch_size} states a family and round"),
            out, args.json)
    use_all_cores()
    with args.holding(out):
        say("moonteam: making grounds and held-out scenarios, compiling")
        dagger = Dagger(config, params, args.preset, args.begin)
        run = Run(dagger, out, args.resume, args.checkpoint_seconds,
                  tensorboard=args.tensorboard, force=args.force, wandb=args.wandb)
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
