"""All planners by name: ours, those of other packages, and those in a user's own file.

A planner of one's own is a class or a function that makes one, offered as
`--planner FILE.py:OBJECT`, by an entry point in the group `moonteam.planners`, or by
`register`. It is called with the `PlannerOptions` if it takes something that must be given or
is called `options`, else with nothing, and what it makes needs `reset` and `act`
(`base.Planner`). Where that has no `plan`, its whole plans are made of its decisions. A class
may say `anytime`, `most_targets` and `wants_policy` of itself, as `kind.PlannerKind` explains.
Ours are imported when they are first asked for.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

from moonteam.errors import InputError
from moonteam.planners.base import Planner, Snapshot, WholePlanner
from moonteam.planners.kind import PlannerKind, PlannerOptions
from moonteam.planners.plans.stepwise import Stepwise
from moonteam.registry import Registry

_HERE = "moonteam.planners"
_REGISTRY: Registry[object] = Registry("planner", _HERE, object, {
    "exact": f"{_HERE}.exact:PLANNER", "greedy": f"{_HERE}.greedy:PLANNER",
    "lns": f"{_HERE}.lns:PLANNER", "guided": f"{_HERE}.guided:PLANNER",
    "cpsat": f"{_HERE}.cpsat:PLANNER", "routing": f"{_HERE}.routing:PLANNER",
    "exhaustive": f"{_HERE}.exhaustive:PLANNER",
    "policy": f"{_HERE}.policy:PLANNER", "auto": f"{_HERE}.auto:PLANNER"})


def names() -> tuple[str, ...]:
    """Of all that are registered."""
    return _REGISTRY.names()


def register(name: str, planner: PlannerKind | Callable[..., Planner]) -> None:
    """Adds a planner in this process. Raises InputError if the name is taken."""
    _kind(name, planner, name)
    _REGISTRY.register(name, planner)


def find(name: str, source: object = "--planner") -> PlannerKind:
    """The planner of that name, or `FILE.py:OBJECT`. Raises InputError naming `source`."""
    return _kind(name, _REGISTRY.get(name, source), source)


def maker(name: str, options: PlannerOptions, source: object = "--planner"
          ) -> Callable[[], WholePlanner]:
    """Makes any number of planners, each for a mission of its own; a policy is loaded once.

    Raises InputError for what cannot be.
    """
    kind = find(name, source)
    if kind.wants_policy:
        options = options.with_policy()
    return lambda: _complete(kind, kind.make(options), options)


def make(name: str, options: PlannerOptions | None = None,
         source: object = "--planner") -> WholePlanner:
    """The planner of that name, which plans whole missions and decides step by step."""
    return maker(name, options or PlannerOptions(), source)()


def check_planner(planner: Planner, snapshot: Snapshot) -> None:
    """Raises InputError if a planner cannot serve a mission.

    `snapshot` holds all its targets, those that events will bring too.
    """
    check = getattr(planner, "check", None)
    if check is not None:
        check(snapshot)
    most, count = getattr(planner, "most_targets", None), len(snapshot.target_cells)
    if most is not None and count > most:
        raise InputError(f"--planner {planner.name}", f"{count} targets, those of events counted; "
                         f"the {planner.name} planner takes up to {most}; use greedy")


def shown(name: str) -> str:
    """A planner's name as tables show it: of `my_file.py:MyPlanner` the object."""
    file, _, thing = name.rpartition(":")
    return thing if file.endswith(".py") else name


def _kind(name: str, thing: object, source: object) -> PlannerKind:
    if isinstance(thing, PlannerKind):
        return thing
    if not callable(thing):
        raise InputError(source, f"{name} is a {type(thing).__name__}; a planner is a class, or a "
                         "function that makes one")
    made: Any = thing
    make = made if _takes_options(made) else lambda options: made()
    return PlannerKind(shown(name), make, bool(getattr(thing, "anytime", False)),
                       getattr(thing, "most_targets", None),
                       bool(getattr(thing, "wants_policy", False)))


def _takes_options(factory: Callable[..., object]) -> bool:
    """Whether it has a parameter that must be given, or one called `options`."""
    parameters = inspect.signature(factory).parameters.values()
    return any(p.name == "options" or (p.default is p.empty and p.kind in (
        p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)) for p in parameters)


def _complete(kind: PlannerKind, planner: Planner, options: PlannerOptions) -> WholePlanner:
    """The planner with all that a WholePlanner has."""
    for method in ("reset", "act"):
        if not callable(getattr(planner, method, None)):
            raise InputError(f"--planner {kind.name}", f"makes a {type(planner).__name__}, which "
                             f"has no {method}; a planner has reset and act")
    if isinstance(planner, WholePlanner):
        return planner
    return Stepwise(planner, kind.name, options.goal[0], options.seed)
