"""Muon: momentum of a matrix, turned into the nearest orthogonal one before it is stepped along.

So all directions are learned at one pace (Jordan et al. 2024, "Muon: An optimizer for hidden layers
in neural networks"). Steps are scaled to the root mean square that Adam's have, to whose rates they
then keep (Liu et al. 2025, "Muon is scalable for LLM training"). Optax has it too; there every
matrix brings a program of its own, which here took two minutes to compile where this takes seconds:
matrices of a shape are turned together.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import Array

MOMENTUM = 0.95
QUINTIC = 3.4445, -4.7750, 2.0315
"""Of X: a X + b X X'X + c (X X')^2 X, which brings singular values near 1 in a few rounds."""
ROUNDS = 5
RMS = 0.2
"""Root mean square of a step, as Adam's have."""


def between_features(params: Any) -> Any:
    """Of parameters: muon for matrices between features; adam for what reads inputs or writes
    numbers, and for all that is no matrix.
    """
    def one(path: tuple[Any, ...], x: Array) -> str:
        layer = str(path[0].key)
        inner = layer.startswith("block") or layer in ("query", "key", "pool")
        return "muon" if inner and x.ndim == 2 else "adam"

    return jax.tree_util.tree_map_with_path(one, params)


def muon() -> optax.GradientTransformation:
    """Of gradients, all of them matrices, steps up them at a rate of 1."""

    def update(slope: Any, state: Any, params: Any = None) -> tuple[Any, Any]:
        del params
        nesterov, state = momentum.update(slope, state)
        leaves, tree = jax.tree.flatten(nesterov)
        shapes = [tuple(sorted(leaf.shape)) for leaf in leaves]
        ways: list[Any] = [None] * len(leaves)
        for shape in dict.fromkeys(shapes):
            own = [k for k, other in enumerate(shapes) if other == shape]
            tall = [leaves[k].shape[0] > leaves[k].shape[1] for k in own]
            flat = jnp.stack([leaves[k].T if turn else leaves[k]
                              for k, turn in zip(own, tall, strict=True)])
            turned = RMS * shape[1] ** 0.5 * orthogonal(flat)
            for k, turn, way in zip(own, tall, turned, strict=True):
                ways[k] = way.T if turn else way
        return jax.tree.unflatten(tree, ways), state

    momentum = optax.trace(MOMENTUM, nesterov=True)
    return optax.GradientTransformation(momentum.init, update)


def orthogonal(flat: Array) -> Array:
    """[K, R, C] each matrix's nearest one with orthogonal rows, nearly; R at most C."""
    norm = jnp.linalg.norm(flat, axis=(1, 2), keepdims=True)
    a, b, c = QUINTIC

    def once(_: int, x: Array) -> Array:
        gram = x @ x.mT
        return a * x + (b * gram + c * gram @ gram) @ x

    return jax.lax.fori_loop(0, ROUNDS, once, flat / jnp.maximum(norm, 1e-12))
