"""Runs that are stopped, killed, torn and resumed end as one that never was."""

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import time

import jax
import numpy as np
import pytest

from moonteam.cli import main
from moonteam.errors import InputError
from moonteam.grid import env
from moonteam.interrupts import Stop
from tests.killed import kill_when_saved
from tests.signalled import begins
from training.mappo import update
from training.mappo.config import BOOTSTRAP, REFINEMENT, Config, Phase
from training.mappo.trainee import Mappo
from training.run import checkpoints, machine, metrics
from training.run.machine import Run
from training.run.trainee import Made

TINY = Config(
    "small", Phase(4, 8, 2, BOOTSTRAP), Phase(6, 8, 2, REFINEMENT), num_agents=2, num_targets=2,
    size=(4, 4), max_steps=8, num_steps=8, width=8, update_epochs=1, chunk_updates=2,
    eval_every=2, eval_scenarios=8)


def words(out, *more):
    """The command line that trains TINY."""
    given = {"num-agents": 2, "num-targets": 2, "max-steps": 8, "num-steps": 8, "width": 8,
             "approach-decay": 0.0075, "gamma": 0.99,
             "update-epochs": 1, "chunk-updates": 2, "eval-every": 2, "eval-scenarios": 8,
             "bootstrap.updates": 4, "bootstrap.num-envs": 8, "bootstrap.num-minibatches": 2,
             "bootstrap.lr": 2e-3, "refinement.ent-coef": 0.01,
             "refinement.updates": 6, "refinement.num-envs": 8, "refinement.num-minibatches": 2,
             "refinement.lr": 2e-3}
    options = [word for key, value in given.items() for word in (f"--{key}", str(value))]
    return ["train", "small", "--size", "4", "4", *options, "--out", str(out), *more]


def bits(run):
    return jax.tree.leaves(jax.device_get(run.trainee.learner.params))


def same(one, other):
    return all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """An uninterrupted run."""
    run = Run(Mappo(TINY), tmp_path_factory.mktemp("whole"), resume=False)
    assert run.train(Stop())
    return run


def stopped(out, *at):
    """A run stopped after so many updates, and gone on with, each time from disk."""
    for number, updates in enumerate(at):
        run = Run(Mappo(TINY), out, resume=number > 0)
        assert not run.train(Stop(), stop_after=updates)
    return Run(Mappo(TINY), out, resume=bool(at))


def test_resumed_twice_is_bit_identical(whole, tmp_path):
    run = stopped(tmp_path, 2, 6)
    assert run.position.phase == "refinement"
    assert run.position.total_updates == 6
    assert run.train(Stop())
    assert same(bits(run), bits(whole))
    rows = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [row["total_updates"] for row in rows] == [2, 4, 6, 8, 10]
    assert {"argmax", "sample", "success", "makespan", "rate"} <= rows[1].keys()


def test_a_run_says_what_is_saved(tmp_path, whole):
    run = Run(Mappo(TINY), tmp_path, resume=False)
    assert run.kept == "no checkpoint is saved yet"
    at = whole.out / "checkpoints" / "00000010"
    assert whole.kept == f"update 10 is saved, {at}"


def test_the_first_rate_leaves_compiling_out(tmp_path, monkeypatch):
    """Whatever a chunk compiles, its rate is that of the work."""
    def chunk(at):
        def heavy(x):
            for _ in range(1000):
                x = jax.numpy.sin(x) + 1
            return x

        jax.jit(heavy).lower(np.zeros(3))
        return Made(2, 128, {"loss": 0.0})

    run = Run(Mappo(TINY), tmp_path, resume=False)
    run.trainee.enter("bootstrap")
    monkeypatch.setattr(run.trainee, "chunk", chunk)
    begun = time.perf_counter()
    row = run._chunk()
    assert row["seconds"] < (time.perf_counter() - begun) / 2
    assert row["rate"] == pytest.approx(row["env_steps"] / row["seconds"])


def test_another_seed_is_another_run(whole, tmp_path):
    run = Run(Mappo(dataclasses.replace(TINY, seed=1)), tmp_path, resume=False)
    run.train(Stop())
    assert not same(bits(run), bits(whole))


def test_refinement_keeps_the_weights_and_takes_a_fresh_optimiser(tmp_path):
    run = stopped(tmp_path, 4)
    before = bits(run)
    run.trainee.enter("refinement")
    assert same(bits(run), before)
    counts = [leaf for leaf in jax.tree.leaves(run.trainee.learner.optimiser) if leaf.ndim == 0]
    assert counts
    assert all(int(count) == 0 for count in counts)
    weights = [run.trainee.task(phase).config.weights for _, phase in TINY.phases]
    assert [(w.SC, w.TC, w.TB) for w in weights] == [(0, 0, 0), (0.3, 0.5, 0.2)]


