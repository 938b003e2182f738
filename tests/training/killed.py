"""A training in a process of its own that is killed once a checkpoint is there."""

import os
import signal
import subprocess
import sys
import time

from training.run import checkpoints

MAIN = "import sys; from moonteam.cli import main; sys.exit(main(sys.argv[1:]))"


def kill_when_saved(out, words, before=""):
    """Runs `moonteam WORDS` until `out` holds a checkpoint, then SIGKILL, wherever it then is.

    `before`: Python to run first in that process, in one line.
    """
    child = subprocess.Popen([sys.executable, "-c", before + MAIN, *words],
                             env=os.environ | {"JAX_PLATFORMS": "cpu"},
                             stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    deadline = time.monotonic() + 900  # beside other work compiling takes long
    try:
        while checkpoints.newest(out / "checkpoints") is None:
            assert child.poll() is None, child.communicate()[1].decode()
            assert time.monotonic() < deadline
            time.sleep(0.01)
    finally:
        child.send_signal(signal.SIGKILL)
        child.communicate()
    assert child.returncode == -signal.SIGKILL
    assert not (out / "report.json").exists()
