"""Pieces on a Ray cluster: the same reports and runs, whatever is killed; no Ray without --on."""

import contextlib
import importlib.util
import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from moonteam.cli import main
from moonteam.policies.policy_file import load_policy
from tests.killed import MAIN
from training.run import checkpoints, metrics

GOLDEN = Path("tests/golden/certified_optima.jsonl").resolve()
needs_ray = pytest.mark.skipif(importlib.util.find_spec("ray") is None,
                               reason="needs pip install 'moonteam[ray]'")
ALONE = os.environ | {"JAX_PLATFORMS": "cpu", "JAX_NUM_CPU_DEVICES": "1",
                      "RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": "0123456789abcdef" * 4}
PIECES = """
import os, signal, sys
from pathlib import Path
from moonteam.cluster import cluster
from moonteam.errors import InputError

def piece(number, folder):
    mark = Path(folder) / "killed"
    if number == 3 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if number == 7:
        raise InputError("set.jsonl", "is not allowed", "line 7")
    return number ** 2

folder = sys.argv[1]
with cluster("ray") as workers:
    found = dict(workers.done(piece, [(n, folder) for n in range(6)]))
    assert found == {n: n ** 2 for n in range(6)}, found
    assert (Path(folder) / "killed").exists()
    assert workers.size(1) == 1 and workers.size(10**6) == 8
    for work, pieces, line in ((piece, [(7, folder)], "set.jsonl: line 7: is not allowed"),
                               (os._exit, [(1,)], "--on: ray: a piece has lost 4 workers")):
        try:
            list(workers.done(work, pieces))
        except InputError as error:
            assert str(error).startswith(line), error
        else:
            raise AssertionError(line)
    workers._setup = workers._setup._replace(version="0")
    try:
        list(workers.done(piece, [(0, folder)]))
    except InputError as error:
        assert "a worker has moonteam" in str(error), error
"""
LETHAL = """
import os, signal
from pathlib import Path
from moonteam.planners.exact import ExactPlanner

class Lethal(ExactPlanner):
    def act(self, snapshot):
        if not (mark := Path(__file__).with_name("killed")).exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().act(snapshot)
"""
TRAINING = ("import dataclasses; from training.mappo.macro import config; "
            "from tests.training.mappo.macro.test_macro import TINY; "
            "config.PRESETS['quick'] = dataclasses.replace(TINY, rounds=6); ")


def moonteam(*words, before="", **more):
    """Starts a command in a process of its own."""
    more.setdefault("env", ALONE)
    return subprocess.Popen([sys.executable, "-c", before + MAIN, *map(str, words)],
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **more)


def finished(child, code=0):
    out, error = child.communicate(timeout=1500)
    assert child.returncode == code, error
    return out, error


def plain(value):
    """A report without the times that it states."""
    if isinstance(value, dict):
        return {key: plain(one) for key, one in value.items() if "seconds" not in key}
    return [plain(one) for one in value] if isinstance(value, list) else value


