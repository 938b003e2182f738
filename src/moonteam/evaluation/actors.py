"""Policies as they act on a whole batch of episodes under one jit.

An actor is static (what the network is); its parameters and what differs between episodes
travel as arrays. Legend: E episodes, N agents, M targets, K kinds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import msgspec
from jax import Array

from moonteam.errors import InputError
from moonteam.evaluation.world import World
from moonteam.grid.config import EnvConfig
from moonteam.grid.observe import observe
from moonteam.grid.travel import problem_fields
from moonteam.grid.types import State
from moonteam.policies import checkpoint, entity, recurrent
from moonteam.policies.entity import EntitySpec
from moonteam.policies.recurrent import RecurrentSpec


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Given:
    """What an actor may know of its episodes besides their state."""

    horizon: Array  # [E] steps
    preference: Array  # [E] 0 time .. 1 effort
    fields: Array | None  # [E, K, M, H, W] travel fields; None: open map, or read each step


class Actor(Protocol):
    """A network that maps states to action logits; hashable, for it is static under jit."""

    @property
    def takes_preference(self) -> bool:
        """Whether one network serves time and effort by a preference input."""
        ...

    def begin(self, episodes: int) -> Any:
        """Empty memory of a batch of episodes."""
        ...

    def logits(self, params: Any, memory: Any, state: State, given: Given) -> tuple[Any, Array]:
        """(memory, [E, N, 5]) at one moment of a batch of episodes."""
        ...

    def check(self, world: World, source: object) -> None:
        """Raises InputError if the policy was made for scenarios of another size."""
        ...


@dataclass(frozen=True)
class RecurrentActor:
    """The paper's network: one team size, one number of targets, one map."""

    spec: RecurrentSpec

    @property
    def takes_preference(self) -> bool:
        """It does not."""
        return False

    def begin(self, episodes: int) -> Array:
        """[E * N, H] zeros."""
        return recurrent.zeros(self.spec, episodes * self.spec.num_agents)

    def logits(self, params: Any, memory: Array, state: State,
               given: Given) -> tuple[Array, Array]:
        """See `Actor`. The agents of an episode share the network, not the memory."""
        del given
        config = EnvConfig(normalize_positions=self.spec.normalise)
        seen = jax.vmap(lambda s: observe(config, s))(state)  # [E, N, D]
        flat = seen.reshape(1, -1, seen.shape[-1])
        never = jnp.zeros(flat.shape[:2], bool)
        applied: Any = recurrent.actor(self.spec).apply(
            {"params": params["actor"]}, memory, flat, never)
        memory, out = applied
        return memory, out.reshape(*seen.shape[:2], -1)

    def check(self, world: World, source: object) -> None:
        """See `Actor`."""
        spec = self.spec
        for scenario in world.scenarios:
            shown = len(scenario.targets) - world.num_buffer
            have = (len(scenario.agents), shown, tuple(scenario.size))
            want = (spec.num_agents, spec.num_targets, tuple(spec.size))
            if have != want:
                raise InputError(source, f"made for {_family(*want)}; scenario {scenario.id} "
                                 f"has {_family(*have)}")
            skills = {s for item in (*scenario.agents, *scenario.targets) for s in item.skills}
            if scenario.mask(skills) >= 2**spec.num_skills:
                raise InputError(source, f"made for {spec.num_skills} skills; scenario "
                                 f"{scenario.id} has {', '.join(sorted(skills))}")
            if scenario.blocked:
                raise InputError(source, "made for open maps; scenario "
                                 f"{scenario.id} has blocked cells")


def _family(agents: int, targets: int, size: Sequence[int]) -> str:
    return f"{agents} agents, {targets} targets on {size[0]}x{size[1]}"


@dataclass(frozen=True)
class EntityActor:
    """The network for any team, any targets, any ground."""

    spec: EntitySpec

    @property
    def takes_preference(self) -> bool:
        """It does."""
        return True

    def begin(self, episodes: int) -> tuple[()]:
        """It has no memory."""
        return ()

    def logits(self, params: Any, memory: tuple[()], state: State,
               given: Given) -> tuple[tuple[()], Array]:
        """See `Actor`; what is returned are log-probabilities."""
        fields = given.fields
        if fields is None and state.problem.passable is not None:
            fields = jax.vmap(problem_fields)(state.problem)
        look = jax.vmap(lambda s, t, p, f: entity.look(s, t, p, f),
                        in_axes=(0, 0, 0, None if fields is None else 0))
        view = look(state, given.horizon, given.preference, fields)
        decision: Any = entity.Entity(self.spec).apply({"params": params}, view)
        return memory, decision.log_probs

    def check(self, world: World, source: object) -> None:
        """Any scenario will do."""
        del world, source


@dataclass(frozen=True)
class Loaded:
    """A policy file, ready to act."""

    actor: Actor
    params: Any
    path: Path
    source: checkpoint.PolicyFile

    @property
    def name(self) -> str:
        """The file's name without its ending."""
        return self.path.stem


def load(path: Path) -> Loaded:
    """Reads a policy file. Raises InputError if it is not one, or of an unknown network."""
    stored = checkpoint.load_policy(path)
    kinds: dict[str, Any] = {"recurrent": (RecurrentSpec, RecurrentActor),
                             "entity": (EntitySpec, EntityActor)}
    if stored.kind not in kinds:
        raise InputError(path, f"network kind {stored.kind!r} is not one of {', '.join(kinds)}")
    spec_type, actor_type = kinds[stored.kind]
    try:
        spec = msgspec.convert(stored.config, spec_type)
    except msgspec.ValidationError as error:
        raise InputError(path, f"its header does not describe a {stored.kind} network: "
                         f"{error}") from None
    spec.check(path)
    return Loaded(actor_type(spec), jax.tree.map(jnp.asarray, stored.params), path, stored)
