"""One network for every team by the clock: who is free points at its next target.

Every agent and every target is a token; masked self-attention mixes them, its logits biased by
what each pair is to each other. What it sees are times and relations, never places, names of
skills or units: it is the same for a map turned or mirrored, for skills renamed, for seconds or
steps. So the same weights serve the grid (a cell a step), the ground (seconds of each kind over
slopes) and the instances of others.

Decentralised reading: all that goes in is known to all robots (positions, goals, targets); each
free robot computes the pass and takes its own row. The value, from the same tokens, is used in
training alone.

Legend: B batch, N agents, M targets, E = N + M tokens, S skills, D width, K heads.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, cast

import jax
import jax.numpy as jnp
from flax import linen as nn
from jax import Array

from moonteam.grid.macro import world
from moonteam.grid.macro.types import FAR, LONG, MacroState
from moonteam.policies import attention


@dataclass(frozen=True)
class PointerSpec:
    """Size of the network; teams and targets of any number fit all of them."""

    width: int = 64
    """D, features of a token."""
    heads: int = 4
    """K, attention heads; divides the width."""
    layers: int = 3
    """Attention blocks."""
    pairs: int = 32
    """Features of a pair of tokens."""
    unfolds: bool = False
    """Sees how many targets are still to come, and how far everything is from where they may."""

    worths: bool = False
    """Sees what it counts to serve each target, where targets may lapse."""
    posts: bool = False
    """May send who has nothing to do to one of a few places to wait at."""

    def check(self, source: object) -> None:
        """Raises InputError if the numbers make no network."""
        attention.check_sizes(source, self.width, self.heads, self.layers, self.pairs)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Outlook:
    """What the network sees of one moment; any leading batch axes, here written [B].

    Times are in units of the moment: about 1 for a usual way.
    """

    agents: Array  # [B, N] bool, in the team
    targets: Array  # [B, M] bool, known and lacking somebody
    free: Array  # [B, N] bool, chooses now
    spare: Array  # [B, N] time until it is free, if it is bound
    slow: Array  # [B, N] log of its time between targets over the quickest's
    travel: Array  # [B, N, M] time until it could be at the target; LONG: never
    between: Array  # [B, M, M] time between targets, by the quickest
    goal: Array  # [B, N, M] bool, bound to the target
    has: Array  # [B, N, S] bool
    lacks: Array  # [B, M, S] agents missing of each skill
    either: Array  # [B, M] bool, any of them will do
    service: Array  # [B, M] time
    ready: Array  # [B, M] time before which it cannot start
    left: Array  # [B, M] time until it lapses; LONG: never
    after: Array  # [B, M, M] bool, after[j, k]: j waits for k
    home: Array  # [B, N, M] time from the target home
    preference: Array  # [B] 0 time .. 1 effort
    ahead: Array | None = None
    """[B, E, 3] log of how many come (0 of places to look from), time to where, both at once (of
    places to look from the share not seen)."""
    worth: Array | None = None  # [B, M] what serving it counts; 0: it has to be served


def look(state: MacroState, preference: Array) -> Outlook:
    """One moment of the macro world as the network sees it (vmap it over episodes)."""
    p = state.problem
    targets = p.start.shape[1]
    lacks = world.missing(p, state.goal)
    incomplete = jnp.any(lacks > 0, axis=1)
    shown = world.known(state)
    open_ = world.open_targets(state) & (incomplete | world.posts(p))
    bound = state.goal < targets
    here = jnp.minimum(state.goal, targets - 1)
    legs = world.legs(p, state.node)
    goal = jax.nn.one_hot(state.goal, targets, dtype=bool)
    ready = jnp.maximum(p.appears - state.now, 0.0)
    # A coalition meets when its last is there; of those still missing, at the soonest of the rest.
    arrive = jnp.max(jnp.where(goal, state.busy[:, None], 0.0), axis=0)  # [M]
    loose = p.agent_mask & ~(bound & incomplete[here])
    come = jnp.where(loose[:, None], state.busy[:, None] + legs, FAR)  # [N, M]
    soonest = together(jnp.where(p.has[:, None], come[:, :, None], FAR), lacks, FAR)
    soonest = jnp.where(lacks > 0, soonest, 0.0)  # [M, S]
    soonest = jnp.where(p.either, jnp.min(jnp.where(lacks > 0, soonest, FAR), axis=1),
                        jnp.max(soonest, axis=1))
    soonest = jnp.where(incomplete, jnp.where(soonest < FAR, soonest, 0.0), 0.0)
    meet = jnp.maximum(jnp.maximum(arrive, soonest), ready)
    ends = jnp.where(state.serving, 0.0, meet + p.service)
    spare = jnp.where(bound, jnp.where(state.serving[here], state.busy, ends[here]), state.busy)
    travel = jnp.where(goal & ~state.serving[None], state.busy[:, None], spare[:, None] + legs)
    best = jnp.min(jnp.where(p.agent_mask[:, None, None], p.between, FAR), axis=0)
    known = open_[:, None] & open_[None] & (best > 0) & (best < FAR)
    ways = jnp.where(known[None] & (p.between < FAR), p.between, 0.0)
    ratio = jnp.sum(ways, axis=(1, 2)) / jnp.maximum(jnp.sum(jnp.where(ways > 0, best[None], 0.0),
                                                             axis=(1, 2)), 1e-6)
    first = jnp.where(open_[None] & (p.start < FAR), p.start, FAR)
    plain = jnp.min(first, axis=0)
    alone = jnp.sum(jnp.where(first < FAR, p.start, 0.0), 1) / jnp.maximum(
        jnp.sum(jnp.where(first < FAR, plain[None], 0.0), 1), 1e-6)
    slow = jnp.log(jnp.clip(jnp.where(ratio > 0, ratio, alone), 0.05, 20.0))
    waits = p.after & ~state.solved[None]
    busy = state.serving | (shown & ~incomplete)  # under way
    under = jnp.max(jnp.where(state.serving[None] & goal, state.busy[:, None], 0.0), axis=0)
    under = jnp.where(state.serving, under, ends)
    ready = jnp.maximum(ready, jnp.max(jnp.where(waits & busy[None], under[None], 0.0), axis=1))

    def norm(times: Array) -> Array:
        return jnp.minimum(times / p.unit, LONG)

    return Outlook(
        agents=p.agent_mask, targets=open_, free=world.free(state), spare=norm(spare), slow=slow,
        travel=norm(travel), between=norm(best), goal=goal, has=p.has, lacks=lacks,
        either=p.either, service=norm(p.service), ready=norm(ready),
        left=norm(jnp.maximum(p.lapses - state.now, 0.0)), after=waits, home=norm(p.home),
        preference=preference, ahead=_ahead(state), worth=p.worth)


def together(times: Array, count: Array, never: float) -> Array:
    """[..., M, S] when `count` [..., M, S] of the agents are there, at `times` [..., N, M, S]; the
    first of them where the count is 0, `never` where they are too few.
    """
    there = jnp.sum(times[..., None, :, :, :] <= times[..., :, None, :, :], axis=-3)
    return jnp.min(jnp.where(there >= count[..., None, :, :], times, never), axis=-3)


def _ahead(state: MacroState) -> Array:
    """[E, 3] what of the future concerns each token; all 0 where nothing more comes."""
    p = state.problem
    count = jnp.log1p(world.coming(state).astype(jnp.float32))
    looks = jnp.concatenate([jnp.zeros_like(p.agent_mask), p.looks])
    agents = jnp.where(p.agent_mask, world.middle_of(state, state.node), 0.0)
    far = jnp.concatenate([agents, jnp.where(p.target_mask, p.middle, 0.0)]) / p.unit
    far = jnp.where(count > 0, jnp.minimum(far, LONG), 0.0)
    count = jnp.where(looks, 0.0, count)  # by which places to look from are told from targets
    unseen = jnp.concatenate([jnp.zeros(p.agent_mask.shape), p.unseen])
    return jnp.stack([count, far, jnp.where(looks, unseen, count * far)], axis=-1)


def _token_features(view: Outlook) -> tuple[Array, Array]:
    """[B, N, .] and [B, M, .] features of each entity by itself."""
    has = (view.has & view.agents[..., None]).astype(jnp.float32)
    asks = view.lacks * view.targets[..., None]
    supply = jnp.sum(has, axis=-2)  # [B, S]
    demand = jnp.sum(asks, axis=-2).astype(jnp.float32)
    scarce = demand / jnp.maximum(supply, 1.0)
    brings = jnp.any((view.lacks[..., None, :, :] > 0) & view.has[..., :, None, :], axis=-1)
    can = brings & view.targets[..., None, :] & view.agents[..., :, None] & (view.travel < LONG)
    reach = jnp.where(can, view.travel, LONG)
    near = jnp.min(reach, axis=-2)  # [B, M]
    second = jnp.min(jnp.where(reach > near[..., None, :], reach, LONG), axis=-2)
    each = together(jnp.where(view.has[..., :, None, :] & view.agents[..., :, None, None],
                              view.travel[..., None], LONG), view.lacks, LONG)  # [B, M, S]
    meet = jnp.max(jnp.where(view.lacks > 0, each, 0.0), axis=-1)
    meet = jnp.where(view.either, near, meet) * view.targets
    moment = jnp.stack([
        jnp.log1p(jnp.sum(view.agents, -1)), jnp.log1p(jnp.sum(view.targets, -1)),
        jnp.log1p(jnp.sum(can, axis=(-1, -2))), view.preference,
        jnp.max(meet, axis=-1), jnp.sum(meet, axis=-1) / 8.0,
        jnp.max(jnp.where(view.agents, view.spare, 0.0), axis=-1)], axis=-1)

    def with_moment(*parts: Array) -> Array:
        spread = (*moment.shape[:-1], parts[0].shape[-1], moment.shape[-1])
        shared = jnp.broadcast_to(moment[..., None, :], spread)
        return jnp.concatenate([jnp.stack(parts, axis=-1), shared], axis=-1)

    agents = with_moment(
        view.slow, view.spare, view.free.astype(jnp.float32),
        jnp.any(view.goal, -1).astype(jnp.float32), jnp.min(reach, axis=-1),
        jnp.log1p(jnp.sum(can, axis=-1)), jnp.sum(has, -1) / 2.0,
        jnp.log1p(jnp.sum(has * scarce[..., None, :], -1)),
        jnp.max(has * scarce[..., None, :], -1))
    wanted = view.lacks.astype(jnp.float32)
    started = jnp.any(view.goal & view.agents[..., None], axis=-2)
    targets = with_moment(
        jnp.sum(wanted, -1) / 2.0, jnp.sum(wanted > 0, -1) / 2.0, view.either.astype(jnp.float32),
        near, second, meet, jnp.log1p(jnp.sum(can, axis=-2)), view.service, view.ready,
        started.astype(jnp.float32), jnp.exp(-view.left), jnp.exp(-view.left / 4.0),
        jnp.log1p(jnp.sum(view.after & view.targets[..., None, :], -1)),
        jnp.log1p(jnp.sum(view.after & view.targets[..., :, None], -2)),
        jnp.sum(jnp.where(wanted > 0, scarce[..., None, :], 0.0), -1))
    return agents, targets


def _worth_features(view: Outlook) -> Array:
    """[B, M, 4] what each target counts, by itself, beside the most of any, and by time left."""
    assert view.worth is not None
    worth = jnp.where(view.targets, view.worth, 0.0)
    most = jnp.maximum(jnp.max(worth, axis=-1, keepdims=True), 1e-6)
    return jnp.stack([jnp.log1p(worth), worth / most, (worth > 0).astype(jnp.float32),
                      worth / most * jnp.exp(-view.left)], axis=-1)


def _pair_features(view: Outlook) -> Array:
    """[B, E, E, F] what token j is to token i."""
    has = view.has.astype(jnp.float32)
    asks = (view.lacks > 0).astype(jnp.float32)
    aa = has @ jnp.swapaxes(has, -1, -2)
    am = has @ jnp.swapaxes(asks, -1, -2)  # [B, N, M]
    mm = asks @ jnp.swapaxes(asks, -1, -2)
    size = jnp.sum(asks, -1)
    left = jnp.where(view.either[..., None, :], 0.0, size[..., None, :] - am)
    covers = ((am > 0) & (left <= 0)).astype(jnp.float32)
    none = jnp.zeros_like(aa)

    def whole(a: Array, b: Array, c: Array, d: Array) -> Array:
        return jnp.concatenate([jnp.concatenate([a, b], -1), jnp.concatenate([c, d], -1)], -2)

    def swap(x: Array) -> Array:
        return jnp.swapaxes(x, -1, -2)

    travel = whole(none, view.travel, swap(view.travel), view.between)
    goal, after = view.goal.astype(jnp.float32), view.after.astype(jnp.float32)
    same = (jnp.sum(goal[..., :, None, :] * goal[..., None, :, :], -1))
    return jnp.stack([
        travel, jnp.log1p(4.0 * travel), jnp.exp(-2.0 * travel), jnp.exp(-8.0 * travel),
        whole(aa, am, swap(am), mm), whole(none, covers, swap(covers), jnp.zeros_like(mm)),
        whole(same, goal, swap(goal), after), whole(none, view.home, swap(view.home), swap(after)),
    ], axis=-1)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Pointed:
    """What the network says of one moment."""

    logits: Array  # [B, N, M + 1] each target, then waiting
    value: Array  # [B] expected return of the team, in units of the moment


class Pointer(nn.Module):
    """Outlook -> each agent's logits over the targets, and the team's value."""

    spec: PointerSpec = PointerSpec()

    @nn.compact
    def __call__(self, view: Outlook) -> Pointed:
        """Any number of agents and targets, any leading batch axes."""
        spec = self.spec
        agents, targets = _token_features(view)
        n = agents.shape[-2]
        x = jnp.concatenate([nn.Dense(spec.width, name="agent")(agents),
                             nn.Dense(spec.width, name="target")(targets)], axis=-2)
        if spec.unfolds:  # zeros at first: it begins as what it was before it saw that
            assert view.ahead is not None
            x = x + nn.Dense(spec.width, use_bias=False, name="ahead",
                             kernel_init=nn.initializers.zeros)(view.ahead)
        if spec.worths:
            assert view.worth is not None
            worth = nn.Dense(spec.width, use_bias=False, name="worth",
                             kernel_init=nn.initializers.zeros)(_worth_features(view))
            x = x + jnp.pad(worth, [(0, 0)] * (x.ndim - 2) + [(n, 0), (0, 0)])
        mask = jnp.concatenate([view.agents, view.targets], axis=-1)
        pairs = nn.gelu(nn.Dense(spec.pairs, name="pairs")(_pair_features(view)))
        x = attention.attend(x, pairs, mask, n, spec.layers, spec.heads)
        logits = jnp.concatenate(attention.point(x, pairs, n), axis=-1)
        return Pointed(logits, self._value(x, mask))

    def _value(self, x: Array, mask: Array) -> Array:
        real = mask[..., None]
        mean = jnp.sum(jnp.where(real, x, 0.0), axis=-2) / jnp.maximum(jnp.sum(real, -2), 1)
        most = jnp.max(jnp.where(real, x, -FAR), axis=-2)
        most = jnp.where(jnp.any(real, -2), most, 0.0)
        pooled = nn.gelu(nn.Dense(self.spec.width, name="pool")(jnp.concatenate([mean, most], -1)))
        return nn.Dense(1, name="value")(pooled)[..., 0]


def point(params: Any, spec: PointerSpec, view: Outlook) -> Pointed:
    """The network's word on a batch of moments; `params` as from `init`."""
    return cast(Pointed, Pointer(spec).apply({"params": params}, view))


