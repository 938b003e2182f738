"""Networks as they decide for a batch of episodes, whatever they are made of.

Legend: E episodes of a batch, N agents, M targets, W columns, H rows (of the map) or units (of
memory), L kinds of robots.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array

from moonteam.grid.config import EnvConfig
from moonteam.grid.macro import draw, world
from moonteam.grid.macro.types import FAR, MacroProblem, MacroState
from moonteam.grid.observe import observe
from moonteam.grid.travel import distances, first_step
from moonteam.grid.types import State
from moonteam.policies import entity, pointer, recurrent
from moonteam.policies.entity import EntitySpec
from moonteam.policies.pointer import PointerSpec
from moonteam.policies.recurrent import RecurrentSpec
from moonteam.problem.rules import UNREACHABLE


class Mission(Protocol):
    """What says whether a network was made for a mission; `planners.base.Snapshot` is one."""

    @property
    def size(self) -> tuple[int, int]:
        """(W, H) cells."""
        ...

    @property
    def cells(self) -> npt.NDArray[np.int32]:
        """[N, 2] of the agents."""
        ...

    @property
    def agent_skills(self) -> npt.NDArray[np.int32]:
        """[N] bitmasks."""
        ...

    @property
    def target_cells(self) -> npt.NDArray[np.int32]:
        """[M, 2]."""
        ...

    @property
    def target_skills(self) -> npt.NDArray[np.int32]:
        """[M] bitmasks."""
        ...


class Brain(Protocol):
    """A network as it decides for a batch of episodes; hashable, for it is static under jit."""

    @property
    def travels(self) -> bool:
        """Whether it reads travel fields where the ground is blocked."""
        ...

    @property
    def prefers(self) -> bool:
        """Whether it takes a preference from time to effort."""
        ...

    def slots(self, num_targets: int) -> int:
        """Target slots that it likes best; sizes between them need no compiling of their own."""
        ...

    def begin(self, episodes: int, num_agents: int) -> Any:
        """Empty memory; every array in it begins with the axis E."""
        ...

    def logits(self, params: Any, memory: Any, states: State, fields: Array | None,
               horizon: Array, preference: Array) -> tuple[Any, Array]:
        """(memory, [E, N, 5] logits) at a moment of each episode.

        `fields` [E, L, M, H, W] are the steps to each target as in `grid.travel`, None on open
        maps; `horizon` and `preference` are [E].
        """
        ...

    def misfit(self, mission: Mission) -> str:
        """Why it cannot serve this mission; empty if it can."""
        ...


@dataclass(frozen=True)
class RecurrentBrain:
    """The paper's network: one team size, one number of targets, one map."""

    spec: RecurrentSpec
    travels = False
    prefers = False

    def slots(self, num_targets: int) -> int:
        """Exactly those there are."""
        return num_targets

    def begin(self, episodes: int, num_agents: int) -> Array:
        """[E, N, H] zeros."""
        return recurrent.zeros(self.spec, episodes * num_agents).reshape(
            episodes, num_agents, -1)

    def logits(self, params: Any, memory: Array, states: State, fields: Array | None,
               horizon: Array, preference: Array) -> tuple[Array, Array]:
        """See `Brain`; fields, horizon and preference are not among what it observes."""
        del fields, horizon, preference
        config = EnvConfig(normalize_positions=self.spec.normalise)
        obs = jax.vmap(partial(observe, config))(states)  # [E, N, D]
        rows = obs.reshape(1, -1, obs.shape[-1])
        never = jnp.zeros(rows.shape[:2], bool)
        net = recurrent.actor(self.spec)
        before = memory.reshape(rows.shape[1], -1)
        result: Any = net.apply({"params": params["actor"]}, before, rows, never)
        after, out = result
        return after.reshape(memory.shape), out[0].reshape(*obs.shape[:2], -1)

    def misfit(self, mission: Mission) -> str:
        """See `Brain`."""
        spec = self.spec
        have = (len(mission.cells), len(mission.target_cells), tuple(mission.size))
        made = (spec.num_agents, spec.num_targets, tuple(spec.size))
        if have != made:
            return f"made for {_family(*made)}; this mission has {_family(*have)}"
        skills = int(max(mission.agent_skills.max(), mission.target_skills.max()))
        if skills >= 2**spec.num_skills:
            return f"made for {spec.num_skills} skills; this mission has more"
        return ""


def _family(agents: int, targets: int, size: tuple[int, ...]) -> str:
    return f"{agents} robots and {targets} targets on a map of {size[0]} x {size[1]}"


