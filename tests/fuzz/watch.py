"""One input, one answer: within a second of processor time and a bound of memory."""

from __future__ import annotations

import contextlib
import resource
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

from moonteam.errors import InputError

SECONDS = 1.0
MEMORY = 1 << 30
"""Bytes of address space that an input may take."""


class TooLong(BaseException):
    """Not an Exception, lest what is tried catches it."""


@contextlib.contextmanager
def watched(seconds: float = SECONDS) -> Iterator[None]:
    """Raises TooLong after `seconds` of this process's time; what allocates more fails."""

    def over(*_: object) -> None:
        raise TooLong(f"no answer within {seconds} s")

    before = signal.signal(signal.SIGPROF, over)
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (held + MEMORY, hard))
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        signal.signal(signal.SIGPROF, before)


def answer(read: Callable[[], object]) -> str:
    """What comes out: "read", or "refused" by one line that a terminal shows as it is."""
    try:
        with watched():
            read()
    except InputError as error:
        line = str(error)
        assert line.isprintable(), ascii(line)
        assert len(line) < 1000, f"{len(line)} characters: {line[:100]}..."
        return "refused"
    return "read"
