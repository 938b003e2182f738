"""The discrete world: problems, the environment, observation, rewards, travel.

from moonteam import grid

config = grid.preset_config("pi_5t")
state, observation = grid.reset(config, jax.random.key(0))
result = grid.step(config, state, actions)
"""

from moonteam.grid.config import EnvConfig, Phase, RewardWeights, observation_length
from moonteam.grid.env import STAY, available, renew, reset, reset_to, step
from moonteam.grid.jaxmarl_face import MoonGrid
from moonteam.grid.jaxmarl_macro import MoonMacro
from moonteam.grid.observe import observe
from moonteam.grid.rewards import PRESETS, TERMS, RewardPreset, preset, preset_config
from moonteam.grid.sampling import sample
from moonteam.grid.scenarios import config_for, generate, stack, to_problem, to_scenario
from moonteam.grid.travel import (
    UNREACHABLE,
    distance_fields,
    distances,
    first_step,
    problem_fields,
)
from moonteam.grid.types import Buffer, Problem, Rewards, State, StepResult

__all__ = [
    "PRESETS",
    "STAY",
    "TERMS",
    "UNREACHABLE",
    "Buffer",
    "EnvConfig",
    "MoonGrid",
    "MoonMacro",
    "Phase",
    "Problem",
    "RewardPreset",
    "RewardWeights",
    "Rewards",
    "State",
    "StepResult",
    "available",
    "config_for",
    "distance_fields",
    "distances",
    "first_step",
    "generate",
    "observation_length",
    "observe",
    "preset",
    "preset_config",
    "problem_fields",
    "renew",
    "reset",
    "reset_to",
    "sample",
    "stack",
    "step",
    "to_problem",
    "to_scenario",
]
