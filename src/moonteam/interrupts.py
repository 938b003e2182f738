"""Ctrl-C and SIGTERM: one answer for every command, which `cli.main` puts around them all.

The first raises KeyboardInterrupt where Python code runs; commands then save what is done. Python
takes no notice of a signal while a compiled program runs or XLA compiles, so a thread watches too:

- nothing is done yet that could be lost: half a second later the process leaves, come what may.
- something is (`hold`): a line is printed at once, and what runs is waited for.
- a second signal: the process leaves half a second later.

Before it leaves so, what others do for it is ended (`leaving`).
"""

from __future__ import annotations

import atexit
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from types import FrameType
from typing import Any, NoReturn

CODE = 130
"""Exit code of whatever was interrupted, by Ctrl-C or SIGTERM."""
SIGNALS = (signal.SIGINT, signal.SIGTERM)
_GRACE = 0.5  # s in which the main thread may leave by itself
_LAST = 5.0  # s for what is registered to be done at the end


@dataclass
class Stop:
    """Whether somebody asked to stop; looked at between two pieces of work."""

    asked: bool = False


@dataclass
class _State:
    """Of the command that runs."""

    asked: int = 0  # signals so far
    number: int = signal.SIGINT  # the last
    sent: int = 0  # those of them that are our own
    raised: bool = False  # KeyboardInterrupt, somewhere
    held: bool = False  # work is done that is lost if the process leaves at once
    saved: str = ""  # what is on the disk by now, in words
    said: bool = False  # that it was interrupted
    stop: Stop | None = None  # who is told instead of interrupted, while something is held
    endings: list[Callable[[], object]] = field(default_factory=list)  # before it leaves


_now = _State()


def hold() -> None:
    """Says that work is done which the end of a command will save: it is waited for from now on."""
    _now.held = True


def release() -> None:
    """Says that all of it is saved: a signal is answered as at the beginning."""
    _now.held = False


@contextmanager
def leaving(end: Callable[[], object]) -> Iterator[None]:
    """Inside it `end()` is called, in another thread, if the process leaves in the middle."""
    endings = _now.endings
    endings.append(end)
    try:
        yield
    finally:
        endings.remove(end)


def saved(words: str) -> None:
    """Tells what is on the disk by now, for the line that answers a signal; empty: nothing."""
    _now.saved = words


def say() -> int:
    """Says that the command was interrupted; returns the exit code."""
    _now.said = True
    with suppress(OSError):
        print(f"moonteam: interrupted{_and_saved(_now)}", file=sys.stderr, flush=True)
    return CODE


def _and_saved(state: _State) -> str:
    return f"; {state.saved}" if state.saved else ""


def leave(code: int) -> NoReturn:
    """Ends the process after a signal.

    Python's own end waits for threads and programs that were left in the middle, without end.
    """
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError):
            stream.flush()
    timer = threading.Timer(_LAST, os._exit, (code,))
    timer.daemon = True
    timer.start()
    atexit._run_exitfuncs()
    os._exit(code)


def _write(text: str) -> None:
    with suppress(OSError):  # nobody reads it any more
        os.write(2, f"moonteam: {text}\n".encode())


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
    hook = sys.unraisablehook
    sys.unraisablehook = partial(_dropped, hook, state)
    try:
        yield
    finally:
        sys.unraisablehook = hook
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


@contextmanager
def kept() -> Iterator[None]:
    """Whatever a library does inside it, signals are answered afterwards as before."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            for number, handler in before.items():
                signal.signal(number, handler)


def _answered() -> dict[signal.Signals, Any]:
    """Answers the signals that are not ignored, as those of a job in the background are; returns
    what answered them before.
    """
    return {number: signal.signal(number, _answer) for number in SIGNALS
            if signal.getsignal(number) is not signal.SIG_IGN}


def _answer(number: int, frame: FrameType | None) -> None:
    """Python's part, on the main thread."""
    _now.asked, _now.number = _now.asked + 1, number
    if _now.stop is not None and _now.held and not _now.stop.asked:
        _now.stop.asked = True
        return
    _now.raised = True
    raise KeyboardInterrupt


def _dropped(hook: Callable[[Any], object], state: _State, what: Any) -> None:
    """Sends the signal again where Python had to drop the exception: where an object ends.

    What else is dropped after one was raised comes of objects that it left half made: nobody needs
    to read it.
    """
    if what.exc_type is not KeyboardInterrupt:
        if not state.raised:
            hook(what)
        return

    def again() -> None:
        state.sent += 1
        signal.pthread_kill(threading.main_thread().ident or 0, state.number)

    timer = threading.Timer(0.05, again)
    timer.daemon = True
    timer.start()


def _watch(reading: int, state: _State) -> None:
    """The other part: a byte comes for each signal at once, whatever the main thread is at."""
    came = heard = 0
    while data := os.read(reading, 16):
        came += sum(byte in SIGNALS for byte in data)
        if came - state.sent <= heard:
            continue
        heard = came - state.sent
        if heard == 1 and state.held:
            _write("stopping; what runs is finished and saved, a second Ctrl-C leaves at once"
                   + _and_saved(state))
        else:
            time.sleep(_GRACE)
            if not state.said:
                _write(f"interrupted{_and_saved(state)}")
            _end(state)
            os._exit(CODE)
    os.close(reading)


def _end(state: _State) -> None:
    """Calls what is to be called before the process leaves; waits no longer than a moment."""
    threads = [threading.Thread(target=end, daemon=True) for end in list(state.endings)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(_GRACE)
