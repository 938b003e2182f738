"""The evolution of guides: it finds what is better, and a resumed run is the same run."""

import dataclasses

import jax
import numpy as np

from moonteam.cli import main
from moonteam.interrupts import Stop
from moonteam.planners.guided import GuidedPlanner
from moonteam.planners.search.guides import PLAIN, parts_of, vector_of
from training.guide import evolution
from training.guide.evolution import Guider
from training.guide.recipe import STEPS, Guiding, Practice
from training.run import metrics
from training.run.machine import Run

TINY = Guiding((Practice(3, 8, 2_000, 3), Practice(4, 12, 3_000, 2, 0.5)), population=4, rounds=3,
               held_out=4)


def test_a_resumed_run_is_the_same_run(tmp_path, monkeypatch):
    whole = Run(Guider(TINY), tmp_path / "whole", False)
    assert whole.train(Stop())
    begun = Run(Guider(TINY), tmp_path / "parts", False)
    assert not begun.train(Stop(), stop_after=2)
    monkeypatch.setattr(evolution, "cores", lambda: 1)  # as many threads as there are: the same
    again = Run(Guider(TINY), tmp_path / "parts", True)
    assert again.train(Stop())
    for a, b in zip(*(jax.tree.leaves(run.trainee.state()) for run in (whole, again)), strict=True):
        np.testing.assert_array_equal(a, b)
    report = again.finish()
    assert [row["practice"] for row in report["practices"]] == [p.name for p in TINY.practices]
    rows = metrics.read(tmp_path / "parts" / "metrics.jsonl")
    assert rows[0]["practices"][0]["over_plain"] == 0.0
    assert (tmp_path / "parts" / "curve.png").stat().st_size > 5_000
    planner = GuidedPlanner(guide=tmp_path / "parts" / "policy.safetensors")
    np.testing.assert_allclose(planner.guide, again.trainee.guide(again.trainee.weights()),
                               rtol=1e-6)


def test_it_finds_out_what_is_better():
    """From a guide that is far too hot, and that has no eye for chains."""
    parts = {name: part.copy() for name, part in parts_of(PLAIN).items()}
    parts["heat"][:, 0] += 4.0
    parts["place"][0, 0] = 0.0
    guider = Guider(dataclasses.replace(TINY, practices=(Practice(6, 30, 30_000, 16),),
                                        population=8, sigma=1.5))
    poor = (vector_of(parts) - PLAIN) / np.where(STEPS > 0, STEPS, 1.0)
    guider.searcher = guider.searcher.replace(mean=poor[guider.moving].astype(np.float32))
    run = [guider.chunk(at).figures["candidates"] for at in _positions(12)]
    assert np.mean(run[:3]) > 0.01  # over the plain guide
    assert np.mean(run[-4:]) < 0.5 * np.mean(run[:3])


def _positions(count):
    return [evolution.Position("evolution", k, k) for k in range(count)]


def test_the_command_trains_and_says_what_it_cannot(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("training.commands.guide.Guiding", lambda **kw: dataclasses.replace(
        TINY, **{k: v for k, v in kw.items() if k != "held_out"}))
    words = ["train", "guide", "--population", "4", "--rounds", "1", "--out", str(tmp_path / "run")]
    assert main(words) == 0
    assert "searches in" in capsys.readouterr().out
    assert main([*words, "--resume"]) == 0
    assert main(["train", "guide", "--population", "2"]) == 2
    assert "--population: 2 is not allowed; at least 4" in capsys.readouterr().err


def test_a_dry_run_says_what_would_be_trained(capsys):
    assert main(["train", "guide", "--dry-run"]) == 0
    told = capsys.readouterr().out
    assert f"{len(PLAIN)} parameters" in told
    assert "20x100" in told
