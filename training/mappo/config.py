"""What a training run is made of: frozen dataclasses that tyro reads, and the presets.

Every figure of the `pi_*` presets is the paper's, except those marked in `Config` as not
stated there. Checked when built: an impossible division never reaches the first update.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from moonteam.errors import InputError, meant
from moonteam.grid import rewards
from moonteam.grid.config import EnvConfig, RewardWeights
from moonteam.policies.recurrent import RecurrentSpec
from training.mappo.hyper import Hyper

REFINEMENT = RewardWeights()
BOOTSTRAP = REFINEMENT.phase("bootstrap")


@dataclass(frozen=True)
class Phase:
    """One stretch of training: fresh optimiser, fresh learning-rate anneal, own rewards."""

    updates: int
    """PPO updates (n_TRAIN); 0 leaves the phase out."""
    num_envs: int
    """Environments stepped side by side (n_ENV)."""
    num_minibatches: int
    """Parts an update's environments are split into (n_MINI)."""
    weights: RewardWeights
    """Reward weights."""
    lr: float = 2e-3
    """Learning rate at the start; falls linearly to 0 (not stated in the paper)."""
    ent_coef: float = 0.01
    """Entropy bonus (not stated in the paper)."""
    seeds: int = 1
    """Seeds that the paper trained; a run here trains one."""


@dataclass(frozen=True)
class Config:
    """A whole training run. Fields from `gamma` on are not stated in the paper: JaxMARL's."""

    name: str
    """The preset these numbers started from."""
    bootstrap: Phase
    """First phase: learn to find targets (AR, TR, WC)."""
    refinement: Phase
    """Second phase: learn to be quick; keeps the weights."""
    num_agents: int = 3
    """Robots in the team."""
    num_targets: int = 5
    """Targets to solve."""
    num_skills: int = 2
    """Skills that exist."""
    size: tuple[int, int] = (32, 32)
    """Map, cells."""
    max_steps: int = 128
    """Steps until an episode is cut off (T_max)."""
    replanning: int = 0
    """Targets that appear later, each in the slot of a solved one (5 in 5T5R)."""
    approach_decay: float = 0.0075
    """C_AR of the approach reward."""
    literal_step_cost: bool = False
    """Take SC as printed, -1 a move, without dividing by T_max."""
    num_steps: int = 128
    """Steps that each environment takes between updates."""
    width: int = 128
    """Units of every hidden layer and of the GRU."""
    memory: bool = True
    """False replaces the GRU by a Dense layer."""
    normalise: bool = True
    """Divide observed positions by (size - 1)."""
    update_epochs: int = 4
    """Passes over the collected steps in each update."""
    gamma: float = 0.99
    """Discount."""
    gae_lambda: float = 0.95
    """Lambda of generalised advantage estimation."""
    clip_eps: float = 0.2
    """Clip of the probability ratio, and of the value's change."""
    vf_coef: float = 0.5
    """Weight of the value loss."""
    max_grad_norm: float = 0.5
    """Gradient norm above which gradients are scaled down, each network on its own."""
    adam_eps: float = 1e-5
    """Adam's epsilon."""
    timeout_is_terminal: bool = False
    """Treat running out of time as a true end (JaxMARL does); else bootstrap from the value."""
    precision: Literal["float32", "tf32", "bfloat16"] = "float32"
    """Of matrix products; parameters, memory and losses are float32 in all three."""
    seed: int = 0
    """Seed of everything random in training."""
    chunk_updates: int = 10
    """Updates between two looks from outside (logging, checkpoint, signals)."""
    eval_every: int = 5
    """Chunks between evaluations on held-out scenarios."""
    eval_scenarios: int = 256
    """Held-out scenarios of each evaluation while training."""

    def __post_init__(self) -> None:
        for phase in ("bootstrap", "refinement"):
            _check_phase(self, phase, getattr(self, phase))
        if self.num_steps > self.max_steps:
            raise InputError(
                self.name, f"{self.num_steps} is more than max_steps {self.max_steps}; at most one "
                "cut-off an environment fits between updates", "num_steps")
        if self.bootstrap.updates + self.refinement.updates < 1:
            raise InputError(self.name, "both phases have 0 updates; at least one is needed",
                             "updates")
        for key in ("num_steps", "update_epochs", "chunk_updates", "eval_every",
                    "eval_scenarios", "max_steps"):
            if getattr(self, key) < 1:
                raise InputError(self.name, f"{getattr(self, key)} is not allowed; at least 1", key)
        self.spec.check(self.name)
        if self.num_targets > self.size[0] * self.size[1] // 2:
            raise InputError(self.name, f"{self.num_targets} targets do not fit a map of "
                             f"{self.size[0]} x {self.size[1]} cells", "num_targets")

    @property
    def spec(self) -> RecurrentSpec:
        """The policy that this run trains."""
        return RecurrentSpec(self.num_agents, self.num_targets, self.size, self.num_skills,
                             self.width, self.memory, self.normalise)

    def env(self, phase: Phase) -> EnvConfig:
        """The grid world of a phase, observed in raw cells; the networks divide."""
        return EnvConfig(
            self.num_agents, self.num_targets, *self.size, self.num_skills, self.max_steps,
            self.replanning, normalize_positions=False, weights=phase.weights,
            c_ar=self.approach_decay, literal_step_cost=self.literal_step_cost)

    def hyper(self, phase: Phase) -> Hyper:
        """The numbers of a phase's updates."""
        return Hyper(
            phase.updates, phase.num_minibatches, phase.lr, phase.ent_coef, self.num_steps,
            self.update_epochs, self.gamma, self.gae_lambda, self.clip_eps, self.vf_coef,
            self.max_grad_norm, self.adam_eps, self.timeout_is_terminal)

    @property
    def phases(self) -> tuple[tuple[str, Phase], ...]:
        """The phases that have updates, in order."""
        both = (("bootstrap", self.bootstrap), ("refinement", self.refinement))
        return tuple((name, phase) for name, phase in both if phase.updates)

    def env_steps(self, phase: Phase) -> int:
        """Environment steps of a phase; each moves all agents once."""
        return phase.updates * phase.num_envs * self.num_steps


