"""MAPPO from scratch as something that a run trains: two phases, chunks of updates."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax

from moonteam.policies.policy_file import PolicyFile
from training.mappo import held_out, networks, update
from training.mappo.config import Config, Phase
from training.mappo.curve import draw_curve
from training.mappo.grid_task import GridTask
from training.mappo.networks import Networks, Pair
from training.mappo.update import Learner, Report
from training.run.metrics import best
from training.run.trainee import Made, Position, Row
from training.sharding import gather, mesh_for

FINAL_SCENARIOS = 500


class Mappo:
    """The learner of the phase that it is in; a `training.run.trainee.Trainee`."""

    unit = "update"

    def __init__(self, config: Config):
        self.config, self.name, self.seed = config, config.name, config.seed
        self.nets: Networks = networks.for_spec(config.spec, config.precision)
        self.mesh = mesh_for(p.num_envs // p.num_minibatches for _, p in config.phases)
        self.phase = ""
        self._optima: dict[int, float | None] = {}
        self.learner: Learner | None = None

    @property
    def recipe(self) -> dict[str, Any]:
        """All numbers of the run."""
        return dataclasses.asdict(self.config)

    @property
    def network(self) -> dict[str, Any]:
        """Shape of the networks."""
        return dataclasses.asdict(self.config.spec)

    @property
    def phases(self) -> tuple[tuple[str, int], ...]:
        """Those that have updates."""
        return tuple((name, phase.updates) for name, phase in self.config.phases)

    @property
    def env_steps(self) -> int:
        """Of both phases."""
        return sum(self.config.env_steps(phase) for _, phase in self.config.phases)

    def task(self, phase: Phase) -> GridTask:
        """The phase's grid world."""
        return GridTask(self.config.env(phase))

    def begin(self, name: str, params: Pair | None) -> Learner:
        """The first state of a phase."""
        phases = dict(self.config.phases)
        key = jax.random.fold_in(jax.random.key(self.config.seed), list(phases).index(name))
        phase = phases[name]
        return update.begin(self.nets, self.task(phase), self.config.hyper(phase),
                            phase.num_envs, key, params)

    def enter(self, phase: str) -> None:
        """Keeps the parameters; optimiser and environments are fresh."""
        if phase != self.phase:
            params = gather(self.learner.params) if self.learner is not None else None
            with networks.matmul_precision(self.config.precision):
                self.restore(phase, self.begin(phase, params))

    def chunk(self, at: Position) -> Made:
        """`chunk_updates`, or what is left of the phase."""
        config, phase = self.config, dict(self.config.phases)[at.phase]
        count = min(config.chunk_updates, phase.updates - at.update)
        assert self.learner is not None
        with networks.matmul_precision(config.precision):
            self.learner, report = update.chunk(self.nets, self.task(phase), config.hyper(phase),
                                                self.learner, count)
        return Made(count, count * phase.num_envs * config.num_steps, _summary(gather(report)))

    def held_out(self, at: Position) -> dict[str, Any]:
        """Every `eval_every` chunks and at the end of a phase."""
        config, phase = self.config, dict(self.config.phases)[at.phase]
        due = at.update // config.chunk_updates % config.eval_every == 0
        if at.update and (due or at.update >= phase.updates):
            return self.evaluate(phase, config.eval_scenarios)
        return {}

    def evaluate(self, phase: Phase, scenarios: int) -> dict[str, dict[str, float]]:
        """Held-out scores, argmax and sampled; with the gap to the optimum where it is known."""
        key = jax.random.key(held_out.HELD_OUT_SEED)
        actor, scores = gather(self.weights().actor), {}
        for decode in ("argmax", "sample"):
            with networks.matmul_precision(self.config.precision):
                score = held_out.score(self.nets, self.task(phase), actor, key, scenarios,
                                       decode == "sample")
            scores[decode] = {k: float(v) for k, v in score._asdict().items()}
            if (best := self._best(scenarios)) is not None:
                scores[decode]["makespan_gap"] = scores[decode]["makespan"] / best - 1.0
        return scores

    def _best(self, scenarios: int) -> float | None:
        """Mean optimum of so many held-out scenarios, which are the same in both phases."""
        if scenarios not in self._optima:
            key = jax.random.key(held_out.HELD_OUT_SEED)
            self._optima[scenarios] = held_out.optimum(
                self.task(self.config.phases[-1][1]), key, scenarios)
        return self._optima[scenarios]

    def weights(self) -> Pair:
        """Parameters of both networks."""
        return self.state().params

    def state(self) -> Learner:
        """Parameters, optimiser, environments, memory, key, update."""
        assert self.learner is not None
        return self.learner

    def shapes(self, phase: str) -> Learner:
        """Of the learner in that phase."""
        return jax.eval_shape(lambda: self.begin(phase, None))

    def restore(self, phase: str, state: Learner) -> None:
        """Spreads it over the devices."""
        self.phase, self.learner = phase, update.shared(self.mesh, state)

    def score(self, row: Row) -> float | None:
        """Success of sampled actions."""
        return row["sample"]["success"] if "sample" in row else None

    def fallen(self, rows: list[Row]) -> str:
        """See `held_out.collapsed`."""
        now = self.score(rows[-1])
        if now is None or not held_out.collapsed(rows, self.config.eval_scenarios):
            return ""
        top = best(rows, self.score)
        assert top is not None
        return (f"sampled actions solve {now:.3f} of the held-out scenarios, after update "
                f"{top['total_updates']} it was {self.score(top):.3f}")

    def words(self, rows: list[Row]) -> str:
        """Where it is, and how argmax did when last looked at."""
        row = rows[-1]
        score = next((r["argmax"] for r in reversed(rows) if "argmax" in r), None)
        scored = (f"held out {score['success']:.3f} success, {score['makespan']:.1f} makespan, "
                  f"{score['moves']:.1f} moves" if score else "held out: no evaluation yet")
        return (f"{row['phase']}, {row['env_steps']:,} env steps, {row['rate']:,.0f}/s\n{scored}")

    def policy(self, at: Position, commit: str) -> PolicyFile:
        """Parameters with network, recipe and commit in the header."""
        return PolicyFile("recurrent", self.network, gather(self.weights())._asdict(),
                          self.recipe | {"env_steps": at.env_steps}, commit)

    def report(self, rows: list[Row]) -> dict[str, Any]:
        """On more scenarios than while training."""
        last = self.config.phases[-1][1]
        return {"scenarios": FINAL_SCENARIOS, **self.evaluate(last, FINAL_SCENARIOS)}

    def lines(self, report: dict[str, Any]) -> list[str]:
        """A line for argmax, one for sampled actions."""
        scores = [(decode, report[decode]) for decode in ("argmax", "sample")]
        return [*(f"{decode}: success {score['success']:.3f}, makespan {score['makespan']:.2f}, "
                  f"moves {score['moves']:.2f} on {report['scenarios']} held-out scenarios"
                  for decode, score in scores),
                f"{report['env_steps']:,} env steps in {report['seconds']:.0f} s"]

    def draw_curve(self, path: Path, rows: list[Row]) -> None:
        """Success, makespan and moves over env steps."""
        draw_curve(path, {f"seed {self.seed}": [rows]})


def _summary(report: Report) -> dict[str, float]:
    """Means over a chunk's updates; episode figures over the episodes that ended in it."""
    tally = report.tally
    episodes = max(int(tally.episodes.sum()), 1)
    ended = {"success": tally.solved, "makespan": tally.steps, "moves": tally.moves}
    row = {key: float(value.sum()) / episodes for key, value in ended.items()}
    row |= {key: float(value.mean()) for key, value in report.actor._asdict().items()}
    return row | {"value_loss": float(report.value_loss.mean()),
                  "mean_reward": float(report.mean_reward.mean())}
