"""Runs in workers that are lost, stopped and taken over end as one that never was."""

import dataclasses

import pytest

from moonteam.errors import InputError
from moonteam.interrupts import Stop
from tests.training.run.test_machine import TINY, bits, same
from training.mappo.trainee import Mappo
from training.run import away, checkpoints, metrics
from training.run.away import Keeping
from training.run.machine import Run


class Workers:
    """A cluster whose workers live here; those of `lost` calls to a thing are new ones."""

    name = "here"

    def __init__(self, lost=()):
        self.lost, self.calls = lost, []

    def hold(self, make, *arguments, cpus):
        return Held(self, lambda: make(*arguments))

    def ready(self, asked, seconds=None):
        return list(asked)[:1]

    def value(self, asked):
        return asked[0]

    def drop(self, held):
        self.calls.append("drop")


class Held:
    def __init__(self, workers, make):
        self.workers, self.make, self.thing = workers, make, make()

    def call(self, method, *arguments):
        self.workers.calls.append(method)
        if len(self.workers.calls) in self.workers.lost:
            self.thing = self.make()
        return [getattr(self.thing, method)(*arguments)]


def train(workers, out, resume=False, config=TINY, stop=None):
    return away.train(workers, Mappo, [(config,)], [out], [Keeping(resume, 0.0)], 1,
                      stop or Stop())


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run in this process."""
    run = Run(Mappo(TINY), tmp_path_factory.mktemp("whole"), resume=False, checkpoint_seconds=0.0)
    assert run.train(Stop())
    run.finish()
    return run


def rows(out):
    return [{key: value for key, value in row.items() if key not in ("seconds", "rate")}
            for row in metrics.read(out / "metrics.jsonl")]


def held(out):
    return sorted(path.name for folder in (out, out / "checkpoints") for path in folder.iterdir())


def test_the_folder_is_that_of_a_run_here_though_workers_are_lost(whole, tmp_path):
    workers = Workers(lost=(2, 5))
    (end,) = train(workers, tmp_path / "run")
    assert end.report["out"] == str(tmp_path / "run")
    assert workers.calls.count("stretch") == 5 + 2  # a chunk each, and two in vain
    assert workers.calls[-2:] == ["close", "drop"]
    again = Run(Mappo(TINY), tmp_path / "run", resume=True)
    assert same(bits(again), bits(whole))
    assert rows(tmp_path / "run") == rows(whole.out)
    assert held(tmp_path / "run") == held(whole.out)


def test_a_run_that_is_stopped_goes_on(whole, tmp_path):
    stop = Stop()

    class Impatient(Workers):
        def value(self, asked):
            stop.asked = stop.asked or self.calls.count("stretch") == 2
            return super().value(asked)

    (end,) = train(Impatient(), tmp_path, stop=stop)
    assert end.report is None
    newest = checkpoints.newest(tmp_path / "checkpoints")
    assert newest.name == f"{end.updates:08d}"
    with pytest.raises(InputError, match=f"^{tmp_path}: already holds a run"):
        train(Workers(), tmp_path)
    with pytest.raises(InputError, match=f"^{tmp_path}/config.json: gamma: was started with other"):
        train(Workers(), tmp_path, resume=True, config=dataclasses.replace(TINY, gamma=0.9))
    train(Workers(), tmp_path, resume=True)
    assert same(bits(Run(Mappo(TINY), tmp_path, resume=True)), bits(whole))
    assert rows(tmp_path) == rows(whole.out)