@pytest.mark.parametrize("harm", ["truncate", "flip", "no about", "half about"])
def test_a_torn_checkpoint_is_passed_over_with_a_warning(whole, tmp_path, harm):
    stopped(tmp_path, 2, 6)
    newest = checkpoints.newest(tmp_path / "checkpoints")
    assert newest.name == "00000006"
    largest = max((p for p in (newest / "learner").rglob("*") if p.is_file()),
                  key=lambda p: p.stat().st_size)
    if harm == "truncate":
        largest.write_bytes(largest.read_bytes()[: largest.stat().st_size // 2])
    elif harm == "flip":
        data = bytearray(largest.read_bytes())
        data[len(data) // 2] ^= 0xFF
        largest.write_bytes(bytes(data))
    elif harm == "no about":
        (newest / "about.json").unlink()
    else:
        (newest / "about.json").write_text('{"phase": "refi')
    with pytest.warns(UserWarning, match="00000006 is torn"):
        run = Run(Mappo(TINY), tmp_path, resume=True)
    assert run.position.total_updates == 4  # saved for its evaluation, the best until then
    assert run.train(Stop())
    assert same(bits(run), bits(whole))


def test_killed_and_resumed_is_bit_identical(whole, tmp_path):
    kill_when_saved(tmp_path, words(tmp_path, "--checkpoint-seconds", "0"))
    assert main(words(tmp_path, "--resume", "--checkpoint-seconds", "0", "--tensorboard")) == 0
    assert list(tmp_path.glob("events.out.tfevents.*"))
    run = Run(Mappo(TINY), tmp_path, resume=True)
    assert run.position.total_updates == 10
    assert same(bits(run), bits(whole))
    for name in ("config.json", "metrics.jsonl", "report.json", "curve.png", "policy.safetensors"):
        assert (tmp_path / name).stat().st_size > 0
    assert main(["train", "compare", str(tmp_path)]) == 0


def test_sigterm_while_training_saves_and_the_run_goes_on_from_there(tmp_path):
    """Checkpoints by the clock are turned off, and so is the one of the best evaluation."""
    endless = ["--bootstrap.updates", "1000000", "--eval-every", "1000000"]
    command = [sys.executable, "-m", "moonteam.cli",
               *words(tmp_path, "--checkpoint-seconds", "1e6", *endless)]
    child = subprocess.Popen(command, env=os.environ | {"JAX_PLATFORMS": "cpu"},
                             stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    lines = tmp_path / "metrics.jsonl"
    deadline = time.monotonic() + 300
    while len(metrics.read(lines)) < 3:
        assert child.poll() is None, child.communicate()[1].decode()
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert checkpoints.newest(tmp_path / "checkpoints") is None
    child.send_signal(signal.SIGTERM)
    line = child.communicate(timeout=300)[1].decode()
    assert child.returncode == 130, line
    done = metrics.read(lines)[-1]["total_updates"]
    assert f"interrupted after update {done}, saved; go on with --out {tmp_path} --resume" in line
    assert checkpoints.newest(tmp_path / "checkpoints").name == f"{done:08d}"
    config = dataclasses.replace(
        TINY, eval_every=1000000, bootstrap=dataclasses.replace(TINY.bootstrap, updates=1000000))
    run = Run(Mappo(config), tmp_path, resume=True)
    assert run.position.total_updates == done
    assert not run.train(Stop(), stop_after=done + 2)
    updates = [row["total_updates"] for row in metrics.read(lines)]
    assert updates == list(range(2, done + 3, 2))


def test_signals_only_ask_to_stop():
    """In a process of its own: the one that tests may have been started with SIGINT ignored."""
    with begins():
        subprocess.run([sys.executable, "-c", """
import os, signal
from moonteam.interrupts import postponed
for number in (signal.SIGTERM, signal.SIGINT):
    with postponed() as stop:
        assert not stop.asked
        os.kill(os.getpid(), number)
        assert stop.asked
assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
"""], check=True)


def test_asked_to_stop_the_run_saves(tmp_path):
    run = Run(Mappo(TINY), tmp_path, resume=False)
    run.train(Stop(), stop_after=2)
    again = Run(Mappo(TINY), tmp_path, resume=True)
    assert not again.train(Stop(asked=True))
    assert checkpoints.newest(tmp_path / "checkpoints").name == "00000002"


def test_an_interrupted_command_saves_and_returns_130(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(Run, "train", lambda self, stop: False)
    assert main(words(tmp_path)) == 130
    assert "--resume" in capsys.readouterr().err


def test_not_a_number_names_the_last_good_checkpoint(tmp_path, capsys):
    run = stopped(tmp_path, 2)
    poisoned = jax.tree.map(lambda x: x * np.nan, run.trainee.learner.params)
    run.trainee.learner = run.trainee.learner._replace(params=poisoned)
    with pytest.raises(machine.Diverged, match=r"not a number; .*checkpoints/00000002"):
        run.train(Stop())
    assert checkpoints.newest(tmp_path / "checkpoints").name == "00000002"


def test_weights_spoiled_by_a_chunks_last_step_are_not_saved_as_good(tmp_path, monkeypatch):
    run = stopped(tmp_path, 2)
    real = update.chunk

    def spoiled(*args):
        learner, report = real(*args)
        return learner._replace(params=jax.tree.map(lambda x: x * np.nan, learner.params)), report

    monkeypatch.setattr(update, "chunk", spoiled)
    with pytest.raises(machine.Diverged, match="weight is not a number"):
        run.train(Stop())
    assert checkpoints.newest(tmp_path / "checkpoints").name == "00000002"


def test_a_lost_policy_stops_the_run_and_the_best_checkpoint_is_left(tmp_path):
    """In 48 steps robots that walk about at random solve nearly all; then they are made to stay."""
    easy = dataclasses.replace(
        TINY, bootstrap=Phase(40, 8, 2, BOOTSTRAP, lr=1e-5), max_steps=48, eval_every=1,
        eval_scenarios=64, refinement=dataclasses.replace(TINY.refinement, updates=0))
    run = Run(Mappo(easy), tmp_path, resume=False, checkpoint_seconds=0)
    run.train(Stop(), stop_after=4)
    good = run.best()
    assert good["sample"]["success"] > 0.6
    params = run.trainee.learner.params
    lame = jax.tree.map(lambda x: x.at[env.STAY].add(100.0) if x.shape == (env.NUM_ACTIONS,) else x,
                        params.actor)  # the bias of the logits
    run.trainee.learner = run.trainee.learner._replace(params=params._replace(actor=lame))
    with pytest.raises(machine.Diverged, match=r"by update 10 .*sampled actions solve 0\.0"):
        run.train(Stop())
    before = tmp_path / "checkpoints" / f"{good['total_updates']:08d}"
    assert before.is_dir()
    fresh = tmp_path / "fresh"  # to go on from it: a folder that holds nothing else
    (fresh / "checkpoints").mkdir(parents=True)
    before.rename(fresh / "checkpoints" / before.name)
    again = Run(Mappo(dataclasses.replace(easy, gamma=0.9)), fresh, resume=True)
    assert again.position.total_updates == good["total_updates"]


def test_a_collapse_ends_the_command_with_one_unless_told_otherwise(tmp_path, monkeypatch, capsys):
    scores = iter([0.9, 0.3, 0.2, 0.4, 0.1] * 3)

    def evaluate(self, phase, scenarios):
        score = {"success": next(scores), "makespan": 8.0, "moves": 9.0}
        return {"argmax": score, "sample": score}

    monkeypatch.setattr(Mappo, "evaluate", evaluate)
    often = ("--eval-every", "1", "--eval-scenarios", "256", "--checkpoint-seconds", "0")
    assert main(words(tmp_path / "a", *often)) == 1
    line = capsys.readouterr().err
    place = tmp_path / "a" / "checkpoints" / "00000002"
    assert f"after update 2 it was 0.900; the last good checkpoint is {place} (" in line
    assert line.count("\n") == 1
    kept = [path.name for path in sorted(place.parent.iterdir())]
    assert kept == ["00000002", "00000004", "00000006"]
    scores = iter([0.9, 0.3, 0.2, 0.4, 0.1] * 3)
    assert main(words(tmp_path / "b", *often, "--no-stop-on-collapse")) == 0
    assert (tmp_path / "b" / "report.json").exists()
    kept = [path.name for path in sorted((tmp_path / "b" / "checkpoints").iterdir())]
    assert kept == ["00000002", "00000004", "00000006", "00000008", "00000010"]


def test_resuming_with_other_numbers_or_over_a_run_is_refused(tmp_path):
    stopped(tmp_path, 2)
    with pytest.raises(InputError, match="already holds a run"):
        Run(Mappo(TINY), tmp_path, resume=False)
    with pytest.raises(InputError, match="gamma: was started with other numbers"):
        Run(Mappo(dataclasses.replace(TINY, gamma=0.9)), tmp_path, resume=True)


def test_a_forced_run_begins_anew_and_takes_nothing_but_the_run(whole, tmp_path):
    """What it would go on from must be elsewhere, and a bad beginning leaves the run there."""
    out = tmp_path / "run"
    shutil.copytree(whole.out, out)
    (out / "notes.txt").write_text("mine")
    before = checkpoints.newest(out / "checkpoints")
    with pytest.raises(InputError, match=r"--begin: .* is in the folder that --force would empty"):
        Run(Mappo(TINY), out, resume=False, begin=before, force=True)
    assert checkpoints.newest(out / "checkpoints") == before
    run = Run(Mappo(TINY), out, resume=False, force=True)
    assert run.position.total_updates == 0
    assert sorted(path.name for path in out.iterdir()) == ["config.json", "metrics.jsonl",
                                                           "notes.txt"]
    assert not (out / "metrics.jsonl").read_text()


def test_beginning_where_another_runs_bootstrap_ended(whole, tmp_path):
    """The same numbers end with the same bits; others change what comes after, and only that."""
    end = whole.out / "checkpoints" / "00000004"
    twin = Run(Mappo(TINY), tmp_path / "twin", resume=False, begin=end)
    assert twin.position.total_updates == 4
    assert (tmp_path / "twin/checkpoints/00000004").is_dir()
    assert twin.train(Stop())
    assert same(bits(twin), bits(whole))
    rows = [metrics.read(run.out / "metrics.jsonl") for run in (twin, whole)]
    assert [r["success"] for r in rows[0]] == [r["success"] for r in rows[1]]

    weights = dataclasses.replace(REFINEMENT, AR=0.0)
    refinement = dataclasses.replace(TINY.refinement, weights=weights)
    quick = dataclasses.replace(TINY, refinement=refinement)
    other = Run(Mappo(quick), tmp_path / "other", resume=False, begin=end)
    assert same(bits(other), bits(Run(Mappo(TINY), tmp_path / "start", resume=False, begin=end)))
    other.train(Stop(), stop_after=6)
    assert (tmp_path / "other/checkpoints/00000004").is_dir()
    again = Run(Mappo(quick), tmp_path / "other", resume=True)
    assert again.train(Stop())
    assert not same(bits(again), bits(whole))


def test_what_a_run_may_not_begin_with_is_one_line_and_leaves_nothing(whole, tmp_path, capsys):
    end = whole.out / "checkpoints" / "00000004"
    torn = tmp_path / "torn"
    shutil.copytree(end, torn)
    largest = max((p for p in torn.rglob("*") if p.is_file()), key=lambda p: p.stat().st_size)
    largest.write_bytes(largest.read_bytes()[:-7])
    for place, more, line in (
            (tmp_path / "none", (), "none: is no whole checkpoint"),
            (torn, (), "torn: is no whole checkpoint (its checksums do not match)"),
            (end, ("--width", "16"), "is of another network"),
            (end, ("--bootstrap.num-envs", "4"), "another network"),
            (end, ("--bootstrap.updates", "2"), "bootstrap.updates: stands after 4 updates"),
            (end, ("--resume",), "--begin: is for a new run")):
        out = tmp_path / "out"
        assert main(words(out, "--begin", str(place), *more)) == 2
        found = capsys.readouterr().err
        assert line in found
        assert found.count("\n") == 1
        assert not out.exists()


def test_a_checkpoint_of_another_network_is_refused(tmp_path):
    stopped(tmp_path, 2)
    wider = dataclasses.replace(TINY, width=16)
    (tmp_path / "config.json").unlink()
    with pytest.raises(InputError, match="another network"):
        Run(Mappo(wider), tmp_path, resume=True)
    arrays = checkpoints.load(tmp_path / "checkpoints")[1]
    like = jax.eval_shape(lambda: Mappo(wider).begin("bootstrap", None))
    with pytest.raises(InputError, match=r"another network.*this run needs"):
        checkpoints.unflatten(arrays, like, "here")


def test_a_full_disk_names_the_checkpoint_before(tmp_path, monkeypatch):
    run = stopped(tmp_path, 2)

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoints.files, "write_json", full)
    with pytest.raises(InputError, match=r"No space left on device; the last good .*00000002"):
        run.save()
    monkeypatch.undo()
    assert [p.name for p in (tmp_path / "checkpoints").iterdir()] == ["00000002"]
    assert checkpoints.load(tmp_path / "checkpoints")[0].total_updates == 2


def test_a_checkpoint_of_an_earlier_version_is_one_line(tmp_path):
    earlier = tmp_path / "checkpoints" / "state.npz"
    earlier.parent.mkdir()
    earlier.write_bytes(b"PK")
    with pytest.raises(InputError, match="already holds a run"):
        Run(Mappo(TINY), tmp_path, resume=False)
    with pytest.raises(InputError, match=r"state\.npz: is a checkpoint of an earlier version"):
        Run(Mappo(TINY), tmp_path, resume=True)
