"""`moonteam replay`: the grid environment's own trace of a given list of actions."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from moonteam import compilation, files
from moonteam.commands.options import Printed, Saved
from moonteam.errors import InputError, meant
from moonteam.problem import scenario
from moonteam.problem.scenario import ACTIONS, Scenario
from moonteam.strict import json_value

FILES = ("replay.json",)
"""In --out."""
TEN = 10
"""Targets whose marks stand together."""


@dataclass(frozen=True)
class Args(Saved, Printed):
    """Trace a list of actions through the grid: positions, solved, rewards, observations.

    ACTIONS is a JSON list of steps, each a list of one action an agent, by name (up, down,
    left, right, stay) or number (0 to 4); or the document of `moonteam plan --json`.

    Entry 0 of the trace is the reset. Reward terms are unweighted, with the sign they carry
    into the sum; `total` is the sum with the weights of --phase. The whole list is traced,
    also past the step that solves the last target.

    File in --out: replay.json.

    Examples:
      moonteam replay scenario.json actions.json
      moonteam replay scenario.json actions.json --phase bootstrap --preset pi_7t --json
      moonteam plan scenario.json --json | moonteam replay scenario.json - --json
    """

    scenario: tyro.conf.Positional[Path]
    """Scenario file (.json), or a set (.jsonl) with --id."""
    actions: tyro.conf.Positional[str]
    """JSON file of actions; - reads standard input."""
    phase: Literal["bootstrap", "refinement"] = "refinement"
    """Which of the paper's two training phases weighs the reward terms."""
    preset: str = "pi_5t"
    """Whose weights and C_AR: pi_5t, pi_6t, pi_7t or pi_5t5r."""
    raw: bool = False
    """Observe positions in cells instead of divided by (size - 1)."""
    literal: bool = False
    """Step cost of -1 a move instead of -1/T_max."""
    buffer: int = 0
    """The last so many targets of the scenario appear only when others are solved."""
    id: Annotated[str, tyro.conf.arg(metavar="ID")] = ""
    """Which scenario of a set of several."""


def choose(path: Path, name: str) -> Scenario:
    """The scenario of a file, or the named one of a set. Raises InputError."""
    found = scenario.load_set(path) if path.suffix == ".jsonl" else [scenario.load(path)]
    if name:
        same = [s for s in found if s.id == name]
        if not same:
            near = meant(name, [s.id for s in found]).rstrip()
            near = near and f"; {near}"
            raise InputError(path, f"holds no scenario with the id {name!r}{near}")
        found = same
    if len(found) > 1:
        raise InputError(path, f"holds {len(found)} scenarios; choose one with --id")
    return found[0]


def read_actions(source: str, num_agents: int, max_steps: int) -> list[list[int]]:
    """The joint actions of a file or of standard input, as numbers [T][N]. Raises InputError."""
    label = "standard input" if source == "-" else source
    text = sys.stdin.read() if source == "-" else files.read_text(source)
    value = json_value(text, label)
    if isinstance(value, dict):
        if "actions" not in value:
            raise InputError(label, 'an object needs the key "actions"')
        value = value["actions"]
    if not isinstance(value, list):
        raise InputError(label, "a list of steps is needed, each a list of actions")
    if len(value) > max_steps:
        raise InputError(label, f"{len(value)} steps; the scenario ends after {max_steps}")
    steps = []
    for t, row in enumerate(value):
        if not isinstance(row, list) or len(row) != num_agents:
            got = f"{len(row)} actions" if isinstance(row, list) else "no list"
            raise InputError(label, f"{got} for {num_agents} agents", f"[{t}]")
        steps.append([_number(action, label, f"[{t}][{i}]") for i, action in enumerate(row)])
    return steps


def _number(action: Any, label: str, key: str) -> int:
    if isinstance(action, str) and action in ACTIONS:
        return ACTIONS.index(action)
    if isinstance(action, int) and not isinstance(action, bool) and 0 <= action < len(ACTIONS):
        return action
    near = meant(action, ACTIONS) if isinstance(action, str) else ""
    raise InputError(label, f"{json.dumps(action)} is no action; {near}one of {', '.join(ACTIONS)} "
                     f"or 0 to {len(ACTIONS) - 1}", key)


def trace(problem: Scenario, actions: list[list[int]], args: Args) -> dict[str, Any]:
    """The document that `--json` prints. Raises InputError for a wrong preset or buffer."""
    compilation.enable_cache()
    import jax
    import jax.numpy as jnp

    from moonteam import grid

    arrays, cells = grid.to_problem(problem, args.buffer)
    config = grid.preset(args.preset).apply(grid.config_for(problem, num_buffer=args.buffer),
                                            args.phase)
    config = replace(config, normalize_positions=not args.raw, literal_step_cost=args.literal)
    state, observation = jax.jit(grid.reset_to, static_argnums=0)(config, arrays, cells)
    step = jax.jit(grid.step, static_argnums=0)

    def entry(state: Any, observation: Any) -> dict[str, Any]:
        return {"positions": state.cells.tolist(), "solved": state.solved.tolist(),
                "observations": observation.tolist()}

    steps = [entry(state, observation)]
    done = bool(state.solved.all())
    makespan, true_moves = 0 if done else None, 0
    for t, joint in enumerate(actions, 1):
        result = step(config, state, jnp.array(joint, jnp.int32))
        state = result.state
        if makespan is None and bool(result.terminated):
            makespan = t
        true_moves += int(result.true_moves.sum())
        # Adding zero turns the -0.0 of a cost that did not arise into 0.0.
        terms = {name: (getattr(result.rewards, name) + 0.0).tolist() for name in grid.TERMS}
        steps.append({"actions": [ACTIONS[a] for a in joint], **entry(state, result.observation),
                      "rewards": terms, "total": (result.reward + 0.0).tolist()})
    moves = sum(ACTIONS[a] != "stay" for joint in actions for a in joint)
    return {"steps": steps, "makespan": makespan, "moves": moves, "true_moves": true_moves}


def show(document: dict[str, Any]) -> None:
    """A table on standard output: one line a step, or, where that is too wide, an agent."""
    from rich.console import Console

    from moonteam.report.tables import show_rows

    rows = []
    for t, row in enumerate(document["steps"]):
        marks = "".join("x" if solved else "." for solved in row["solved"])
        rows.append([str(t), row.get("actions", []), [f"({x},{y})" for x, y in row["positions"]],
                     [marks[k:k + TEN] for k in range(0, len(marks), TEN)],
                     [f"{total:+.4f}" for total in row.get("total", [])]])
    console = Console()
    show_rows(console, ["step", "actions", "positions", "solved", "total reward"], rows, "replay")
    makespan = document["makespan"]
    ended = f"all solved at step {makespan}" if makespan is not None else "not all solved"
    console.print(f"{ended}; {document['moves']} moves, {document['true_moves']} of them changed "
                  "a cell")


def run(args: Args) -> int:
    """Prints the trace; 0 whether or not it solves the targets."""
    problem = choose(args.scenario, args.id)
    document = trace(problem, read_actions(args.actions, len(problem.agents), problem.max_steps),
                     args)
    if args.out is not None:
        files.write_json(args.out / "replay.json", document, indent=0)
    if args.json:
        print(files.dump_json(document))
    else:
        show(document)
    return 0
