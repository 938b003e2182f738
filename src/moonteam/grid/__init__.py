"""The discrete world: problems, the environment, observation, rewards, travel.

from moonteam import grid

config = grid.preset_config("pi_5t")
state, observation = grid.reset(config, jax.random.key(0))
result = grid.step(config, state, actions)
"""

from moonteam.grid.config import EnvConfig, RewardWeights, observation_length
from moonteam.grid.env import STAY, available, renew, reset, reset_to, step
from moonteam.grid.observe import observe
from moonteam.grid.rewards import PRESETS, TERMS, RewardPreset, preset, preset_config
from moonteam.grid.sampling import sample
from moonteam.grid.types import Buffer, Problem, Rewards, State, StepResult

__all__ = [
    "PRESETS",
    "STAY",
    "TERMS",
    "Buffer",
    "EnvConfig",
    "Problem",
    "RewardPreset",
    "RewardWeights",
    "Rewards",
    "State",
    "StepResult",
    "available",
    "observation_length",
    "observe",
    "preset",
    "preset_config",
    "renew",
    "reset",
    "reset_to",
    "sample",
    "step",
]
