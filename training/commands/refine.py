"""`moonteam train refine`: MAPPO from the weights of an imitated policy."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from moonteam.commands.options import parse as parse_words
from moonteam.errors import InputError
from moonteam.report.progress import say
from training.commands.ending import Taught, complete
from training.commands.imitate import entity_policy
from training.run import metrics
from training.run.machine import Run
from training.run.trainee import Row
from training.teacher.curve import draw_curve
from training.teacher.presets import PRESETS
from training.teacher.refinement import Refinement, Refiner


@dataclass(frozen=True)
class Args(Taught):
    """Refine an imitated policy by MAPPO, with a centralised critic over the same tokens.

    Examples:
      moonteam train refine any_team_imitated --out runs/refined
      moonteam train refine runs/imitate-quick-0/policy.safetensors --families quick --reward paper
      moonteam train refine any_team_imitated --out runs/refined --resume --beside runs/control
    """

    policy: tyro.conf.Positional[str]
    """Policy file (.safetensors) or the name of a bundled policy to begin with."""
    families: Literal["quick", "any_team"] = "any_team"
    """The preset whose teams, targets and grounds are practised."""
    reward: Literal["regret", "paper", "none"] = "regret"
    """regret: minus the cost lost against the exact planner; paper: the paper's terms; none:
    imitation of the same states alone, the control."""
    rounds: int = 300
    """Rounds of collection and learning."""
    lr: float = 3e-4
    """Learning rate at the start."""
    leash: float = 0.1
    """Weight of the imitation loss beside the policy's."""
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
    spec, params = entity_policy(args.policy)
    config = Refinement(
        families=PRESETS[args.families].families, spec=spec, reward=args.reward,
        rounds=args.rounds, lr=args.lr, leash=args.leash, seed=args.seed)
    out = args.folder("refine", args.seed)
    say("moonteam: making grounds and held-out scenarios, compiling")
    refiner = Refiner(config, params, source=args.policy)
    run = Run(refiner, out, args.resume, args.checkpoint_seconds, tensorboard=args.tensorboard)
    code = complete(run, args.json)
    if others and code == 0:
        draw_curve(out / "beside.png", {str(out): run.metrics.rows} | others)
    return code


def _rows(folder: Path) -> list[Row]:
    """The evaluations of a run. Raises InputError if the folder holds none."""
    rows = [row for row in metrics.read(folder / "metrics.jsonl") if "families" in row]
    if not rows:
        raise InputError("--beside", f"{folder} holds no run that can be read: no evaluation in "
                         "its metrics.jsonl")
    return rows
