"""The grid environment with the interface of JaxMARL's `MultiAgentEnv`, without importing it.

    env = MoonGrid("pi_5t")
    observations, state = env.reset(key)
    observations, state, rewards, dones, infos = env.step(key, state, actions)

Dicts keyed by agent name exist only here; everything inside works on arrays.
"""

from __future__ import annotations

from functools import partial
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from jax import Array

from moonteam.grid import env
from moonteam.grid.config import EnvConfig
from moonteam.grid.observe import observe
from moonteam.grid.rewards import preset_config
from moonteam.grid.types import State
from moonteam.problem.rules import NUM_ACTIONS

ByAgent = dict[str, Array]


class Discrete:
    """The integers 0 .. n-1."""

    def __init__(self, num_categories: int, dtype: Any = jnp.int32):
        self.n = num_categories
        self.shape = ()
        self.dtype = dtype

    def sample(self, rng: Array) -> Array:
        """A uniform draw."""
        return jax.random.randint(rng, self.shape, 0, self.n, self.dtype)

    def contains(self, x: Array) -> Array:
        """Whether `x` is one of them."""
        return (x >= 0) & (x < self.n)


class Box:
    """Arrays of a shape, each entry between `low` and `high`."""

    def __init__(self, low: float, high: float, shape: tuple[int, ...], dtype: Any = jnp.float32):
        self.low, self.high, self.shape, self.dtype = low, high, shape, dtype

    def sample(self, rng: Array) -> Array:
        """A uniform draw."""
        return jax.random.uniform(rng, self.shape, self.dtype, self.low, self.high)

    def contains(self, x: Array) -> Array:
        """Whether every entry of `x` is within the bounds."""
        return jnp.all((x >= self.low) & (x <= self.high))


class Spaces(Protocol):
    """A module of space classes: this one, or `jaxmarl.environments.spaces`."""

    Discrete: Any
    Box: Any


class OwnSpaces:
    """Those of this module."""

    Discrete = Discrete
    Box = Box


class Face:
    """What our environments have in common: agents, their spaces, the automatic reset.

    With `world_state` observations hold "world_state" too, [state_size] float32: all agents'
    observations side by side, for JaxMARL's scripts that read it from the environment (SMAX's).
    """

    def __init__(self, num_agents: int, observation: Any, action: Any, world_state: bool = False):
        self.num_agents = self.num_allies = num_agents
        self.state_size = num_agents * observation.shape[0]
        self._world_state = world_state
        self.agents = [f"agent_{i}" for i in range(num_agents)]
        self.observation_spaces = dict.fromkeys(self.agents, observation)
        self.action_spaces = dict.fromkeys(self.agents, action)

    @property
    def name(self) -> str:
        """The environment's name."""
        return type(self).__name__

    @property
    def agent_classes(self) -> dict[str, list[str]]:
        """One class: every agent has the same spaces."""
        return {"robot": list(self.agents)}

    def observation_space(self, agent: str) -> Any:
        """Box of the observation's length."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Any:
        """Discrete, one number an action."""
        return self.action_spaces[agent]

    @partial(jax.jit, static_argnums=0)
    def reset(self, key: Array) -> tuple[ByAgent, Any]:
        """A new episode: observations by agent, and the state."""
        raise NotImplementedError

    def step_env(self, key: Array, state: Any, actions: ByAgent,
                 ) -> tuple[ByAgent, Any, ByAgent, ByAgent, dict[str, Array]]:
        """One step without a new episode."""
        raise NotImplementedError

    def get_obs(self, state: Any) -> ByAgent:
        """Observations [D] by agent."""
        raise NotImplementedError

    @partial(jax.jit, static_argnums=0)
    def step(self, key: Array, state: Any, actions: ByAgent, reset_state: Any = None,
             ) -> tuple[ByAgent, Any, ByAgent, ByAgent, dict[str, Array]]:
        """One step, and a new episode where this one ended.

        Args:
          key: JAX key, drawn from only for the new episode.
          state: as from `reset` or `step`.
          actions: [] or [1] integer by agent.
          reset_state: what to begin again from; None: a random problem.

        Returns:
          Observations (of the new episode where one began), state, rewards, dones with
          "__all__", and infos, see `step_env`.
        """
        _, key_reset = jax.random.split(key)
        observations, after, rewards, dones, infos = self.step_env(key, state, actions)
        if reset_state is None:
            fresh_observations, fresh = self.reset(key_reset)
        else:
            fresh_observations, fresh = self.get_obs(reset_state), reset_state
        ended = dones["__all__"]
        after, observations = jax.tree.map(
            lambda new, old: jax.lax.select(ended, new, old),
            (fresh, fresh_observations), (after, observations))
        return observations, after, rewards, dones, infos

    def _split(self, values: Array) -> ByAgent:
        return {agent: values[i] for i, agent in enumerate(self.agents)}

    def _observed(self, observation: Array) -> ByAgent:
        """Observations [N, D] by agent, and the world state where it is asked for."""
        whole = {"world_state": observation.reshape(-1)} if self._world_state else {}
        return self._split(observation) | whole

    def _own_first(self, rows: Array, *shared: Array) -> Array:
        """[N, D]: each agent's row [N, F], then the others' by index, then what all see [..]."""
        return jnp.stack([
            jnp.concatenate([rows[i], jnp.delete(rows, i, axis=0).reshape(-1), *shared])
            for i in range(self.num_agents)])

    def _joint(self, actions: ByAgent) -> Array:
        """[N] int32. JaxMARL's recurrent MAPPO hands each agent an action of shape [1]."""
        return jnp.stack([jnp.reshape(jnp.asarray(actions[agent]), ()).astype(jnp.int32)
                          for agent in self.agents])


