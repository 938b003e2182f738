"""Kinds of robot: our own, those of installed packages, and those in a user's file."""

from collections.abc import Iterable

from moonteam.registry import Registry
from moonteam.robots.base import RobotKind

OWN = ("drone", "legged", "wheeled")
"""The kinds of this package, which random teams are made of."""

KINDS = Registry("robot kind", "moonteam.robots", RobotKind, {
    name: f"moonteam.robots.{name}:{name.upper()}" for name in OWN})

__all__ = ["KINDS", "OWN", "RobotKind", "shades"]


def shades(names: Iterable[str]) -> dict[str, str]:
    """#rrggbb of ground closed to each of those kinds that are registered."""
    known = KINDS.names()
    return {name: KINDS.get(name).colour for name in names if name in known}
