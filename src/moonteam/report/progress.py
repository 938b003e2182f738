"""A progress bar on standard error, when somebody watches it."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from typing import TypeVar

T = TypeVar("T")


def track(items: Iterable[T], title: str, total: int) -> Iterator[T]:
    """The items, one by one, with a bar on standard error if it is a terminal."""
    if not sys.stderr.isatty():
        yield from items
        return
    from rich.console import Console
    from rich.progress import track as rich_track

    yield from rich_track(items, title, total, console=Console(stderr=True), transient=True)


def say(text: str) -> None:
    """A passing remark on standard error, if it is a terminal (such as: compiling)."""
    if sys.stderr.isatty():
        print(text, file=sys.stderr)