class _AnyTeam:
    """A network without memory, for any number of robots and targets and any ground."""

    travels = True
    prefers = True

    def slots(self, num_targets: int) -> int:
        """The next multiple of four; padding changes nothing."""
        return -(-num_targets // 4) * 4

    def begin(self, episodes: int, num_agents: int) -> tuple[()]:
        """Nothing."""
        del episodes, num_agents
        return ()

    def misfit(self, mission: Mission) -> str:
        """See `Brain`: everything fits."""
        del mission
        return ""


@dataclass(frozen=True)
class EntityBrain(_AnyTeam):
    """The network for any team, any targets, any ground; it has no memory."""

    spec: EntitySpec
    def logits(self, params: Any, memory: tuple[()], states: State, fields: Array | None,
               horizon: Array, preference: Array) -> tuple[tuple[()], Array]:
        """See `Brain`; what is returned are log-probabilities."""

        def look(state: State, horizon: Any, preference: Array, fields: Array | None) -> Any:
            return entity.look(state, horizon, preference, fields)

        view = jax.vmap(look)(states, horizon, preference, fields)
        return memory, entity.decide(params, self.spec, view).log_probs


_LOOSE = 0.25
"""Share of what a pointing agent weighs that its settled choice does not take; below a third, so
that one of two moves that bring it nearer outweighs staying."""


@dataclass(frozen=True)
class PointerBrain(_AnyTeam):
    """The network that points at targets, asked anew at every step; it has no memory.

    At each moment all agents are free and choose among the targets, claims settled as in
    `grid.macro.world.choose`; each target's weight is spread over the moves that shorten the way
    to it. The likeliest action is always one of the settled choice: of moves that serve it
    equally, the one that suits the other targets best. Whole plans, in which a choice is held
    until the target is solved, are made by `planners.macro` from the same network.
    """

    spec: PointerSpec
    def logits(self, params: Any, memory: tuple[()], states: State, fields: Array | None,
               horizon: Array, preference: Array) -> tuple[tuple[()], Array]:
        """See `Brain`; what is returned are log-probabilities."""

        def moment(state: State, limit: Any, fields: Array | None) -> MacroState:
            return world.reset(_by_target(state, limit, fields))

        moments = jax.vmap(moment)(states, horizon, fields)
        said = pointer.point(params, self.spec, jax.vmap(pointer.look)(moments, preference))
        weight = jax.vmap(_settled)(moments, said.logits)
        return memory, jax.vmap(_moves)(states, fields, weight)


def _settled(state: MacroState, logits: Array) -> Array:
    """[N, M + 1] what each agent weighs of the targets and of waiting, when claims are settled.

    Who waits at a target already must not count as somebody under way, for whose coming the others
    may wait: where nobody would move, nobody may wait who has a choice.
    """
    targets = logits.shape[1] - 1
    none = jnp.zeros_like(logits)
    eager = logits.at[:, targets].set(-FAR / 2)
    patient, may = world.choose(state, logits, none)
    hurried, must = world.choose(state, eager, none)
    here = state.problem.start <= 0  # [N, M]
    goes = jax.nn.one_hot(patient, targets, dtype=bool) & ~here
    still = ~jnp.any(goes)
    choice, options = jnp.where(still, hurried, patient), jnp.where(still, must, may)
    weight = jax.nn.softmax(jnp.where(options, jnp.where(still, eager, logits), -FAR), axis=-1)
    return _LOOSE * weight + (1.0 - _LOOSE) * jax.nn.one_hot(choice, targets + 1)


def _by_target(state: State, limit: Array, fields: Array | None) -> MacroProblem:
    """A moment of the world of steps, by the clock: what is left to do, everybody free."""
    problem = state.problem
    problem = replace(problem, target_mask=problem.target_mask & ~state.solved)
    start = between = None
    if fields is not None:
        spots = problem.target_cells
        ways = fields[:, :, spots[:, 1], spots[:, 0]]  # [L, M, M], from the last to the middle
        between = _steps(jnp.swapaxes(ways, 1, 2)[problem.agent_kinds])
        start = _steps(distances(problem, fields, state.cells))
    return draw.of_grid(problem, state.cells, limit, start=start, between=between)


def _steps(ways: Array) -> Array:
    """Whole steps as the macro world takes them."""
    return jnp.where(ways < UNREACHABLE, ways.astype(jnp.float32), FAR)


def _moves(state: State, fields: Array | None, weight: Array) -> Array:
    """[N, 5] log-probabilities of the moves, from the weight of each target and of waiting.

    A target's weight goes evenly to the moves that shorten the way; underfoot it means stay.
    """
    there = distances(state.problem, fields, state.cells) < 1
    toward = first_step(state.problem, fields, state.cells).astype(weight.dtype)  # [N, M, 4]
    toward = toward / jnp.maximum(jnp.sum(toward, axis=-1, keepdims=True), 1.0)
    going = jnp.einsum("nm,nma->na", weight[:, :-1], toward)
    still = weight[:, -1] + jnp.sum(jnp.where(there, weight[:, :-1], 0.0), axis=-1)
    pointed = jnp.concatenate([going, still[:, None]], axis=-1)
    return jnp.log(jnp.clip(pointed, 1e-8, 1.0))
