"""A trained policy as a planner: decides each joint action, or rolls out whole plans.

Legend: E episodes of a batch, N agents, M targets, K rollouts, W columns, H rows (of the map)
or units (of memory), L kinds of robots.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from jax import Array

from moonteam.errors import InputError
from moonteam.grid import env
from moonteam.grid.config import EnvConfig
from moonteam.grid.observe import observe
from moonteam.grid.types import Problem, State
from moonteam.planners import simulate
from moonteam.planners.base import SAMPLING, IntArray, Objective, Plan, Snapshot
from moonteam.planners.plans.routes import Certificate, infeasible, plan_of_trace
from moonteam.planners.search.travel import UNREACHABLE, distance_fields
from moonteam.policies import entity, policy_file, recurrent
from moonteam.policies.entity import EntitySpec
from moonteam.policies.recurrent import RecurrentSpec

Decode = Literal["argmax", "sample"]


class Brain(Protocol):
    """A network as it decides for a batch of episodes; hashable, for it is static under jit."""

    @property
    def travels(self) -> bool:
        """Whether it reads travel fields where the ground is blocked."""
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

    def misfit(self, snapshot: Snapshot) -> str:
        """Why it cannot serve this mission; empty if it can."""
        ...


@dataclass(frozen=True)
class RecurrentBrain:
    """The paper's network: one team size, one number of targets, one map."""

    spec: RecurrentSpec
    travels = False

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

    def misfit(self, snapshot: Snapshot) -> str:
        """See `Brain`."""
        spec = self.spec
        have = (len(snapshot.cells), len(snapshot.target_cells), tuple(snapshot.size))
        made = (spec.num_agents, spec.num_targets, tuple(spec.size))
        if have != made:
            return f"made for {_family(*made)}; this mission has {_family(*have)}"
        skills = int(max(snapshot.agent_skills.max(), snapshot.target_skills.max()))
        if skills >= 2**spec.num_skills:
            return f"made for {spec.num_skills} skills; this mission has more"
        return ""


def _family(agents: int, targets: int, size: tuple[int, ...]) -> str:
    return f"{agents} robots and {targets} targets on a map of {size[0]} x {size[1]}"


