"""What a guide is practised on, and the numbers of its evolution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from moonteam.planners.search.guides import Floats, vector_of
from moonteam.planners.search.neighbourhoods import SHAPES


@dataclass(frozen=True)
class Practice:
    """Problems of one size, each searched for so long."""

    agents: int
    targets: int
    places: int
    """That a search may try: so many take as long whatever is taken out, some 50 ns each."""
    problems: int
    """A generation; every candidate has the same."""
    weight: float = 1.0
    """Of the mean of the makespans' logarithms."""

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.agents}x{self.targets}, {self.places / 1e6:g} million places"


PRACTICES = (
    Practice(8, 40, 60_000, 24), Practice(8, 40, 300_000, 6),
    Practice(5, 20, 15_000, 16, 0.7), Practice(5, 20, 80_000, 6, 0.5),
    Practice(6, 12, 10_000, 12, 0.5), Practice(12, 60, 150_000, 6, 0.8),
    Practice(20, 100, 200_000, 6), Practice(20, 100, 1_000_000, 1, 0.7),
    Practice(50, 500, 300_000, 1, 0.4))
"""From crews that a millisecond is enough for to 50 robots and 500 targets."""


@dataclass(frozen=True)
class Guiding:
    """A run's numbers."""

    practices: tuple[Practice, ...] = PRACTICES
    population: int = 20
    """Candidates of a generation."""
    sigma: float = 0.4
    """Of the first generation, in units of `STEPS`."""
    rounds: int = 400
    """Generations."""
    held_out: int = 64
    """Problems that each practice is looked at by; fewer of what takes long."""
    seed: int = 0


def _steps() -> Floats:
    parts = {name: np.ones(shape) for name, shape in SHAPES.items()}
    parts["ways"][:] = parts["back"][:] = 0.5
    parts["size"][:] = 0.3, 0.2, 0.5
    parts["seed"][:, :4] = parts["near"][:] = parts["row"][1:] = 0.3
    parts["row"][0] = 0.5
    parts["place"][:] = np.array([0.02, 0.7, 0.4, 0.4])[:, None]
    parts["heat"][:] = np.array([0.3, 0.4])[:, None]
    parts["heat"][:, 1] = 0.0  # how hot it is by share is what heat says
    return vector_of(parts)


STEPS = _steps()
"""How far each weight is moved at first, by one sigma of the evolution."""
