"""One device, four devices, two processes of two: the same curve, a cell or a target a decision."""

import json
import os
import socket
import subprocess
import sys

import numpy as np
import pytest

from moonteam.cli import main
from tests.killed import MAIN
from tests.training.run.test_machine import words

MACRO = ("from training.mappo.macro import config; "
         "from tests.training.mappo.macro.test_macro import BOTH; "
         "config.PRESETS['quick'] = BOTH; ")
"""Python to run first: `train quick` with few numbers, a family by the critic and one by branches.
"""
FIGURES = ("success", "makespan", "moves", "mean_reward", "value_loss", "entropy")


def train(out, devices, *more):
    """Starts the command in a process that has so many devices."""
    return moonteam(devices, words(out, *more))


def moonteam(devices, arguments, before=""):
    environment = dict(os.environ, JAX_NUM_CPU_DEVICES=str(devices), JAX_PLATFORMS="cpu")
    return subprocess.Popen([sys.executable, "-c", before + MAIN, *arguments], env=environment,
                            stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)


def together():
    """The options of two processes, but for the number of each."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    return ["--coordinator", f"127.0.0.1:{port}", "--processes", "2", "--process"]


def finished(*runs):
    for run in runs:
        _, err = run.communicate(timeout=500)
        assert run.returncode == 0, err


def curve(out, figures=FIGURES):
    rows = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    return np.array([[row[key] for key in figures] for row in rows if figures[0] in row])


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """The curve of one device."""
    out = tmp_path_factory.mktemp("alone") / "run"
    finished(train(out, 1))
    return curve(out)


def test_four_devices_give_the_same_curve(alone, tmp_path):
    finished(train(tmp_path / "run", 4))
    assert json.loads((tmp_path / "run" / "report.json").read_text())["device"].startswith("4 x")
    np.testing.assert_allclose(curve(tmp_path / "run"), alone, rtol=1e-3, atol=1e-4)


@pytest.mark.soak
def test_two_processes_of_two_give_the_same_curve(alone, tmp_path):
    shared = together()
    finished(*[train(tmp_path / "run", 2, *shared, str(i)) for i in range(2)])
    np.testing.assert_allclose(curve(tmp_path / "run"), alone, rtol=1e-3, atol=1e-4)
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert report["device"].startswith("4 x")


@pytest.mark.soak
def test_two_processes_train_quick_as_one(tmp_path):
    """Of two devices in all, each with one of them; the same draws, the same curve."""
    def run(devices, out, *more):
        return moonteam(devices, ["train", "quick", "--out", str(tmp_path / out), *more], MACRO)

    finished(run(2, "alone"))
    shared = together()
    finished(*[run(1, "both", *shared, str(i)) for i in range(2)])
    figures = ("entropy", "success", "value_loss")
    np.testing.assert_allclose(curve(tmp_path / "both", figures),
                               curve(tmp_path / "alone", figures), rtol=1e-3, atol=1e-4)
    copy = tmp_path / "both" / "process-1"
    np.testing.assert_array_equal(curve(copy, figures), curve(tmp_path / "both", figures))
    report = json.loads((tmp_path / "both" / "report.json").read_text())
    assert report["device"].startswith("2 x")


def test_a_process_that_cannot_be(tmp_path, capsys):
    assert main(words(tmp_path / "run", "--coordinator", "127.0.0.1:1", "--processes", "2",
                      "--process", "2")) == 2
    assert "--process: 2 is not allowed; 0 to 1" in capsys.readouterr().err
    assert main(["train", "quick", "--out", str(tmp_path / "run"), "--coordinator", "127.0.0.1:1",
                 "--processes", "2", "--process", "2"]) == 2
    assert "--process: 2 is not allowed; 0 to 1" in capsys.readouterr().err
