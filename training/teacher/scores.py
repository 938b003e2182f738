"""How a policy under training does on scenarios that training never draws.

Legend: E scenarios of a family.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from moonteam.grid import env
from moonteam.policies.entity import EntitySpec, decide
from training.mappo.held_out import HELD_OUT_SEED
from training.optima import plans
from training.teacher.families import (
    Family,
    Ground,
    Walk,
    bare,
    begin,
    make_ground,
    on_ground,
    views,
)


class Score(NamedTuple):
    """Over held-out scenarios of one family; failures count with the horizon, and with a move of
    every robot at each of its steps: standing still is no way to save effort.
    """

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
        solved = jnp.all(after.solved, axis=-1)
        return _Play(walk._replace(states=bare(after)), solved, play.steps + ~play.over,
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
        passable = np.asarray(self.ground.passable)[place] if self.ground else None

        def optimum(objective: Any) -> Any:
            return plans(states, passable, objective=objective, exact_to=family.exact_to,
                         iterations=10 * family.iterations)

        self.best_makespan = float(optimum("makespan").makespan.mean())
        self.best_moves = float(optimum("moves").moves.mean())

    def score(self, spec: EntitySpec, params: Any, preference: float) -> Score:
        """How the policy does by argmax, without a deadlock watch."""
        solved, steps, moves = jax.device_get(
            play(spec, self.family, np.float32(preference), params, self.ground, self.walk))
        most = self.family.num_agents * self.family.max_steps
        moves = np.where(solved, moves, most)
        return Score(float(solved.mean()), float(steps.mean()), float(moves.mean()),
                     self.best_makespan, self.best_moves)


def family_row(family: Family, held_out: HeldOut, spec: EntitySpec, params: Any) -> dict[str, Any]:
    """Success and gaps of one family at both ends of the preference."""
    quick = held_out.score(spec, params, 0.0)
    thrifty = held_out.score(spec, params, 1.0)
    ground = ", blocked ground" if family.grounds else ""
    return {"family": f"{family.num_agents} robots, {family.num_targets} targets{ground}",
            "success": quick.success, "makespan_gap": quick.makespan / quick.best_makespan - 1,
            "success_effort": thrifty.success, "moves_gap": thrifty.moves / thrifty.best_moves - 1}
