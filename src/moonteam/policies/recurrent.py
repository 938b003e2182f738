"""The paper's recurrent actor and critic, shared by all agents, for one team size.

Dense, ReLU, GRU (forgets where an episode began), Dense, ReLU, head; two separate networks.
The critic reads every agent's observation, the agent's own first.

Legend: T steps, B sequences (environments x agents, or any batch), N agents, M targets,
D observation length, H width.
"""

from __future__ import annotations

import operator
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jax import Array

from moonteam.errors import InputError
from moonteam.policies.attention import MOST_WIDE
from moonteam.problem.rules import NUM_ACTIONS
from moonteam.problem.scenario import MAX_SKILLS, MOST_AGENTS, MOST_SIDE, MOST_TARGETS


@dataclass(frozen=True)
class RecurrentSpec:
    """What a recurrent policy was made for; fixes every shape in it."""

    num_agents: int
    """N, robots in the team."""
    num_targets: int
    """M, target slots in the observation."""
    size: tuple[int, int]
    """(W, H) of the map in cells; positions are divided by (W - 1, H - 1)."""
    num_skills: int = 2
    """Skills that exist; skill sets are bitmasks below 2 ** num_skills."""
    width: int = 128
    """H, units of every hidden layer and of the GRU."""
    memory: bool = True
    """False replaces the GRU by a Dense layer (the feed-forward ablation)."""
    normalise: bool = True
    """Divide positions by (size - 1); False leaves cells as they are."""

    @property
    def obs_size(self) -> int:
        """D = 2N + 2M + N + M + M."""
        return 3 * self.num_agents + 4 * self.num_targets

    def obs_scale(self) -> np.ndarray:
        """[D] factors that turn the grid's raw integer observation into network input."""
        pairs = self.num_agents + self.num_targets
        side = np.maximum(np.array(self.size, np.float32) - 1.0, 1.0)
        scale = np.ones(self.obs_size, np.float32)
        if self.normalise:
            scale[: 2 * pairs] = np.tile(1.0 / side, pairs)
        return scale

    def check(self, source: object) -> None:
        """Raises InputError if the numbers make no policy."""
        counts = (self.num_agents, self.num_targets, self.num_skills, self.width, *self.size)
        most = (MOST_AGENTS, MOST_TARGETS, MAX_SKILLS, MOST_WIDE, MOST_SIDE, MOST_SIDE)
        if min(counts) < 1 or len(self.size) != 2 or any(map(operator.gt, counts, most)):
            raise InputError(source, f"not the numbers of a policy: {self}; at most {most}")


class Gru(nn.Module):
    """Gated recurrent unit over a sequence, its input projection hoisted out of the scan.

    r = s(W_r x + b_r + U_r h), z = s(W_z x + b_z + U_z h),
    n = tanh(W_n x + b_n + r (U_n h + c_n)), h' = (1 - z) n + z h  (Cho et al. 2014 in the
    form of cuDNN and flax). Kernels: W [H, 3H], U [H, 3H].
    """

    width: int
    dtype: jnp.dtype | None = None

    @nn.compact
    def __call__(self, hidden: Array, inputs: Array, reset_before: Array) -> tuple[Array, Array]:
        """hidden [B, H], inputs [T, B, H], reset_before [T, B] -> (hidden, outputs [T, B, H])."""
        gates = nn.Dense(3 * self.width, dtype=self.dtype, name="input")(inputs)
        kernel = self.param("recurrent", _orthogonal_gates, (self.width, 3 * self.width))
        bias = self.param("candidate_bias", nn.initializers.zeros, (self.width,))
        if self.dtype is not None:
            kernel = kernel.astype(self.dtype)
        if inputs.shape[0] == 1:  # acting: no loop around one step
            hidden, _ = _gru_step(kernel, bias, hidden, gates[0], reset_before[0])
            return hidden, hidden[None]
        return _gru_scan(kernel, bias, hidden, gates, reset_before)


class _Kept(NamedTuple):
    """What the gradient of a step needs of it, each [B, H]."""

    before: Array  # memory that the step began with
    r: Array
    z: Array
    n: Array
    back: Array  # U_n h + c_n


def _gru_step(kernel: Array, bias: Array, hidden: Array, gate: Array,
              reset: Array) -> tuple[Array, _Kept]:
    """hidden [B, H], gate [B, 3H], reset [B] -> the next hidden, and what it was made of."""
    width = hidden.shape[1]
    hidden = jnp.where(reset[:, None], 0.0, hidden)
    back = (hidden.astype(kernel.dtype) @ kernel).astype(hidden.dtype)
    gate = gate.astype(hidden.dtype)
    r, z = jnp.split(nn.sigmoid(gate[:, : 2 * width] + back[:, : 2 * width]), 2, axis=-1)
    own = back[:, 2 * width :] + bias[None, :]
    n = jnp.tanh(gate[:, 2 * width :] + r * own)
    return (1.0 - z) * n + z * hidden, _Kept(hidden, r, z, n, own)


@jax.custom_vjp
def _gru_scan(kernel: Array, bias: Array, hidden: Array, gates: Array,
              reset_before: Array) -> tuple[Array, Array]:
    """All steps: kernel [H, 3H], bias [H], hidden [B, H], gates [T, B, 3H], reset_before [T, B].

    -> (hidden, outputs [T, B, H]). The gradient is written out because JAX's own would add up
    the kernel's at every step: a product too small to be quick, a pass over the whole kernel
    and, where sequences are spread over devices, a sum over all of them. Here it is one
    product after the last step (Appleyard et al. 2016).
    """
    def step(hidden: Array, at: tuple[Array, Array]) -> tuple[Array, Array]:
        hidden, _ = _gru_step(kernel, bias, hidden, *at)
        return hidden, hidden

    return jax.lax.scan(step, hidden, (gates, reset_before))


