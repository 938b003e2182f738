"""moonteam plans for a team of unlike robots on the Moon and proves the plan in physics.

What is named here is the public face, each shown with an example in docs/python.md; everything
else is free to move.
"""

from moonteam.api import evaluate, load, make, plan, register, rollout, train
from moonteam.errors import InputError
from moonteam.problem.mission import Mission
from moonteam.problem.scenario import Scenario
from moonteam.version import __version__

__all__ = ["InputError", "Mission", "Scenario", "__version__", "evaluate", "load", "make", "plan",
           "register", "rollout", "train"]
