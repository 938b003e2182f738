"""What a planner says of itself, and the one record of options that every planner is made from."""

from __future__ import annotations

import importlib
import math
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from moonteam.errors import InputError
from moonteam.planners import decode as decoding
from moonteam.planners.base import Objective, Planner, check_objective
from moonteam.planners.decode import Decode

if TYPE_CHECKING:
    from moonteam.policies.policy import Policy

DEFAULT_POLICY = "any_team"
"""The bundled policy that decides where none is named."""


NO_THREADS = "has no effect without a planner that takes them, such as lns"
"""What is said of threads that nobody would use."""


@dataclass(frozen=True)
class PlannerOptions:
    """What a user may ask of a planner. Raises InputError naming the option, as it is built.

    Each planner takes what concerns it and ignores the rest.
    """

    objective: Objective | None = None
    """None: makespan; for best-of-K what the preference asks for."""
    alpha: float = 1.0
    """Weight of the makespan in the objective weighted."""
    beta: float = 0.05
    """Weight of the moves in the objective weighted."""
    time_limit: float | None = None
    """Seconds a plan that anytime planners may take; None: theirs."""
    seed: int = 0
    """Of what is random in a whole plan; the closed loop gives one to `reset`."""
    policy: str | os.PathLike[str] | Policy = DEFAULT_POLICY
    """A policy file or the name of a bundled one, or one that is loaded."""
    decode: str = "argmax"
    """How actions are read from a policy, see `decode.ALLOWED`."""
    preference: float = 0.0
    """0 (time) to 1 (effort), for policies that were trained with it."""
    threads: int = 1
    """That a planner may search with side by side, if it can."""

    def __post_init__(self) -> None:
        if self.objective is not None:
            check_objective(self.objective, self.alpha, self.beta)
        limit = self.time_limit
        if limit is not None and not (math.isfinite(limit) and limit > 0):
            raise InputError("--time-limit", f"{limit} is not allowed; seconds above 0")
        if self.seed < 0:
            raise InputError("--seed", f"{self.seed} is not allowed; at least 0")
        if self.threads < 1:
            raise InputError("--threads", f"{self.threads} is not allowed; at least 1")
        if not 0.0 <= self.preference <= 1.0:
            raise InputError("--preference",
                             f"{self.preference} is not allowed; 0 (time) to 1 (effort)")
        decoding.parse(self.decode)

    @property
    def goal(self) -> tuple[Objective, float, float]:
        """Objective, alpha and beta of planners that have no preference."""
        return self.objective or "makespan", self.alpha, self.beta

    @property
    def decoding(self) -> Decode:
        """How actions are read from a policy."""
        return decoding.parse(self.decode)

    def loaded(self) -> Policy:
        """The policy. Raises InputError if the file is none."""
        from moonteam.policies.policy import Policy

        return self.policy if isinstance(self.policy, Policy) else Policy.load(self.policy)

    def with_policy(self) -> PlannerOptions:
        """The same with the policy loaded, for planners that are made many times."""
        return replace(self, policy=self.loaded())


@dataclass(frozen=True)
class PlannerKind:
    """A planner as it is registered: one object that answers what commands ask of it."""

    name: str
    make: Callable[[PlannerOptions], Planner]
    """A planner for one mission at a time. Raises InputError for what cannot be."""
    anytime: bool = False
    """Whether a time limit stops it with the best plan found so far."""
    most_targets: int | None = None
    """Open targets that it takes on; None: any number."""
    wants_policy: bool = False
    parallel: bool = False
    """Whether it searches with several threads side by side."""


def ortools(module: str, planner: str) -> Any:
    """A module of OR-Tools, which is an extra. Raises InputError, in `planner`'s name, without."""
    try:
        return importlib.import_module(f"ortools.{module}")
    except ImportError:
        raise InputError(f"--planner {planner}", "OR-Tools is not installed; "
                         "pip install moonteam[ortools]") from None
