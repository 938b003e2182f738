"""How well the current policy does on scenarios that training never draws.

Legend: E scenarios, N agents.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from moonteam import trees
from moonteam.planners.batch import OPTIMAL
from training.mappo.grid_task import GridTask
from training.mappo.networks import Networks
from training.mappo.task import EnvState, Task
from training.optima import plans

HELD_OUT_SEED = 715517
"""Keys of held-out scenarios descend from this seed, those of training from the run's."""


class Score(NamedTuple):
    """Over E scenarios; failures count with max_steps and their real moves."""

    success: Array  # [] share solved within max_steps
    makespan: Array  # [] mean steps
    moves: Array  # [] mean team effort


class _Walk(NamedTuple):
    state: EnvState
    memory: Array
    solved: Array
    steps: Array
    moves: Array


@partial(jax.jit, static_argnames=("networks", "task", "num_scenarios", "sample"))
def score(networks: Networks, task: Task, actor: dict, key: Array, num_scenarios: int,
          sample: bool) -> Score:
    """Plays each scenario once: argmax of the logits, or a sampled action."""
    begin_key, play_key = jax.random.split(key)
    state = task.reset(begin_key, num_scenarios)
    never = jnp.zeros((1, num_scenarios), bool)

    def step(walk: _Walk, t: Array) -> tuple[_Walk, None]:
        obs = task.observe(walk.state)[None]
        memory, logits = networks.logits(actor, walk.memory, obs, never)
        act_key, env_key = jax.random.split(jax.random.fold_in(play_key, t))
        action = (jax.random.categorical(act_key, logits[0]) if sample
                  else jnp.argmax(logits[0], axis=-1))
        out = task.step(env_key, walk.state, action)
        after = _Walk(out.state, memory, out.terminated, out.steps, out.moves)
        return trees.where(walk.solved, walk, after), None

    none = jnp.zeros(num_scenarios, jnp.int32)
    walk = _Walk(state, networks.empty(num_scenarios).actor, never[0], none, none)
    walk, _ = jax.lax.scan(step, walk, jnp.arange(task.max_steps))
    return Score(walk.solved.mean(), walk.steps.mean(), walk.moves.mean())


EXACT_TO = 8
"""Targets up to which optima are worth their time."""


def optimum(task: GridTask, key: Array, num_scenarios: int) -> float | None:
    """Mean makespan of certified optimal plans for the scenarios that `score` plays with `key`.

    None where it is not known: targets that appear later, or more than `EXACT_TO`.
    """
    config = task.config
    if config.num_buffer or config.num_targets > EXACT_TO:
        return None
    state = jax.device_get(task.reset(jax.random.split(key)[0], num_scenarios).world)
    best = plans(state, objective="makespan")
    return float(best.makespan.mean()) if (best.status == OPTIMAL).all() else None


STANDING = 0.5
"""Success from which on a policy counts as one that can be lost."""
PATIENCE = 3
"""Evaluations in a row that must show the fall."""


def collapsed(rows: list[dict[str, Any]], scenarios: int) -> bool:
    """Whether a policy that could do something has lost it, and not for a moment.

    True when the best evaluation solved at least half of the scenarios, and each of the last
    three at most half as many as it, the fall being more than chance explains: four standard
    errors of the difference of two shares of `scenarios`. Sampled actions count, since argmax
    also fails by robots that wait for each other, which comes and goes while all is well. The
    phases are one: they set the same scenarios. A fresh optimiser and new rewards may cost a
    policy something at the start of a phase, which is why one low evaluation is not enough.
    """
    found = [row["sample"]["success"] for row in rows if "sample" in row]
    top, last = max(found, default=0.0), found[-PATIENCE:]
    low = min(top / 2, top - 4 * math.sqrt(0.5 / scenarios))
    return top >= STANDING and len(last) == PATIENCE and max(last) <= low
