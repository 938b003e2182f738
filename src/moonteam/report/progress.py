"""A progress bar on standard error, when somebody watches it.

Time left is by what was done since the bar began, compiling left out.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from moonteam import compilation

T = TypeVar("T")


def track(items: Iterable[T], title: str, total: int) -> Iterator[T]:
    """The items, one by one, with a bar on standard error if it is a terminal."""
    if not sys.stderr.isatty():
        yield from items
        return
    from rich.console import Console
    from rich.progress import track as rich_track

    yield from rich_track(items, title, total, console=Console(stderr=True), transient=True,
                          get_time=compilation.working_time)


class Pace:
    """How long the rest will take.

    Args:
      total: of what is to be done.
      done: before it began.
      clock: s; one that stands still while something is compiled.
    """

    def __init__(self, total: int, done: int,
                 clock: Callable[[], float] = compilation.working_time):
        self._total, self._first, self._clock = total, done, clock
        self.begun = clock()

    def left(self, done: int, now: float | None = None) -> float | None:
        """Seconds left, with so much done by now; None where nothing tells."""
        made = done - self._first
        if made <= 0:
            return None
        now = self._clock() if now is None else now
        return max(self._total - done, 0) * (now - self.begun) / made


def hours(seconds: float | None) -> str:
    """As h:mm:ss."""
    if seconds is None:
        return "-:--:--"
    whole = round(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02}:{whole % 60:02}"


@contextmanager
def bar(title: str, total: int, done: int = 0, *, plain_s: float = 0.0
        ) -> Iterator[Callable[[int, str], None]]:
    """A bar on standard error if that is a terminal, with the time left: `update(done, words)`.

    `done` is what lies behind already, where something is resumed; words may have two lines.
    `plain_s`: elsewhere a plain line each so many seconds; 0: nothing.
    """
    if not sys.stderr.isatty():
        yield _plain(title, total, done, plain_s) if plain_s else lambda done, words: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    pace = Pace(total, done)
    with Progress(TextColumn("{task.description}"), BarColumn(bar_width=10),
                  TextColumn("{task.fields[left]}", style="progress.remaining"),
                  TextColumn("{task.fields[words]}"),
                  console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(title, total=total, completed=done, words="", left=hours(None))
        yield lambda done, words: progress.update(task, completed=done, words=words,
                                                  left=hours(pace.left(done)))


def _plain(title: str, total: int, behind: int, every_s: float) -> Callable[[int, str], None]:
    """Lines such as "moonteam: video 210 of 720, about 0:31 left"."""
    pace = Pace(total, behind, time.monotonic)
    said = pace.begun

    def update(done: int, words: str) -> None:
        nonlocal said
        now = time.monotonic()
        if now - said < every_s:
            return
        said = now
        rest = pace.left(done, now) if done < total else None
        left = "" if rest is None else f", about {round(rest) // 60}:{round(rest) % 60:02d} left"
        more = " ".join(words.split())
        print(f"moonteam: {title} {done} of {total}{left}" + (f" ({more})" if more else ""),
              file=sys.stderr, flush=True)

    return update


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
