"""Commands in a process of their own that are killed, and gone on with."""

import os
import random
import signal
import subprocess
import sys
import time

from training.run import checkpoints

MAIN = "import sys; from moonteam.cli import main; sys.exit(main(sys.argv[1:]))"


def worked(pid):
    """CPU s of a process so far, which other processes cannot lengthen."""
    with open(f"/proc/{pid}/stat", encoding="utf-8") as file:
        user, system = file.read().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def kill_once(words, ready, delay=0.0, before=""):
    """Runs `moonteam WORDS`; SIGKILL so many seconds after `ready()`, wherever it then is.

    `before`: Python to run first in that process, in one line. False if it had ended by then.
    """
    child = subprocess.Popen([sys.executable, "-c", before + MAIN, *words],
                             env=os.environ | {"JAX_PLATFORMS": "cpu"},
                             stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    try:
        while not ready() and child.poll() is None:
            assert worked(child.pid) < 900  # compiling takes long
            time.sleep(0.01)
        time.sleep(delay)
    finally:
        child.send_signal(signal.SIGKILL)
        said = child.communicate()[1].decode()
    assert child.returncode in (0, -signal.SIGKILL), said
    return child.returncode != 0


def kill_when_saved(out, words, before="", kills=1):
    """Kills a training once `out` holds a checkpoint; then, gone on with, at random moments after
    each further one. Returns how often; at least once, before its end.
    """
    chance, done = random.Random(0), 0
    for number in range(kills):
        old = checkpoints.newest(out / "checkpoints")
        more = ["--resume"] if number else []
        delay = chance.random() if number else 0.0
        done += kill_once([*words, *more], lambda old=old: checkpoints.newest(
            out / "checkpoints") != old, delay, before)
        if (out / "report.json").exists():
            break
    assert done
    print(f"{done} kills survived")
    return done
