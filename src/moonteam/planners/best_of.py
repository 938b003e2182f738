"""Best-of-K: sampled rollouts of a policy, of which the cheapest counts.

What is cheap has one meaning, here and wherever rollouts are compared (`prices`, `cheapest`):

| objective | price of a rollout |
|---|---|
| makespan | steps; ties by fewer moves |
| moves | moves; ties by fewer steps |
| weighted | alpha * makespan + beta * moves |
| none | (1 - p) * makespan + p * moves at the preference p, with a trace more of both, for ties |

Steps are counted until the last target is solved. A rollout that solved every target comes
before any that did not.

Legend: K rollouts, N agents, T steps, E episodes of a batch, M targets, L kinds, W, H the map.
"""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array

from moonteam.errors import InputError
from moonteam.grid import env
from moonteam.grid.config import EnvConfig
from moonteam.grid.types import State
from moonteam.planners import simulate
from moonteam.planners.base import SAMPLING, IntArray, Objective, Plan, Snapshot, check_objective
from moonteam.planners.kind import PlannerOptions
from moonteam.planners.learned import LearnedPlanner, fields_of, masked, state_of
from moonteam.planners.plans.follow import Follower
from moonteam.planners.plans.routes import Certificate, infeasible, plan_of_trace
from moonteam.policies.brain import Brain
from moonteam.policies.policy import Policy

_TIE = 2.0**-20
_NO_PRICE = (np.nan, np.nan)


def prices(objective: Objective | None = None, alpha: float = 1.0, beta: float = 0.05,
           preference: float = 0.0) -> tuple[float, float]:
    """What a step and a move of a rollout cost. Raises InputError for weights that cannot be."""
    if objective is None:
        return 1.0 - preference + _TIE, preference + _TIE
    check_objective(objective, alpha, beta)
    return {"makespan": (1.0, _TIE), "moves": (_TIE, 1.0), "weighted": (alpha, beta)}[objective]


def meaning(options: PlannerOptions) -> tuple[Objective, float, float]:
    """Objective, alpha and beta in words that a plan can carry, for best-of-K without one."""
    p = options.preference
    if options.objective is not None or p == 0.0:
        return options.goal
    return ("moves", 1.0, 0.05) if p == 1.0 else ("weighted", 1.0 - p, p)


def cheapest(solved: npt.NDArray[np.bool_], steps: npt.NDArray[np.int64],
             moves: npt.NDArray[np.int64], price: tuple[float, float]) -> Any:
    """Index [...] of the rollout that counts, of [..., K]; the first of those that cost the same.

    One that solved its mission if there is one, then the cheapest.
    """
    cost = price[0] * steps + price[1] * moves
    return np.argmin(np.where(solved, cost, cost + cost.max() + 1.0), axis=-1)


class BestOfPlanner(Follower):
    """Follows the best of K sampled rollouts of a policy; samples again when off that plan.

    Where none of them solves the mission it decides step by step instead.

    Args:
      policy: see `Policy.load`.
      rollouts: K.
      objective: by which the best is chosen; None: what the preference asks for.
      temperature: of drawing.
      alpha: weight of the makespan in the weighted objective.
      beta: weight of the moves in the weighted objective.
      preference: 0 time .. 1 effort.
      seed: of `plan`; `reset` brings that of the decisions.
    """

    name = "policy"

    def __init__(self, policy: Policy, rollouts: int, objective: Objective | None = None,
                 temperature: float = SAMPLING, *, alpha: float = 1.0, beta: float = 0.05,
                 preference: float = 0.0, seed: int = 0):
        super().__init__()
        prices(objective, alpha, beta, preference)
        self.policy, self.rollouts, self.temperature = policy, rollouts, temperature
        self.objective: Objective | None = objective
        self.alpha, self.beta, self.preference, self.seed = alpha, beta, preference, seed
        self._stepwise = LearnedPlanner(policy, preference=preference)
        self._seed = 0

    def check(self, snapshot: Snapshot) -> None:
        """Raises InputError if the policy cannot serve this mission."""
        self.policy.check(snapshot)

    def reset(self, snapshot: Snapshot, seed: int = 0) -> None:
        """Starts a mission. Raises InputError if the policy cannot serve it."""
        self._stepwise.reset(snapshot, seed)
        super().reset(snapshot, seed)
        self._seed = seed

    def plan(self, snapshot: Snapshot) -> Plan:
        """The best of K rollouts; infeasible if none solved every target."""
        return self._best(snapshot, self.seed)

    def _best(self, snapshot: Snapshot, seed: int) -> Plan:
        return plan_best_of(self.policy, snapshot, self.rollouts, seed, self.objective,
                            self.temperature, self.preference, self.alpha, self.beta)

    def _ahead(self, snapshot: Snapshot) -> IntArray:
        # From step 0, so that the compiled rollout has one length.
        return self._best(replace(snapshot, step=0), self._seed).actions

    def _beyond(self, snapshot: Snapshot) -> IntArray:
        return self._stepwise.act(snapshot)


