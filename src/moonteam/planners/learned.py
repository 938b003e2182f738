"""A trained policy as a planner: decides each joint action, or rolls out whole plans.

Legend: N agents, M targets, K rollouts, W columns, H rows (of the map) or units (of memory).
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
from moonteam.grid.travel import problem_fields
from moonteam.grid.types import Problem, State
from moonteam.planners import simulate
from moonteam.planners.base import IntArray, Objective, Plan, Snapshot
from moonteam.planners.routes import Certificate, infeasible, plan_of_trace
from moonteam.policies import checkpoint, entity, recurrent
from moonteam.policies.entity import EntitySpec
from moonteam.policies.recurrent import RecurrentSpec

Decode = Literal["argmax", "sample"]


class Brain(Protocol):
    """A network as it decides for one team; hashable, for it is static under jit."""

    def begin(self, num_agents: int) -> Any:
        """Empty memory."""
        ...

    def logits(self, params: Any, memory: Any, state: State, horizon: Array,
               preference: Array) -> tuple[Any, Array]:
        """(memory, [N, 5] logits) at a moment."""
        ...

    def misfit(self, snapshot: Snapshot) -> str:
        """Why it cannot serve this mission; empty if it can."""
        ...


@dataclass(frozen=True)
class RecurrentBrain:
    """The paper's network: one team size, one number of targets, one map."""

    spec: RecurrentSpec

    def begin(self, num_agents: int) -> Array:
        """[N, H] zeros."""
        return recurrent.zeros(self.spec, num_agents)

    def logits(self, params: Any, memory: Array, state: State, horizon: Array,
               preference: Array) -> tuple[Array, Array]:
        """See `Brain`; horizon and preference are not among what it observes."""
        del horizon, preference
        obs = observe(EnvConfig(normalize_positions=self.spec.normalise), state)  # [N, D]
        never = jnp.zeros((1, obs.shape[0]), bool)
        net = recurrent.actor(self.spec)
        result: Any = net.apply({"params": params["actor"]}, memory, obs[None], never)
        memory, out = result
        return memory, out[0]

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

    def begin(self, num_agents: int) -> tuple[()]:
        """Nothing."""
        del num_agents
        return ()

    def logits(self, params: Any, memory: tuple[()], state: State, horizon: Array,
               preference: Array) -> tuple[tuple[()], Array]:
        """See `Brain`; what is returned are log-probabilities."""
        fields = problem_fields(state.problem)

        def look(state: State, horizon: Any, preference: Array, fields: Array | None) -> Any:
            return entity.look(state, horizon, preference, fields)

        batch = jax.tree.map(lambda x: x[None], (state, horizon, preference, fields))
        view = jax.vmap(look)(*batch)
        return memory, entity.decide(params, self.spec, view).log_probs[0]

    def misfit(self, snapshot: Snapshot) -> str:
        """See `Brain`: everything fits."""
        del snapshot
        return ""


