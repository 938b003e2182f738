"""What an update needs to know; static under jit.

Legend: T decisions, E environments, I episodes, S moments, K options.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from moonteam.policies.pointer import Outlook


@dataclass(frozen=True)
class Hyper:
    """Of all kinds of update."""

    num_steps: int = 16
    """T, decisions of each environment between updates."""
    epochs: int = 1
    """Passes over what was collected."""
    learned: float = 0.625
    """Share of the moments that are learned from; those at which somebody had a choice first, which
    are about as many."""
    minibatches: int = 10
    """Parts of a pass."""
    gae_lambda: float = 0.95
    """Of generalised advantage estimation; the discount is 1."""
    clip_eps: float = 0.2
    """Of the probability ratio."""
    vf_coef: float = 0.5
    """Weight of the critic's squared error."""
    max_grad_norm: float = 0.5
    """Gradient norm above which gradients are scaled down."""
    failure: float = 1.0
    """What each target left costs when an episode is cut off, in units of time."""
    worth: float = 1.0
    """What each unit of worth costs that lapses, in units of time."""
    tie: float = 0.02
    """Weight that time and way both keep at either end of the preference."""
    spread: bool = False
    """Preferences drawn from time to effort; else always time."""
    loose: float = 0.0
    """Share of the moments at which those on their way choose again."""
    optimiser: Literal["muon", "adam"] = "muon"
    """What makes steps of gradients; muon leaves to Adam what is no matrix between features."""
    ema: float = 0.998
    """Decay of the running mean of the weights, which is what is kept."""
    part: int = 12_800
    """Pairs of tokens that pass the network together: what fits the cache of a core."""

    def rows(self, view: Outlook) -> int:
        """Moments that pass the network together."""
        tokens = view.agents.shape[-1] + view.targets.shape[-1]
        return max(1, self.part // tokens**2)


@dataclass(frozen=True)
class Vine:
    """Of updates by branches alone, see `vine`."""

    episodes: int = 512
    """I, from which moments are taken; fewer where they are longer."""
    num_steps: int = 0
    """T, decisions of each of them; 0: twice the most targets."""
    moments: int = 2048
    """S, branched."""
    options: int = 3
    """K, options tried of each moment: the likeliest, and others drawn."""
    heat: float = 1.0
    """Temperature at which the episodes are played."""
    wide: float = 2.0
    """Temperature at which the other options are drawn."""
    floor: float = 0.2
    """Weight of a moment beside the entropy of its choice, by which moments are drawn."""
    tau: float = 0.1
    """Weight of the divergence from the policy as it was, in units of time."""
    minibatches: int = 16
    """Parts of a pass."""
    epochs: int = 2
    """Passes over the moments."""
    longest: int = 128
    """Decisions after which a branch is given up."""

    def over(self, devices: int) -> Vine:
        """The share of one of them."""
        return replace(self, episodes=self.episodes // devices, moments=self.moments // devices)


@dataclass(frozen=True)
class Tries:
    """Of updates by whole tries, see `tries`."""

    problems: int = 256
    """I, drawn for an update; fewer of a family that shrinks."""
    each: int = 16
    """K, tries of each."""
    heat: float = 0.5
    """Temperature of the policy that is tried, and learned."""
    num_steps: int = 0
    """L, decisions after which a try is given up; 0: twice the most targets."""
    learned: float = 0.1
    """Share of the I x K x L decisions that is learned from, the undecided first."""
    rows: int = 256
    """Moments of a minibatch."""
    epochs: int = 1
    """Passes over the moments."""

    @property
    def episodes(self) -> int:
        """I x K, played."""
        return self.problems * self.each

    @property
    def minibatches(self) -> int:
        """Of a pass."""
        return max(1, self._learned // self.rows)

    @property
    def moments(self) -> int:
        """S, learned from."""
        return self._learned // self.minibatches * self.minibatches

    @property
    def _learned(self) -> int:
        return int(self.episodes * self.num_steps * self.learned)

    def over(self, devices: int) -> Tries:
        """The share of one of them."""
        return replace(self, problems=self.problems // devices)