def plan_best_of(policy: Policy, snapshot: Snapshot, count: int, seed: int = 0,
                 objective: Objective | None = None, temperature: float = SAMPLING,
                 preference: float = 0.0, alpha: float = 1.0, beta: float = 0.05) -> Plan:
    """The best of `count` sampled rollouts in the grid env, all in one batched call.

    Best by `prices`. The call ends as soon as no rollout still under way can become the best.
    Raises InputError if the policy cannot serve this mission.
    """
    begun = time.perf_counter()
    policy.check(snapshot)
    if count < 1:
        raise InputError("best-of", f"{count} is not allowed; at least 1")
    price = prices(objective, alpha, beta, preference)
    word, *_ = meaning(PlannerOptions(objective, alpha, beta, preference=preference))
    snapshot = replace(snapshot, solved=simulate.holding(snapshot))
    found = rollouts_of(policy, snapshot, count, seed, temperature, preference, price)
    best = cheapest(found.solved, found.steps, found.moves, price)
    steps = int(found.steps[best]) if found.solved[best] else 0
    reason = f"none of {count} sampled rollouts solved every target in time"
    return _as_plan(snapshot, found.actions[:steps, best].astype(np.int32), word,
                    time.perf_counter() - begun, reason)


class Rollouts(NamedTuple):
    """What K rollouts did; one that could not become the best may have been left unfinished."""

    solved: npt.NDArray[np.bool_]  # [K]
    steps: npt.NDArray[np.int64]  # [K]
    moves: npt.NDArray[np.int64]  # [K]
    actions: npt.NDArray[np.int8]  # [T, K, N]


def rollouts_of(policy: Policy, snapshot: Snapshot, count: int, seed: int, temperature: float,
                preference: float, price: tuple[float, float] | None = None) -> Rollouts:
    """`count` rollouts from a moment, played until the best by `price` is known.

    Without a price each is played to its own end.
    """
    slots = policy.brain.slots(len(snapshot.solved))
    travels = snapshot.passable is not None and policy.brain.travels
    room = 1 << max(snapshot.max_steps - 1, 1).bit_length()
    end = _roll(
        policy.brain, policy.params, state_of(snapshot, slots),
        fields_of(snapshot, slots) if travels else None, np.uint32(seed % 2**32),
        np.float32(temperature), np.int32(snapshot.max_steps), np.float32(preference),
        np.array(price or _NO_PRICE, np.float32), count, room)
    solved, steps, moves, actions = jax.device_get(
        (end.states.solved, end.steps, end.moves, end.actions))
    return Rollouts(solved.all(1), steps.astype(np.int64), moves.astype(np.int64), actions)


def _as_plan(snapshot: Snapshot, actions: IntArray, objective: Objective, seconds: float,
             reason: str) -> Plan:
    agents = len(snapshot.cells)
    trace = simulate.replay_whole(snapshot, actions.reshape(-1, agents))
    if not trace.complete:
        return infeasible("policy", objective, reason, seconds, agents)
    return plan_of_trace(snapshot, trace, Certificate("policy", objective, "feasible", None),
                         seconds)


class _Rollouts(NamedTuple):
    step: Array  # []
    states: State  # [K]
    memory: Any
    steps: Array  # [K] int32, those that stand still are not counted
    moves: Array  # [K] int32
    actions: Array  # [T, K, N] int8

    @property
    def solved(self) -> Array:
        """[K] bool."""
        return jnp.all(self.states.solved, axis=1)


def _costs(rollouts: _Rollouts, price: Array) -> tuple[Array, Array, Array]:
    """[K] solved, [K] price so far, [] the least price of those solved."""
    solved = rollouts.solved
    cost = price[0] * rollouts.steps + price[1] * rollouts.moves
    return solved, cost, jnp.min(jnp.where(solved, cost, jnp.inf))


@partial(jax.jit, static_argnames=("brain", "count", "room"))
def _roll(brain: Brain, params: Any, state: State, fields: Array | None, seed: Array,
          heat: Array, horizon: Array, preference: Array, price: Array, count: int,
          room: int) -> _Rollouts:
    """`count` sampled rollouts from one state; a finished one stands still.

    Prices only grow, so the loop ends when those under way cost as much as the best finished.
    That float32 knows no ties here is no matter: who is under way has a step more to pay.
    """
    config = EnvConfig(max_steps=2**30)  # the loop itself watches the horizon
    agents = state.cells.shape[0]
    key = jax.random.key(seed)

    def many(value: Any) -> Any:
        return jax.tree.map(lambda x: jnp.broadcast_to(x[None], (count, *x.shape)), value)

    ground, horizons, likings = many((fields, horizon, preference))

    def going(rollouts: _Rollouts) -> Array:
        solved, cost, best = _costs(rollouts, price)
        return jnp.any(~solved & ~(cost >= best)) & (rollouts.step < horizon - state.step)

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
    return jax.lax.while_loop(going, step, start)
