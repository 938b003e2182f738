"""The eight turns and reflections of the map, under which a good decision turns with it.

The network sees displacements, not places, so that turning the cells about the origin will
do. Legend as in `entity`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from moonteam.policies.entity import STAY, Entities, EntitySpec, decide

_MOVES = np.array([(0, 1), (0, -1), (-1, 0), (1, 0)], np.int32)

TURNS = np.array([[[a, 0], [0, b]] for a in (1, -1) for b in (1, -1)]
                 + [[[0, a], [b, 0]] for a in (1, -1) for b in (1, -1)], np.int32)
"""[8, 2, 2] matrices; the first is the identity."""

BECOMES = np.array([[int(np.flatnonzero((turn @ move == _MOVES).all(1))[0]) for move in _MOVES]
                    for turn in TURNS])
"""[8, 4] which move each of the four becomes."""


def turned(view: Entities, which: int) -> Entities:
    """The same moment on the turned map."""
    turn, back = TURNS[which], np.argsort(BECOMES[which])
    return replace(view, agent_cells=view.agent_cells @ turn.T,
                   target_cells=view.target_cells @ turn.T,
                   toward=view.toward[..., back], allowed=view.allowed[..., back])


def averaged(params: Any, spec: EntitySpec, view: Entities) -> Array:
    """[B, N, 5] log of the action probabilities' mean over the eight maps."""
    views = jax.tree.map(lambda *x: jnp.stack(x), *(turned(view, i) for i in range(len(TURNS))))
    probs = jnp.exp(decide(params, spec, views).log_probs)  # [8, B, N, 5]
    columns = np.concatenate([BECOMES, np.full((len(TURNS), 1), STAY)], axis=1)
    return jnp.log(jnp.mean(jnp.stack(
        [probs[i][..., columns[i]] for i in range(len(TURNS))]), axis=0))
