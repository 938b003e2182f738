"""Fresh scenarios where no set is given; the seed alone decides which."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from moonteam.errors import InputError
from moonteam.grid.scenarios import generate
from moonteam.problem.scenario import Scenario


@dataclass(frozen=True)
class Draw:
    """How many scenarios of which size, on open square maps with two skills."""

    count: int
    seed: int = 0
    num_agents: int = 3
    num_targets: int = 5
    side: int = 32
    max_steps: int = 128

    def check(self) -> None:
        """Raises InputError, in the words of the command line, if a number makes no sense."""
        options = {"--count": self.count, "--agents": self.num_agents, "--side": self.side,
                   "--targets": self.num_targets, "--max-steps": self.max_steps}
        for name, value in options.items():
            if value < 1:
                raise InputError(name, f"{value} is not allowed; at least 1")

    def scenarios(self, word: str) -> list[Scenario]:
        """The scenarios; the first ones stay the same when `count` grows."""
        self.check()
        return [generate(
            np.random.default_rng([self.seed, i]), num_agents=self.num_agents,
            num_targets=self.num_targets, size=(self.side, self.side),
            max_steps=self.max_steps, name=f"{word}-{self.seed}-{i:04d}")
            for i in range(self.count)]