def _check_phase(config: Config, name: str, phase: Phase) -> None:
    for key in ("num_envs", "num_minibatches"):
        if getattr(phase, key) < 1:
            raise InputError(config.name, f"{getattr(phase, key)} is not allowed; at least 1",
                             f"{name}.{key}")
    if phase.updates < 0:
        raise InputError(config.name, f"{phase.updates} is not allowed; 0 or more",
                         f"{name}.updates")
    if phase.num_envs % phase.num_minibatches:
        raise InputError(
            config.name, f"{phase.num_envs} environments do not divide into "
            f"{phase.num_minibatches} minibatches ({phase.num_envs} / {phase.num_minibatches} = "
            f"{phase.num_envs / phase.num_minibatches:g})", f"{name}.num_minibatches")


def _paper(name: str, bootstrap: tuple[int, int, int], refinement: tuple[int, int, int],
           seeds: tuple[int, int]) -> Config:
    rewarded = rewards.preset(name)
    first, second = (
        Phase(updates, envs, minibatches, weights, seeds=count)
        for (updates, envs, minibatches), weights, count in zip(
            (bootstrap, refinement), (BOOTSTRAP, REFINEMENT), seeds, strict=True))
    return Config(name, first, second, num_targets=rewarded.num_targets,
                  approach_decay=rewarded.c_ar, replanning=rewarded.num_buffer,
                  chunk_updates=2, eval_every=5, eval_scenarios=500)


PRESETS = {
    "pi_5t": _paper("pi_5t", (572, 16384, 16), (1271, 30720, 32), (2, 4)),
    "pi_6t": _paper("pi_6t", (572, 16384, 16), (2034, 26880, 28), (2, 2)),
    "pi_7t": _paper("pi_7t", (1668, 16384, 16), (3814, 24576, 32), (2, 2)),
    "pi_5t5r": _paper("pi_5t5r", (572, 16384, 16), (1271, 30720, 32), (2, 4)),
    "small": Config(
        "small", Phase(1000, 512, 8, BOOTSTRAP, lr=2.5e-3),
        Phase(1000, 512, 8, REFINEMENT, lr=2e-3, ent_coef=0.003),
        num_targets=3, size=(8, 8), max_steps=48, num_steps=24, width=64, approach_decay=0.3,
        update_epochs=2, gamma=0.95, chunk_updates=10, eval_every=5),
    "laptop": Config(
        "laptop", Phase(2400, 512, 8, BOOTSTRAP, lr=2.5e-3),
        Phase(2400, 512, 8, REFINEMENT, lr=2e-3, ent_coef=0.003),
        num_targets=3, size=(16, 16), max_steps=96, num_steps=32, width=64, approach_decay=0.15,
        update_epochs=2, gamma=0.96, chunk_updates=30, eval_every=5),
}
"""`pi_5t5r` takes the five-target figures: the paper lists none of its own."""


def preset(name: str, others: Sequence[str] = (), words: Iterable[str] = ()) -> Config:
    """The preset of that name.

    Raises InputError listing the names, those of `others` too; `words` may have been meant as well.
    """
    if name not in PRESETS:
        names = [*others, *PRESETS]
        near = meant(name, [*names, *words])
        raise InputError(name or "moonteam train", ("no such preset; " if name else
                         "a preset must be given; ") + f"{near}one of: {', '.join(names)}")
    return PRESETS[name]
