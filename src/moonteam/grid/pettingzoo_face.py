"""Our environments with the interface of PettingZoo's `ParallelEnv`, for who does not use JAX.

    env = moonteam.make("MoonGrid-v0", face="pettingzoo")
    observations, infos = env.reset(seed=0)
    observations, rewards, terminations, truncations, infos = env.step(actions)

pettingzoo, and gymnasium that comes with it, are imported when one is made.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from moonteam.errors import InputError
from moonteam.grid.jaxmarl_face import Face

Floats = npt.NDArray[np.float32]
ByAgent = dict[str, Any]


def parallel(env: Face, name: str) -> Any:
    """A `ParallelEnv` around one of our environments, called `name` in its metadata.

    Raises InputError where pettingzoo is not installed.
    """
    try:
        base = importlib.import_module("pettingzoo").ParallelEnv
        spaces = importlib.import_module("gymnasium").spaces
    except ModuleNotFoundError as error:
        raise InputError(name, f"{error.name} is not installed; "
                         'pip install "moonteam[pettingzoo]"', "face") from None
    return type("Parallel", (Parallel, base), {})(env, name, spaces)


class Parallel:
    """The methods of a `ParallelEnv`.

    All agents end together. `infos` of each hold `action_mask` ([A] int8, 1 where the action may
    be taken) and what the environment says of the step. Who is given an action that is masked goes
    by the rules of the environment.
    """

    render_mode = None

    def __init__(self, env: Any, name: str, spaces: Any):
        self.env = env
        self.metadata = {"name": name, "render_modes": [], "is_parallelizable": True}
        self.possible_agents: list[str] = list(env.agents)
        self.agents: list[str] = []
        self.observation_spaces = {agent: spaces.Box(
            box.low, box.high, box.shape, np.float32) for agent, box in
            env.observation_spaces.items()}
        self.action_spaces = {agent: spaces.Discrete(int(one.n)) for agent, one in
                              env.action_spaces.items()}
        self._reset, self._step = env.reset, jax.jit(env.step_env)
        self._key: jax.Array | None = None
        self._state: Any = None
        self._seen: dict[str, Floats] = {}

    def observation_space(self, agent: str) -> Any:
        """gymnasium's Box [D] of float32."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Any:
        """gymnasium's Discrete."""
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict | None = None
              ) -> tuple[dict[str, Floats], dict[str, ByAgent]]:
        """A new episode. `seed` begins a series of episodes; without one it goes on.

        `options` are not looked at.
        """
        del options
        if seed is not None or self._key is None:
            entropy = np.random.SeedSequence(seed).generate_state(1)[0]
            self._key = jax.random.key(int(entropy) if seed is None else seed)
        self._key, key = jax.random.split(self._key)
        observations, self._state = self._reset(key)
        self.agents = list(self.possible_agents)
        return self._told(observations), self._infos({})

    def step(self, actions: Mapping[str, Any]
             ) -> tuple[dict[str, Floats], dict[str, float], dict[str, bool], dict[str, bool],
                        dict[str, ByAgent]]:
        """One joint action, an integer for every agent.

        Raises InputError for an action that is missing or outside its space.
        """
        agents = list(self.agents)
        if not agents:
            return {}, {}, {}, {}, {}
        joint: dict[str, Any] = {}
        for agent in agents:
            number = self.action_spaces[agent].n
            action = None if agent not in actions else np.asarray(actions[agent]).reshape(-1)
            if action is None or action.size != 1 or not 0 <= action[0] < number:
                raise InputError("step", f"{actions.get(agent)!r} is not allowed; "
                                 f"0 to {number - 1}", f"actions[{agent}]")
            joint[agent] = jnp.asarray(int(action[0]), jnp.int32)
        assert self._key is not None
        observations, self._state, rewards, dones, said = self._step(
            self._key, self._state, joint)
        said = {name: np.asarray(value) for name, value in said.items()}

        def each(name: str) -> dict[str, bool]:
            return {agent: bool(said[name][i]) for i, agent in enumerate(agents)}

        paid = {agent: float(rewards[agent]) for agent in agents}
        told, infos = self._told(observations), self._infos(said)
        if bool(dones["__all__"]):
            self.agents = []
        return told, paid, each("terminated"), each("truncated"), infos

    def state(self) -> Floats:
        """[N * D] all agents' observations side by side."""
        return np.concatenate([self._seen[agent] for agent in self.possible_agents])

    def render(self) -> None:
        """There is nothing to see."""

    def close(self) -> None:
        """Forgets the episode."""
        self.agents, self._state = [], None

    def _told(self, observations: Mapping[str, Any]) -> dict[str, Floats]:
        self._seen = {agent: np.asarray(observations[agent], np.float32)
                      for agent in self.possible_agents}
        return dict(self._seen)

    def _infos(self, said: dict[str, np.ndarray]) -> dict[str, ByAgent]:
        may = self.env.get_avail_actions(self._state)
        return {agent: {"action_mask": np.asarray(may[agent], np.int8)}
                | {name: value[i].item() for name, value in said.items()}
                for i, agent in enumerate(self.possible_agents)}