@dataclass(frozen=True)
class Policy:
    """A policy file, ready to act."""

    brain: Brain
    params: Any
    source: checkpoint.PolicyFile
    path: str

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Policy:
        """Reads a policy file. Raises InputError if it is none, or its parts do not fit."""
        stored = checkpoint.load_policy(path)
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
        checkpoint.check_shapes(path, stored.params, wanted)
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
      temperature: logits are divided by it when drawing.
      watch: argmax can circle for ever. With the watch on, when a joint state (cells and
        solved targets) comes back without a target solved in between, that decision is drawn
        instead, at a temperature of 1 for the first return, 2 for the second and so on.
      preference: 0 time .. 1 effort, for policies that were trained with it.

    A lost robot stays and is observed as absent. Where the map has blocked cells, moves that
    would be turned back are never chosen.
    """

    name = "policy"

    def __init__(self, policy: Policy, decode: Decode = "argmax", temperature: float = 1.0,
                 watch: bool = True, preference: float = 0.0):
        if temperature <= 0:
            raise InputError("temperature", f"{temperature} is not allowed; above 0")
        self.policy, self.decode, self.temperature = policy, decode, temperature
        self.watch, self.preference = watch, preference
        self._begin(0, 0)

    @classmethod
    def load(cls, path: str | os.PathLike[str], decode: Decode = "argmax",
             temperature: float = 1.0, watch: bool = True,
             preference: float = 0.0) -> LearnedPlanner:
        """From a policy file. Raises InputError."""
        return cls(Policy.load(path), decode, temperature, watch, preference)

    def _begin(self, num_agents: int, seed: int) -> None:
        self._memory = self.policy.brain.begin(num_agents)
        self._key, self._decisions = jax.random.key(seed), 0
        self._seen: dict[bytes, int] = {}
        self._solved = b""
        self.rescues = 0

    def reset(self, snapshot: Snapshot, seed: int = 0) -> None:
        """Empties the memory. Raises InputError if the policy cannot serve this mission."""
        self.policy.check(snapshot)
        self._begin(len(snapshot.cells), seed)

    def act(self, snapshot: Snapshot) -> IntArray:
        """Joint action [N]. Raises InputError if the mission has grown out of the policy."""
        self.policy.check(snapshot)
        if self._decisions == 0 and jax.tree.leaves(self._memory):
            self._memory = self.policy.brain.begin(len(snapshot.cells))
        returns = self._returns(snapshot)
        heat = self.temperature if self.decode == "sample" else float(max(returns, 1))
        key = jax.random.fold_in(self._key, self._decisions)
        self._memory, likeliest, drawn = _decide(
            self.policy.brain, self.policy.params, self._memory, state_of(snapshot), key,
            np.float32(heat), np.int32(snapshot.max_steps), np.float32(self.preference))
        self._decisions += 1
        rescue = self.decode == "argmax" and self.watch and returns > 0
        self.rescues += rescue
        chosen = np.asarray(drawn if rescue or self.decode == "sample" else likeliest)
        return np.where(snapshot.agent_mask, chosen, simulate.STAY).astype(np.int32)

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
        return _as_plan(snapshot, actions, "makespan", time.perf_counter() - begun,
                        "the policy did not solve every target in time")


def plan_best_of(policy: Policy, snapshot: Snapshot, count: int, seed: int = 0,
                 objective: Objective = "makespan", temperature: float = 1.0,
                 preference: float = 0.0) -> Plan:
    """The best of `count` sampled rollouts in the grid env, all in one batched call.

    Best by makespan, by moves, or by their sum for `weighted`; ties by the other.
    Raises InputError if the policy cannot serve this mission.
    """
    begun = time.perf_counter()
    policy.check(snapshot)
    if count < 1:
        raise InputError("best-of", f"{count} is not allowed; at least 1")
    snapshot = replace(snapshot, solved=simulate.holding(snapshot))
    steps = max(snapshot.max_steps - snapshot.step, 1)
    heat, horizon = np.float32(temperature), np.int32(snapshot.max_steps)
    rolled = jax.device_get(_roll(
        policy.brain, policy.params, state_of(snapshot), jax.random.key(seed), heat, horizon,
        np.float32(preference), count, steps))
    cost = {"makespan": rolled.makespan * 1e4 + rolled.moves,
            "moves": rolled.moves * 1e4 + rolled.makespan,
            "weighted": (rolled.makespan + rolled.moves) * 1e4 + rolled.makespan}[objective]
    best = int(np.where(rolled.solved, cost, np.inf).argmin())
    reason = f"none of {count} sampled rollouts solved every target in time"
    actions = list(rolled.actions[:, best]) if rolled.solved[best] else []
    return _as_plan(snapshot, actions, objective, time.perf_counter() - begun, reason)


def state_of(snapshot: Snapshot) -> State:
    """The snapshot as a state of the grid env."""
    put = jnp.asarray
    problem = Problem(
        size=put(snapshot.size, dtype=jnp.int32), agent_skills=put(snapshot.agent_skills),
        agent_kinds=put(snapshot.agent_kinds), agent_mask=put(snapshot.agent_mask),
        target_cells=put(snapshot.target_cells), target_skills=put(snapshot.target_skills),
        target_and=put(snapshot.target_and), target_mask=jnp.ones(len(snapshot.solved), bool),
        passable=None if snapshot.passable is None else put(snapshot.passable))
    return State(problem, put(snapshot.cells), put(snapshot.solved),
                 put(snapshot.step, dtype=jnp.int32))


def _as_plan(snapshot: Snapshot, actions: list[IntArray], objective: Objective, seconds: float,
             reason: str) -> Plan:
    trace = simulate.replay(snapshot, actions)
    if not trace.complete:
        return infeasible("policy", objective, reason, seconds, len(snapshot.cells))
    return plan_of_trace(snapshot, trace, Certificate("policy", objective, "feasible", None),
                         seconds)


def masked(logits: Array, state: State) -> Array:
    """Moves that blocked ground or the border would turn back are out, on maps with such."""
    if state.problem.passable is None:
        return logits
    return jnp.where(env.available(state), logits, -1e9)


@partial(jax.jit, static_argnames="brain")
def _decide(brain: Brain, params: Any, memory: Any, state: State, key: Array, heat: Array,
            horizon: Array, preference: Array) -> tuple[Any, Array, Array]:
    """(memory, likeliest [N], drawn [N]) at one moment."""
    memory, logits = brain.logits(params, memory, state, horizon, preference)
    logits = masked(logits, state)
    return memory, jnp.argmax(logits, axis=-1), jax.random.categorical(key, logits / heat)


class _Rolled(NamedTuple):
    actions: Array  # [T, K, N]
    solved: Array  # [K] bool
    makespan: Array  # [K] steps from the snapshot
    moves: Array  # [K]


class _Walk(NamedTuple):
    state: State
    memory: Any
    steps: Array
    moves: Array


@partial(jax.jit, static_argnames=("brain", "count", "steps"))
def _roll(brain: Brain, params: Any, state: State, key: Array, heat: Array, horizon: Array,
          preference: Array, count: int, steps: int) -> _Rolled:
    """`count` sampled rollouts from one state, `steps` long; a finished one stands still."""
    config = EnvConfig(max_steps=2**30)  # the caller's horizon is the length of the scan
    agents = state.cells.shape[0]

    def step(walk: _Walk, key: Array) -> tuple[_Walk, Array]:
        memory, logits = brain.logits(params, walk.memory, walk.state, horizon, preference)
        open_still = ~jnp.all(walk.state.solved)
        drawn = jax.random.categorical(key, masked(logits, walk.state) / heat)
        able = open_still & walk.state.problem.agent_mask
        action = jnp.where(able, drawn, env.STAY)
        after = env.step(config, walk.state, action).state
        moves = walk.moves + jnp.sum(action != env.STAY)
        return _Walk(after, memory, walk.steps + open_still, moves), action

    def one(key: Array) -> tuple[_Walk, Array]:
        zero = jnp.zeros((), jnp.int32)
        walk = _Walk(state, brain.begin(agents), zero, zero)
        return jax.lax.scan(step, walk, jax.random.split(key, steps))

    walk, actions = jax.vmap(one, out_axes=(0, 1))(jax.random.split(key, count))
    return _Rolled(actions, jnp.all(walk.state.solved, axis=1), walk.steps, walk.moves)