def grafted(spec: PointerSpec, params: Any) -> Any:
    """Parameters of a network that does not see what is to come, or what targets are worth, for one
    that does: it begins as the same policy.
    """
    fresh = init(spec, jax.random.key(0))
    return {**{name: fresh[name] for name in ("ahead", "worth") if name in fresh}, **params}


def deepened(spec: PointerSpec, params: Any, layers: int) -> Any:
    """Parameters of a network with more blocks, the new ones last: it begins as the same policy."""
    fresh = init(replace(spec, layers=layers), jax.random.key(0))
    out = {**fresh, **params}
    for name, own in fresh.items():
        if name.startswith("bias_"):
            out[name] = jax.tree.map(lambda new, old: jnp.zeros_like(new).at[
                ..., :old.shape[-1]].set(old), own, params[name])
        elif name.startswith("block") and name not in params:
            out[name] = {part: jax.tree.map(jnp.zeros_like, value) if part in ("out", "down")
                         else value for part, value in own.items()}
    return out


def init(spec: PointerSpec, key: Array) -> Any:
    """Fresh parameters; their shapes hold for teams of any size."""
    flag, number = jnp.zeros(2, bool), jnp.zeros(2)
    square = jnp.zeros((2, 2))
    view = Outlook(
        agents=~flag, targets=~flag, free=~flag, spare=number, slow=number, travel=square,
        between=square, goal=square > 0, has=square > 0, lacks=square, either=flag, service=number,
        ready=number, left=number, after=square > 0, home=square, preference=jnp.zeros(()),
        ahead=jnp.zeros((4, 3)), worth=number)
    return Pointer(spec).init(key, view)["params"]
