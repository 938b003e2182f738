"""`moonteam train ... --dry-run`: what would be trained, from its numbers alone.

Nothing is compiled, drawn or written; shapes come from `jax.eval_shape`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from moonteam import files

if TYPE_CHECKING:
    from training.guide.recipe import Guiding
    from training.mappo.macro.config import MacroConfig, Practice
    from training.teacher.imitation import Imitation
    from training.teacher.refinement import Refinement

LEFT = ("config.json", "metrics.jsonl", "checkpoints/", "policy.safetensors", "curve.png",
        "report.json")
"""What a run leaves in its folder, in the order in which it comes."""


def show(document: dict[str, Any], text: str, out: Path, json: bool) -> int:
    """Prints a dry run, the folder and the files of the run among it; returns the exit code."""
    if json:
        print(files.dump_json(document | {"out": str(out), "files": list(LEFT)}, 2))
    else:
        print(text.rstrip("\n"), f"run folder: {out}", f"files: {', '.join(LEFT)}", sep="\n")
    return 0


def macro(config: MacroConfig, source: str) -> tuple[dict[str, Any], str]:
    """Of MAPPO on macro-decisions: the document and the text.

    Args:
      config: the run's numbers.
      source: the policy that it would go on from; empty for fresh weights.
    """
    from moonteam.policies import pointer

    families = []
    for one in config.families:
        families.append({"family": one.name, "advantages": one.advantages, "maps": one.grounds,
                         **_round(config, one)})
    document = _document("MAPPO on macro-decisions", config, source, families,
                         _count(lambda key: pointer.init(config.spec, key)),
                         env_steps=config.rounds * config.decisions)
    by = {"vine": "by branches", "critic": "by the critic", "tries": "by whole tries"}
    rows = [f"  {row['family']}: {row['decisions']:,} decisions a round, of {row['episodes']:,} x "
            f"{row['num_steps']} played, {by[row['advantages']]}, {row['gradient_steps']} gradient "
            "steps" for row in families]
    return document, "\n".join([
        *_head(f"moonteam train {config.macro}", document),
        f"decisions: {document['env_steps']:,} in {config.rounds:,} rounds, "
        f"{config.decisions:,} a round", *rows,
        f"learner: lr {config.lr:g} falling to a twentieth, tau {config.vine.tau:g}, "
        f"{config.vine.options} options a branch, entropy {config.ent_coef:g}, {config.precision}",
        f"looked at: every {config.chunk_rounds * config.eval_every} rounds, "
        f"{config.eval_scenarios} held-out problems a family"])


def _round(config: MacroConfig, family: Practice) -> dict[str, int]:
    """What a round plays and learns of a family."""
    if family.advantages == "critic":
        rule, episodes, steps = config.hyper, config.envs(family), config.hyper.num_steps
    else:
        rule = config.grown(family) if family.advantages == "vine" else config.tried(family)
        episodes, steps = rule.episodes, rule.num_steps
    return {"decisions": config.moments(family), "episodes": episodes, "num_steps": steps,
            "gradient_steps": rule.epochs * rule.minibatches}


def taught(title: str, config: Imitation | Refinement, source: str, lead: str
           ) -> tuple[dict[str, Any], str]:
    """Of imitation and refinement: the document and the text.

    Args:
      title: the command's words.
      config: the run's numbers.
      source: the policy that it would go on from; empty for fresh weights.
      lead: how the learner learns.
    """
    from moonteam.policies import entity

    steps = getattr(config, "steps_between", 1)
    states = [config.num_envs // f.shrink * getattr(config, "num_steps", 1)
              for f in config.families]
    families = [{
        "family": f"{f.num_agents} robots, {f.num_targets} targets"
        + (", blocked" if f.grounds else ""),
        "maps": f.grounds, "environments": config.num_envs // f.shrink, "labelled": count,
        "env_steps": count * steps} for f, count in zip(config.families, states, strict=True)]
    document = _document(title, config, source, families,
                         _count(lambda key: entity.init(config.spec, key)),
                         labelled=config.rounds * sum(states),
                         env_steps=config.rounds * sum(states) * steps)
    rows = [f"  {row['family']}: {row['labelled']:,} labelled states and {row['env_steps']:,} env "
            f"steps a round, {row['environments']} environments" for row in families]
    return document, "\n".join([
        *_head(title, document),
        f"decisions: {document['env_steps']:,} env steps and {document['labelled']:,} labelled "
        f"states in {config.rounds:,} rounds", *rows, f"learner: lr {config.lr:g}, {lead}"])


def guiding(config: Guiding) -> tuple[dict[str, Any], str]:
    """Of an evolution of guides: the document and the text."""
    from moonteam.planners.search.guides import PLAIN

    sizes = [dataclasses.asdict(p) | {"practice": p.name} for p in config.practices]
    searches = config.population * sum(p.problems for p in config.practices)
    document = {"method": "separable CMA-ES", "config": dataclasses.asdict(config), "source": "",
                "parameters": len(PLAIN), "practices": sizes, "env_steps": config.rounds * searches}
    rows = [f"  {size['practice']}: {size['problems']} problems a generation, weight "
            f"{size['weight']:g}" for size in sizes]
    return document, "\n".join([
        *_head("moonteam train guide", document),
        f"searches: {document['env_steps']:,} in {config.rounds:,} generations of "
        f"{config.population} candidates, {searches:,} a generation", *rows,
        f"looked at: {config.held_out} held-out problems a size, an eighth of the large"])


def _document(method: str, config: Any, source: str, families: Sequence[dict[str, Any]],
              parameters: int, **totals: int) -> dict[str, Any]:
    return {"method": method, "config": dataclasses.asdict(config), "source": source,
            "parameters": parameters, "families": list(families), **totals}


def _head(title: str, document: dict[str, Any]) -> list[str]:
    begun = f"goes on from {document['source']}" if document["source"] else "from fresh weights"
    return [f"{title}: {document['parameters']:,} parameters, {begun}, seed "
            f"{document['config']['seed']}"]


def _count(init: Callable[[Any], Any]) -> int:
    """Parameters, by their shapes alone."""
    import jax

    tree = jax.eval_shape(lambda: init(jax.random.key(0)))
    return sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(tree))