@dataclass(frozen=True)
class EntityBrain:
    """The network for any team, any targets, any ground; it has no memory."""

    spec: EntitySpec
    travels = True

    def slots(self, num_targets: int) -> int:
        """The next multiple of four; padding changes nothing."""
        return -(-num_targets // 4) * 4

    def begin(self, episodes: int, num_agents: int) -> tuple[()]:
        """Nothing."""
        del episodes, num_agents
        return ()

    def logits(self, params: Any, memory: tuple[()], states: State, fields: Array | None,
               horizon: Array, preference: Array) -> tuple[tuple[()], Array]:
        """See `Brain`; what is returned are log-probabilities."""

        def look(state: State, horizon: Any, preference: Array, fields: Array | None) -> Any:
            return entity.look(state, horizon, preference, fields)

        view = jax.vmap(look)(states, horizon, preference, fields)
        return memory, entity.decide(params, self.spec, view).log_probs

    def misfit(self, snapshot: Snapshot) -> str:
        """See `Brain`: everything fits."""
        del snapshot
        return ""


@dataclass(frozen=True)
class Policy:
    """A policy file, ready to act."""

    brain: Brain
    params: Any
    source: policy_file.PolicyFile
    path: str

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Policy:
        """Reads a policy file. Raises InputError if it is none, or its parts do not fit."""
        stored = policy_file.load_policy(path)
        kinds: dict[str, Any] = {"recurrent": (RecurrentSpec, RecurrentBrain, recurrent.init),
                                 "entity": (EntitySpec, EntityBrain, entity.init)}
        if stored.kind not in kinds:
            raise InputError(path, f"network kind {stored.kind!r} is not one of "
                             + ", ".join(kinds))
        spec_type, brain_type, init = kinds[stored.kind]
        try:
            spec = msgspec.convert(stored.config, spec_type)
        except msgspec.ValidationError as error:
            raise InputError(path, f"its header describes no {stored.kind} network: "
                             f"{error}") from None
        spec.check(path)
        wanted = jax.eval_shape(partial(init, spec), jax.random.key(0))
        policy_file.check_shapes(path, stored.params, wanted)
        params = jax.tree.map(jnp.asarray, stored.params)
        return cls(brain_type(spec), params, stored, str(path))

    def check(self, snapshot: Snapshot) -> None:
        """Raises InputError if the policy was made for another kind of mission."""
        problem = self.brain.misfit(snapshot)
        if problem:
            raise InputError(self.path, problem)


class LearnedPlanner:
    """A policy asked at each decision; keeps its memory between the decisions of a mission.

    Args:
      policy: see `Policy.load`; or use `LearnedPlanner.load`.
      decode: take the likeliest action of each agent, or draw one.
      temperature: logits are divided by it when drawing; `SAMPLING` if not given, and 1 for the
        watch.
      watch: argmax can circle for ever. With the watch on, when a joint state (cells and
        solved targets) comes back without a target solved in between, that decision is drawn
        instead, at `temperature` for the first return, twice that for the second and so on.
      preference: 0 time .. 1 effort, for policies that were trained with it.

    A lost robot stays and is observed as absent. Where the map has blocked cells, moves that
    would be turned back are never chosen; travel times over it are searched when the map or
    the targets change, not at each decision.
    """

    name = "policy"

    def __init__(self, policy: Policy, decode: Decode = "argmax",
                 temperature: float | None = None, watch: bool = True, preference: float = 0.0):
        if temperature is None:
            temperature = SAMPLING if decode == "sample" else 1.0
        if temperature <= 0:
            raise InputError("temperature", f"{temperature} is not allowed; above 0")
        self.policy, self.decode, self.temperature = policy, decode, temperature
        self.watch, self.preference = watch, preference
        self._begin(0)

    @classmethod
    def load(cls, path: str | os.PathLike[str], decode: Decode = "argmax",
             temperature: float | None = None, watch: bool = True,
             preference: float = 0.0) -> LearnedPlanner:
        """From a policy file. Raises InputError."""
        return cls(Policy.load(path), decode, temperature, watch, preference)

    def _begin(self, seed: int) -> None:
        self._memory: Any = None
        self._seed, self._decisions = seed, 0
        self._seen: dict[bytes, int] = {}
        self._solved = b""
        self._ground: tuple[bytes, Any] = (b"", None)
        self.rescues = 0

    def reset(self, snapshot: Snapshot, seed: int = 0) -> None:
        """Empties the memory. Raises InputError if the policy cannot serve this mission."""
        self.policy.check(snapshot)
        self._begin(seed)

    def act(self, snapshot: Snapshot) -> IntArray:
        """Joint action [N]. Raises InputError if the mission has grown out of the policy."""
        self.policy.check(snapshot)
        brain = self.policy.brain
        if self._memory is None:
            self._memory = brain.begin(1, len(snapshot.cells))
        returns = self._returns(snapshot)
        self._memory, logits = _decide(
            brain, self.policy.params, self._memory, self._state(snapshot), self._ground[1],
            np.int32(snapshot.max_steps), np.float32(self.preference))
        logits = np.asarray(logits)
        rescue = self.decode == "argmax" and self.watch and returns > 0
        self.rescues += rescue
        if rescue or self.decode == "sample":
            heat = self.temperature * (returns if rescue else 1)
            chance = np.random.default_rng([self._seed, self._decisions])
            logits = logits / heat + chance.gumbel(size=logits.shape)
        self._decisions += 1
        return np.where(snapshot.agent_mask, logits.argmax(-1), simulate.STAY).astype(np.int32)

    def _state(self, snapshot: Snapshot) -> State:
        """The snapshot in the slots of the network; searches travel times if they are new."""
        slots = self.policy.brain.slots(len(snapshot.solved))
        if snapshot.passable is not None and self.policy.brain.travels:
            posed = snapshot.target_cells.tobytes() + snapshot.passable.tobytes()
            if posed != self._ground[0]:
                self._ground = (posed, jax.device_put(_fields(snapshot, slots)))
        else:
            self._ground = (b"", None)
        return state_of(snapshot, slots)

    def _returns(self, snapshot: Snapshot) -> int:
        """How often this joint state was met before, since a target was last solved."""
        solved = snapshot.solved.tobytes() + snapshot.target_cells.tobytes()
        if solved != self._solved:
            self._seen, self._solved = {}, solved
        here = snapshot.cells.tobytes()
        self._seen[here] = self._seen.get(here, -1) + 1
        return self._seen[here]

    def plan(self, snapshot: Snapshot, seed: int = 0) -> Plan:
        """The whole plan that its decisions make on the grid; `infeasible` if they fail."""
        begun = time.perf_counter()
        self.reset(snapshot, seed)
        now, actions = replace(snapshot, solved=simulate.holding(snapshot)), []
        while not now.solved.all() and now.step < now.max_steps:
            actions.append(self.act(now))
            now = simulate.step(now, actions[-1])
        return _as_plan(snapshot, np.array(actions), "makespan", time.perf_counter() - begun,
                        "the policy did not solve every target in time")


_TIE = 2.0**-12
"""Weight of the second wish, exact in float32 beside the first: ties fall to the other."""

_PRICES: dict[Objective, tuple[float, float]] = {
    "makespan": (1.0, _TIE), "moves": (_TIE, 1.0), "weighted": (1.0 + _TIE, 1.0)}
"""Price of a step and of a move by which rollouts are compared."""


def plan_best_of(policy: Policy, snapshot: Snapshot, count: int, seed: int = 0,
                 objective: Objective = "makespan", temperature: float = SAMPLING,
                 preference: float = 0.0) -> Plan:
    """The best of `count` sampled rollouts in the grid env, all in one batched call.

    Best by makespan, by moves, or by their sum for `weighted`; ties by the other. The call ends
    as soon as no rollout still under way can become the best.
    Raises InputError if the policy cannot serve this mission.
    """
    begun = time.perf_counter()
    policy.check(snapshot)
    if count < 1:
        raise InputError("best-of", f"{count} is not allowed; at least 1")
    snapshot = replace(snapshot, solved=simulate.holding(snapshot))
    slots = policy.brain.slots(len(snapshot.solved))
    travels = snapshot.passable is not None and policy.brain.travels
    room = 1 << max(snapshot.max_steps - 1, 1).bit_length()
    found = jax.device_get(_roll(
        policy.brain, policy.params, state_of(snapshot, slots),
        _fields(snapshot, slots) if travels else None, np.uint32(seed % 2**32),
        np.float32(temperature), np.int32(snapshot.max_steps), np.float32(preference),
        np.array(_PRICES[objective], np.float32), count, room))
    reason = f"none of {count} sampled rollouts solved every target in time"
    actions = found.actions[:int(found.steps) if found.solved else 0].astype(np.int32)
    return _as_plan(snapshot, actions, objective, time.perf_counter() - begun, reason)


def state_of(snapshot: Snapshot, slots: int | None = None) -> State:
    """The snapshot as a state of the grid env (NumPy arrays), padded to `slots` targets."""
    count = len(snapshot.solved)
    slots = slots or count

    def pad(values: np.ndarray, fill: int = 0) -> Any:
        if slots == count:
            return values
        out = np.full((slots, *values.shape[1:]), fill, values.dtype)
        out[:count] = values
        return out

    whole: Any = np.asarray
    real = np.zeros(slots, bool)
    real[:count] = True
    problem = Problem(
        size=whole(snapshot.size, np.int32), agent_skills=whole(snapshot.agent_skills, np.int32),
        agent_kinds=whole(snapshot.agent_kinds, np.int32), agent_mask=whole(snapshot.agent_mask),
        target_cells=pad(snapshot.target_cells), target_skills=pad(snapshot.target_skills),
        target_and=pad(snapshot.target_and), target_mask=whole(real),
        passable=None if snapshot.passable is None else whole(snapshot.passable))
    return State(problem, whole(snapshot.cells, np.int32), pad(snapshot.solved, 1),
                 whole(snapshot.step, np.int32))


def _fields(snapshot: Snapshot, slots: int) -> Any:
    """[L, M, H, W] steps from every cell to each target, padded to `slots` targets."""
    assert snapshot.passable is not None
    found = distance_fields(snapshot.passable, snapshot.target_cells)
    more = slots - found.shape[1]
    return np.pad(found, ((0, 0), (0, more), (0, 0), (0, 0)), constant_values=UNREACHABLE)


def _as_plan(snapshot: Snapshot, actions: IntArray, objective: Objective, seconds: float,
             reason: str) -> Plan:
    agents = len(snapshot.cells)
    trace = simulate.replay_whole(snapshot, actions.reshape(-1, agents))
    if not trace.complete:
        return infeasible("policy", objective, reason, seconds, agents)
    return plan_of_trace(snapshot, trace, Certificate("policy", objective, "feasible", None),
                         seconds)


def masked(logits: Array, states: State) -> Array:
    """[E, N, 5] without moves that blocked ground or the border turns back, if ground is blocked.

    On open maps a move against the border is the network's own affair, as in training.
    """
    if states.problem.passable is None:
        return logits
    return jnp.where(jax.vmap(env.available)(states), logits, -1e9)


@partial(jax.jit, static_argnames="brain")
def _decide(brain: Brain, params: Any, memory: Any, state: State, fields: Array | None,
            horizon: Array, preference: Array) -> tuple[Any, Array]:
    """(memory, [N, 5] logits) at one moment."""
    batch = jax.tree.map(lambda x: x[None], (state, fields, horizon, preference))
    memory, logits = brain.logits(params, memory, *batch)
    return memory, masked(logits, batch[0])[0]


class _Rolled(NamedTuple):
    solved: Array  # [] bool, whether any rollout solved everything
    steps: Array  # [] of the best
    actions: Array  # [T, N] int8 of the best


class _Rollouts(NamedTuple):
    step: Array  # []
    states: State  # [K]
    memory: Any
    steps: Array  # [K] int32, those that stand still are not counted
    moves: Array  # [K] int32
    actions: Array  # [T, K, N] int8


def _prices(rollouts: _Rollouts, price: Array) -> tuple[Array, Array, Array]:
    """[K] solved, [K] price so far, [] the least price of those solved."""
    solved = jnp.all(rollouts.states.solved, axis=1)
    cost = price[0] * rollouts.steps + price[1] * rollouts.moves
    return solved, cost, jnp.min(jnp.where(solved, cost, jnp.inf))


@partial(jax.jit, static_argnames=("brain", "count", "room"))
def _roll(brain: Brain, params: Any, state: State, fields: Array | None, seed: Array,
          heat: Array, horizon: Array, preference: Array, price: Array, count: int,
          room: int) -> _Rolled:
    """The best of `count` sampled rollouts from one state; a finished one stands still.

    Prices only grow, so the loop ends when those under way cost as much as the best finished.
    """
    config = EnvConfig(max_steps=2**30)  # the loop itself watches the horizon
    agents = state.cells.shape[0]
    key = jax.random.key(seed)

    def many(value: Any) -> Any:
        return jax.tree.map(lambda x: jnp.broadcast_to(x[None], (count, *x.shape)), value)

    ground, horizons, likings = many((fields, horizon, preference))

    def going(rollouts: _Rollouts) -> Array:
        solved, cost, best = _prices(rollouts, price)
        return jnp.any(~solved & (cost < best)) & (rollouts.step < horizon - state.step)

    def step(rollouts: _Rollouts) -> _Rollouts:
        states = rollouts.states
        memory, logits = brain.logits(params, rollouts.memory, states, ground, horizons, likings)
        now = jax.random.fold_in(key, rollouts.step)
        drawn = jax.random.categorical(now, masked(logits, states) / heat)
        open_still = ~jnp.all(states.solved, axis=1)
        able = open_still[:, None] & states.problem.agent_mask
        action = jnp.where(able, drawn, env.STAY)
        after = jax.vmap(lambda s, a: env.step(config, s, a).state)(states, action)
        moves = rollouts.moves + jnp.sum(action != env.STAY, axis=1)
        kept = rollouts.actions.at[rollouts.step].set(action.astype(jnp.int8))
        return _Rollouts(rollouts.step + 1, after, memory, rollouts.steps + open_still, moves,
                         kept)

    none = jnp.zeros(count, jnp.int32)
    start = _Rollouts(jnp.zeros((), jnp.int32), many(state), brain.begin(count, agents), none,
                      none, jnp.zeros((room, count, agents), jnp.int8))
    end = jax.lax.while_loop(going, step, start)
    solved, cost, _ = _prices(end, price)
    best = jnp.argmin(jnp.where(solved, cost, jnp.inf))
    return _Rolled(solved[best], end.steps[best], end.actions[:, best])
