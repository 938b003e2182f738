"""What a run leaves while it goes, without training anything."""

import struct
import sys
from types import SimpleNamespace

import pytest

from moonteam.cli import main
from moonteam.errors import InputError
from training.run import metrics

SCORE = {"success": 0.987, "makespan": 14.25, "moves": 26.5}


def row(updates, **more):
    return {"phase": "bootstrap", "total_updates": updates, "env_steps": 100 * updates,
            "rate": 23456.7, "success": 0.75, "makespan": 20.0, "moves": 31.0} | more


def events(folder):
    """(tag, step, value) of every scalar in the event files, and the steps from which on what
    was written before is void.
    """
    from tensorboardX.proto.event_pb2 import Event

    found, void = [], []
    for path in sorted(folder.glob("events.out.tfevents.*")):
        data = path.read_bytes()
        while data:  # a record: length, its checksum, event, its checksum
            (length,) = struct.unpack("<Q", data[:8])
            event = Event.FromString(data[12:12 + length])
            data = data[16 + length:]
            found += [(v.tag, event.step, v.simple_value) for v in event.summary.value]
            void += [event.step] if event.HasField("session_log") else []
    return found, void


def test_tensorboard_gets_every_number_of_every_row(tmp_path):
    written = metrics.Metrics(tmp_path / "metrics.jsonl", 0, tensorboard=True)
    written.add(row(1))
    written.add(row(2, argmax=SCORE, sample=SCORE))
    written.close()
    found, _ = events(tmp_path)
    assert ("success", 100, 0.75) in found
    assert ("sample/makespan", 200, 14.25) in found
    assert len(found) == 6 + 6 + 6
    assert not any(tag == "phase" for tag, _, _ in found)


def test_resumed_events_go_on_where_the_rows_do(tmp_path):
    first = metrics.Metrics(tmp_path / "metrics.jsonl", 0, tensorboard=True)
    for updates in (1, 2, 3):
        first.add(row(updates))
    first.close()
    again = metrics.Metrics(tmp_path / "metrics.jsonl", 2, tensorboard=True)
    again.add(row(3, success=0.5))
    again.close()
    found, void = events(tmp_path)
    assert [entry for entry in found if entry[0] == "success"][-1] == ("success", 300, 0.5)
    assert 201 in void


def test_without_the_package_one_line_says_what_to_install(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    assert main(["train", "small", "--tensorboard", "--out", str(tmp_path / "run")]) == 2
    error = capsys.readouterr().err
    assert "pip install 'moonteam[tensorboard]'" in error
    assert error.count("\n") == 1
    assert not (tmp_path / "run").exists()
    with pytest.raises(InputError, match="is not installed"):
        metrics.Metrics(tmp_path / "metrics.jsonl", 0, tensorboard=True)
    metrics.Metrics(tmp_path / "metrics.jsonl", 0).add(row(1))


class Biases:
    """Stands in for Weights & Biases: takes down what is called."""

    Error = RuntimeError

    def __init__(self, fails=""):
        self.calls, self._fails = [], fails

    def Settings(self, **given):
        return given

    def init(self, **given):
        if self._fails:
            raise self.Error(self._fails)
        self.calls.append(("init", given))
        return SimpleNamespace(
            define_metric=lambda *a, **k: self.calls.append(("define_metric", a, k)),
            log=lambda row: self.calls.append(("log", row)),
            finish=lambda: self.calls.append(("finish",)))


def test_weights_and_biases_gets_every_number_of_every_row(tmp_path, monkeypatch):
    biases = Biases()
    monkeypatch.setitem(sys.modules, "wandb", biases)
    written = metrics.Metrics(tmp_path / "metrics.jsonl", 0, recipe={"seed": 3})
    written.add(row(1, sample=SCORE))
    written.close()
    (_, begun), over, logged, end = biases.calls
    assert begun["config"] == {"seed": 3}
    assert (begun["dir"], begun["name"], begun["id"]) == (str(tmp_path), tmp_path.name, None)
    assert over == ("define_metric", ("*",), {"step_metric": "env_steps"})
    assert logged == ("log", metrics.scalars(row(1, sample=SCORE)))
    assert logged[1]["sample/makespan"] == 14.25
    assert end == ("finish",)


def test_a_resumed_run_of_weights_and_biases_is_the_same(tmp_path, monkeypatch):
    biases = Biases()
    monkeypatch.setitem(sys.modules, "wandb", biases)
    for name in ("offline-run-20260101_000000-first", "run-20260102_000000-abc123"):
        (tmp_path / "wandb" / name).mkdir(parents=True)
    metrics.Metrics(tmp_path / "metrics.jsonl", 0, recipe={}).close()
    assert biases.calls[0][1]["id"] == "abc123"
    assert biases.calls[0][1]["resume"] == "allow"


def test_where_weights_and_biases_cannot_be_one_line_says_so(tmp_path, monkeypatch, capsys):
    words = ["train", "small", "--wandb", "--out", str(tmp_path / "run")]
    monkeypatch.setitem(sys.modules, "wandb", None)
    assert main(words) == 2
    assert "pip install 'moonteam[wandb]'" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
    monkeypatch.setitem(sys.modules, "wandb", Biases("api_key not configured (no-tty)\nmore"))
    with pytest.raises(InputError, match=r"api_key not configured.*WANDB_MODE=offline"):
        metrics.Metrics(tmp_path / "metrics.jsonl", 0, recipe={})


def test_weights_and_biases_offline_needs_no_account(tmp_path, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    written = metrics.Metrics(tmp_path / "metrics.jsonl", 0, recipe={"seed": 3})
    written.add(row(1))
    written.close()
    (run,) = (tmp_path / "wandb").glob("offline-run-*")
    (log,) = run.glob("run-*.wandb")
    assert log.stat().st_size > 100
    again = metrics.Metrics(tmp_path / "metrics.jsonl", 1, recipe={"seed": 3})
    again.add(row(2))
    again.close()
    names = [one.name.rpartition("-")[2] for one in (tmp_path / "wandb").glob("offline-run-*")]
    assert len(names) == 2
    assert len(set(names)) == 1


def test_scores_of_a_list_are_numbered():
    looked = row(1, families=[{"family": "two", "success": 0.5}, {"family": "three", "success": 1}])
    found = metrics.scalars(looked)
    assert (found["families/0/success"], found["families/1/success"]) == (0.5, 1)
    assert not any(name.endswith("/family") for name in found)


def test_the_last_of_equally_good_evaluations_is_the_best():
    rows = [row(10 * i, sample={"success": s}) for i, s in enumerate((0.5, 0.8, 0.8, 0.7), 1)]

    def score(row):
        return row["sample"]["success"] if "sample" in row else None

    assert metrics.best(rows, score)["total_updates"] == 30
    assert metrics.best([row(5)], score) is None
