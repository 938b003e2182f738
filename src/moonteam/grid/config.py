"""What is fixed when an environment is built: sizes, horizon, reward weights.

All of it is hashable, so that a config can be a static argument of `jax.jit`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from moonteam.errors import InputError, not_one_of
from moonteam.problem.scenario import MAX_SKILLS

Phase = Literal["bootstrap", "refinement"]
PHASES: tuple[Phase, ...] = ("bootstrap", "refinement")


@dataclass(frozen=True)
class RewardWeights:
    """Weight of each reward term in the sum; the defaults are the paper's refinement phase."""

    AR: float = 1.0
    TR: float = 1.0
    WC: float = 0.25
    SC: float = 0.3
    TC: float = 0.5
    TB: float = 0.2

    def phase(self, phase: Phase) -> RewardWeights:
        """The weights active in a training phase: bootstrap has AR, TR and WC alone."""
        if phase not in PHASES:
            raise InputError("phase", not_one_of(phase, PHASES))
        return replace(self, SC=0.0, TC=0.0, TB=0.0) if phase == "bootstrap" else self


@dataclass(frozen=True)
class EnvConfig:
    """A family of grid problems and how they are rewarded.

    `num_agents`, `num_targets`, `width`, `height` and `num_skills` say what `reset` samples;
    `step` and `observe` take all sizes from the state's arrays, padded or not.
    """

    num_agents: int = 3
    """N, agents that reset samples."""
    num_targets: int = 5
    """M, target slots that reset samples."""
    width: int = 32
    """W, cells along x."""
    height: int = 32
    """H, cells along y."""
    num_skills: int = 2
    """Different skills in the family, 1 to 8."""
    max_steps: int = 128
    """T_max, steps after which an episode is truncated."""
    num_buffer: int = 0
    """B, further targets that take the slots of the first B solved (replanning: 5)."""
    normalize_positions: bool = True
    """Observed positions are divided by (size - 1); False: raw cells."""
    weights: RewardWeights = field(default_factory=RewardWeights)
    """Weights of the reward terms."""
    c_ar: float = 0.0075
    """C_AR, decay of the approach reward, per cell."""
    literal_step_cost: bool = False
    """True: the step cost is -1 a move instead of -1/T_max."""

    def __post_init__(self):
        if not 1 <= self.num_skills <= MAX_SKILLS:
            raise InputError("num_skills", f"{self.num_skills} is not in 1..{MAX_SKILLS}")
        for name in ("num_agents", "num_targets", "width", "height", "max_steps"):
            if getattr(self, name) < 1:
                raise InputError(name, f"{getattr(self, name)} is not allowed; at least 1")
        if self.num_buffer < 0:
            raise InputError("num_buffer", f"{self.num_buffer} is not allowed; at least 0")

    @property
    def num_cells(self) -> int:
        """Cells of the map."""
        return self.width * self.height

    @property
    def obs_dim(self) -> int:
        """D, length of one agent's observation: 2N + 2M + N + M + M."""
        return observation_length(self.num_agents, self.num_targets)

    def phase(self, phase: Phase) -> EnvConfig:
        """The same family with the weights of a training phase."""
        return replace(self, weights=self.weights.phase(phase))


def observation_length(num_agents: int, num_targets: int) -> int:
    """Length of one agent's observation, 2N + 2M + N + M + M."""
    return 3 * num_agents + 4 * num_targets
