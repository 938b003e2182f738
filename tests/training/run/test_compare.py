"""Run folders as training leaves them, put together by seed."""

import dataclasses
import json
from pathlib import Path

import pytest
from PIL import Image

from moonteam import files
from moonteam.cli import main
from training.mappo.config import PRESETS


def score(success, makespan=10.0):
    return {"success": success, "makespan": makespan, "moves": 20.0}


def folder(out, success, finished=True, looks=3, **changes):
    """A run folder of `small`; its figures grow to `success`."""
    config = dataclasses.replace(PRESETS["small"], **changes)
    files.write_json(out / "config.json", config)
    rows = []
    for look in range(1, 2 * looks + 1):
        row = {"phase": "bootstrap" if look < looks else "refinement", "total_updates": look,
               "env_steps": 100 * look, "seconds": 2.0 * look, "rate": 50.0, **score(0.1)}
        if look % 2 == 0:
            held_out = score(success * look / (2 * looks), 30.0 - look)
            row |= {"argmax": held_out, "sample": held_out}
        rows.append(row)
    files.write_text(out / "metrics.jsonl", "".join(files.dump_json(r) + "\n" for r in rows))
    if finished:
        files.write_json(out / "report.json", {
            "preset": "small", "seed": config.seed, "env_steps": 600, "seconds": 12.5,
            "device": "1 x cpu", "commit": f"abc{config.seed}", "scenarios": 500,
            "argmax": score(success, 12.0), "sample": score(success + 0.01)})
    return str(out)


@pytest.fixture
def runs(tmp_path):
    """Three seeds of one kind, two of another, one of them unfinished."""
    ablated = dataclasses.replace(PRESETS["small"].refinement, lr=1.0)
    return [folder(tmp_path / "a", 0.9, seed=2), folder(tmp_path / "b", 0.95, seed=0),
            folder(tmp_path / "c", 0.97, seed=1),
            folder(tmp_path / "d", 0.5, seed=0, memory=False, refinement=ablated),
            folder(tmp_path / "e", 0.4, False, 2, seed=1, memory=False, refinement=ablated)]


