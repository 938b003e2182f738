"""How far places are from each other, by the metric of the ways."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from moonteam.problem.timed import Metric


def apart(a: Array, b: Array, metric: Metric) -> Array:
    """[..., A, B] metres from places a [..., A, 2] to b [..., B, 2]."""
    shift = jnp.abs(a[..., :, None, :] - b[..., None, :, :]).astype(jnp.float32)
    if metric == "manhattan":
        return jnp.sum(shift, axis=-1)
    return jnp.sqrt(jnp.sum(shift**2, axis=-1))
