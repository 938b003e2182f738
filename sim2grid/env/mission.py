"""Missions in physics with the interface of JaxMARL's `MultiAgentEnv`, without importing it.

    env = MoonMission("sampling")
    observations, state = env.reset(key)
    observations, state, rewards, dones, infos = env.step(key, state, actions)

A step is a macro-decision: it lasts until the executor asks again, see `sim2grid.clock`. The
physics runs on the host, called back from JAX, so a step can stand under jit, vmap and scan; the
state is plain data, the mission and the choices so far, and a step a pure function of it.

Legend: N robots, M targets (of the mission that has most, those of its events included), S skills,
K decisions at most.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array

from moonteam import compilation, loading
from moonteam.errors import InputError
from moonteam.grid.jaxmarl_face import ByAgent, Face, OwnSpaces, Spaces
from moonteam.grid.macro.types import FAR, LONG
from moonteam.grid.macro.world import missing
from moonteam.planners.kind import PlannerOptions
from moonteam.planners.seconds import registry
from moonteam.planners.seconds.base import Moment
from moonteam.planners.seconds.keeper import Keeper
from moonteam.problem.mission import Mission
from sim2grid.clock.execution import TimedExecution
from sim2grid.env.session import Session, Stage
from sim2grid.env.sessions import Seen, Sessions, Sizes
from sim2grid.measure.metrics import Report, make_report
from sim2grid.measure.slip import ground_height

Named = str | os.PathLike[str] | Mission


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MissionState:
    """A moment of a mission: how it came about, and what is seen of it."""

    mission: Array  # [] int32, its number
    count: Array  # [] int32 decisions taken
    history: Array  # [K, N] int32, the actions taken; -1 where none was yet
    seen: Seen


class MoonMission(Face):
    """Physics missions as a JaxMARL environment.

    Action j < M sends a robot to target j, action M has it wait where it stands, M + 1 go home. At
    every decision all robots of the team choose that are in no service and are heard of; those on
    their way may turn. Who is given an action that it may not take goes on with what it is about.

    Observation of an agent, D = N * (2M + S + 5) + M * (S + 6) + 1: its own row, then the others'
    by index (in the team, choosing, s until it is free, what it is about as M + 2 flags, s to each
    open target, its skills as S flags); then of each open target (1, OR, its service in s, s until
    it may start and until it lapses, whether what comes before it is done, the robots that it lacks
    of each skill, counting those bound to it); and the s that are left. Seconds are in units of
    `unit_s`, at most `LONG`.

    Reward, the same for all: minus the seconds until the next decision, in units of `unit_s`. A
    mission that fails costs all of its `max_seconds`. Terminated: it succeeded or failed.
    Truncated: K decisions were taken.

    Args:
      mission: a mission, its file, the name of a bundled one, or several with equally many robots,
        of which `reset` draws one. A mission in steps is run by the clock.
      backend: the engine, native or mjx.
      max_decisions: K.
      unit_s: seconds that count as one in observations and rewards.
      spaces: as of `MoonGrid`.
      world_state: as of `MoonGrid`.

    Raises InputError for missions that cannot be run, or not together.
    """

    def __init__(self, mission: Named | Sequence[Named] = "sampling", *, backend: str = "native",
                 max_decisions: int = 128, unit_s: float = 60.0, spaces: Spaces | None = None,
                 world_state: bool = False):
        compilation.call_at_once()  # the engine calls its controllers a hundred times a second
        if max_decisions < 1 or not unit_s > 0:
            raise InputError("MoonMission", "max_decisions and unit_s must be above 0")
        single = isinstance(mission, (str, os.PathLike, Mission))
        stages = [_stage(one, backend) for one in ([mission] if single else mission)]
        self.missions = tuple(stage.prepared.mission for stage in stages)
        if len({len(one.robots) for one in self.missions}) != 1:
            raise InputError("mission", "missions of one environment have equally many robots; "
                             "these have " + ", ".join(str(len(m.robots)) for m in self.missions))
        sizes = Sizes.of(stages)
        self.num_targets, self.max_decisions, self.unit_s = sizes.targets, max_decisions, unit_s
        self._backend, self._sessions = backend, Sessions(stages, sizes)
        self._home = np.array([[robot.home is not None for robot in one.robots]
                               for one in self.missions])
        self._limits = np.array([one.max_seconds for one in self.missions], np.float32)
        none = np.zeros((0, sizes.robots), np.int32)
        first = [self._sessions.seen(m, none) for m in range(len(stages))]
        self._first = jax.tree.map(lambda *x: np.stack(x), *first)
        self._shapes = jax.tree.map(
            lambda x: jax.ShapeDtypeStruct(np.shape(x), np.asarray(x).dtype), first[0])
        agents, targets, skills = sizes.robots, sizes.targets, len(sizes.skills)
        length = agents * (2 * targets + skills + 5) + targets * (skills + 6) + 1
        maker = spaces or OwnSpaces
        super().__init__(agents, maker.Box(0.0, max(LONG, agents), (length,)),
                         maker.Discrete(targets + 2), world_state)

    @partial(jax.jit, static_argnums=0)
    def reset(self, key: Array) -> tuple[ByAgent, MissionState]:
        """A mission at its first decision: observations by agent, and the state."""
        mission = jax.random.randint(key, (), 0, len(self.missions), jnp.int32)
        state = MissionState(
            mission, jnp.zeros((), jnp.int32),
            jnp.full((self.max_decisions, self.num_agents), -1, jnp.int32),
            jax.tree.map(lambda x: jnp.asarray(x)[mission], self._first))
        return self.get_obs(state), state

    def step_env(self, key: Array, state: MissionState, actions: ByAgent,
                 ) -> tuple[ByAgent, MissionState, ByAgent, ByAgent, dict[str, Array]]:
        """One macro-decision without a new episode; nothing is random.

        Infos: [N] arrays `terminated`, `truncated`, `success` and `seconds` (that passed).
        """
        del key
        before = state.seen
        wanted, may = self._joint(actions), self._may(state)
        known = (wanted >= 0) & (wanted < may.shape[1])
        index = jnp.where(known, wanted, 0)[:, None]
        fits = known & jnp.take_along_axis(may, index, axis=1)[:, 0]
        row = jnp.where(fits, wanted, before.choice)
        over = before.success | before.failed | (state.count >= self.max_decisions)
        count = jnp.where(over, state.count, state.count + 1)
        history = jnp.where(over, state.history, state.history.at[state.count].set(row))
        after: Seen = jax.pure_callback(self._sessions.rows, self._shapes, state.mission, count,
                                        history, vmap_method="broadcast_all")
        terminated = after.success | after.failed
        truncated = ~terminated & (count >= self.max_decisions)
        seconds = after.now - before.now
        left = jnp.maximum(jnp.asarray(self._limits)[state.mission] - after.now, 0.0)
        charged = seconds + jnp.where(after.failed & ~over, left, 0.0)
        said = {"terminated": terminated, "truncated": truncated, "success": after.success,
                "seconds": seconds}
        infos = {name: jnp.broadcast_to(value, self.num_agents) for name, value in said.items()}
        dones = dict.fromkeys([*self.agents, "__all__"], terminated | truncated)
        rewards = dict.fromkeys(self.agents, -charged / self.unit_s)
        now = replace(state, count=count, history=history, seen=after)
        return self.get_obs(now), now, rewards, dones, infos

    def get_obs(self, state: MissionState) -> ByAgent:
        """Observations [D] by agent."""
        seen, problem = state.seen, state.seen.problem
        open_, targets = problem.target_mask, self.num_targets

        def units(times: Array) -> Array:
            return jnp.clip(times / self.unit_s, 0.0, LONG)

        rows = jnp.concatenate([
            problem.agent_mask[:, None], seen.can[:, None], units(problem.free)[:, None],
            jax.nn.one_hot(seen.choice, targets + 2), units(problem.start) * open_[None],
            problem.has], axis=1)
        rows = jnp.where(problem.agent_mask[:, None], rows, 0.0)
        ready = ~jnp.any(problem.after & open_[None], axis=1)
        told = jnp.concatenate([
            open_[:, None], problem.either[:, None], units(problem.service)[:, None],
            units(problem.appears)[:, None], units(problem.lapses)[:, None], ready[:, None],
            missing(problem, seen.choice)], axis=1)
        told = jnp.where(open_[:, None], told, 0.0).reshape(-1)
        left = units(problem.limit)[None]
        return self._observed(self._own_first(rows, told, left))

    @partial(jax.jit, static_argnums=0)
    def get_avail_actions(self, state: MissionState) -> ByAgent:
        """[M + 2] bool by agent: open targets that it can reach and has a skill for, waiting, and
        its home; of a robot that does not choose now, what it is about.

        That others come too, where they are needed, is for the agents to see to.
        """
        return self._split(self._may(state))

    def _may(self, state: MissionState) -> Array:
        """[N, M + 2] bool."""
        seen, problem = state.seen, state.seen.problem
        helps = jnp.any(problem.has[:, None] & (problem.need > 0)[None], axis=2)
        goals = (problem.target_mask & (problem.lapses >= 0))[None] & (problem.start < FAR) & helps
        home = jnp.asarray(self._home)[state.mission]
        may = jnp.concatenate([goals, jnp.ones_like(home)[:, None], home[:, None]], axis=1)
        about = jax.nn.one_hot(seen.choice, self.num_targets + 2, dtype=bool)
        return jnp.where(seen.can[:, None], may, about)

    def keeper(self, planner: str = "policy", **options: Any) -> Keeper:
        """Who decides in `moonteam rollout --mode clock`: `act(env.moment(state))` gives choices.

        `options` are fields of `PlannerOptions`, such as policy="any_team". One keeper an episode.
        Raises InputError.
        """
        return Keeper(registry.find(planner).make(PlannerOptions(**options)))

    def actions(self, choices: npt.ArrayLike) -> ByAgent:
        """Choices [N] of a planner by the clock as actions by agent.

        Who is sent home and has none waits, as it would there.
        """
        return self._split(jnp.asarray(self._sessions.actions(choices)))

    def moment(self, state: MissionState) -> Moment:
        """What a planner by the clock is asked; of one state, not of a batch."""
        return self._session(state).moment

    def execution(self, state: MissionState) -> TimedExecution:
        """The mission under way, with its `record`, until the next step; not to be changed."""
        return self._session(state).execution

    def report(self, state: MissionState, planner: str = "actions") -> Report:
        """What `moonteam rollout` would report, `planner` as who decided."""
        stage = self._sessions.stages[int(state.mission)]
        its, site = stage.prepared, stage.prepared.site
        return make_report(
            self.execution(state).record, its.mission, its.frame, its.bases, planner=planner,
            objective=None, mode="clock", backend=self._backend, seed=0, grid_plan=None,
            kinds=its.kinds, height=ground_height(site.heights, site.spacing))

    def _session(self, state: MissionState) -> Session:
        history = np.asarray(state.history)[:int(state.count)]
        return self._sessions.session(int(state.mission), history)


def _stage(mission: Named, backend: str) -> Stage:
    """Raises InputError."""
    if isinstance(mission, Mission):
        return Stage.of(mission, mission.name or "mission", backend)
    found, path = loading.read_mission(os.fspath(mission))
    return Stage.of(found, path, backend)
