"""MAPPO on macro-decisions, as something that a run trains; see `training.run`."""

from __future__ import annotations

import dataclasses
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from moonteam.compilation import cores
from moonteam.policies import pointer
from moonteam.policies.brain import PointerBrain
from moonteam.policies.policy import Policy
from moonteam.policies.policy_file import PolicyFile
from moonteam.report.progress import say
from training.mappo.macro import grounds, tries, vine
from training.mappo.macro.config import MacroConfig, Practice
from training.mappo.macro.curve import draw_curve
from training.mappo.macro.held_out import HeldOut
from training.mappo.macro.learner import Learner
from training.mappo.macro.update import Report, Walk, fresh, update
from training.run.families import mean
from training.run.trainee import Made, Position, Row
from training.sharding import everywhere, gather, mesh_for, spread

PHASE = "macro"
PRECISION = {"float32": "float32", "tf32": "tensorfloat32", "bfloat16": "bfloat16"}
"""Of matrix products, as JAX calls them; where a device cannot, it takes a better one."""


class Held(NamedTuple):
    """All that a resumed run needs; what is drawn descends from seed and round."""

    learner: Learner
    walks: list[Walk | None]  # of those whose advantages are the critic's


class MacroMappo:
    """A run in progress; `learner.mean` is the policy. A `training.run.trainee.Trainee`."""

    unit = "round"

    def __init__(self, config: MacroConfig, params: Any = None, source: str = ""):
        """Makes grounds and environments from the config's seed, parameters too if not given."""
        self.config, self.name, self.seed, self.source = config, config.macro, config.seed, source
        self._programs: dict[int, jax.stages.Compiled] = {}  # by family, once `enter` was called
        parts = config.hyper.minibatches
        met = [f for f in config.families if f.advantages == "critic"]
        grown = [config.grown(f) for f in config.families if f.advantages == "vine"]
        tried = [config.tried(f) for f in config.families if f.advantages == "tries"]
        self.mesh = mesh_for([config.envs(f) for f in met]
                             + [config.rows(f) // parts for f in met]
                             + [v.moments // v.minibatches for v in grown]
                             + [v.episodes for v in grown]
                             + [t.problems for t in tried])
        key = jax.random.key(config.seed)
        keys = jax.random.split(key, len(config.families) + 1)
        params = pointer.init(config.spec, keys[0]) if params is None else params
        self.learner = everywhere(self.mesh, Learner.begin(params, config.hyper))
        self.grounds = [everywhere(self.mesh, grounds.make(f.draw, f.grounds, config.seed + i))
                        if f.grounds else None for i, f in enumerate(config.families)]
        self.walks = [
            spread(self.mesh, jax.jit(partial(fresh, f.draw, config.hyper, count=config.envs(f)))(
                ground, k)) if f.advantages == "critic" else None
            for f, ground, k in zip(config.families, self.grounds, keys[1:], strict=True)]

    @property
    def recipe(self) -> dict[str, Any]:
        """All numbers of the run."""
        numbers = {"method": "MAPPO on macro-decisions", **dataclasses.asdict(self.config)}
        return numbers | ({"source": self.source} if self.source else {})

    @property
    def network(self) -> dict[str, Any]:
        """Size of the network."""
        return dataclasses.asdict(self.config.spec)

    @property
    def phases(self) -> tuple[tuple[str, int], ...]:
        """One."""
        return ((PHASE, self.config.rounds),)

    @property
    def env_steps(self) -> int:
        """Decisions of the whole run."""
        return self.config.rounds * self.config.decisions

    def enter(self, phase: str) -> None:
        """Compiles the families' programs, if they are not yet; there is no other phase."""
        if self._programs:
            return
        families, running = self.config.families, {}
        # Of several processes, all have to come to each program in the same order.
        together = 1 if jax.process_count() > 1 else min(cores(), len(families))
        say(f"moonteam: compiling {len(families)} programs, {together} at once")
        pool = ThreadPoolExecutor(together)
        try:
            # Tracing holds Python, so it is done here, one after the other; XLA lets go of it.
            for i in range(len(families)):
                running[pool.submit(self._traced(i).compile)] = i
            for done, program in enumerate(as_completed(running), 1):
                i = running[program]
                self._programs[i] = program.result()
                say(f"moonteam: compiled {done} of {len(families)}, {families[i].name}")
        finally:  # an interruption waits for none of them
            pool.shutdown(wait=False, cancel_futures=True)

    def _traced(self, i: int) -> jax.stages.Lowered:
        """The update on a family, which is the config's number i, before XLA compiles it."""
        config, (function, fixed) = self.config, self._update(i)
        given = self._given(i, self._key(0, i), np.float32(config.lr), np.float32(config.ent_coef))
        with jax.default_matmul_precision(PRECISION[config.precision]):
            return function.lower(*fixed, *given)

    def _update(self, i: int) -> tuple[Any, tuple[Any, ...]]:
        """The update on the config's family number i, and its arguments that are static."""
        config, family = self.config, self.config.families[i]
        fixed = self.mesh, config.spec, family.draw, config.hyper
        if family.advantages == "critic":
            return update, fixed
        if family.advantages == "vine":
            return vine.improve, (*fixed, config.grown(family))
        return tries.improve, (*fixed, config.tried(family))

    def _given(self, i: int, key: Array, lr: np.float32, entropy: np.float32) -> tuple[Any, ...]:
        """Its other arguments."""
        walk = self.walks[i]
        own = (key, lr) if walk is None else (walk, key, lr, entropy)
        return self.grounds[i], self.learner, *own

    def _key(self, number: int, i: int) -> Array:
        """Of round `number` on the config's family number i."""
        return jax.random.fold_in(jax.random.key(self.config.seed + 1_000_003),
                                  number * len(self.config.families) + i)

    def chunk(self, at: Position) -> Made:
        """`chunk_rounds`, or what is left; each family in turn in every round."""
        config = self.config
        count = min(config.chunk_rounds, config.rounds - at.update)
        reports = []
        for number in range(at.update, at.update + count):
            share = number / config.rounds
            lr = np.float32(config.lr * (1.0 - 0.95 * share))
            entropy = np.float32(config.ent_coef * max(0.0, 1.0 - 1.2 * share))
            for i, family in enumerate(config.families):
                key = self._key(number, i)
                with jax.default_matmul_precision(PRECISION[config.precision]):
                    reports.append(self.practise(i, family, key, lr, entropy))
        return Made(count, count * config.decisions, _summary(gather(reports)))

    def practise(self, i: int, family: Practice, key: Array, lr: np.float32,
                 entropy: np.float32) -> Report | vine.Grown | tries.Compared:
        """One update on a family, which is the config's number i."""
        function, fixed = self._update(i)
        # Before `enter`, as on the bench, nothing is compiled.
        run = self._programs.get(i) or partial(function, *fixed)
        self.learner, *walk, report = run(*self._given(i, key, lr, entropy))
        if walk:
            self.walks[i] = walk[0]
        return report

    @cached_property
    def scenarios(self) -> list[HeldOut]:
        """Of each family, with their optima."""
        return [HeldOut(f, max(32, self.config.eval_scenarios // f.shrink))
                for f in self.config.families]

    def held_out(self, at: Position) -> dict[str, Any]:
        """Success and gap of each family; before the first round too, and after the last."""
        config = self.config
        due = at.update // config.chunk_rounds % config.eval_every == 0
        if not due and at.update < config.rounds:
            return {}
        return {"families": self.evaluate()}

    def evaluate(self) -> list[dict[str, Any]]:
        """Argmax on the held-out problems of each family."""
        stored = self._stored("")
        policy = Policy(PointerBrain(self.config.spec), jax.tree.map(jnp.asarray, stored.params),
                        stored, self.name)
        return [one.score(policy) for one in self.scenarios]

    def _stored(self, commit: str) -> PolicyFile:
        return PolicyFile("pointer", self.network, gather(self.learner.mean), self.recipe, commit)

    def weights(self) -> Any:
        """The parameters and their running mean."""
        return self.learner.params, self.learner.mean

    def state(self) -> Held:
        """Learner and environments."""
        return Held(self.learner, self.walks)

    def shapes(self, phase: str) -> Held:
        """They are always the same."""
        return self.state()

    def restore(self, phase: str, state: Held) -> None:
        """Spreads it over the devices."""
        self.learner = everywhere(self.mesh, Learner(*state.learner))
        self.walks = [None if walk is None else spread(self.mesh, Walk(*walk))
                      for walk in state.walks]

    def score(self, row: Row) -> float | None:
        """Mean success over the families, less the mean gap: both count."""
        if "families" not in row:
            return None
        return mean(row, "success") - mean(row, "makespan_gap")

    def fallen(self, rows: list[Row]) -> str:
        """When success on the held-out problems has fallen to half of what it was."""
        found = [mean(row, "success") for row in rows if "families" in row]
        if len(found) < 3 or max(found[-3:]) > max(found) / 2:
            return ""
        return f"it solves {found[-1]:.3f} of the held-out problems, and solved {max(found):.3f}"

    def words(self, rows: list[Row]) -> str:
        """Where it is, and how it did when last looked at."""
        row, look = rows[-1], next(r for r in reversed(rows) if "families" in r)
        return (f"round {row['update']:,} of {self.config.rounds:,}, {row['rate']:,.0f} moments/s"
                f", entropy {row['entropy']:.2f}, critic error {row['value_loss']:.3f}\n"
                f"held out {mean(look, 'success'):.3f} success, {mean(look, 'makespan_gap'):.1%} "
                "over the optimum")

    def policy(self, at: Position, commit: str) -> PolicyFile:
        """The running mean with network, recipe and commit in the header."""
        return self._stored(commit)

    def report(self, rows: list[Row]) -> dict[str, Any]:
        """The last evaluation."""
        return {"method": "MAPPO on macro-decisions",
                "scenarios": self.config.eval_scenarios, "families": rows[-1]["families"]}

    def lines(self, report: dict[str, Any]) -> list[str]:
        """A line a family."""
        return [*(f"{row['family']}: success {row['success']:.3f}, " + (
                      f"{row['worth_served']:.1%} of the worth served, hindsight "
                      f"{row['makespan_gap']:.1%} more" if "worth_served" in row else
                      f"makespan {row['makespan_gap']:.1%} over the optimum")
                  for row in report["families"]),
                f"{report['env_steps']:,} moments in {report['seconds']:.0f} s"]

    def draw_curve(self, path: Path, rows: list[Row]) -> None:
        """Success and gap over minutes."""
        draw_curve(path, {self.name: [rows]})


def _summary(reports: list[Report | vine.Grown | tries.Compared]) -> dict[str, float]:
    """Means over a chunk's updates, each figure over those that have it.

    What is known of episodes or branches is weighed by how many there were.
    """
    def figure(name: str) -> float:
        own = [report for report in reports if name in report._fields]
        weights = ([max(float(report.episodes), 1.0) for report in own]
                   if name in ("success", "episode_seconds") else None)
        return float(np.average([getattr(report, name) for report in own], weights=weights))

    names = {name for report in reports for name in report._fields} - {"episodes"}
    return {name: figure(name) for name in sorted(names)}
