"""The benchmarks of physics and execution print one document with figures that make sense."""

import json

import pytest

from moonteam import cli


def test_physics_on_the_native_engine(capsys, tmp_path):
    words = ["bench", "physics", "--backend", "native", "--worlds", "1", "--samples", "33",
             "--seconds", "0.01"]
    assert cli.main([*words, "--json", "--out", str(tmp_path)]) == 0
    report = json.loads(capsys.readouterr().out)
    assert json.loads((tmp_path / "bench_physics.json").read_text()) == report
    row, = report["rows"]
    assert (row["backend"], row["worlds"], row["threads"], row["diverged"]) == ("native", 1, 1, 0)
    assert row["physics_steps_per_s"] > row["steps_per_s"] > 0
    dt = report["dt"]
    assert row["real_time_factor"] == pytest.approx(row["steps_per_s"] * dt)
    assert row["controllers_add"] == pytest.approx(
        row["physics_steps_per_s"] / row["steps_per_s"] - 1)
    assert row["cpu_s"] > 0
    assert row["peak_memory_mb"] > 50
    assert cli.main([*words, "--markdown"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "`moonteam bench physics --backend native --worlds 1 --samples 33 " \
                       "--seconds 0.01`"
    assert lines[2].startswith("| engine | worlds |")
    assert lines[4].startswith("| native | 1 | 1 |")


def test_execution_step_by_step(capsys):
    words = ["bench", "execution", "--engine", "native", "--missions", "2", "--site", "flat",
             "--side", "3", "--targets", "1", "--planner", "first"]
    assert cli.main([*words, "--json"]) == 0
    row, = json.loads(capsys.readouterr().out)["rows"]
    assert (row["engine"], row["missions"], row["solved"]) == ("native", 2, 2)
    assert row["simulated_s"] > 0
    assert row["real_time_factor"] == pytest.approx(row["simulated_s"] / row["wall_s"])


def test_travel_beside_dijkstra(capsys, tmp_path):
    words = ["bench", "travel", "--side", "8", "--targets", "2", "--repeats", "2"]
    assert cli.main([*words, "--json", "--out", str(tmp_path)]) == 0
    report = json.loads(capsys.readouterr().out)
    assert json.loads((tmp_path / "bench_travel.json").read_text()) == report
    ours, peer = report["rows"]
    assert ours["fields"] == peer["fields"] == 2 * len(report["kinds"])
    assert ours["error_mean"] < ours["error_worst"] < 0.01 < peer["error_mean"]
    assert peer["error_worst"] == pytest.approx(2**0.5 * (2 - 2**0.5)**0.5 - 1, abs=0.003)
    assert all(abs(row[f"field_over_way_{key}"]) < 0.05 for row in report["ways"]
               for key in ("least", "median", "most"))
    assert cli.main([*words, "--markdown"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "`moonteam bench travel --side 8 --targets 2 --repeats 2`"
    assert lines[2].startswith("| solver | first call | 6 fields, median |")


def test_bad_numbers_give_one_line(capsys):
    assert cli.main(["bench", "travel", "--targets", "0"]) == 2
    assert cli.main(["bench", "travel", "--side", "1000"]) == 2
    assert cli.main(["bench", "physics", "--worlds", "0"]) == 2
    assert cli.main(["bench", "physics", "--samples", "5"]) == 2
    assert cli.main(["bench", "physics", "--threads", "0"]) == 2
    assert cli.main(["bench", "execution", "--missions", "0"]) == 2
    assert cli.main(["bench", "execution", "--seconds", "0"]) == 2
    assert cli.main(["bench", "execution", "--policy", "nobody"]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 8
    assert all(line.startswith("moonteam: ") for line in lines)