def compare(capsys, *words):
    assert main(["train", "compare", *words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_seeds_of_one_kind_are_one_row_with_mean_lowest_and_highest(runs, capsys):
    first, second = compare(capsys, *runs)["summary"]
    assert (first["planner"], first["seeds"]) == ("small", 3)
    assert first["argmax_success"] == pytest.approx(0.94)
    assert first["intervals"]["argmax_success"] == [0.9, 0.97]
    assert first["intervals"]["sample_success"] == pytest.approx([0.91, 0.98])
    assert (first["argmax_makespan"], first["sample_makespan"]) == (12.0, 10.0)
    assert (first["env_steps"], first["seconds"]) == (600, 12.5)
    assert "env_steps" not in first["intervals"]
    assert second["planner"] == "small, refinement.lr=1.0, memory=False"
    assert second["argmax_success"] == pytest.approx((0.5 + 0.4) / 2)
    assert second["intervals"]["env_steps"] == [400, 600]


def test_one_seed_has_no_spread(runs, capsys):
    document = compare(capsys, runs[0])
    assert document["summary"][0]["intervals"] == {}
    assert document["rows"][0]["seed"] == 2


def test_the_notes_name_seeds_and_unfinished_runs(runs, capsys):
    notes = " ".join(compare(capsys, *runs, "--label", "GRU", "--label", "Dense")["notes"])
    assert "GRU: 0 to 2; Dense: 0, 1." in notes
    assert f"{runs[4]} is not finished: its last evaluation, on 256 scenarios after 400" in notes
    assert runs[3] not in notes
    assert "On 500 scenarios at the end of training; trained at commit abc0, abc1, abc2 on" in notes


def test_tables_and_curves(runs, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["train", "compare", *runs, "--markdown", "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert text == (out / "table.md").read_text()
    assert "| small | 3 | 600 | 0.940 [0.900, 0.970] | 0.950 [0.910, 0.980] | 12.00 [" in text
    assert text.startswith("`moonteam train compare ")
    assert len(json.loads((out / "compare.json").read_text())["rows"]) == 5
    with Image.open(out / "curves.png") as picture:
        assert len(picture.convert("RGB").getcolors(1 << 20)) > 50
    assert main(["train", "compare", *runs]) == 0
    assert "[0.900, 0.970]" in capsys.readouterr().out


def test_the_mean_line_ends_where_the_shortest_run_does(runs):
    from matplotlib.figure import Figure

    from training.mappo import curve
    from training.run import metrics

    axis = Figure().subplots()
    group = [metrics.read(Path(name) / "metrics.jsonl") for name in runs[3:]]
    curve._draw_group(axis, "success", "Dense", group, "C0")
    mean, low, high, dotted = axis.lines
    assert list(mean.get_xdata()) == list(dotted.get_xdata()) == [200, 400]
    assert list(mean.get_ydata()) == pytest.approx([(0.5 / 3 + 0.2) / 2, (1.0 / 3 + 0.4) / 2])
    assert [len(low.get_xdata()), len(high.get_xdata())] == [3, 2]
    assert len(axis.collections) == 1


def harm(kind, path):
    if kind == "twice":
        return [str(path), str(path)]
    if kind == "labels":
        return [str(path), "--label", "one", "--label", "two"]
    if kind == "missing":
        return [str(path / "nowhere")]
    if kind == "no looks":
        lines = (path / "metrics.jsonl").read_text().splitlines()
        (path / "metrics.jsonl").write_text(lines[0] + "\n")
        (path / "report.json").unlink()
    if kind == "torn config":
        (path / "config.json").write_text('{"name": "sm')
    if kind == "other kind":
        (path / "config.json").write_text('{"families": [], "seed": 0}')
    if kind == "odd report":
        (path / "report.json").write_text('{"env_steps": 3}')
    if kind == "odd row":
        (path / "metrics.jsonl").write_text('{"phase": 3}\n')
    return [] if kind == "none" else [str(path)]


@pytest.mark.parametrize(("kind", "line"), [
    ("twice", "is the same run as"), ("labels", "1 different names are needed, for small"),
    ("missing", "nowhere/config.json: no such file"), ("none", "no run folder is given"),
    ("no looks", "metrics.jsonl: holds no evaluation"), ("torn config", "is not JSON"),
    ("other kind", "is no run of the presets small, laptop, pi_*"),
    ("odd report", "report.json: missing required field `seconds`"),
    ("odd row", "metrics.jsonl: [0].phase: Expected `str`")])
def test_bad_folders_are_one_line(kind, line, tmp_path, capsys):
    folder(tmp_path / "run", 0.9)
    assert main(["train", "compare", *harm(kind, tmp_path / "run")]) == 2
    error = capsys.readouterr().err
    assert line in error
    assert error.count("\n") == 1


def test_a_half_written_last_line_is_left_out(tmp_path, capsys):
    path = folder(tmp_path / "run", 0.9, finished=False)
    with (tmp_path / "run" / "metrics.jsonl").open("a") as out:
        out.write('{"phase": "refin')
    assert compare(capsys, path)["summary"][0]["argmax_success"] == pytest.approx(0.9)


def test_two_kinds_are_in_one_table_by_what_both_have(tmp_path, capsys):
    mappo = folder(tmp_path / "run", 0.9)
    taught = tmp_path / "taught"
    look = {"family": "2 robots", "success": 0.5, "makespan_gap": 0.2, "success_effort": 0.4,
            "moves_gap": 0.1}
    files.write_json(taught / "config.json", {"preset": "quick", "seed": 3, "families": []})
    files.write_text(taught / "metrics.jsonl", files.dump_json(
        {"phase": "imitation", "env_steps": 6, "seconds": 1.0, "labelled": 3,
         "families": [look, look | {"success": 1.0}]}) + "\n")
    assert main(["train", "compare", mappo, str(taught)]) == 2  # written without gaps
    err = capsys.readouterr().err
    assert "small is judged by other figures than those beside it, and its gap" in err
    path = tmp_path / "run" / "metrics.jsonl"
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    for row in rows:
        if "argmax" in row:
            row["argmax"] |= {"makespan_gap": 30.0 / row["total_updates"]}
    files.write_text(path, "".join(files.dump_json(row) + "\n" for row in rows))
    both = tmp_path / "both"
    found = compare(capsys, mappo, str(taught), "--out", str(both))["summary"]
    assert [(r["planner"], r["success"], r["makespan_gap"], r["seconds"]) for r in found] == [
        ("small", 0.9, 5.0, 12.0), ("quick", 0.75, pytest.approx(0.2), 1.0)]
    assert (both / "curves.png").stat().st_size > 0
    out = tmp_path / "out"
    assert main(["train", "compare", str(taught), "--out", str(out)]) == 0
    (row,) = json.loads((out / "compare.json").read_text())["summary"]
    assert (row["success"], row["moves_gap"], row["env_steps"]) == (0.75, 0.1, 6)
    assert (out / "curves.png").stat().st_size > 0
