"""Planners by the clock, by name: ours, other packages', and those in a user's own file.

One's own is a class, or a function, that makes an object with `plan(moment) -> TimedPlan`
(`base.TimedPlanner`), offered as `--planner FILE.py:OBJECT` or by an entry point in the group
`moonteam.planners.seconds`. It is called with what it has parameters for: `objective`
(makespan, effort or weighted), `alpha`, `beta`, `time_limit`, `seed`, `threads`, or all as
`options`. A
class may say of itself `most_targets`, the open targets that it takes on, and `wants_policy`, that
it decides by the policy of the options. Ours are imported when they are first asked for.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, cast

from moonteam.errors import InputError
from moonteam.planners.kind import PlannerOptions
from moonteam.planners.seconds.base import TimedPlanner
from moonteam.registry import Registry

_HERE = "moonteam.planners.seconds"
_REGISTRY: Registry[object] = Registry("planner by the clock", _HERE, object, {
    "exact": f"{_HERE}.exact:ExactPlanner", "greedy": f"{_HERE}.greedy:GreedyPlanner",
    "lns": f"{_HERE}.local:LocalSearchPlanner", "cpsat": f"{_HERE}.cpsat:CpSatPlanner",
    "routing": f"{_HERE}.routing:RoutingPlanner",
    "exhaustive": f"{_HERE}.exhaustive:ExhaustivePlanner",
    "policy": f"{_HERE}.policy:PolicyPlanner", "auto": f"{_HERE}.auto:AutoPlanner"})


@dataclass(frozen=True)
class TimedPlannerKind:
    """A planner by the clock as it is registered."""

    name: str
    factory: Callable[..., TimedPlanner]
    most_targets: int | None = None
    """Open targets that it takes on; None: any number."""
    wants_policy: bool = False
    """Whether it decides by the policy of the options."""

    @property
    def anytime(self) -> bool:
        """Whether a time limit stops it with the best plan found so far."""
        takes = set(self._parameters)
        return "time_limit" in takes or ("options" in takes and not self.wants_policy)

    @property
    def parallel(self) -> bool:
        """Whether it searches with as many threads as it is given."""
        return "threads" in self._parameters

    @property
    def _parameters(self) -> Mapping[str, inspect.Parameter]:
        return inspect.signature(self.factory).parameters

    def make(self, options: PlannerOptions) -> TimedPlanner:
        """A planner of these options. Raises InputError for what cannot be."""
        objective = options.goal[0]
        offered: dict[str, Any] = {
            "objective": "effort" if objective == "moves" else objective, "seed": options.seed,
            "alpha": options.alpha, "beta": options.beta, "threads": options.threads,
            "options": options}
        if options.time_limit is not None:
            offered["time_limit"] = options.time_limit
        planner = self.factory(**{k: v for k, v in offered.items() if k in self._parameters})
        if not callable(getattr(planner, "plan", None)):
            raise InputError(f"--planner {self.name}", f"makes a {type(planner).__name__}, which "
                             "has no plan; a planner by the clock has plan(moment)")
        return planner


def names() -> tuple[str, ...]:
    """Of all that are registered."""
    return _REGISTRY.names()


def register(name: str, factory: Callable[..., TimedPlanner]) -> None:
    """Adds a planner in this process. Raises InputError if the name is taken."""
    _REGISTRY.register(name, factory)


def find(name: str, source: object = "--planner") -> TimedPlannerKind:
    """The planner of that name, or `FILE.py:OBJECT`. Raises InputError naming `source`."""
    thing = _REGISTRY.get(name, source)
    if not callable(thing):
        raise InputError(source, f"{name}: a {type(thing).__name__} is no planner by the clock, "
                         "which is a class, or a function that makes one")
    own = name.rpartition(":")[2] if ".py:" in name else name
    factory = cast(Callable[..., TimedPlanner], thing)
    return TimedPlannerKind(own, factory, getattr(thing, "most_targets", None),
                            bool(getattr(thing, "wants_policy", False)))
