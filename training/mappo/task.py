"""What the learner asks of an environment, always for a batch of E of them at once.

Legend: E environments, N agents, D observation length.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

from jax import Array

EnvState = Any  # pytree, leading axis E


class Outcome(NamedTuple):
    """One step of E environments, before any of them begins anew."""

    state: EnvState
    reward: Array  # [E, N]
    terminated: Array  # [E] bool, a true end: nothing follows
    truncated: Array  # [E] bool, cut off by time, not terminated
    steps: Array  # [E] int32, steps of the episode so far
    moves: Array  # [E] int32, team effort of the episode so far


class Task(Protocol):
    """A batch of environments; hashable, for it is static under jit."""

    @property
    def num_agents(self) -> int:
        """N."""
        ...

    @property
    def max_steps(self) -> int:
        """Steps after which an episode is truncated."""
        ...

    def reset(self, key: Array, count: int) -> EnvState:
        """`count` fresh episodes."""
        ...

    def observe(self, state: EnvState) -> Array:
        """[E, N, D]; small integers where they suffice, they are stored as they come."""
        ...

    def step(self, key: Array, state: EnvState, action: Array) -> Outcome:
        """Moves all agents; action [E, N] int32."""
        ...