def workers_of(child):
    """Process numbers of the busy Ray workers that a command has begun."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            words = (folder / "cmdline").read_text()
            session = os.getsid(int(folder.name))
        except OSError:
            continue
        if words.startswith("ray::_Holder") and session == os.getsid(child.pid):
            found.append(int(folder.name))
    return found


def test_nothing_imports_ray_unless_asked(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "ray", None)
    grid = ["evaluate", "grid", str(GOLDEN), "--limit", "1", "--out"]
    assert main([*grid, str(tmp_path / "out")]) == 0
    train = ["train", "quick", "--seeds", "0", "1", "--out", str(tmp_path / "run"), "--on", "ray"]
    execution = ["evaluate", "execution", "--out", str(tmp_path / "run"), "--on", "ray"]
    capsys.readouterr()
    for words in ([*grid, str(tmp_path / "run"), "--on", "ray"], train, execution):
        assert main(words) == 2
        error = capsys.readouterr().err
        assert error == ("moonteam: --on: needs Ray, which is not installed: "
                         "pip install 'moonteam[ray]'\n")
    for bad in ("nowhere", "head:", ":6379", "ray://head", "head:70000"):
        assert main(["evaluate", "grid", str(GOLDEN), "--on", bad]) == 2
        assert f"--on: {bad!r} is not allowed; ray (the cores" in capsys.readouterr().err
    assert main([*train, "--coordinator", "127.0.0.1:1"]) == 2
    assert "--coordinator: is for runs in this process" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@needs_ray
def test_an_address_that_does_not_answer_is_one_line(capsys, tmp_path):
    for address in ("127.0.0.1:1", "ray://127.0.0.1:1"):
        words = ["evaluate", "execution", "--out", str(tmp_path / "out"), "--on", address]
        assert main(words) == 2
        error = capsys.readouterr().err
        assert error.startswith(f"moonteam: --on: nothing answers at {address} (")
        assert "ray start --head" in error
        assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


@needs_ray
def test_pieces_come_back_whatever_is_killed(tmp_path):
    done = subprocess.run([sys.executable, "-c", PIECES, str(tmp_path)], env=ALONE,
                          capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr


@needs_ray
@pytest.mark.soak
def test_what_answers_and_is_no_cluster_is_one_line(capsys):
    with socket.create_server(("127.0.0.1", 0)) as deaf:
        address = f"127.0.0.1:{deaf.getsockname()[1]}"
        assert main(["evaluate", "grid", str(GOLDEN), "--on", address]) == 2
    assert f"--on: what answers at {address} is no Ray cluster; " in capsys.readouterr().err


@needs_ray
@pytest.mark.soak
@pytest.mark.parametrize("words", [
    (GOLDEN, "--limit", "30", "--planner", "exact", "--planner", "policy", "--decode", "argmax",
     "--decode", "best-of-2", "--objective", "makespan", "--objective", "moves"),
    ("seconds/3x5-7", "--limit", "30", "--planner", "exact", "--planner", "policy",
     "--policy", "any_team_mappo")])
def test_a_table_of_plans_is_the_same(words):
    found = [json.loads(finished(moonteam("evaluate", "grid", *words, "--json", *on))[0])
             for on in ((), ("--on", "ray"))]
    assert json.dumps(plain(found[0])) == json.dumps(plain(found[1]))


@needs_ray
@pytest.mark.soak
def test_missions_are_the_same_though_a_worker_is_killed(tmp_path):
    """And a run begun on a cluster goes on without."""
    (tmp_path / "lethal.py").write_text(LETHAL)
    words = ["evaluate", "execution", "--site", "flat", "--count", "4", "--side", "8", "--targets",
             "2", "--planner", f"{tmp_path / 'lethal.py'}:Lethal", "--loop", "closed", "grid",
             "--lose", "0.5", "--json"]
    away, _ = finished(moonteam(*words, "--out", tmp_path / "away", "--on", "ray"))
    assert (tmp_path / "killed").exists()
    here, _ = finished(moonteam(*words, "--out", tmp_path / "here"))
    assert here == away
    rows = [(tmp_path / name / "rows.jsonl").read_text() for name in ("here", "away")]
    assert sorted(rows[0].splitlines()) == sorted(rows[1].splitlines())
    (tmp_path / "away" / "rows.jsonl").write_text(rows[1].splitlines(True)[0])
    assert finished(moonteam(*words, "--out", tmp_path / "away", "--resume"))[0] == here


def free_ports(count):
    """Ports that nobody listens at."""
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    found = [one.getsockname()[1] for one in sockets]
    for one in sockets:
        one.close()
    return found


@pytest.fixture(scope="module")
def head(tmp_path_factory):
    """Addresses of a cluster that stands by itself: of its head, and of its client server."""
    folder = tmp_path_factory.mktemp("head")
    own, client, agent, grpc = free_ports(4)
    command = [str(Path(sys.executable).with_name("ray")), "start", "--head", "--block",
               "--port", own, "--ray-client-server-port", client, "--num-cpus", 2,
               "--dashboard-agent-listen-port", agent, "--dashboard-agent-grpc-port", grpc,
               "--object-store-memory", 200 * 2**20, "--include-dashboard", "false",
               "--node-ip-address", "127.0.0.1", "--disable-usage-stats"]
    with open(folder / "log", "w", encoding="utf-8") as log:
        child = subprocess.Popen([*map(str, command)], env=ALONE, stdout=log, stderr=log,
                                 cwd=folder, start_new_session=True)
    try:
        for port in (own, client):
            answers(port, child, folder / "log")
        yield f"127.0.0.1:{own}", f"ray://127.0.0.1:{client}"
    finally:
        child.terminate()
        try:
            child.wait(60)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)


def answers(port, child, log):
    deadline = time.monotonic() + 300
    while True:
        try:
            return socket.create_connection(("127.0.0.1", port), 1).close()
        except OSError:
            assert child.poll() is None, log.read_text()
            assert time.monotonic() < deadline, log.read_text()
            time.sleep(0.2)


ENGINES = {"native mjx": ("--planner", "exact", "--lose", "0.5", "--backend", "native", "mjx"),
           "fused": ("--planner", "policy", "--backend", "fused")}


@needs_ray
@pytest.mark.soak
@pytest.mark.parametrize("engines", ENGINES)
def test_missions_are_the_same_on_a_cluster_that_stands_by_itself(tmp_path, head, engines):
    """By its head's address and by its client port, the workers not being the command's own."""
    words = ["evaluate", "execution", "--site", "flat", "--count", "4", "--width", "2", "--side",
             "4", "--targets", "1", *ENGINES[engines], "--json"]
    here, _ = finished(moonteam(*words, "--out", tmp_path / "here"))
    rows = (tmp_path / "here" / "rows.jsonl").read_text().splitlines()
    for number, address in enumerate(head):
        out = tmp_path / str(number)
        assert finished(moonteam(*words, "--out", out, "--on", address))[0] == here
        assert sorted((out / "rows.jsonl").read_text().splitlines()) == sorted(rows)


@needs_ray
@pytest.mark.soak
def test_who_lacks_the_token_is_told(tmp_path, head):
    for address in head:
        child = moonteam("evaluate", "grid", GOLDEN, "--limit", "1", "--on", address,
                         env=ALONE | {"RAY_AUTH_TOKEN": "f" * 64})
        said = finished(child, 2)[1].splitlines()[-1]
        assert said.startswith(f"moonteam: --on: {address}")
        assert "wants its token: set RAY_AUTH_MODE=token" in said


@needs_ray
@pytest.mark.soak
def test_seeds_end_with_the_same_bits_though_worker_and_command_are_killed(tmp_path):
    words = ["train", "quick", "--seeds", "3", "4", "--checkpoint-seconds", "0", "--out"]
    finished(moonteam(*words, tmp_path / "here", before=TRAINING))
    child = moonteam(*words, tmp_path / "away", "--on", "ray", before=TRAINING,
                     start_new_session=True)
    lost = []
    while checkpoints.newest(tmp_path / "away" / "3" / "checkpoints") is None:
        assert child.poll() is None, child.communicate()[1]
        time.sleep(0.01)
        lost = lost or workers_of(child)[:1]
    lost = lost or workers_of(child)[:1]
    os.kill(lost[0], signal.SIGKILL)
    while checkpoints.newest(tmp_path / "away" / "4" / "checkpoints") is None:
        time.sleep(0.01)
    os.killpg(child.pid, signal.SIGKILL)
    child.communicate()
    finished(moonteam(*words, tmp_path / "away", "--on", "ray", "--resume", before=TRAINING))
    for seed in "34":
        here, away = tmp_path / "here" / seed, tmp_path / "away" / seed
        one, other = (load_policy(out / "policy.safetensors") for out in (here, away))
        assert str(one.params) == str(other.params)
        mine, theirs = (plain([{k: v for k, v in row.items() if k != "rate"}
                               for row in metrics.read(out / "metrics.jsonl")])
                        for out in (here, away))
        assert mine == theirs
        assert np.array_equal(sorted(p.name for p in here.iterdir()),
                              sorted(p.name for p in away.iterdir()))
    assert (tmp_path / "away" / "curves.png").exists()
