"""What the networks over robots and targets have in common: attention biased by pairs.

Legend: B batch, N agents, E = N + M tokens, agents before targets, D width, K heads.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import linen as nn
from jax import Array

from moonteam.errors import InputError

FAR = 1.0e9
"""Stands for minus infinity in masked logits, without its not-a-number."""

MOST_WIDE = 4096
MOST_LAYERS = 32


def check_sizes(source: object, width: int, heads: int, layers: int, pairs: int = 1) -> None:
    """Raises InputError if the numbers make no network, or too large a one."""
    for name, number, most in (("width", width, MOST_WIDE), ("heads", heads, MOST_WIDE),
                               ("layers", layers, MOST_LAYERS), ("pairs", pairs, MOST_WIDE)):
        if not 1 <= number <= most:
            raise InputError(source, f"{name} ({number}) is not allowed; 1 to {most}")
    if width % heads:
        raise InputError(source, f"heads ({heads}) must divide width ({width})")


class Block(nn.Module):
    """Pre-norm self-attention with a pair bias, then a small feed-forward layer."""

    width: int
    heads: int

    @nn.compact
    def __call__(self, x: Array, bias: Array, mask: Array) -> Array:
        """x [B, E, D], bias [B, E, E, K] added to the logits, mask [B, E] real tokens."""
        width, heads = self.width, self.heads
        y = nn.LayerNorm()(x)
        qkv = nn.Dense(3 * width, use_bias=False, name="qkv")(y)
        q, k, v = jnp.split(qkv.reshape(*y.shape[:-1], heads, 3 * width // heads), 3, axis=-1)
        logits = jnp.einsum("...ikd,...jkd->...ijk", q, k) * (width // heads) ** -0.5 + bias
        logits = jnp.where(mask[..., None, :, None], logits, -FAR)
        mixed = jnp.einsum("...ijk,...jkd->...ikd", jax.nn.softmax(logits, axis=-2), v)
        x = x + nn.Dense(width, name="out")(mixed.reshape(y.shape))
        y = nn.Dense(2 * width, name="up")(nn.LayerNorm()(x))
        return x + nn.Dense(width, name="down")(nn.gelu(y))


def attend(x: Array, pairs: Array, mask: Array, agents: int, layers: int, heads: int) -> Array:
    """All blocks and the last norm; within a compact module, whose parameters they become.

    Args:
      x: [B, E, D] tokens.
      pairs: [B, E, E, F] what token j is to token i.
      mask: [B, E] real tokens.
      agents: N.
      layers: blocks.
      heads: K.
    """
    biases = _by_role(pairs, agents, layers * heads)
    for layer in range(layers):
        part = biases[..., layer * heads : (layer + 1) * heads]
        x = Block(x.shape[-1], heads, name=f"block{layer}")(x, part, mask)
    return nn.LayerNorm(name="last")(x)


def point(x: Array, pairs: Array, agents: int) -> tuple[Array, Array]:
    """What each agent points at: logits of the targets [B, N, M], and of staying [B, N, 1]."""
    width = x.shape[-1]
    query = nn.Dense(width, name="query")(x[..., :agents, :])
    key = nn.Dense(width, name="key")(x[..., agents:, :])
    bias = nn.Dense(1, name="point_bias")(pairs[..., :agents, agents:, :])[..., 0]
    logits = jnp.einsum("...nd,...md->...nm", query, key) * width**-0.5 + bias
    return logits, nn.Dense(1, name="stay")(x[..., :agents, :])


def _by_role(pairs: Array, agents: int, outputs: int) -> Array:
    """[B, E, E, outputs] linear readings of the pair features, one for each ordered pair of roles.

    Agents and targets read a pair differently.
    """
    rows = []
    for i, own in ((slice(0, agents), "agent"), (slice(agents, None), "target")):
        parts = [nn.Dense(outputs, name=f"bias_{own}_{other}")(pairs[..., i, j, :])
                 for j, other in ((slice(0, agents), "agent"), (slice(agents, None), "target"))]
        rows.append(jnp.concatenate(parts, axis=-2))
    return jnp.concatenate(rows, axis=-3)
