"""Commands that are interrupted or killed, each in a process of its own."""

import json
import math
import os
import random
import signal
import subprocess
import sys
import threading
import time

import pytest

from tests import killed
from tests.killed import kill_once
from tests.signalled import begins

CHILD = {"JAX_PLATFORMS": "cpu"}
BUSY = 8.0
"""s more than the second in which a signal is answered, for a machine that has other work."""


def rows(out):
    path = out / "rows.jsonl"
    return path.read_text().count("\n") if path.exists() else 0


class Child:
    """`moonteam WORDS`, and what it says on standard error as it says it."""

    def __init__(self, words):
        with begins():
            self.process = subprocess.Popen(
                [sys.executable, "-m", "moonteam.cli", *words], env=os.environ | CHILD,
                stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        self.said, self.when = b"", []
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self):
        while part := os.read(self.process.stderr.fileno(), 4096):
            self.said += part
            self.when.append(time.monotonic())

    def worked(self):
        """CPU s so far; after its end, without end."""
        if self.process.poll() is not None:
            return math.inf
        return killed.worked(self.process.pid)

    def answer(self, number, ready):
        """Sends a signal once it is `ready()`; (s to its answer, exit code, what it said)."""
        deadline = time.monotonic() + 600
        while not ready():
            assert self.process.poll() is None, self.said.decode()
            assert time.monotonic() < deadline
            time.sleep(0.01)
        sent = time.monotonic()
        self.process.send_signal(number)
        code = self.process.wait(600)
        ended = time.monotonic()
        self._reader.join()
        self.process.stderr.close()
        answered = min([ended, *(when for when in self.when if when >= sent)])
        return answered - sent, code, self.said.decode()


def check(child, ready, number=signal.SIGINT):
    """The signal is answered within a second, with one or two lines and the exit code 130."""
    took, code, said = child.answer(number, ready)
    if code == -number and not said:
        pytest.skip("all was done, and Python itself was ending")
    assert took < 1.0 + BUSY
    assert code == 130, said
    assert "Traceback" not in said
    assert "interrupted" in said
    return said


NUMBERS = pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])


@NUMBERS
@pytest.mark.parametrize("threads", ["1", "2"])
def test_a_search_is_left(number, threads):
    child = Child(["plan", "8x40:0", "--planner", "lns", "--time-limit", "600",
                   "--threads", threads])
    check(child, lambda: child.worked() > 1.0, number)


@NUMBERS
def test_rows_are_saved_and_gone_on_with(tmp_path, number):
    words = ["evaluate", "grid", "8x40", "--planner", "lns", "--time-limit", "0.3", "--limit", "40",
             "--out", str(tmp_path)]
    check(Child(words), lambda: rows(tmp_path) >= 2, number)
    done = rows(tmp_path)
    check(Child([*words, "--resume"]), lambda: rows(tmp_path) >= done + 2, number)
    keys = [json.loads(line)[0] for line in (tmp_path / "rows.jsonl").read_text().splitlines()]
    assert len({tuple(key) for key in keys}) == len(keys) >= done + 2


@pytest.mark.soak
@pytest.mark.parametrize("seconds", [0.5, 1.5, 4.0, 8.0, 16.0])
@pytest.mark.parametrize("words", [
    ("train", "quick"), ("train", "small"), ("train", "imitate", "quick"), ("train", "guide"),
    ("train", "refine", "any_team_imitated", "--families", "quick"),
    ("evaluate", "execution", "--count", "40"), ("evaluate", "sets"), ("evaluate", "peers"),
    ("rollout", "outpost", "--backend", "native"), ("rollout", "demo"), ("bench", "grid"),
    ("site", "--preset", "mare")], ids=" ".join)
def test_wherever_it_is(tmp_path, words, seconds):
    """Importing, making grounds, compiling, at work: after so many s of CPU, each somewhere."""
    child = Child([*words, "--out", str(tmp_path / "out")])
    while child.worked() < seconds:
        time.sleep(0.01)
    if child.process.poll() is not None:
        pytest.skip("is done by then")
    check(child, lambda: True)


@pytest.mark.soak
@pytest.mark.parametrize("mode", ["barrier", "clock"])
def test_an_evaluation_in_physics_survives_kills(tmp_path, mode):
    """Killed at random moments and gone on with, the same rows to the bit, each once."""
    words = ["evaluate", "execution", "--site", "flat", "--planner", "exact", "--side", "8",
             "--targets", "2", "--count", "8", "--width", "2", "--mode", mode, "--out"]
    chance, whole, parts, kills = random.Random(1), tmp_path / "whole", tmp_path / "parts", 0
    environment = os.environ | CHILD
    run = [sys.executable, "-m", "moonteam.cli", *words]
    assert subprocess.run([*run, str(whole)], env=environment, stdout=subprocess.DEVNULL,
                          check=False).returncode == 0
    more: list[str] = []
    while kills < 3 and rows(parts) < 8:
        old = rows(parts)
        kills += kill_once([*words, str(parts), *more],
                           lambda old=old: rows(parts) > old, 0.3 * chance.random())
        more = ["--resume"]
    assert subprocess.run([*run, str(parts), "--resume"], env=environment,
                          stdout=subprocess.DEVNULL, check=False).returncode == 0
    print(f"{kills} kills survived")
    assert kills >= 2
    found = [json.loads((folder / "report.json").read_text()) for folder in (whole, parts)]
    assert found[0]["rows"] == found[1]["rows"]
    assert found[0]["summary"] == found[1]["summary"]
    lines = [sorted((folder / "rows.jsonl").read_text().splitlines()) for folder in (whole, parts)]
    assert lines[0] == lines[1]


PLANNING = """
import signal

from moonteam import grid
from moonteam.planners.base import Snapshot
from moonteam.planners.lns import LnsPlanner

moment = Snapshot.start(grid.generate(0, num_agents=8, num_targets=40))
LnsPlanner(time_limit=0.003).plan(moment)
planning = False


def interrupt(number, frame):
    global planning
    if planning:
        planning = False
        raise KeyboardInterrupt


signal.signal(signal.SIGINT, interrupt)
print("ready", flush=True)
while True:
    try:
        planning = True
        LnsPlanner(time_limit=0.003).plan(moment)
        planning = False
    except KeyboardInterrupt:
        pass
"""


def test_an_interruption_inside_the_search_never_crashes_it():
    """What Numba runs of Python while it takes and returns arguments may not meet a signal."""
    with subprocess.Popen([sys.executable, "-c", PLANNING], stdout=subprocess.PIPE,
                          stderr=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"ready\n"
        rng = random.Random(0)
        for _ in range(150):
            time.sleep(rng.uniform(0.004, 0.012))
            process.send_signal(signal.SIGINT)
        time.sleep(0.1)
        assert process.poll() is None, process.stderr.read().decode()[-2000:]
        process.kill()
