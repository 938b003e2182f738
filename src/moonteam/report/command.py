"""The command line that makes a report again, from the parsed arguments alone.

An option whose value is its default is left out, and so is one that no figure depends on, which
is marked where it is declared: `json: Aside[bool] = False`. What is written parses back to
the same arguments (tests/commands/test_command_lines.py).
"""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Iterator
from typing import Annotated, Any, TypeVar, get_args, get_type_hints

import tyro

T = TypeVar("T")


class _NotAFigure:
    """The mark of `Aside`."""


Aside = Annotated[T, _NotAFigure]
"""An option on which no figure depends, such as where a report is written to."""

# tyro's marks are objects inside Annotated; they have no public name of their own.
_POSITIONAL, _AGAIN = (get_args(mark[int])[1]
                       for mark in (tyro.conf.Positional, tyro.conf.UseAppendAction))


def line(name: str, args: Any, default: Any = None) -> str:
    """`moonteam NAME` with the arguments `args`, a dataclass that tyro read.

    Values are compared with those of `default`, an instance that holds the defaults where these
    are not the fields' own.
    """
    before, after = [], []
    for option in _options(args, default, ""):
        (before if option.positional else after).extend(option.words())
    return shlex.join(["moonteam", *name.split(), *before, *after])


def figures(args: Any) -> dict[str, Any]:
    """The arguments on which figures depend, by field."""
    return {field.name: getattr(args, field.name) for field, notes in _fields(args)
            if _NotAFigure not in notes}


def flag(name: str) -> str:
    """The option of a field."""
    return f"--{name.replace('_', '-')}"


@dataclasses.dataclass(frozen=True)
class _Option:
    """One value that is not its default, and how it is written."""

    name: str
    value: Any
    positional: bool
    again: bool  # once for each of several values

    def words(self) -> list[str]:
        """The words of the command line."""
        if isinstance(self.value, bool):
            group, dot, last = self.name.rpartition(".")
            return [flag(group + dot + ("" if self.value else "no_") + last)]
        # str writes floats so that they are read back exactly, but 15 as 15.0
        values = [str(v).removesuffix(".0") if isinstance(v, float) else str(v)
                  for v in (self.value if isinstance(self.value, tuple) else [self.value])]
        if self.positional:
            return values
        if isinstance(self.value, tuple) and not self.again:
            return [flag(self.name), *values]
        return [word for value in values for word in self._one(value)]

    def _one(self, value: str) -> list[str]:
        # A value that begins like an option has to be tied to its own.
        return [f"{flag(self.name)}={value}"] if value.startswith("-") else [flag(self.name), value]


def _options(args: Any, default: Any, prefix: str) -> Iterator[_Option]:
    for field, notes in _fields(args):
        value = getattr(args, field.name)
        usual = _default(field) if default is None else getattr(default, field.name)
        name = next((note.name for note in notes if getattr(note, "name", None) is not None),
                    field.name)
        if dataclasses.is_dataclass(value):
            yield from _options(value, None if usual is dataclasses.MISSING else usual,
                                f"{prefix}{name}." if name else prefix)
        elif value != usual and _NotAFigure not in notes:
            yield _Option(prefix + name, value, _POSITIONAL in notes, _AGAIN in notes)


def _fields(args: Any) -> Iterator[tuple[dataclasses.Field[Any], list[Any]]]:
    """The fields, each with what is noted in its annotation."""
    hints = get_type_hints(type(args), include_extras=True)
    for field in dataclasses.fields(args):
        yield field, list(getattr(hints[field.name], "__metadata__", ()))


def _default(field: dataclasses.Field[Any]) -> Any:
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.default
