"""A progress bar on standard error, when somebody watches it."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
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


@contextmanager
def bar(title: str, total: int, done: int = 0) -> Iterator[Callable[[int, str], None]]:
    """A bar on standard error if that is a terminal, with the time left: `update(done, words)`.

    `done` is what lies behind already, where something is resumed; words may have two lines.
    """
    if not sys.stderr.isatty():
        yield lambda done, words: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    # The estimate must outlive a long silence: a chunk of training can take minutes.
    with Progress(TextColumn("{task.description}"), BarColumn(bar_width=10),
                  TimeRemainingColumn(), TextColumn("{task.fields[words]}"),
                  console=Console(stderr=True), transient=True,
                  speed_estimate_period=1800) as progress:
        task = progress.add_task(title, total=total, completed=done, words="")
        yield lambda done, words: progress.update(task, completed=done, words=words)


@contextmanager
def busy(text: str) -> Iterator[Callable[[str], None]]:
    """A sign of life on standard error if that is a terminal, where no end can be foreseen.

    `update(text)` changes what it says.
    """
    if not sys.stderr.isatty():
        yield lambda text: None
        return
    from rich.console import Console

    with Console(stderr=True).status(text) as status:
        yield lambda text: status.update(text)


def say(text: str) -> None:
    """A passing remark on standard error, if it is a terminal (such as: compiling)."""
    if sys.stderr.isatty():
        print(text, file=sys.stderr)