class MoonGrid(Face):
    """The grid as a JaxMARL environment; actions are up, down, left, right, stay.

    Args:
      config: the family of problems that `reset` samples, and the rewards; or the name of a
        preset, such as "pi_5t".
      spaces: where `Discrete` and `Box` come from. Wrappers that look at the class of a
        space (JaxMARL's CTRolloutManager) need `jaxmarl.environments.spaces` here.
      world_state: whether observations hold "world_state" too, see `Face`.
    """

    def __init__(self, config: EnvConfig | str | None = None, spaces: Spaces | None = None,
                 world_state: bool = False):
        named = preset_config(config) if isinstance(config, str) else config
        self.config = named or EnvConfig()
        maker = spaces or OwnSpaces
        bound = float(max(self.config.width - 1, self.config.height - 1,
                          2**self.config.num_skills - 1))
        super().__init__(self.config.num_agents,
                         maker.Box(-bound, bound, (self.config.obs_dim,)),
                         maker.Discrete(NUM_ACTIONS), world_state)

    @partial(jax.jit, static_argnums=0)
    def reset(self, key: Array) -> tuple[ByAgent, State]:
        """A new episode: observations by agent, and the state."""
        state, observation = env.reset(self.config, key)
        return self._observed(observation), state

    def step_env(self, key: Array, state: State, actions: ByAgent,
                 ) -> tuple[ByAgent, State, ByAgent, ByAgent, dict[str, Array]]:
        """One step without a new episode; the rules draw no random numbers.

        Infos: [N] arrays `terminated`, `truncated` and `true_moves`.
        """
        del key
        result = env.step(self.config, state, self._joint(actions))
        ended = result.terminated | result.truncated
        dones = dict.fromkeys([*self.agents, "__all__"], ended)
        everyone = (self.num_agents,)
        infos = {
            "terminated": jnp.broadcast_to(result.terminated, everyone),
            "truncated": jnp.broadcast_to(result.truncated, everyone),
            "true_moves": result.true_moves,
        }
        return (self._observed(result.observation), result.state, self._split(result.reward),
                dones, infos)

    def get_obs(self, state: State) -> ByAgent:
        """Observations [D] by agent."""
        return self._observed(observe(self.config, state))

    @partial(jax.jit, static_argnums=0)
    def get_avail_actions(self, state: State) -> ByAgent:
        """[5] bool by agent: staying, and moves that the map does not turn back."""
        return self._split(env.available(state))
