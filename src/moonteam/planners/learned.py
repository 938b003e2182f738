"""A trained policy as a planner that decides each joint action as it comes.

Legend: E episodes of a batch, N agents, M targets, W columns and H rows of the map, L kinds of
robots.
"""

from __future__ import annotations

import os
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from moonteam.errors import InputError
from moonteam.grid import env
from moonteam.grid.types import Problem, State
from moonteam.planners import simulate
from moonteam.planners.base import SAMPLING, IntArray, Objective, Plan, Snapshot
from moonteam.planners.plans.stepwise import plan_from_planner
from moonteam.planners.search.travel import UNREACHABLE, distance_fields
from moonteam.policies.brain import Brain
from moonteam.policies.policy import Policy

Decode = Literal["argmax", "sample"]


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
      seed: of `plan`; `reset` brings that of the decisions.
      objective: written into plans; step by step a policy has none of its own.

    A lost robot stays and is observed as absent. Where the map has blocked cells, moves that
    would be turned back are never chosen; travel times over it are searched when the map or
    the targets change, not at each decision.
    """

    name = "policy"

    def __init__(self, policy: Policy, decode: Decode = "argmax",
                 temperature: float | None = None, watch: bool = True, preference: float = 0.0,
                 seed: int = 0, objective: Objective = "makespan"):
        if temperature is None:
            temperature = SAMPLING if decode == "sample" else 1.0
        if temperature <= 0:
            raise InputError("temperature", f"{temperature} is not allowed; above 0")
        self.policy, self.decode, self.temperature = policy, decode, temperature
        self.watch, self.preference, self.seed = watch, preference, seed
        self.objective: Objective = objective
        self._begin(0)

    @classmethod
    def load(cls, path: str | os.PathLike[str], decode: Decode = "argmax",
             temperature: float | None = None, watch: bool = True,
             preference: float = 0.0, seed: int = 0) -> LearnedPlanner:
        """From a policy file or the name of a bundled one. Raises InputError."""
        return cls(Policy.load(path), decode, temperature, watch, preference, seed)

    def _begin(self, seed: int) -> None:
        self._memory: Any = None
        self._seed, self._decisions = seed, 0
        self._seen: dict[bytes, int] = {}
        self._solved = b""
        self._ground: tuple[bytes, Any] = (b"", None)
        self.rescues = 0

    def check(self, snapshot: Snapshot) -> None:
        """Raises InputError if the policy cannot serve this mission."""
        self.policy.check(snapshot)

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
                self._ground = (posed, jax.device_put(fields_of(snapshot, slots)))
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

    def plan(self, snapshot: Snapshot) -> Plan:
        """The whole plan that its decisions make on the grid; infeasible if they fail."""
        return plan_from_planner(self, snapshot, self.objective, self.seed)


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


def fields_of(snapshot: Snapshot, slots: int) -> Any:
    """[L, M, H, W] steps from every cell to each target, padded to `slots` targets."""
    assert snapshot.passable is not None
    found = distance_fields(snapshot.passable, snapshot.target_cells)
    more = slots - found.shape[1]
    return np.pad(found, ((0, 0), (0, more), (0, 0), (0, 0)), constant_values=UNREACHABLE)


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
