"""Signals while Python code runs, and while a compiled program does that knows nothing of them."""

import os
import signal
import subprocess
import sys
import time

import pytest

from tests.signalled import begins

BUSY = 8.0
"""s more than promised, for a machine that has other work."""
BEGIN = """
import hashlib, sys
from moonteam import interrupts

def compiled(rounds):
    "Without the lock of Python, and without a look at signals."
    hashlib.pbkdf2_hmac("sha256", b"", b"", rounds)

def main():
    print("ready", flush=True)
    try:
        work()
    except KeyboardInterrupt:
        print("saved", flush=True)
        return interrupts.say()

def started():
    with interrupts.handled():
        code = main()
        if interrupts.asked():
            interrupts.leave(code or 0)
"""
ENDLESS = 1 << 31
NUMBERS = pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])


def run(work, *signals, ignored=()):
    """(code, standard output, standard error, s from the last signal to the end) of some work."""
    with begins(ignored):
        child = subprocess.Popen(
            [sys.executable, "-c", f"{BEGIN}\ndef work():\n    {work}\nstarted()"],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert child.stdout.readline() == b"ready\n"
    said = b""
    for number in signals:
        time.sleep(0.2)
        sent = time.monotonic()
        child.send_signal(number)
        if len(signals) > 1 and not said:  # the first is answered with a line
            said = os.read(child.stderr.fileno(), 4096)
            assert time.monotonic() - sent < 1.0 + BUSY
    out, err = child.communicate(timeout=120)
    return child.returncode, out.decode(), (said + err).decode(), time.monotonic() - sent


@NUMBERS
def test_python_code_is_left_at_once(number):
    code, out, err, seconds = run("import time; time.sleep(100)", number)
    assert (code, out, err) == (130, "saved\n", "moonteam: interrupted\n")
    assert seconds < 1.0 + BUSY


@NUMBERS
def test_where_nothing_is_done_a_compiled_program_is_not_waited_for(number):
    code, out, err, seconds = run(f"compiled({ENDLESS - 1})", number)
    assert (code, out, err) == (130, "", "moonteam: interrupted\n")
    assert seconds < 1.0 + BUSY


@NUMBERS
def test_where_something_is_done_a_line_comes_at_once_and_the_program_is_waited_for(number):
    code, out, err, _ = run("interrupts.hold(); compiled(3_000_000)", number)
    assert (code, out) == (130, "saved\n")
    assert err.startswith("moonteam: stopping; what runs is finished and saved, a second Ctrl-C ")
    assert err.endswith("moonteam: interrupted\n")


def test_what_is_saved_stands_in_the_line_that_comes_at_once():
    _, _, err, _ = run("interrupts.saved('update 7 is saved'); interrupts.hold(); "
                       "compiled(3_000_000)", signal.SIGINT)
    stopping, interrupted = err.splitlines()
    assert stopping.startswith("moonteam: stopping; what runs is finished and saved, a second ")
    assert stopping.endswith("; update 7 is saved")
    assert interrupted == "moonteam: interrupted; update 7 is saved"
    _, _, err, seconds = run(f"interrupts.saved('update 7 is saved'); compiled({ENDLESS - 1})",
                             signal.SIGINT)
    assert err == "moonteam: interrupted; update 7 is saved\n"
    assert seconds < 1.0 + BUSY


def test_a_second_signal_leaves_at_once():
    code, out, err, seconds = run(f"interrupts.hold(); compiled({ENDLESS - 1})", signal.SIGINT,
                                  signal.SIGINT)
    assert (code, out) == (130, "")
    assert "stopping" in err
    assert seconds < 1.0 + BUSY


def test_what_is_let_go_of_is_not_waited_for_and_what_runs_beside_is_ended():
    work = """
    interrupts.hold()
    interrupts.release()
    with interrupts.leaving(lambda: print("ended", flush=True)):
        compiled(ENDLESS)"""
    code, out, err, seconds = run(work.strip().replace("ENDLESS", str(ENDLESS - 1)), signal.SIGINT)
    assert (code, out, err) == (130, "ended\n", "moonteam: interrupted\n")
    assert seconds < 1.0 + BUSY


def test_between_two_pieces_the_first_signal_only_asks():
    work = """
    interrupts.hold()
    with interrupts.postponed() as stop:
        while not stop.asked:
            compiled(200_000)
    print("finished", flush=True)"""
    code, out, err, _ = run(work.strip(), signal.SIGTERM)
    assert (code, out) == (0, "finished\n")
    assert "stopping" in err


def test_an_exception_that_python_drops_is_raised_again():
    work = """
    import time, weakref
    class Thing: pass
    thing = Thing()
    kept = weakref.ref(thing, lambda _: time.sleep(1.0))  # Python drops what is raised in it
    interrupts.hold()
    del thing
    time.sleep(100)"""
    code, out, err, seconds = run(work.strip(), signal.SIGINT)
    assert (code, out) == (130, "saved\n")
    assert "Traceback" not in err
    assert seconds < 2.0 + BUSY


def test_what_was_ignored_at_the_start_is_ignored():
    code, out, _, _ = run("import time; time.sleep(2)", signal.SIGINT, ignored=[signal.SIGINT])
    assert (code, out) == (0, "")


HALF_MADE = """
    class Made:
        def __init__(self):
            {wait}
            self.inside = 1
        def __del__(self):
            del self.inside
    try:
        Made()
    except OSError:
        pass
    {after}"""


def test_what_an_interruption_left_half_made_ends_without_a_word():
    """As libraries' objects do whose `__init__` was interrupted; a failure of theirs is shown."""
    work = HALF_MADE.format(wait="import time; time.sleep(100)", after="").strip()
    code, out, err, _ = run(work, signal.SIGINT)
    assert (code, out, err) == (130, "saved\n", "moonteam: interrupted\n")
    work = HALF_MADE.format(wait="raise OSError", after="import time; time.sleep(100)").strip()
    code, out, err, _ = run(work, signal.SIGINT)
    assert (code, out) == (130, "saved\n")
    assert "AttributeError" in err
