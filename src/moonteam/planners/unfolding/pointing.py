"""A policy that decides in missions that unfold by its likeliest choice, and plans nothing.

Legend: B missions, N robots, M targets known of.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from moonteam.grid.macro import world
from moonteam.grid.macro.types import MacroProblem
from moonteam.planners import macro
from moonteam.planners.seconds.base import Moment
from moonteam.planners.seconds.keeper import WAIT
from moonteam.planners.seconds.macro import problem_of
from moonteam.policies import pointer
from moonteam.policies.pointer import PointerSpec
from moonteam.policies.policy import Policy


class Pointing:
    """What the network points at, one choice after the other, the surest first.

    Raises InputError for a policy that does not point at targets.
    """

    def __init__(self, policy: Policy, preference: float = 0.0):
        self._spec, self._params = macro.spec_of(policy), policy.params
        self._preference = np.float32(preference)

    def choose(self, moments: Sequence[Moment]) -> list[np.ndarray]:
        """[B] of [N] int64: a target's number or WAIT, for who is free now."""
        problems = macro.stacked([problem_of(moment) for moment in moments])
        found = np.asarray(_point(self._spec, self._params, problems, self._preference))
        chosen = []
        for row, moment in zip(found, moments, strict=True):
            own = row[:len(moment.present)].astype(np.int64)
            chosen.append(np.where(own < len(moment.solved), own, WAIT))
        return chosen


@partial(jax.jit, static_argnames="spec")
def _point(spec: PointerSpec, params: Any, problems: MacroProblem, preference: Array) -> Array:
    """[B, N] int32 choices; M for waiting."""
    states = jax.vmap(world.reset)(problems)
    liking = jnp.broadcast_to(preference, states.now.shape)
    logits = pointer.point(params, spec, jax.vmap(pointer.look)(states, liking)).logits
    choice, _ = jax.vmap(world.choose)(states, logits, jnp.zeros_like(logits))
    return choice
