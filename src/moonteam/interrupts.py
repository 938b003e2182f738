"""Ctrl-C and SIGTERM: one answer for every command, which `cli.main` puts around them all.

The first raises KeyboardInterrupt where Python code runs; commands then save what is done. Python
takes no notice of a signal while a compiled program runs or XLA compiles, so a thread watches too:

- nothing is done yet that could be lost: half a second later the process leaves, come what may.
- something is (`hold`): a line is printed at once, and what runs is waited for.
- a second signal: the process leaves half a second later.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import Any

CODE = 130
"""Exit code of whatever was interrupted, by Ctrl-C or SIGTERM."""
SIGNALS = (signal.SIGINT, signal.SIGTERM)
_GRACE = 0.5  # s in which the main thread may leave by itself


@dataclass
class Stop:
    """Whether somebody asked to stop; looked at between two pieces of work."""

    asked: bool = False


@dataclass
class _State:
    """Of the command that runs."""

    asked: int = 0  # signals so far
    held: bool = False  # work is done that is lost if the process leaves at once
    said: bool = False  # that it was interrupted
    stop: Stop | None = None  # who is told instead of interrupted, while something is held


_now = _State()


def hold() -> None:
    """Says that work is done which the end of a command will save: it is waited for from now on."""
    _now.held = True


def say() -> int:
    """Says that the command was interrupted; returns the exit code."""
    print("moonteam: interrupted", file=sys.stderr)
    _now.said = True
    return CODE


def asked() -> bool:
    """Whether a signal came, even if a library made another exception of it."""
    return _now.asked > 0


@contextmanager
def handled() -> Iterator[None]:
    """Around a command: signals are answered as the module says. In other threads, nothing."""
    global _now
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    _now = state = _State()
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    before = _answered()
    wakeup = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    threading.Thread(target=_watch, args=(reading, state), daemon=True).start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(wakeup)
        for number, handler in before.items():
            signal.signal(number, handler)
        os.close(writing)


@contextmanager
def postponed() -> Iterator[Stop]:
    """Inside it the first signal only sets `asked`, once something is held."""
    global _now
    stop = Stop()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    outer, before = _now, {}
    if signal.getsignal(signal.SIGTERM) is not _answer:  # called from Python, not as a command
        _now, before = _State(held=True), _answered()
    _now.stop = stop
    try:
        yield stop
    finally:
        _now.stop = None
        for number, handler in before.items():
            signal.signal(number, handler)
        _now = outer


def _answered() -> dict[signal.Signals, Any]:
    """Answers the signals that are not ignored, as those of a job in the background are; returns
    what answered them before.
    """
    return {number: signal.signal(number, _answer) for number in SIGNALS
            if signal.getsignal(number) is not signal.SIG_IGN}


def _answer(number: int, frame: FrameType | None) -> None:
    """Python's part, on the main thread."""
    _now.asked += 1
    if _now.stop is not None and _now.held and not _now.stop.asked:
        _now.stop.asked = True
        return
    raise KeyboardInterrupt


def _watch(reading: int, state: _State) -> None:
    """The other part: a byte comes for each signal at once, whatever the main thread is at."""
    came = 0
    while data := os.read(reading, 16):
        came += sum(byte in SIGNALS for byte in data)
        if came == 1 and state.held:
            os.write(2, b"moonteam: stopping; what runs is finished and saved, a second Ctrl-C "
                        b"leaves at once\n")
        elif came:
            time.sleep(_GRACE)
            if not state.said:
                os.write(2, b"moonteam: interrupted\n")
            os._exit(CODE)
    os.close(reading)
