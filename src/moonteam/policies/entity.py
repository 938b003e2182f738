"""One network for any team, any targets, any ground.

Every agent and every target is a token; masked self-attention mixes them, its logits biased
by what each pair is to each other (displacement, travel distance, shared skills). A pointer
head then asks of each agent: which open target, or stay? Its five action probabilities are
the mixture of the moves that shorten the way to the targets pointed at, plus a small free
term that no target explains.

Decentralised reading: everything here is computed from positions, skills, targets and travel
distances that all robots share; a robot that knows them computes the whole forward pass and
takes its own row. No message beyond the shared observation is needed, and no memory.

Legend: B batch, N agents, M targets, E = N + M tokens, S skill bits, D width, K heads.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import jax
import jax.numpy as jnp
from flax import linen as nn
from jax import Array

from moonteam.errors import InputError
from moonteam.grid.env import available
from moonteam.grid.travel import distances, first_step
from moonteam.grid.types import Problem, State
from moonteam.policies import attention
from moonteam.policies.attention import FAR
from moonteam.problem.rules import NUM_ACTIONS, STAY, UNREACHABLE
from moonteam.problem.scenario import MAX_SKILLS


@dataclass(frozen=True)
class EntitySpec:
    """Size of the network; teams, targets and maps of any size fit all of them."""

    width: int = 64
    """D, features of a token."""
    heads: int = 4
    """K, attention heads; divides the width."""
    layers: int = 3
    """Attention blocks."""
    free: float = 0.02
    """Share of the action probabilities that the free term may take."""

    def check(self, source: object) -> None:
        """Raises InputError if the numbers make no network."""
        attention.check_sizes(source, self.width, self.heads, self.layers)
        if not 0 <= self.free <= 1:
            raise InputError(source, f"free ({self.free}) is a share, 0 to 1")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Entities:
    """What the network sees of one moment; any leading batch axes, here written [B].

    Distances of `problem.rules.UNREACHABLE` or more mean out of reach.
    """

    agent_cells: Array  # [B, N, 2] cells
    agent_skills: Array  # [B, N] bitmask
    agent_mask: Array  # [B, N] bool, in the team
    target_cells: Array  # [B, M, 2] cells
    target_skills: Array  # [B, M] bitmask
    target_and: Array  # [B, M] bool
    target_open: Array  # [B, M] bool, real and not solved
    travel: Array  # [B, N, M] steps from agent to target by the agent's kind
    between: Array  # [B, M, M] steps between targets by the best kind
    toward: Array  # [B, N, M, 4] bool, moves that shorten the way
    allowed: Array  # [B, N, 4] bool, moves that do not run into the border or blocked ground
    time_left: Array  # [B] steps until the episode ends
    preference: Array  # [B] 0 time .. 1 effort


def _bits(mask: Array) -> Array:
    """[...] bitmask -> [..., S] floats."""
    shifts = jnp.arange(MAX_SKILLS).reshape((1,) * mask.ndim + (MAX_SKILLS,))
    return ((mask[..., None] >> shifts) & 1).astype(jnp.float32)


def usable(view: Entities) -> Array:
    """[B, N, M] bool: the agent shares a skill with the open target and can get there."""
    share = (view.agent_skills[..., :, None] & view.target_skills[..., None, :]) != 0
    there = view.target_open[..., None, :] & view.agent_mask[..., :, None]
    return share & there & (view.travel < UNREACHABLE)


def _token_features(view: Entities) -> tuple[Array, Array]:
    """[B, N, .] and [B, M, .] features of each entity by itself."""
    agent = _bits(view.agent_skills)
    need = _bits(view.target_skills)
    count = jnp.sum(agent * view.agent_mask[..., None], axis=-2)  # [B, S] robots with the skill
    open_now = view.target_open[..., None]
    demand = jnp.sum(need * open_now, axis=-2)  # [B, S] open targets asking for it
    moment = jnp.stack([
        view.time_left / 128.0, view.preference,
        jnp.sum(view.agent_mask, -1) / 4.0, jnp.sum(view.target_open, -1) / 8.0,
    ], axis=-1)

    def with_moment(*parts: Array) -> Array:
        rows = parts[0].shape[-2]
        shared = jnp.concatenate([count / 4.0, demand / 8.0, moment], axis=-1)
        spread = (*shared.shape[:-1], rows, shared.shape[-1])
        shared = jnp.broadcast_to(shared[..., None, :], spread)
        return jnp.concatenate([*parts, shared], axis=-1)

    need_kind = view.target_and[..., None].astype(jnp.float32)
    # How well the team covers a target: how many can serve it, how near the nearest is.
    can = usable(view)
    near = jnp.min(jnp.where(can, view.travel, 256.0), axis=-2) / 32.0
    helpers = jnp.sum(can, axis=-2) / 4.0
    reach = jnp.min(jnp.where(can, view.travel, 256.0), axis=-1) / 32.0
    choices = jnp.sum(can, axis=-1) / 8.0
    return (with_moment(agent, reach[..., None], choices[..., None]),
            with_moment(need, need_kind, need * need_kind, near[..., None], helpers[..., None]))


def _pair_features(view: Entities) -> Array:
    """[B, E, E, F] what token j is to token i."""
    cells = jnp.concatenate([view.agent_cells, view.target_cells], axis=-2).astype(jnp.float32)
    shift = (cells[..., None, :, :] - cells[..., :, None, :]) / 16.0
    skills = _bits(jnp.concatenate([view.agent_skills, view.target_skills], axis=-1))
    shared = skills @ jnp.swapaxes(skills, -1, -2)
    covers = (shared >= jnp.sum(skills, -1)[..., None, :]).astype(jnp.float32)
    flat = 16.0 * jnp.sum(jnp.abs(shift), -1)
    n = view.agent_cells.shape[-2]
    across = jnp.where(view.travel < UNREACHABLE, view.travel, 256.0)
    top = jnp.concatenate([flat[..., :n, :n], across], axis=-1)
    inner = jnp.where(view.between < UNREACHABLE, view.between, 256.0)
    low = jnp.concatenate([jnp.swapaxes(across, -1, -2), inner], axis=-1)
    travel = jnp.concatenate([top, low], axis=-2)
    return jnp.concatenate([
        shift, jnp.abs(shift),
        jnp.stack([travel / 16.0, jnp.log1p(travel), jnp.exp(-travel / 4.0),
                   (travel < 0.5).astype(jnp.float32), shared, covers], axis=-1)], axis=-1)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Decision:
    """What the network says of one moment."""

    pointer: Array  # [B, N, M + 1] logits: each target, then stay
    log_probs: Array  # [B, N, 5] of the grid actions
    value: Array  # [B] expected return of the team (trained by refinement alone)


class Entity(nn.Module):
    """Entities -> pointer logits, action log-probabilities and the team's value."""

    spec: EntitySpec = EntitySpec()
    together: bool = True  # actions respect the claims of `agree`; the pointer stays as it is

    @nn.compact
    def __call__(self, view: Entities) -> Decision:
        """Any number of agents and targets, any leading batch axes."""
        spec = self.spec
        agents, targets = _token_features(view)
        n = agents.shape[-2]
        x = jnp.concatenate([nn.Dense(spec.width, name="agent")(agents),
                             nn.Dense(spec.width, name="target")(targets)], axis=-2)
        mask = jnp.concatenate([view.agent_mask, view.target_open], axis=-1)
        pairs = nn.gelu(nn.Dense(32, name="pairs")(_pair_features(view)))
        x = attention.attend(x, pairs, mask, n, spec.layers, spec.heads)
        logits, stay = attention.point(x, pairs, n)
        pointer = jnp.concatenate([jnp.where(usable(view), logits, -FAR), stay], axis=-1)
        free = nn.Dense(NUM_ACTIONS, name="free")(x[..., :n, :])
        acting = agree(pointer, view) if self.together else pointer
        return Decision(pointer, mix(acting, free, view, spec.free), self._value(x, mask))

    def _value(self, x: Array, mask: Array) -> Array:
        real = mask[..., None].astype(x.dtype)
        mean = jnp.sum(x * real, axis=-2) / jnp.maximum(jnp.sum(real, axis=-2), 1.0)
        pooled = nn.gelu(nn.Dense(self.spec.width, name="pool")(mean))
        return nn.Dense(1, name="value")(pooled)[..., 0]


