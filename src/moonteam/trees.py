"""One rule for choosing between two trees of arrays, on the host and under jit."""

from __future__ import annotations

from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

Tree = TypeVar("Tree")


def where(mask: Any, yes: Tree, no: Tree) -> Tree:
    """`yes` where `mask` [...], else `no`, leaf by leaf.

    Leaves have the mask's axes in front, and any others behind them. NumPy leaves stay NumPy
    where the mask is NumPy too.
    """
    def pick(a: Any, b: Any) -> Any:
        on_host = all(isinstance(x, np.ndarray | np.generic) for x in (mask, a, b))
        xp = np if on_host else jnp
        return xp.where(mask.reshape(mask.shape + (1,) * (np.ndim(a) - mask.ndim)), a, b)

    return jax.tree.map(pick, yes, no)


def single(tree: Tree) -> Tree:
    """Leaves of 64 bits as such of 32, which is what all of it computes in.

    A process with JAX_ENABLE_X64 makes some where none are asked for, and a loop of JAX refuses a
    state whose kind changes.
    """
    narrow = {np.dtype(np.float64): np.float32, np.dtype(np.int64): np.int32}

    def cast(leaf: Any) -> Any:
        kind = narrow.get(leaf.dtype)
        return leaf if kind is None else leaf.astype(kind)

    return jax.tree.map(cast, tree)
