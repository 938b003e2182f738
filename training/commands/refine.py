"""`moonteam train refine`: MAPPO from the weights of an imitated policy."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import tyro

from moonteam.commands.options import parse as parse_words
from moonteam.errors import InputError
from moonteam.policies.entity import EntitySpec, init
from moonteam.report.progress import say
from training.commands import dry
from training.commands.ending import Taught, complete
from training.commands.imitate import entity_policy
from training.run import metrics
from training.run.machine import Run
from training.run.trainee import Row
from training.sharding import use_all_cores
from training.teacher.curve import draw_curve
from training.teacher.presets import PRESETS
from training.teacher.refinement import Refinement, Refiner

FRESH = "fresh"


@dataclass(frozen=True)
class Args(Taught):
    """Refine an imitated policy by MAPPO, with a centralised critic over the same tokens.

    `fresh` in place of a policy begins from nothing: with --leash 0 --reward bootstrap that is
    MAPPO step by step without a teacher.

    Examples:
      moonteam train refine any_team_imitated --out runs/refined
      moonteam train refine runs/imitate-quick-0/policy.safetensors --families quick --reward paper
      moonteam train refine any_team_imitated --out runs/refined --resume --beside runs/control
      moonteam train refine fresh --families quick --reward bootstrap --leash 0
    """

    policy: tyro.conf.Positional[str]
    """Policy file (.safetensors) or the name of a bundled policy to begin with, or `fresh`."""
    families: Literal["quick", "any_team"] = "any_team"
    """The preset whose teams, targets and grounds are practised."""
    reward: Literal["regret", "paper", "bootstrap", "none"] = "regret"
    """regret: minus the cost lost against the exact planner; paper: the paper's terms of its second
    phase; bootstrap: those of its first; none: imitation of the same states alone, the control."""
    rounds: int = 300
    """Rounds of collection and learning."""
    lr: float = 3e-4
    """Learning rate at the start."""
    leash: float = 0.1
    """Weight of the imitation loss beside the policy's."""
    ent_coef: float = 0.0
    """Weight of the entropy."""
    beside: tyro.conf.UseAppendAction[tuple[Path, ...]] = ()
    """Folder of another refinement to draw beside this one in beside.png; again for more."""


def parse(words: list[str]) -> Args:
    """Arguments of `moonteam train refine`."""
    return parse_words(Args, "train refine", words)


def run(args: Args) -> int:
    """Refines; returns the exit code."""
    if args.rounds < 1:
        raise InputError("--rounds", f"{args.rounds} is not allowed; at least 1")
    others = {str(folder): _rows(folder) for folder in args.beside}
    spec, params = _fresh(args.seed) if args.policy == FRESH else entity_policy(args.policy)
    config = Refinement(
        families=PRESETS[args.families].families, spec=spec, reward=args.reward,
        rounds=args.rounds, lr=args.lr, leash=args.leash, ent_coef=args.ent_coef,
        seed=args.seed)
    out = args.folder("refine", args.seed)
    if args.dry_run:
        return dry.show(*dry.taught(
            f"moonteam train refine {args.policy}", config,
            "" if args.policy == FRESH else args.policy,
            f"reward {config.reward}, leash {config.leash:g}, entropy {config.ent_coef:g}, "
            f"{config.minibatches} minibatches a family and round"), out, args.json)
    with args.holding(out):
        say("moonteam: making grounds and held-out scenarios, compiling")
        refiner = Refiner(config, params, source="" if args.policy == FRESH else args.policy)
        run = Run(refiner, out, args.resume, args.checkpoint_seconds,
                  tensorboard=args.tensorboard, force=args.force, wandb=args.wandb)
        code = complete(run, args.json)
        if others and code == 0:
            draw_curve(out / "beside.png", {str(out): run.metrics.rows} | others)
        return code


def _fresh(seed: int) -> tuple[EntitySpec, Any]:
    """Size and parameters that know nothing."""
    use_all_cores()
    spec = EntitySpec()
    return spec, init(spec, jax.random.key(seed))


def _rows(folder: Path) -> list[Row]:
    """The evaluations of a run. Raises InputError if the folder holds none."""
    rows = [row for row in metrics.read(folder / "metrics.jsonl") if "families" in row]
    if not rows:
        raise InputError("--beside", f"{folder} holds no run that can be read: no evaluation in "
                         "its metrics.jsonl")
    return rows
