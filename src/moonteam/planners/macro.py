"""A pointing policy played out in the macro world: many problems, K tries of each, in one call.

What planners in steps and by the clock have in common. A problem is a `MacroProblem` of NumPy
arrays; `stacked` pads several to one of few shapes, `rollouts` plays them. All problems and tries
share a pool of fixed size; a place whose episode has ended takes the next one, so that nobody
waits for the longest. What an episode does depends on its problem, its number in the call, its
try and the seed alone.

Legend: B problems, K tries of each, E places of the pool, F episodes of a call (B * K), N agents,
M targets, S skills.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array

from moonteam import trees
from moonteam.errors import InputError
from moonteam.grid.macro import world
from moonteam.grid.macro.types import FAR, MacroProblem, MacroState
from moonteam.planners.decode import MOST_ROLLOUTS
from moonteam.policies import pointer
from moonteam.policies.brain import PointerBrain
from moonteam.policies.pointer import PointerSpec
from moonteam.policies.policy import Policy

_PLACES = 256
_PAIRS = 1 << 15  # token pairs of the pool, which is what the attention of the network holds
FEW = 8.0
"""Targets up to which all tries of a problem are as hot as asked for."""
_CHUNK = 4096  # episodes of a call, more only if one problem's tries are
_LESS = 0.125  # of the preference, where what it asks for comes too late
_AXES = {"start": "NM", "between": "NMM", "home": "NM", "home_now": "N", "has": "NS",
         "need": "MS", "either": "M", "service": "M", "after": "MM", "appears": "M",
         "shown": "M", "following": "M", "looks": "M", "unseen": "M", "coming": "",
         "middle": "M", "middle_now": "N",
         "lapses": "M", "worth": "M", "free": "N", "lost": "N", "effort": "N", "limit": "",
         "agent_mask": "N", "target_mask": "M", "unit": ""}
_PADDING = {"start": FAR, "between": FAR, "lapses": FAR, "lost": FAR}  # zero and False elsewhere


@dataclass(frozen=True)
class Rollouts:
    """The plan that every try came to. Times in s (or the tables' unit) from its time 0."""

    solved: npt.NDArray[np.bool_]  # [B, K] every target within the problem's limit
    seconds: npt.NDArray[np.float64]  # [B, K] until all are solved (and home); until it broke off
    effort: npt.NDArray[np.float64]  # [B, K] weighted s of travel
    order: npt.NDArray[np.int32]  # [B, K, N, M] decision at which it set out there; -1: never
    start: npt.NDArray[np.float64]  # [B, K, M] s, of each target's service; nan: never served
    end: npt.NDArray[np.float64]  # [B, K, M] s

    @property
    def team(self) -> npt.NDArray[np.bool_]:
        """[B, K, M, N] who serves each target; nobody where it was never served."""
        there = np.swapaxes(self.order >= 0, -1, -2)
        return there & np.isfinite(self.start)[..., None]

    def routes(self, problem: int, attempt: int = 0) -> npt.NDArray[np.int32]:
        """[N, M] each agent's targets in order, then -1; those never served are left out.

        No two agents wait for each other for ever.
        """
        order = self.order[problem, attempt]
        served = np.isfinite(self.start[problem, attempt])
        turn = np.where((order >= 0) & served, order, np.iinfo(np.int32).max)
        route = np.argsort(turn, axis=1, kind="stable").astype(np.int32)
        return np.where(np.sort(turn, axis=1) < np.iinfo(np.int32).max, route, -1)


def spec_of(policy: Policy) -> PointerSpec:
    """The network's size. Raises InputError if the policy does not point at targets."""
    if not isinstance(policy.brain, PointerBrain):
        raise InputError(policy.path, f"a network of kind {policy.source.kind} does not choose "
                         "targets; one of kind pointer is needed, such as any_team")
    return policy.brain.spec


def padded(count: int) -> int:
    """The size to which so many agents, targets or skills are padded: 1, 2, 3, 4, 6, 8, 12, .."""
    if count <= 4:
        return max(count, 1)
    half = 1 << (count - 1).bit_length() - 1
    return half * 3 // 2 if count <= half * 3 // 2 else half * 2


def stacked(problems: Sequence[MacroProblem]) -> MacroProblem:
    """[B] of problems of any sizes; NumPy arrays, padded to one of few shapes.

    Many problems are padded to the largest of them, few to a size of `padded`.
    """
    size = (lambda count: max(count, 1)) if len(problems) > 64 else padded
    shapes = [np.shape(p.has) + np.shape(p.service) for p in problems]  # N, S, M
    agents, skills, targets = (size(max(column)) for column in zip(*shapes, strict=True))
    whole = {"N": agents, "M": targets, "S": skills}

    def column(name: str) -> np.ndarray:
        axes = _AXES[name]
        first = np.asarray(getattr(problems[0], name))
        kind = np.float32 if first.dtype.kind == "f" else first.dtype
        out = np.full((len(problems), *(whole[a] for a in axes)), _PADDING.get(name, 0), kind)
        for i, one in enumerate(problems):
            value = np.asarray(getattr(one, name))
            out[(i, *(slice(length) for length in value.shape))] = value
        return out

    columns: dict[str, Any] = {name: column(name) for name in _AXES}
    return MacroProblem(**columns)


def unit_of(start: npt.NDArray, has: npt.NDArray, need: npt.NDArray) -> np.float32:
    """The unit of time of `grid.macro.draw.unit_of`, on the host; start [N, M], need [M, S]."""
    use = (has[:, None] & (need[None] > 0)).any(2) & (start < FAR)
    mean = start[use].mean() if use.any() else 1.0
    return np.float32(mean if mean > 0 else 1.0)


def rollouts(policy: Policy, problems: MacroProblem, *, tries: int = 1, heat: float = 0.0,
             cooling: bool = False, seed: int = 0, preference: float = 0.0,
             within: npt.ArrayLike = np.inf,
             tick: Callable[[int], object] = lambda episodes: None) -> Rollouts:
    """Plays every problem `tries` times from its beginning to its end.

    At every event those on their way may turn to another target, as robots that ask the policy
    anew would. Of a plan it is known beforehand who serves what in which order: in the routes that
    are returned everybody goes there at once, and times and effort are theirs.

    Args:
      policy: of kind pointer.
      problems: [B] NumPy arrays as from `stacked`.
      tries: K.
      heat: temperature at which choices are drawn, but for the first of several tries, which
        takes the likeliest; 0: all of them do.
      cooling: of a problem with more than `FEW` targets each try is cooler than the one before
        it, the more targets the cooler, see `coolest`.
      seed: of the draws.
      preference: 0 time .. 1 effort.
      within: [B] or [], s in which a try has to solve everything. What saves way may come too
        late, and then saves nothing: a problem no try of which is in time is played again with
        less of the preference, by eighths, at last for time alone.
      tick: told how many episodes have ended, now and then; not of those played again.

    Raises:
      InputError: the policy is of another kind, or that is no number of tries.
    """
    if not 1 <= tries <= MOST_ROLLOUTS:
        raise InputError("rollouts", f"{tries} is not allowed; 1 to {MOST_ROLLOUTS}")
    play = _Call.of(policy, problems, tries)

    def played(problems: MacroProblem, preference: float,
               tick: Callable[[int], object]) -> Rollouts:
        count, parts = len(problems.limit), []
        for first in range(0, count, play.rows):
            real = min(play.rows, count - first)
            done = play(problems, first, real, heat, cooling, seed, preference)
            parts.append(jax.tree.map(
                lambda x, n=real: x.reshape(play.rows, tries, *x.shape[1:])[:n], done))
            tick(real * tries)
        whole: _Done = jax.tree.map(lambda *x: np.concatenate(x), *parts)
        return _routed(problems, whole)

    found = played(problems, preference, tick)
    limit = np.broadcast_to(within, problems.limit.shape)[:, None]
    while preference > 0.0:
        late = np.flatnonzero(~(found.solved & (found.seconds <= limit)).any(1))
        if not len(late):
            break
        preference = max(preference - _LESS, 0.0)
        again = played(jax.tree.map(lambda x, at=late: x[at], problems), preference,
                       lambda episodes: None)
        for one in fields(Rollouts):
            getattr(found, one.name)[late] = getattr(again, one.name)
    return found


def warm(policy: Policy, problems: MacroProblem, tries: int = 1) -> None:
    """Compiles what `rollouts` of problems of these shapes needs, and plays nothing."""
    _Call.of(policy, problems, tries)(problems, 0, 0, 0.0, False, 0, 0.0)


@dataclass(frozen=True)
class _Call:
    """The compiled program for one shape."""

    spec: PointerSpec
    params: Any
    tries: int
    rows: int  # problems of a call
    places: int  # E

    @classmethod
    def of(cls, policy: Policy, problems: MacroProblem, tries: int) -> _Call:
        """Sizes by the memory that the pool takes."""
        spec, (count, agents, targets) = spec_of(policy), problems.start.shape
        rows = 1 << (min(count, max(1, _CHUNK // tries)) - 1).bit_length()
        places = max(1, min(_PLACES, _PAIRS // (agents + targets) ** 2, rows * tries))
        return cls(spec, policy.params, tries, rows, places)

    def __call__(self, problems: MacroProblem, first: int, real: int, heat: float, cooling: bool,
                 seed: int, preference: float) -> _Done:
        """Plays `real` problems from number `first` on; NumPy arrays."""
        index = np.minimum(np.arange(first, first + self.rows), len(problems.limit) - 1)
        done = _play(self.spec, self.params, jax.tree.map(lambda x: x[index], problems),
                     np.int32(real * self.tries), np.int32(first), np.float32(heat),
                     np.bool_(cooling), np.uint32(seed % 2**32), np.float32(preference),
                     self.tries, self.places)
        return jax.device_get(done)


class _Done(NamedTuple):
    """What the episodes did; [F], or [E] while they are under way."""

    solved: Any
    order: Any  # [., N, M] int32
    arrival: Any  # [., N, M] s at which an agent is at a target that it set out for
    served: Any  # [., M] bool


class _Pool(NamedTuple):
    episode: Array  # [E] int32; those past the last stand still
    state: MacroState  # [E]
    turn: Array  # [E] int32, decisions so far
    log: _Done  # [E]
    done: _Done  # [F]
    following: Array  # [] int32, the next episode


@partial(jax.jit, static_argnames=("spec", "tries", "places"))
def _play(spec: PointerSpec, params: Any, problems: MacroProblem, count: Array, first: Array,
          heat: Array, cooling: Array, seed: Array, preference: Array, tries: int,
          places: int) -> _Done:
    """The first `count` of the episodes [F]; `first` is the number of the first problem."""
    rows = problems.limit.shape[0]
    agents, targets = problems.start.shape[1:]
    key = jax.random.key(seed)
    likings = jnp.broadcast_to(preference, (places,))

    def blank(size: int) -> _Done:
        shape = (size, agents, targets)
        return _Done(jnp.zeros(size, bool), jnp.full(shape, -1, jnp.int32), jnp.zeros(shape),
                     jnp.zeros((size, targets), bool))

    def fresh(episode: Array) -> MacroState:
        row = jnp.minimum(episode // tries, rows - 1)
        return jax.vmap(world.reset)(jax.tree.map(lambda x: x[row], problems))

    def noise(episode: Array, turn: Array) -> Array:
        own = jax.random.fold_in(jax.random.fold_in(key, first + episode // tries),
                                 episode % tries)
        return jax.random.gumbel(jax.random.fold_in(own, turn), (agents, targets + 1))

    def decide(pool: _Pool) -> _Pool:
        state, log = pool.state, pool.log
        view = jax.vmap(pointer.look)(state, likings)
        logits = pointer.point(params, spec, view).logits
        first_try = (pool.episode % tries == 0) & (tries > 1)
        share = jnp.maximum(pool.episode % tries - 1, 0) / max(tries - 2, 1)
        warm = heat * jnp.where(cooling, coolest(state.problem.target_mask) ** share, 1.0)
        warm = jnp.where(first_try, 0.0, warm)[:, None, None]
        drawn = warm * jax.vmap(noise)(pool.episode, pool.turn)
        choice, _ = jax.vmap(world.choose)(state, logits, drawn)
        result = jax.vmap(world.step)(state, choice)
        log = _written(log, state, choice, pool.turn)
        after = jax.vmap(world.loosen)(result.state, jnp.ones(choice.shape, bool))
        turned = jax.nn.one_hot(jnp.where(after.goal != result.state.goal, result.state.goal,
                                          targets), targets, dtype=bool)
        log = log._replace(order=jnp.where(turned, -1, log.order))
        over = (result.terminated | result.truncated) & (pool.episode < count)
        log = log._replace(solved=result.terminated,
                           served=(after.solved & ~after.lapsed) | after.serving)
        at = jnp.where(over, pool.episode, rows * tries)
        done = jax.tree.map(lambda all_, own: all_.at[at].set(own, mode="drop"), pool.done, log)
        episode, following = refilled(over, pool.episode, pool.following)
        log, after = trees.where(over, (blank(places), fresh(episode)), (log, after))
        return _Pool(episode, after, jnp.where(over, 0, pool.turn + 1), log, done,
                     following)

    everyone = jnp.arange(places, dtype=jnp.int32)
    begun = _Pool(everyone, fresh(everyone), jnp.zeros(places, jnp.int32), blank(places),
                  blank(rows * tries), jnp.int32(places))
    return jax.lax.while_loop(lambda pool: jnp.any(pool.episode < count), decide, begun).done


def coolest(target_mask: Array) -> Array:
    """[...] temperature of the last of several tries, as a share of the first's; mask [..., M].

    Of few targets only hot tries are different plans, of many only cool ones are good plans.
    """
    count = jnp.maximum(jnp.sum(target_mask, axis=-1), 1)
    return jnp.clip((FEW / count) ** 2, 0.05, 1.0)


def refilled(over: Array, held: Array, following: Array) -> tuple[Array, Array]:
    """The numbers [E] that the places of a pool hold, where it is `over` [E] the next ones.

    `held` [E] int32 is what they held; `following` [] int32 the next number, before and after.
    """
    taken = following + jnp.cumsum(over) - 1
    return (jnp.where(over, taken, held).astype(jnp.int32),
            following + jnp.sum(over, dtype=jnp.int32))


def _written(log: _Done, state: MacroState, choice: Array, turn: Array) -> _Done:
    """The log with who set out, and when each will be there."""
    targets = log.served.shape[1]
    going = jax.nn.one_hot(choice, targets, dtype=bool) & jax.vmap(world.free)(state)[:, :, None]
    legs = jax.vmap(world.legs)(state.problem, state.node)
    order = jnp.where(going, turn[:, None, None], log.order)
    arrival = jnp.where(going, state.now[:, None, None] + legs, log.arrival)
    return log._replace(order=order, arrival=arrival)


def _routed(problems: MacroProblem, done: _Done) -> Rollouts:
    """Everybody straight to what it came to serve, in the order in which that began."""
    played = _times(problems, done)  # [B, K, M]
    deep = depth(np.asarray(problems.after))[:, None].astype(np.float64)
    turn = np.where(done.order >= 0, done.order, -1).max(2)
    sequence = np.lexsort((turn, np.broadcast_to(deep, played.shape), played), axis=-1)
    own = np.swapaxes(done.order >= 0, -1, -2) & np.isfinite(played)[..., None]  # [B, K, M, N]
    agents, targets = problems.start.shape[1:]
    row = np.arange(len(played))[:, None, None]
    each = np.arange(agents)[None, None]
    clock = np.broadcast_to(problems.free[:, None].astype(np.float64), (*own.shape[:2], agents))
    clock, last = clock.copy(), np.full(clock.shape, targets)
    start, end = np.full(played.shape, np.nan), np.full(played.shape, np.nan)
    effort, fits = np.zeros(clock.shape), np.ones(played.shape[:2], bool)
    for place in range(targets):
        j = sequence[..., place, None]  # [B, K, 1]
        team = np.take_along_axis(own, j[..., None], axis=2)[:, :, 0]  # [B, K, N]
        served = team.any(-1)
        leg = np.where(last == targets, problems.start[row, each, j],
                       problems.between[row, each, np.minimum(last, targets - 1), j])
        begin = np.where(team, clock + leg, 0.0).max(-1)
        begin = np.maximum(begin, problems.appears[row[..., 0], j[..., 0]])
        waits = problems.after[row[..., 0], j[..., 0]]  # [B, K, M]
        begin = np.maximum(begin, np.where(waits & np.isfinite(end), end, 0.0).max(-1))
        fits &= ~served | (begin <= problems.lapses[row[..., 0], j[..., 0]] + world.SOON)
        finish = begin + problems.service[row[..., 0], j[..., 0]]
        effort += np.where(team, leg, 0.0)
        clock, last = np.where(team, finish[..., None], clock), np.where(team, j, last)
        for times, value in ((start, begin), (end, finish)):
            np.put_along_axis(times, j, np.where(served, value, np.nan)[..., None], axis=-1)
    home = np.where(last == targets, problems.home_now[:, None],
                    problems.home[row, each, np.minimum(last, targets - 1)])
    home = np.where(problems.agent_mask[:, None], home, 0.0)
    there = np.where(problems.agent_mask[:, None], clock + home, 0.0).max(-1)
    seconds = np.maximum(there, np.nanmax(np.where(np.isfinite(end), end, 0.0), axis=-1))
    cost = ((effort + home) * problems.effort[:, None]).sum(-1)
    solved = done.solved & fits & (seconds <= problems.limit[:, None] + world.SOON)
    return Rollouts(solved, seconds, cost, done.order, start, end)


def depth(after: npt.NDArray[np.bool_]) -> npt.NDArray[np.int64]:
    """[..., M] how many targets one behind the other come before each; after [..., M, M]."""
    deep = np.zeros(after.shape[:-1], np.int64)
    for _ in range(after.shape[-1]):
        deeper = np.where(after, deep[..., None, :] + 1, 0).max(-1, initial=0)
        if (deeper <= deep).all():
            break
        deep = np.maximum(deep, deeper)
    return deep


def _times(problems: MacroProblem, done: _Done) -> npt.NDArray[np.float64]:
    """[B, K, M] when each service began as it was played, nan where it never did.

    Made anew from the arrivals, for several services may start and end between two decisions.
    """
    there = np.where(done.order >= 0, done.arrival, 0.0).astype(np.float64).max(2)
    start = np.maximum(there, problems.appears[:, None])
    service = problems.service[:, None].astype(np.float64)
    after = problems.after[:, None]  # [B, 1, M, M]
    while after.any():
        later = np.where(after, (start + service)[:, :, None], 0.0).max(-1)
        if (later <= start).all():
            break
        start = np.maximum(start, later)
    served = done.served & problems.target_mask[:, None]
    return np.where(served, start, np.nan)