def _gru_forward(kernel: Array, bias: Array, hidden: Array, gates: Array,
                 reset_before: Array) -> tuple[tuple[Array, Array], tuple]:
    def step(hidden: Array, at: tuple[Array, Array]) -> tuple[Array, tuple[Array, _Kept]]:
        hidden, kept = _gru_step(kernel, bias, hidden, *at)
        return hidden, (hidden, kept)

    hidden, (outputs, kept) = jax.lax.scan(step, hidden, (gates, reset_before))
    like = jnp.zeros((0,), gates.dtype)
    return (hidden, outputs), (kernel, kept, reset_before, like)


def _gru_backward(residuals: tuple, cotangents: tuple[Array, Array]) -> tuple:
    kernel, kept, reset_before, like = residuals
    d_last, d_outputs = cotangents

    def step(d_hidden: Array, at: tuple[Array, _Kept, Array]) -> tuple[Array, tuple[Array, Array]]:
        d_output, (before, r, z, n, back), reset = at
        d_hidden = d_hidden + d_output
        d_n = d_hidden * (1.0 - z) * (1.0 - n * n)
        d_z = d_hidden * (before - n) * z * (1.0 - z)
        d_r = d_n * back * r * (1.0 - r)
        d_back = jnp.concatenate([d_r, d_z, d_n * r], axis=-1)
        through = (d_back.astype(kernel.dtype) @ kernel.T).astype(d_hidden.dtype)
        return jnp.where(reset[:, None], 0.0, d_hidden * z + through), (d_back, d_n)

    d_hidden, (d_back, d_n) = jax.lax.scan(step, d_last, (d_outputs, kept, reset_before),
                                           reverse=True)
    width = d_n.shape[-1]
    d_kernel = jax.lax.dot_general(kept.before.astype(kernel.dtype), d_back.astype(kernel.dtype),
                                   (((0, 1), (0, 1)), ((), ())))
    d_gates = jnp.concatenate([d_back[..., : 2 * width], d_n], axis=-1).astype(like.dtype)
    d_bias = jnp.sum(d_back[..., 2 * width :], axis=(0, 1))
    return d_kernel, d_bias, d_hidden, d_gates, None


_gru_scan.defvjp(_gru_forward, _gru_backward)


def _orthogonal_gates(key: Array, shape: tuple[int, int]) -> Array:
    """One orthogonal square a gate, side by side."""
    make = nn.initializers.orthogonal()
    squares = [make(k, (shape[0], shape[0]), jnp.float32) for k in jax.random.split(key, 3)]
    return jnp.concatenate(squares, axis=1)


class Recurrent(nn.Module):
    """Dense H, ReLU, GRU H, Dense H, ReLU, head: actor (5 outputs) or critic (1 output)."""

    outputs: int
    width: int = 128
    memory: bool = True
    head_gain: float = 0.01
    dtype: jnp.dtype | None = None  # of matrix products; parameters and memory stay float32

    @nn.compact
    def __call__(self, hidden: Array, inputs: Array, reset_before: Array) -> tuple[Array, Array]:
        """hidden [B, H], inputs [T, B, D], reset_before [T, B] -> (hidden, [T, B, outputs])."""
        gain = nn.initializers.orthogonal

        def dense(units: int, scale: float, name: str) -> nn.Dense:
            return nn.Dense(units, kernel_init=gain(scale), dtype=self.dtype, name=name)

        x = nn.relu(dense(self.width, 2.0**0.5, "embed")(inputs))
        if self.memory:
            hidden, x = Gru(self.width, self.dtype, name="gru")(hidden, x, reset_before)
        else:
            x = nn.relu(dense(self.width, 2.0**0.5, "feed_forward")(x))
        x = nn.relu(dense(self.width, 2.0, "mix")(x))
        return hidden, dense(self.outputs, self.head_gain, "head")(x).astype(jnp.float32)


def actor(spec: RecurrentSpec, dtype: jnp.dtype | None = None) -> Recurrent:
    """Observation -> logits of the five actions."""
    return Recurrent(NUM_ACTIONS, spec.width, spec.memory, 0.01, dtype)


def critic(spec: RecurrentSpec, dtype: jnp.dtype | None = None) -> Recurrent:
    """All observations, own first -> value."""
    return Recurrent(1, spec.width, spec.memory, 1.0, dtype)


def init(spec: RecurrentSpec, key: Array) -> dict:
    """Fresh parameters: {"actor": ..., "critic": ...}."""
    keys = jax.random.split(key)
    flags = jnp.zeros((1, 1), bool)
    memory = zeros(spec, 1)
    own = jnp.zeros((1, 1, spec.obs_size))
    everyone = jnp.zeros((1, 1, spec.num_agents * spec.obs_size))
    return {"actor": actor(spec).init(keys[0], memory, own, flags)["params"],
            "critic": critic(spec).init(keys[1], memory, everyone, flags)["params"]}


def zeros(spec: RecurrentSpec, batch: int) -> Array:
    """[batch, H] empty memory."""
    return jnp.zeros((batch, spec.width if spec.memory else 1))


def own_first(obs: Array) -> Array:
    """[..., N, D] observations of all agents -> [..., N, N * D] critic input, own first."""
    count = obs.shape[-2]
    order = np.array([[i, *(j for j in range(count) if j != i)] for i in range(count)])
    return obs[..., order, :].reshape(*obs.shape[:-1], count * obs.shape[-1])


def kernel_count(params: dict) -> int:
    """Parameters that are matrices (biases left out), as the paper counts."""
    return sum(leaf.size for leaf in jax.tree.leaves(params) if leaf.ndim == 2)
