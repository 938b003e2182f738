"""How a pointing policy under training does on problems that training never draws.

Legend: E problems of a family, N agents, M targets.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array

from moonteam import trees
from moonteam.grid.macro import world
from moonteam.grid.macro.types import FAR, MacroProblem
from moonteam.planners.macro import rollouts, spec_of
from moonteam.planners.seconds.base import MS, NEVER, Moment
from moonteam.planners.seconds.exact import ExactPlanner
from moonteam.planners.seconds.leaving import EXACTLY, served
from moonteam.planners.seconds.local import LocalSearchPlanner
from moonteam.policies.pointer import PointerSpec, look
from moonteam.policies.policy import Policy
from training.mappo.held_out import HELD_OUT_SEED
from training.mappo.macro import grounds
from training.mappo.macro.config import Practice
from training.mappo.macro.hyper import Hyper
from training.mappo.macro.learner import say
from training.mappo.macro.update import fresh

EXACT_TO = 8
"""Targets up to which the optimum is certified; beyond, it is the best that search finds."""
MOVES = 20_000
"""Of that search."""


def moment_of(problem: MacroProblem) -> Moment:
    """One problem (host arrays) in whole milliseconds, as the planners by the clock take it."""
    agents, targets = problem.start.shape
    return Moment(
        start=_ms(problem.start), between=_ms(problem.between), home=_ms(problem.home),
        home_now=_ms(problem.home_now), classes=np.arange(agents), has=np.asarray(problem.has),
        need=np.asarray(problem.need, np.int64), either=np.asarray(problem.either),
        service=_ms(problem.service), after=np.asarray(problem.after),
        appears=_ms(problem.appears), lapses=_ms(problem.lapses), free=_ms(problem.free),
        present=np.asarray(problem.agent_mask),
        solved=~np.asarray(problem.target_mask) | np.asarray(problem.looks),
        ends=np.zeros(targets, np.int64), effort=np.asarray(problem.effort, np.float64),
        worth=np.asarray(problem.worth, np.float64) if np.any(problem.worth) else None)


def _ms(seconds: Any) -> npt.NDArray[np.int64]:
    times = np.asarray(seconds, np.float64)
    return np.where(times >= FAR / 2, NEVER, np.round(times * MS)).astype(np.int64)


class HeldOut:
    """Problems of one family, with their optima."""

    def __init__(self, family: Practice, count: int):
        """Draws them and plans each once, exactly or nearly."""
        self.family = family
        ground = grounds.make(family.draw, count, HELD_OUT_SEED) if family.grounds else None
        key = jax.random.key(HELD_OUT_SEED)
        walk = jax.jit(lambda k: fresh(family.draw, Hyper(), ground, k, count))(key)
        self.problems: MacroProblem = jax.device_get(walk.states.problem)
        each = [moment_of(jax.tree.map(lambda x, i=i: x[i], self.problems)) for i in range(count)]
        spans = [_best(one) for one in each]
        known = [span is not None for span in spans]  # all of them, but for closed-off ground
        self.problems = jax.tree.map(lambda x: x[np.array(known)], self.problems)
        self.best = np.array([span for span in spans if span is not None])

    def score(self, policy: Policy) -> dict[str, Any]:
        """Success and mean gap of the makespan by argmax; failures count with the limit.

        Where not everything is known from the start, over hindsight; where targets lapse, by how
        much more could have been served than was.
        """
        if self.family.draw.unfolds:
            solved, took, missed = jax.device_get(
                played(spec_of(policy), policy.source.params, self.problems))
            if self.family.draw.worth[1]:
                offered = self.problems.worth.sum(1)
                done = offered - missed
                return {"family": self.family.name, "success": float(solved.mean()),
                        "makespan_gap": float(self.best.mean() / done.mean() - 1.0),
                        "worth_served": float(done.sum() / offered.sum())}
        else:
            done = rollouts(policy, self.problems)
            solved, took = done.solved[:, 0], done.seconds[:, 0]
        seconds = np.where(solved, took, self.problems.limit)
        return {"family": self.family.name, "success": float(solved.mean()),
                "makespan_gap": float(seconds.mean() / self.best.mean() - 1.0)}


@partial(jax.jit, static_argnames="spec")
def played(spec: PointerSpec, params: Any, problems: MacroProblem) -> tuple[Array, Array, Array]:
    """Whether all was solved [E], s [E] and worth missed [E], by the likeliest choices, made anew
    at every event.
    """
    states = jax.vmap(world.reset)(problems)
    targets = states.solved.shape[1]
    wish = jnp.zeros(states.now.shape)

    def step(carry: tuple, _: Any) -> tuple[tuple, None]:
        states, solved, seconds, missed, over = carry
        logits = say(params, spec, Hyper(), jax.vmap(look)(states, wish)).logits
        choice, _ = jax.vmap(world.choose)(states, logits, jnp.zeros_like(logits))
        result = jax.vmap(world.step)(states, choice)
        after = jax.vmap(world.loosen)(result.state, jnp.ones(choice.shape, bool))
        seconds = jnp.where(over, seconds, seconds + result.seconds)
        missed = jnp.where(over, missed, missed + result.missed)
        solved = jnp.where(over, solved, result.terminated)
        ended = over | result.terminated | result.truncated
        return (trees.where(ended, states, after), solved, seconds, missed, ended), None

    none = jnp.zeros(states.now.shape, bool)
    (_, solved, seconds, missed, _), _ = jax.lax.scan(
        step, (states, none, states.now, states.now, none), None, 4 * targets)
    return solved, seconds, missed


def _best(moment: Moment) -> float | None:
    """s of the least makespan known, or the most worth that can be served; None: no plan."""
    few = int((~moment.solved).sum()) <= (EXACT_TO if moment.worth is None else EXACTLY)
    plan = (ExactPlanner() if few else LocalSearchPlanner(iterations=MOVES)).plan(moment)
    if moment.worth is not None:
        return served(moment, plan.services)
    return None if plan.makespan is None else plan.makespan / MS


