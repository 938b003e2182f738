import dataclasses
import json

import pytest

from moonteam.cli import main
from moonteam.errors import InputError
from training.mappo.config import PRESETS, Phase, preset


def dry_run(capsys, *words):
    assert main(["train", *words, "--dry-run", "--json"]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.parametrize(("name", "rows"), [
    ("pi_5t", [(572, 16384, 16, 1.2e9), (1271, 30720, 32, 5e9)]),
    ("pi_6t", [(572, 16384, 16, 1.2e9), (2034, 26880, 28, 7e9)]),
    ("pi_7t", [(1668, 16384, 16, 3.5e9), (3814, 24576, 32, 12e9)]),
    ("pi_5t5r", [(572, 16384, 16, 1.2e9), (1271, 30720, 32, 5e9)])])
def test_presets_hold_the_papers_figures(name, rows):
    config = preset(name)
    for (_, phase), (updates, envs, minibatches, steps) in zip(config.phases, rows, strict=True):
        assert (phase.updates, phase.num_envs, phase.num_minibatches) == (
            updates, envs, minibatches)
        assert config.env_steps(phase) == pytest.approx(steps, rel=2e-3)
    assert config.approach_decay == (0.04 if name == "pi_7t" else 0.0075)
    assert config.replanning == (5 if name == "pi_5t5r" else 0)
    assert (config.num_steps, config.max_steps, config.size) == (128, 128, (32, 32))


def test_dry_run_of_pi_5t(capsys):
    table = dry_run(capsys, "pi_5t")
    assert table["kernel_parameters"] == {"actor": 119_040, "critic": 125_952, "total": 244_992}
    assert table["env_steps"] == 572 * 16384 * 128 + 1271 * 30720 * 128
    refinement = table["phases"]["refinement"]
    assert refinement["flops_per_env_step"] == 2 * 244_992 * 3 * 13
    assert refinement["memory_bytes"]["total"] < 20 * 2**30
    assert table["h100"]["tf32"]["compute"] == pytest.approx(
        table["env_steps"] * refinement["flops_per_env_step"] / 494.7e12)
    launched = (572 * 16 + 1271 * 32) * 4 * 128
    assert table["h100"]["float32"]["launches"] == pytest.approx(launched * 12 * 3e-6)
    assert table["config"]["refinement"]["weights"]["SC"] == 0.3
    assert table["config"]["bootstrap"]["weights"] == {
        "AR": 1.0, "TR": 1.0, "WC": 0.25, "SC": 0.0, "TC": 0.0, "TB": 0.0}


def test_the_account_of_memory_covers_what_xla_sets_aside(capsys):
    """And not by far: a bound that is twice the truth says nothing."""
    table = dry_run(capsys, "small", "--compiled", "--refinement.updates", "0")
    phase = table["phases"]["bootstrap"]
    assert 1.0 <= phase["memory_bytes"]["total"] / phase["compiled_bytes"] < 1.3


def test_dry_run_as_a_table(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["train", "pi_5t", "--dry-run"]) == 0
    text = capsys.readouterr().out
    for figure in ("244,992", "30,720", "1,271", "6,197,346,304", "19.1 M"):
        assert figure in text
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("words", "decisions"), [
    ("quick", 90 * 2048), ("paper_team", 600 * 2048), ("any_team --rounds 10", None),
    ("quick --seeds 0 1 --families.0.advantages critic --num-envs 64", 90 * 64 * 16),
    ("any_team --policy any_team_mappo", None),
    ("imitate quick", 900 * 3 * 256 * 6), ("imitate any_team", None),
    ("refine fresh --families quick", 300 * 3 * 128 * 16), ("refine any_team_imitated", None),
    *((name, None) for name in PRESETS)])
def test_every_preset_has_a_dry_run(words, decisions, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    table = dry_run(capsys, *words.split())
    assert table["env_steps"] == decisions or decisions is None
    assert table["env_steps"] > 0
    assert table["parameters"] > 1000
    assert table["out"].startswith("runs/")
    assert {"policy.safetensors", "report.json"} <= set(table["files"])
    assert main(["train", *words.split(), "--dry-run"]) == 0
    text = capsys.readouterr().out
    assert f"run folder: {table['out']}" in text
    assert f"{table['env_steps']:,}" in text
    assert not list(tmp_path.iterdir())


def test_options_change_the_preset(capsys):
    table = dry_run(capsys, "small", "--seed", "4", "--bootstrap.updates", "7")
    assert (table["config"]["seed"], table["config"]["bootstrap"]["updates"]) == (4, 7)


@pytest.mark.parametrize(("words", "line"), [
    (["nosuch"], "nosuch: no such preset; one of: quick,"),
    ([], "moonteam train: a preset must be given; one of: quick,"),
    (["qick"], "qick: no such preset; did you mean quick? one of: quick,"),
    (["comprae"], "comprae: no such preset; did you mean compare?"),
    (["small", "--bootstrap.num-minibatches", "7"],
     "bootstrap.num_minibatches: 512 environments do not divide into 7 minibatches"),
    (["small", "--num-steps", "49"], "num_steps: 49 is more than max_steps 48"),
    (["small", "--num-targets", "40"], "40 targets do not fit")])
def test_bad_words_are_one_line(words, line, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["train", *words]) == 2
    error = capsys.readouterr().err
    assert line in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_help_names_presets_and_options(capsys):
    for words in (["--help"], ["small", "--help"]):
        with pytest.raises(SystemExit) as stopped:
            main(["train", *words])
        assert stopped.value.code == 0
        text = capsys.readouterr().out
        assert "pi_5t" in text
        assert "--bootstrap.updates" in text


def test_impossible_numbers_are_refused_when_built():
    small = PRESETS["small"]
    with pytest.raises(InputError, match="both phases have 0 updates"):
        dataclasses.replace(small, bootstrap=Phase(0, 8, 2, small.bootstrap.weights),
                            refinement=Phase(0, 8, 2, small.bootstrap.weights))
    with pytest.raises(InputError, match=r"bootstrap\.num_envs: 0"):
        dataclasses.replace(small, bootstrap=Phase(1, 0, 1, small.bootstrap.weights))
    with pytest.raises(InputError, match="eval_every: 0"):
        dataclasses.replace(small, eval_every=0)
