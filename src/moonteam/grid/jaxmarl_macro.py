"""The macro world with the interface of JaxMARL's `MultiAgentEnv`, without importing it.

    env = MoonMacro(Draw(metric="straight", speeds=(1.5, 0.36, 0.47)))
    observations, state = env.reset(key)
    observations, state, rewards, dones, infos = env.step(key, state, actions)

A step is a macro-decision: it lasts until the next moment at which a robot is free. Legend as in
`macro.types`.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax import Array

from moonteam.grid.jaxmarl_face import ByAgent, Face, OwnSpaces, Spaces
from moonteam.grid.macro import world
from moonteam.grid.macro.draw import Draw, draw
from moonteam.grid.macro.types import LONG, MacroState


class MoonMacro(Face):
    """The macro world as a JaxMARL environment; action j < M is target j, action M waits.

    Observation of an agent, D = N * (2M + S + 2) + M * (S + 4): its own row, then the others'
    by index (free, time until it is free or arrives, the target that it is bound to as M flags,
    the time from where it is or will be to each target, its skills as S flags); then of each target
    (open, OR, service, time until it may start, the agents that it lacks of each skill). Times are
    in units of the problem, at most `LONG`. Agents and targets that are padding are zeros.

    Args:
      family: the problems that `reset` draws.
      spaces: as of `MoonGrid`.
      world_state: as of `MoonGrid`.
    """

    def __init__(self, family: Draw | None = None, spaces: Spaces | None = None,
                 world_state: bool = False):
        self.family = family or Draw()
        maker = spaces or OwnSpaces
        self.num_targets = self.family.targets[1]
        agents, targets, skills = self.family.agents[1], self.num_targets, self.family.num_skills
        length = agents * (2 * targets + skills + 2) + targets * (skills + 4)
        super().__init__(agents, maker.Box(0.0, max(LONG, agents), (length,)),
                         maker.Discrete(targets + 1), world_state)

    @partial(jax.jit, static_argnums=0)
    def reset(self, key: Array) -> tuple[ByAgent, MacroState]:
        """A new episode at its first decision: observations by agent, and the state."""
        state = world.reset(draw(self.family, key))
        return self.get_obs(state), state

    def step_env(self, key: Array, state: MacroState, actions: ByAgent,
                 ) -> tuple[ByAgent, MacroState, ByAgent, ByAgent, dict[str, Array]]:
        """One macro-decision without a new episode; the rules draw no random numbers.

        Free agents choose one after the other. Whose action is not allowed when its turn comes
        waits; where that is not allowed either, it goes to the first target that is. Agents that
        are not free go on.

        Reward, the same for all: minus the time until the next decision, in units of the problem.
        Infos: [N] arrays `terminated`, `truncated` and `seconds` (that passed).
        """
        del key
        wanted = self._joint(actions)
        liking = 2.0 * jax.nn.one_hot(wanted, self.num_targets + 1)
        liking = liking.at[:, -1].add(1.0)
        choice, _ = world.choose(state, liking, jnp.zeros_like(liking))
        result = world.step(state, choice)
        dones = dict.fromkeys([*self.agents, "__all__"], result.terminated | result.truncated)
        said = {"terminated": result.terminated, "truncated": result.truncated,
                "seconds": result.seconds}
        infos = {name: jnp.broadcast_to(value, self.num_agents) for name, value in said.items()}
        rewards = dict.fromkeys(self.agents, -result.seconds / state.problem.unit)
        return self.get_obs(result.state), result.state, rewards, dones, infos

    def get_obs(self, state: MacroState) -> ByAgent:
        """Observations [D] by agent."""
        problem, targets = state.problem, self.num_targets

        def units(times: Array) -> Array:
            return jnp.clip(times / problem.unit, 0.0, LONG)

        bound = jax.nn.one_hot(state.goal, targets)
        open_ = world.open_targets(state)
        rows = jnp.concatenate([
            world.free(state)[:, None], units(state.busy)[:, None], bound,
            units(world.legs(problem, state.node)) * open_[None], problem.has], axis=1)
        rows = jnp.where(problem.agent_mask[:, None], rows, 0.0)
        told = jnp.concatenate([
            open_[:, None], problem.either[:, None], units(problem.service)[:, None],
            units(problem.appears - state.now)[:, None],
            world.missing(problem, state.goal)], axis=1)
        told = jnp.where(open_[:, None], told, 0.0).reshape(-1)
        return self._observed(self._own_first(rows, told))

    @partial(jax.jit, static_argnums=0)
    def get_avail_actions(self, state: MacroState) -> ByAgent:
        """[M + 1] bool by agent: where it may go now, and waiting where that leads anywhere.

        Each is right by itself; of agents that choose at once see `step_env`.
        """
        may = world.allowed(state, state.goal)
        return self._split(world.with_waiting(may, world.anyone_coming(state)))
