"""`moonteam train refine`: MAPPO from the weights of an imitated policy."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec
import tyro

from moonteam.commands.options import Printed, RunFolder, Seeded
from moonteam.commands.options import parse as parse_words
from moonteam.errors import InputError
from moonteam.report.progress import say
from training.commands.imitate import PRESETS, complete, entity_policy
from training.run.folder import Run, draw_curve
from training.teacher.refinement import Refinement, Refiner


@dataclass(frozen=True)
class Args(Seeded, RunFolder, Printed):
    """Refine an imitated policy by MAPPO, with a centralised critic over the same tokens.

    Examples:
      moonteam train refine any_team --out runs/refined
      moonteam train refine runs/quick-0/policy.safetensors --families quick --reward paper
      moonteam train refine any_team --out runs/refined --resume --beside runs/control
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
    out = args.out or Path("runs") / f"refine-{args.seed}"
    say("moonteam: making grounds and held-out scenarios, compiling")
    work = Run("refine", f"MAPPO from imitation, reward {args.reward}",
               Refiner(config, params), out, args.resume, str(args.policy))
    code = complete(work, args.json)
    if others and code == 0:
        draw_curve(out / "beside.png", {str(out): work.rows} | others)
    return code


def _rows(folder: Path) -> list[dict]:
    """The metrics of a run. Raises InputError if the folder holds none."""
    try:
        lines = (folder / "metrics.jsonl").read_text().splitlines()
        return [msgspec.json.decode(line) for line in lines]
    except (OSError, msgspec.DecodeError) as error:
        raise InputError("--beside", f"{folder} holds no run that can be read: {error}") from None