def decide(params: Any, spec: EntitySpec, view: Entities, together: bool = True) -> Decision:
    """The network's word on a batch of moments; `params` as from `init`.

    `together`: actions are those left when claims are settled, see `agree`.
    """
    return cast(Decision, Entity(spec, together).apply({"params": params}, view))


def agree(pointer: Array, view: Entities) -> Array:
    """Pointer logits [B, N, M + 1] without the targets that others have claimed.

    The network decides for all agents at once, so two of them may set out for a target that
    needs one. Everybody knows everybody's logits; so the surest agent takes its first choice,
    then the surest of the others among what is left, and so on. An OR target is closed once
    claimed; an AND target to agents that bring none of the skills still missing there.
    """
    agents = pointer.shape[-2]
    everyone = jnp.arange(agents)

    def claim(at: tuple[Array, Array, Array], _: None) -> tuple[tuple, None]:
        logits, missing, waiting = at
        sure = jnp.max(jax.nn.log_softmax(logits, axis=-1), axis=-1)  # [..., N]
        turn = jnp.argmax(jnp.where(waiting, sure, -2.0 * FAR), axis=-1)
        mine = everyone.reshape((1,) * turn.ndim + (agents,)) == turn[..., None]  # [..., N]
        row = jnp.sum(jnp.where(mine[..., None], logits, 0.0), axis=-2)
        choice = jax.nn.one_hot(jnp.argmax(row, axis=-1), row.shape[-1], dtype=bool)[..., :-1]
        skills = jnp.sum(jnp.where(mine, view.agent_skills, 0), axis=-1, dtype=jnp.int32)
        left = jnp.where(view.target_and, missing & ~skills[..., None], 0)
        missing = jnp.where(choice, left, missing)  # [..., M]
        waiting = waiting & ~mine
        shut = (view.agent_skills[..., :, None] & missing[..., None, :]) == 0  # [..., N, M]
        shut = shut & waiting[..., None]
        closed = jnp.where(shut, -FAR, logits[..., :-1])
        return (jnp.concatenate([closed, logits[..., -1:]], axis=-1), missing, waiting), None

    start = (pointer, view.target_skills, view.agent_mask)
    return jax.lax.scan(claim, start, None, agents)[0][0]


