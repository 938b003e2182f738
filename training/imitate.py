"""A whole imitation run in one folder, resumable: what `moonteam train quick|any_team` does.

`config.json`, `metrics.jsonl`, `checkpoints/state.npz` (everything a resumed run needs, the
labelled states included) and, at the end, `policy.safetensors`, `report.json`, `curve.png`.
"""

from __future__ import annotations

import dataclasses
import inspect
import sys
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple
from zipfile import BadZipFile

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
import tyro
from jax import Array

from moonteam import files
from moonteam.errors import InputError
from moonteam.evaluation.progress import say, track
from moonteam.grid import env
from moonteam.planners.batch import solve_batch
from moonteam.policies.checkpoint import PolicyFile, save_policy
from moonteam.policies.entity import EntitySpec, decide
from training.held_out import HELD_OUT_SEED
from training.imitation import (
    Dagger,
    Family,
    Ground,
    Imitation,
    Sample,
    Walk,
    begin,
    make_ground,
    on_ground,
    spread_walk,
    views,
)
from training.loop import Stop, commit, describe_device, stop_on_signals
from training.sharding import everywhere, use_all_cores

CHECKPOINT_SECONDS = 60.0
SCENARIOS = 256
EVAL_EVERY = 100

PAPER = (Family(3, 5), Family(3, 6), Family(3, 7))

