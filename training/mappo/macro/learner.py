"""What learning on macro-decisions changes, and one pass of gradient steps over what was met.

Legend: B rows of a minibatch.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array

from moonteam.policies.pointer import Outlook, Pointed, PointerSpec, point
from training.mappo.macro.hyper import Hyper

AXIS = "batch"
"""Of the mesh, see `training.sharding`."""


class Learner(NamedTuple):
    """What learning changes."""

    params: Any
    mean: Any  # running mean of the parameters
    optimiser: optax.OptState
    steps: Array  # [] int32, gradient steps made

    @classmethod
    def begin(cls, params: Any, hyper: Hyper) -> Learner:
        """Copies of the parameters, since a learner is donated, and a fresh optimiser."""
        params, mean = jax.tree.map(jnp.array, params), jax.tree.map(jnp.array, params)
        return cls(params, mean, _optimiser(hyper).init(params), jnp.zeros((), jnp.int32))


def _optimiser(hyper: Hyper) -> optax.GradientTransformation:
    """Behind a gradient-norm clip; the rate is given with each update.

    Muon turns the momentum of a matrix between features into the nearest orthogonal one, so that
    all directions are learned at one pace (Jordan et al. 2024); scaled to the root mean square of
    Adam's steps, to whose rates it then keeps (Liu et al. 2025). All else is Adam's.
    """
    clip = optax.clip_by_global_norm(hyper.max_grad_norm)
    if hyper.optimiser == "adam":
        return optax.chain(clip, optax.scale_by_adam(eps=1e-5))
    return optax.chain(clip, optax.contrib.muon(
        learning_rate=-1.0, consistent_rms=0.2, muon_weight_dimension_numbers=_between_features))


def _between_features(params: Any) -> Any:
    """Of parameters those that Muon turns: matrices, but for those that read inputs or write
    numbers; else None.
    """
    def one(path: tuple[Any, ...], x: Array) -> optax.contrib.MuonDimensionNumbers | None:
        layer = str(path[0].key)
        inner = layer.startswith("block") or layer in ("query", "key", "pool")
        return optax.contrib.MuonDimensionNumbers() if inner and x.ndim == 2 else None

    return jax.tree_util.tree_map_with_path(one, params)


def part_of(count: int, size: int) -> int:
    """Rows that are computed together: at most `size`, and `count` is a multiple of them."""
    return max(n for n in range(1, min(size, count) + 1) if count % n == 0)


def say(params: Any, spec: PointerSpec, hyper: Hyper, view: Outlook) -> Pointed:
    """The network's word on all moments [B, ...], part by part."""
    count = view.agents.shape[0]
    size = part_of(count, hyper.rows(view))
    if size == count:
        return point(params, spec, view)
    split = jax.tree.map(lambda x: x.reshape(count // size, size, *x.shape[1:]), view)
    said = jax.lax.map(lambda part: point(params, spec, part), split)
    return jax.tree.map(lambda x: x.reshape(count, *x.shape[2:]), said)


def descend(learner: Learner, hyper: Hyper, loss: Callable[[Any, Any, Array], tuple[Array, Array]],
            rows: Any, real: Array, order: Array, lr: Array) -> tuple[Learner, Array]:
    """One gradient step for every row of `order`, on the device's own rows; gradients are shared.

    Args:
      learner: before.
      hyper: its clip, mean and part.
      loss: of parameters, rows and the number of choices that it is to divide by: a sum over the
        rows, and figures of the same kind.
      rows: [S, ...] all of them; `rows.view` is what the network saw.
      real: [S] choices that a row has.
      order: [steps, B] indices of the rows of each minibatch.
      lr: learning rate.

    Returns:
      The learner after, and the figures [steps, ...].
    """
    rule = _optimiser(hyper)
    size = part_of(order.shape[1], hyper.rows(rows.view))

    def step(learner: Learner, index: Array) -> tuple[Learner, Array]:
        count = jnp.maximum(jnp.sum(real[index]), 1)

        def slope(part: Array) -> Any:
            own = jax.tree.map(lambda x: x[part], rows)
            return jax.grad(loss, has_aux=True)(learner.params, own, count)

        way, said = jax.tree.map(lambda x: jnp.sum(x, axis=0),
                                 jax.lax.map(slope, index.reshape(-1, size)))
        way, state = rule.update(jax.lax.pmean(way, AXIS), learner.optimiser, learner.params)
        params = jax.tree.map(lambda p, w: p - lr * w, learner.params, way)
        # Young, the mean must not remember how it began.
        steps = learner.steps.astype(jnp.float32)
        keep = jnp.minimum(hyper.ema, (1.0 + steps) / (10.0 + steps))
        mean = jax.tree.map(lambda m, p: keep * m + (1.0 - keep) * p, learner.mean, params)
        return Learner(params, mean, state, learner.steps + 1), said

    return jax.lax.scan(step, learner, order)
