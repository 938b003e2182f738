"""A set of scenarios as one batch of the grid environment, which judges every planner.

Whatever a planner promises, its actions are played here and the environment says what they
did. Scenarios of unlike sizes are padded to one shape. Legend: S scenarios (or rollouts of
them), N agents, M targets, T steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array

from moonteam import trees
from moonteam.errors import InputError
from moonteam.evaluation.metrics import Family
from moonteam.grid import env, scenarios
from moonteam.grid.config import EnvConfig
from moonteam.grid.types import Problem, State
from moonteam.planners.base import BoolArray, Snapshot
from moonteam.problem.scenario import Scenario


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Walk:
    """Episodes under way. One that has ended, or waits for a new plan, stands still."""

    state: State  # [S]
    moves: Array  # [S] int32, team effort so far
    waiting: Array  # [S] bool, a target appeared since the last plan

    @property
    def done(self) -> Array:
        """[S] bool, every target solved."""
        return jnp.all(self.state.solved, axis=1)


@dataclass(frozen=True)
class World:
    """The batch, at its start."""

    scenarios: tuple[Scenario, ...]
    config: EnvConfig
    start: Walk
    horizon: Array  # [S] int32, T_max of each scenario
    num_buffer: int = 0

    def __len__(self) -> int:
        return len(self.scenarios)

    @property
    def family(self) -> Family:
        """Names, horizons and team sizes for the metrics."""
        return Family(tuple(s.id for s in self.scenarios),
                      np.array([s.max_steps for s in self.scenarios], np.int64),
                      np.array([len(s.agents) for s in self.scenarios], np.int64))

    @property
    def longest(self) -> int:
        """Steps after which every episode has ended."""
        return max(s.max_steps for s in self.scenarios)


def build(found: Sequence[Scenario], num_buffer: int = 0) -> World:
    """The batch of a scenario set; scenarios without an id are numbered.

    Args:
      found: the scenarios.
      num_buffer: the last so many targets of each appear one by one, in the slots of those
        solved (the replanning experiment); 0 shows all targets from the start.

    Raises:
      InputError: if the buffer leaves a scenario without a target.
    """
    named = tuple(s if s.id else _named(s, i) for i, s in enumerate(found))
    problems, cells = scenarios.stack([scenarios.to_problem(s, num_buffer) for s in named])
    horizon = np.array([s.max_steps for s in named], np.int32)
    config = EnvConfig(max_steps=int(horizon.max()))
    states = _reset(config, problems, cells)
    none = jnp.zeros(len(named), jnp.int32)
    return World(named, config, Walk(states, none, none > 0), jnp.asarray(horizon), num_buffer)


def _named(scenario: Scenario, index: int) -> Scenario:
    import msgspec

    return msgspec.structs.replace(scenario, id=str(index))


@partial(jax.jit, static_argnames="config")
def _reset(config: EnvConfig, problems: Problem, cells: Array) -> State:
    return jax.vmap(lambda p, c: env.reset_to(config, p, c)[0])(problems, cells)


def advance(config: EnvConfig, walk: Walk, horizon: Array, actions: Array,
            pause: bool = False) -> Walk:
    """One step of every episode that goes on; actions [S, N] int32.

    With `pause`, an episode in which a target appears stands still until `waiting` is cleared.
    """
    going = ~walk.done & (walk.state.step < horizon) & ~walk.waiting
    after = jax.vmap(lambda s, a: env.step(config, s, a).state)(walk.state, actions)
    before, now = walk.state.problem.buffer, after.problem.buffer
    appeared = jnp.zeros_like(going)
    if pause and before is not None and now is not None:
        appeared = now.used > before.used

    return Walk(
        state=trees.where(going, after, walk.state),
        moves=walk.moves + jnp.where(going, _effort(walk.state.problem, actions), 0),
        waiting=walk.waiting | (going & appeared))


def _effort(problem: Problem, actions: Array) -> Array:
    """[S] actions other than stay, of the agents that are real."""
    moving = (actions != env.STAY) & problem.agent_mask
    return jnp.sum(moving, axis=1, dtype=jnp.int32)


@partial(jax.jit, static_argnames=("config", "pause"))
def replay(config: EnvConfig, walk: Walk, horizon: Array, actions: Array,
           pause: bool = False) -> Walk:
    """Plays joint actions [T, S, N] as far as each episode goes."""
    def step(walk: Walk, joint: Array) -> tuple[Walk, None]:
        return advance(config, walk, horizon, joint, pause), None

    return jax.lax.scan(step, walk, actions)[0]


def joint_actions(world: World, plans: Sequence[npt.ArrayLike]) -> Array:
    """[T, S, N] int8 from plans [T', N'] of each scenario, filled up with stay.

    T is rounded up to a power of two, so that few lengths are ever compiled.
    """
    arrays = [np.asarray(plan, np.int8) for plan in plans]
    num_agents = world.start.state.cells.shape[1]
    longest = max(1, min(world.longest, max(len(plan) for plan in arrays)))
    length = 1 << (longest - 1).bit_length()
    out = np.full((length, len(arrays), num_agents), env.STAY, np.int8)
    for i, plan in enumerate(arrays):
        part = plan[:length]
        if len(part):
            out[:len(part), i, :part.shape[1]] = part
    return jnp.asarray(out)


def play_plans(world: World, plan: Callable[[list[Snapshot], BoolArray, int],
                                             Sequence[npt.ArrayLike]]) -> Walk:
    """Every episode to its end, planned anew wherever a target appears.

    `plan(moments, over, round)` returns the joint actions [T, N] of each moment; what it says of
    episodes that are over [S] bool is not played.
    """
    walk = world.start
    for round_ in range(world.num_buffer + 1):
        over = np.asarray(walk.done | (walk.state.step >= world.horizon))
        plans = plan(snapshots(world, walk), over, round_)
        walk = replay(world.config, walk, world.horizon, joint_actions(world, plans),
                      pause=world.num_buffer > 0)
        if not np.asarray(walk.waiting).any():
            break
        walk = Walk(walk.state, walk.moves, walk.waiting & False)
    return walk


def tally(world: World, walk: Walk) -> tuple[BoolArray, npt.NDArray[np.int64],
                                             npt.NDArray[np.int64]]:
    """Success, steps (T_max where it failed) and moves [S] of episodes played to their end."""
    success = np.asarray(walk.done)
    steps = np.where(success, np.asarray(walk.state.step), np.asarray(world.horizon))
    return success, steps.astype(np.int64), np.asarray(walk.moves, np.int64)


def snapshots(world: World, walk: Walk) -> list[Snapshot]:
    """Every episode's present moment as a host planner sees it."""
    state = jax.tree.map(np.asarray, walk.state)
    found = []
    for i, scenario in enumerate(world.scenarios):
        n, m = len(scenario.agents), len(scenario.targets) - world.num_buffer
        problem = state.problem
        start = Snapshot.start(scenario)
        found.append(replace(
            start, cells=state.cells[i, :n], target_cells=problem.target_cells[i, :m],
            target_skills=problem.target_skills[i, :m], target_and=problem.target_and[i, :m],
            solved=state.solved[i, :m], step=int(state.step[i])))
    return found


def check_fresh(world: World, source: object) -> None:
    """Raises InputError if a shown target is solved before the first step.

    Such a target would never be replaced, and its scenario would have fewer than the others.
    """
    solved = np.asarray(world.start.state.solved & world.start.state.problem.target_mask)
    for i in np.flatnonzero(solved.any(axis=1)).tolist():
        raise InputError(source, f"target {int(np.argmax(solved[i]))} is solved before the first "
                         "step; start the agents elsewhere", world.scenarios[i].id)