PRESETS = {
    "quick": Imitation(families=PAPER, rounds=500, num_envs=256, batches=2),
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
class Args:
    """Train the policy for any team by imitating the exact planner: quick or any_team.

    Examples:
      moonteam train quick
      moonteam train quick --seed 1 --out runs/quick-1
      moonteam train any_team --out runs/any --resume
    """

    preset: tyro.conf.Positional[Literal["quick", "any_team"]]
    """quick: 3 robots, 5 to 7 targets, 32 x 32; any_team: teams, maps and ground of all sizes."""
    seed: int = 0
    """Seed of everything random in the run."""
    rounds: int | None = None
    """Rounds of visiting, labelling and learning; the preset's number if not given."""
    out: Path | None = None
    """Run folder; runs/PRESET-SEED if not given."""
    resume: bool = False
    """Go on with the run in the folder."""
    json: bool = False
    """Print the report as one JSON document and nothing else."""


def parse(words: list[str]) -> Args:
    """Arguments of `moonteam train quick|any_team`."""
    return tyro.cli(Args, prog="moonteam train", args=words, description=inspect.getdoc(Args),
                    config=(tyro.conf.FlagCreatePairsOff,))


def run(args: Args) -> int:
    """Trains; returns the exit code."""
    rounds = PRESETS[args.preset].rounds if args.rounds is None else args.rounds
    if rounds < 1:
        raise InputError("--rounds", f"{rounds} is not allowed; at least 1")
    config = dataclasses.replace(PRESETS[args.preset], seed=args.seed, rounds=rounds)
    out = args.out or Path("runs") / f"{args.preset}-{args.seed}"
    use_all_cores()
    say("moonteam: making grounds and held-out scenarios, compiling")
    work = Run(args.preset, config, out, args.resume)
    with stop_on_signals() as stop:
        finished = work.train(stop)
    if not finished:
        print(f"moonteam: interrupted after round {work.dagger.number}, saved; go on with "
              f"--out {out} --resume", file=sys.stderr)
        return 130
    report = work.finish()
    if args.json:
        print(files.dump_json(report | {"out": str(out)}))
        return 0
    for row in report["families"]:
        print(f"{row['family']}: success {row['success']:.3f}, makespan gap "
              f"{row['makespan_gap']:.1%}, moves gap {row['moves_gap']:.1%}")
    print(f"{report['labelled']:,} labelled states in {report['seconds']:.0f} s; policy, curve "
          f"and report in {out}")
    return 0


class Score(NamedTuple):
    """Over held-out scenarios of one family; failures count with the horizon and their moves."""

    success: float
    makespan: float
    moves: float
    best_makespan: float
    best_moves: float


class _Play(NamedTuple):
    walk: Walk
    over: Array
    steps: Array
    moves: Array


@partial(jax.jit, static_argnums=(0, 1))
def play(spec: EntitySpec, family: Family, preference: Array | np.float32, params: Any,
         ground: Ground | None, walk: Walk) -> tuple[Array, Array, Array]:
    """Argmax to the end: solved [E], steps [E], moves [E]."""
    wish = jnp.full_like(walk.preference, preference)

    def step(play: _Play, _: None) -> tuple[_Play, None]:
        walk = play.walk
        view = views(family, ground, walk.states, walk.place, wish)
        actions = jnp.argmax(decide(params, spec, view).log_probs, axis=-1)
        actions = jnp.where(play.over[:, None], env.STAY, actions)
        whole = on_ground(ground, walk.states, walk.place)
        after = jax.vmap(lambda s, a: env.step(family.config, s, a))(whole, actions).state
        bare = dataclasses.replace(
            after, problem=dataclasses.replace(after.problem, passable=None))
        solved = jnp.all(after.solved, axis=-1)
        return _Play(walk._replace(states=bare), solved, play.steps + ~play.over,
                     play.moves + jnp.sum(actions != env.STAY, axis=-1)), None

    none = jnp.zeros(walk.place.shape, jnp.int32)
    over = jnp.all(walk.states.solved, axis=-1)
    end = jax.lax.scan(step, _Play(walk, over, none, none), None, family.max_steps)[0]
    return end.over, end.steps, end.moves


class HeldOut:
    """Scenarios of one family that training never draws, with their optima."""

    def __init__(self, family: Family, count: int):
        """Solves each once for makespan and once for moves (large ones nearly)."""
        self.family = family
        self.ground = make_ground(dataclasses.replace(family, grounds=min(family.grounds, count)),
                                  HELD_OUT_SEED)
        self.walk = begin(family, self.ground, jax.random.key(HELD_OUT_SEED), count)
        states, place = jax.device_get((self.walk.states, self.walk.place))
        problem = states.problem
        given = {"agent_kinds": problem.agent_kinds,
                 "passable": np.asarray(self.ground.passable)[place]} if self.ground else {}

        def optimum(objective: Any) -> Any:
            return solve_batch(
                states.cells, problem.agent_skills, problem.target_cells, problem.target_skills,
                problem.target_and, solved=states.solved, agent_mask=problem.agent_mask,
                steps_left=1024, objective=objective, exact_to=self.family.exact_to,
                iterations=10 * self.family.iterations, **given)

        self.best_makespan = float(optimum("makespan").makespan.mean())
        self.best_moves = float(optimum("moves").moves.mean())

    def score(self, spec: EntitySpec, params: Any, preference: float) -> Score:
        """How the policy does by argmax, without a deadlock watch."""
        solved, steps, moves = jax.device_get(
            play(spec, self.family, np.float32(preference), params, self.ground, self.walk))
        return Score(float(solved.mean()), float(steps.mean()), float(moves.mean()),
                     self.best_makespan, self.best_moves)


class Run:
    """One imitation run in one folder."""

    def __init__(self, name: str, config: Imitation, out: Path, resume: bool):
        """Raises InputError if the folder holds a run that this one may not go on with."""
        self.name, self.config, self.out = name, config, out
        self.state_file = out / "checkpoints" / "state.npz"
        plain = msgspec.json.decode(files.dump_json(dataclasses.asdict(config)))
        stored = out / "config.json"
        if stored.exists():
            if not resume:
                raise InputError(out, "already holds a run; --resume goes on with it, or choose "
                                 "another --out")
            if msgspec.json.decode(stored.read_bytes()) != plain:
                raise InputError(stored, "was started with other numbers; a resumed run must keep "
                                 "them")
        files.write_json(stored, plain)
        self.seconds = 0.0
        self.rows: list[dict[str, Any]] = []
        self.dagger = Dagger(config)
        if resume and self.state_file.exists():
            self._load()
        self.held_out = [HeldOut(f, SCENARIOS // f.shrink) for f in config.families]

    def train(self, stop: Stop) -> bool:
        """Runs to the end or until asked to stop; True when it reached the end."""
        dagger, saved = self.dagger, time.monotonic()
        for _ in track(range(dagger.number, self.config.rounds), self.name,
                       self.config.rounds - dagger.number):
            if stop.asked:
                break
            begun = time.monotonic()
            report = dagger.round()
            self.seconds += time.monotonic() - begun
            if dagger.number % EVAL_EVERY == 0 or dagger.done:
                self._record(report.loss)
            if time.monotonic() - saved > CHECKPOINT_SECONDS:
                self.save()
                saved = time.monotonic()
        self.save()
        return dagger.done

    def _record(self, loss: float) -> None:
        row = {"round": self.dagger.number, "seconds": self.seconds, "loss": loss,
               "labelled": self.dagger.number * self.config.num_envs * len(self.config.families),
               "families": [family_row(f, h, self.config.spec, self.dagger.learner.mean)
                            for f, h in zip(self.config.families, self.held_out, strict=True)]}
        self.rows.append(row)
        files.write_text(self.out / "metrics.jsonl",
                         "".join(files.dump_json(r) + "\n" for r in self.rows))

    def save(self) -> None:
        """Everything a resumed run needs, whole or not at all."""
        arrays = {f"leaf{i}": leaf for i, leaf in enumerate(_leaves(self.dagger))}
        about = {"number": self.dagger.number, "seconds": self.seconds, "rows": self.rows,
                 "counts": [m.count for m in self.dagger.memories]}
        with files.replacing(self.state_file) as temporary, temporary.open("wb") as out:
            arrays["about"] = np.frombuffer(files.dump_json(about).encode(), np.uint8)
            np.savez(out, allow_pickle=False, **arrays)

    def _load(self) -> None:
        dagger = self.dagger
        try:
            with self.state_file.open("rb") as raw, np.load(raw) as stored:
                about = msgspec.json.decode(stored["about"].tobytes())
                arrays = [stored[f"leaf{i}"] for i in range(len(stored.files) - 1)]
        except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
            raise InputError(self.state_file, f"is torn ({error}); delete it to start again"
                             ) from None
        dagger.number, self.seconds, self.rows = about["number"], about["seconds"], about["rows"]
        _restore(dagger, arrays, about["counts"])

    def finish(self) -> dict[str, Any]:
        """Writes policy, curve and report of a run that reached its end; returns the report."""
        recipe = {"preset": self.name, "method": "imitation (DAgger)",
                  **msgspec.json.decode(files.dump_json(dataclasses.asdict(self.config)))}
        params = jax.device_get(self.dagger.learner.mean)
        save_policy(self.out / "policy.safetensors",
                    PolicyFile("entity", dataclasses.asdict(self.config.spec), params, recipe,
                               commit()))
        report = {"preset": self.name, "seed": self.config.seed, "seconds": self.seconds,
                  "device": describe_device(), "commit": commit(), **self.rows[-1]}
        files.write_json(self.out / "report.json", report)
        draw_curve(self.out / "curve.png", self.rows)
        return report


def family_row(family: Family, held_out: HeldOut, spec: EntitySpec, params: Any) -> dict[str, Any]:
    """Success and gaps of one family at both ends of the preference."""
    quick = held_out.score(spec, params, 0.0)
    thrifty = held_out.score(spec, params, 1.0)
    ground = ", blocked ground" if family.grounds else ""
    return {"family": f"{family.num_agents} robots, {family.num_targets} targets{ground}",
            "success": quick.success, "makespan_gap": quick.makespan / quick.best_makespan - 1,
            "success_effort": thrifty.success, "moves_gap": thrifty.moves / thrifty.best_moves - 1}


def _leaves(dagger: Dagger) -> list[np.ndarray]:
    """Learner, environments and memories as host arrays, keys as their raw words."""
    walks = [w._replace(key=jax.random.key_data(w.key)) for w in dagger.walks]
    tree = (dagger.learner, walks, [m.rows for m in dagger.memories])
    return [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]


def _restore(dagger: Dagger, arrays: list[np.ndarray], counts: list[int]) -> None:
    """Puts the leaves back; memories take the shapes of what they hold."""
    walks = [w._replace(key=jax.random.key_data(w.key)) for w in dagger.walks]
    fixed, shape = jax.tree.flatten((dagger.learner, walks))
    learner, walks = jax.tree.unflatten(shape, [jnp.asarray(a) for a in arrays[:len(fixed)]])
    dagger.learner = everywhere(learner)
    dagger.walks = [spread_walk(w._replace(key=jax.random.wrap_key_data(w.key))) for w in walks]
    rest = arrays[len(fixed):]
    for memory, walk, count in zip(dagger.memories, dagger.walks, counts, strict=True):
        sample = Sample(walk.states, walk.place, walk.preference, walk.place)
        like = jax.tree.structure(sample)
        size = like.num_leaves
        memory.rows, rest = jax.tree.unflatten(like, rest[:size]), rest[size:]
        memory.count = count


def draw_curve(path: Path, rows: list[dict[str, Any]]) -> None:
    """Failures and gaps of every family over labelled states."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 3)
    states = [row["labelled"] for row in rows]
    for i, first in enumerate(rows[0]["families"]):
        for axis, key in zip(axes, ("success", "makespan_gap", "moves_gap"), strict=True):
            axis.plot(states, [row["families"][i][key] for row in rows], label=first["family"])
    for axis, title in zip(axes, ("success, argmax, preference 0", "makespan gap, preference 0",
                                  "moves gap, preference 1"), strict=True):
        axis.set_title(title)
        axis.set_xlabel("labelled states")
    for axis in axes[1:]:
        axis.set_yscale("symlog", linthresh=0.01)
    axes[0].legend(fontsize=7)
    with files.replacing(path) as temporary:
        figure.savefig(temporary, dpi=120)
