"""A policy that decides in missions that unfold by its likeliest choice, and plans nothing.

Legend: B missions, N robots, M targets known of and places to look from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from moonteam.grid.macro import world
from moonteam.grid.macro.types import MacroProblem, MacroState
from moonteam.planners import macro
from moonteam.planners.seconds.keeper import WAIT
from moonteam.planners.seconds.macro import problem_of
from moonteam.planners.unfolding.world import View
from moonteam.policies import pointer
from moonteam.policies.pointer import PointerSpec
from moonteam.policies.policy import Policy


class Pointing:
    """What the network points at, one choice after the other, the surest first.

    Who waits at a target for others stays bound to it, as in the world that it was trained in; who
    is on the way may turn. Raises InputError for a policy that does not point at targets.
    """

    def __init__(self, policy: Policy, preference: float = 0.0):
        self._spec, self._params = macro.spec_of(policy), policy.params
        self._preference = np.float32(preference)

    def choose(self, views: Sequence[View]) -> list[np.ndarray]:
        """[B] of [N] int64: a target's number or WAIT."""
        problems, bound = moments(views)
        found = np.asarray(_point(self._spec, self._params, problems, bound, self._preference))
        chosen = []
        for row, own, view in zip(found, bound, views, strict=True):
            count, targets = len(view.places), len(view.moment.solved)
            free = np.where(row < targets, row, WAIT)
            chosen.append(np.where(own >= 0, own, free)[:count].astype(np.int64))
        return chosen


def moments(views: Sequence[View]) -> tuple[MacroProblem, np.ndarray]:
    """What is known in several missions as one stack, [B]; and who is bound where, [B, N] int32."""
    problems = macro.stacked([problem_in(view) for view in views])
    bound = np.full(problems.free.shape, -1, np.int32)
    for row, view in zip(bound, views, strict=True):
        row[:len(view.places)] = _bound(view)
    return problems, bound


def problem_in(view: View) -> MacroProblem:
    """What is known as a problem of the macro world (NumPy arrays)."""
    problem = problem_of(view.moment)
    column = np.arange(len(problem.looks)) - len(view.targets)
    looks = (column >= 0) & (column < len(view.looks))
    unseen = np.zeros(len(looks), np.float32)
    unseen[looks] = [look.share for look in view.looks]
    return replace(problem, looks=looks, unseen=unseen)


def _bound(view: View) -> list[int]:
    """[N] the open target at which each robot waits; -1 of the others."""
    return [body.goal if body.phase == "there" and isinstance(body.goal, int) and body.goal >= 0
            and not view.moment.solved[body.goal] else -1 for body in view.state.bodies]


def begun(problems: MacroProblem, bound: Array) -> MacroState:
    """The states [B] in which those `bound` [B, N] to a target, where they wait, do not choose."""
    states = jax.vmap(world.reset)(problems)
    held = (bound >= 0) & problems.agent_mask
    goal, node = (jnp.where(held, bound, x) for x in (states.goal, states.node))
    return replace(states, goal=goal, node=node)


def said(spec: PointerSpec, params: Any, states: MacroState, preference: Array) -> Array:
    """Logits [B, N, M + 1] of each of a batch of moments."""
    liking = jnp.broadcast_to(preference, states.now.shape)
    return pointer.point(params, spec, jax.vmap(pointer.look)(states, liking)).logits


@partial(jax.jit, static_argnames="spec")
def _point(spec: PointerSpec, params: Any, problems: MacroProblem, bound: Array,
           preference: Array) -> Array:
    """[B, N] int32 choices; M for waiting, and of those `bound` [B, N] to a target already."""
    states = begun(problems, bound)
    logits = said(spec, params, states, preference)
    choice, _ = jax.vmap(world.choose)(states, logits, jnp.zeros_like(logits))
    return choice