def init(spec: EntitySpec, key: Array) -> Any:
    """Fresh parameters; their shapes hold for teams of any size."""
    pair, spots = jnp.zeros(2, jnp.int32), jnp.zeros((2, 2), jnp.int32)
    problem = Problem(size=jnp.full(2, 8), agent_skills=pair, agent_kinds=pair,
                      agent_mask=pair == 0, target_cells=spots, target_skills=pair,
                      target_and=pair == 1, target_mask=pair == 0)
    state = State(problem, spots, pair == 1, jnp.zeros((), jnp.int32))
    return Entity(spec).init(key, look(state, 1, jnp.zeros(())))["params"]


def mix(pointer: Array, free: Array, view: Entities, share: float) -> Array:
    """[B, N, 5] log-probabilities of the grid actions from pointer and free logits.

    Each target's weight is spread evenly over the moves that shorten the way to it; a target
    underfoot means stay.
    """
    weight = jax.nn.softmax(pointer, axis=-1)
    there = view.travel < 0.5
    moves = view.toward.astype(weight.dtype)  # [B, N, M, 4]
    moves = moves / jnp.maximum(jnp.sum(moves, axis=-1, keepdims=True), 1.0)
    going = jnp.einsum("...nm,...nma->...na", weight[..., :-1], moves)
    still = weight[..., -1] + jnp.sum(jnp.where(there, weight[..., :-1], 0.0), axis=-1)
    pointed = jnp.concatenate([going, still[..., None]], axis=-1)
    open_moves = jnp.concatenate([view.allowed, jnp.ones_like(view.allowed[..., :1])], axis=-1)
    loose = jax.nn.softmax(jnp.where(open_moves, free, -FAR), axis=-1)
    return jnp.log(jnp.clip((1.0 - share) * pointed + share * loose, 1e-8, 1.0))


def look(state: State, max_steps: int, preference: Array, fields: Array | None = None) -> Entities:
    """One moment of the grid env as the network sees it (vmap it over environments).

    Args:
      state: one state of `grid.env`.
      max_steps: horizon of the episode.
      preference: [] 0 time .. 1 effort.
      fields: [K, M, H, W] from `grid.travel.problem_fields`, needed where
        the map has blocked cells; None on an open map, where steps are |dx| + |dy|.
    """
    problem, cells = state.problem, state.cells
    spots = problem.target_cells
    if fields is None:
        apart = jnp.sum(jnp.abs(spots[None, :, :] - spots[:, None, :]), axis=-1)
    else:
        apart = jnp.min(fields[:, :, spots[:, 1], spots[:, 0]], axis=0)
    return Entities(
        agent_cells=cells, agent_skills=problem.agent_skills, agent_mask=problem.agent_mask,
        target_cells=spots, target_skills=problem.target_skills,
        target_and=problem.target_and, target_open=problem.target_mask & ~state.solved,
        travel=distances(problem, fields, cells).astype(jnp.float32),
        between=apart.astype(jnp.float32), toward=first_step(problem, fields, cells),
        allowed=available(state)[:, :STAY],
        time_left=(max_steps - state.step).astype(jnp.float32), preference=preference)
