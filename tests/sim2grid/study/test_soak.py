"""The soak: small missions in physics, exceptions that are noted, missions that can be repeated."""

import contextlib
import io
import json

import pytest

from moonteam.cli import main
from sim2grid.study import soak

SEED = 6


@pytest.fixture
def small(monkeypatch):
    """Blocks of three missions of one rover on 8 m."""
    monkeypatch.setattr(soak, "BLOCK", 3)
    monkeypatch.setattr(soak, "SIDES", {8: 1.0})
    monkeypatch.setattr(soak, "mixtures", lambda *_: (("wheeled",),))
    monkeypatch.setattr(soak, "PLANNERS", {"greedy": 1.0})
    monkeypatch.setattr(soak, "MOST_TARGETS", 2)
    soak._stage.cache_clear()
    yield
    soak._stage.cache_clear()


def command(*words):
    with contextlib.redirect_stdout(io.StringIO()) as out:
        code = main(["evaluate", "soak", "--seed", str(SEED), "--json", *words])
    return code, json.loads(out.getvalue())


def rows(folder):
    return [json.loads(line) for line in (folder / "rows.jsonl").read_text().splitlines()]


def test_missions_that_failed_end_alike_when_repeated_from_their_files(small, tmp_path):
    code, report = command("--count", "3", "--out", str(tmp_path))
    assert code == 0
    found = rows(tmp_path)
    assert [row["number"] for row in found] == [0, 1, 2]
    assert {row["mode"] == "clock" for row in found} == {True, False}
    failed = [row for row in found if not row["success"]]
    assert 0 < len(failed) < 3
    assert sorted(p.name for p in (tmp_path / "failed").iterdir()) == [
        f"{row['number']:04d}.yaml" for row in failed]
    assert (tmp_path / "soak.png").stat().st_size > 1000
    for row in failed:
        words = report["commands"][str(row["number"])].split()[1:]
        out = tmp_path / f"again{row['number']}"
        with contextlib.redirect_stdout(io.StringIO()):
            assert main([*words, "--out", str(out)]) == 1
        again = json.loads((out / "report.json").read_text())
        assert (again["seconds"], again["decisions"]) == (row["seconds"], row["decisions"])
        assert row["cause"].startswith(again["cause"].replace("_", " "))


def test_an_exception_is_noted_and_the_soak_goes_on_where_it_was_stopped(
        small, tmp_path, monkeypatch):
    def run(stage, deciders):
        if 0 in deciders:
            raise ZeroDivisionError("once")
        raise KeyboardInterrupt

    monkeypatch.setattr(soak.Stage, "run", run)
    code, report = command("--count", "3", "--out", str(tmp_path))
    assert code == 130
    assert report["failures"] == {"exception: ZeroDivisionError: once": [0]}
    assert "in run" in report["tracebacks"]["0"]
    monkeypatch.setattr(soak.Stage, "run", lambda *_: 1 / 0)
    code, report = command("--count", "3", "--resume", "--out", str(tmp_path))
    assert code == 1
    assert [row["process"] for row in rows(tmp_path)] == [0, 1, 1]
    assert len(report["tracebacks"]) == 3


def test_the_mix_holds_every_mixture_of_kinds_planner_and_mode():
    teams = [tuple(kind for _, kind in soak.block(0, k).team) for k in range(200)]
    assert len(set(teams)) == 83
    assert {len(team) for team in teams} == set(soak.TEAMS)
    assert len({(w.planner, w.mode) for w in (soak.who_decides(0, n) for n in range(200))}) == 12
    assert {soak.recipe_targets(0, n) for n in range(200)} == set(range(1, 9))


def entry(number, memory, process=0):
    return soak.Entry(number, "mare", 0, 8, ("wheeled",), 1, (), "barrier", "exact", True, None,
                      None, 1.0, 1, 1.0, memory, process)


def test_the_line_through_memory_leaves_out_what_a_process_begins_with():
    line = [entry(k, 100 + 0.01 * k) for k in range(50)]
    line += [entry(k, 500 + 0.01 * k, 50) for k in range(50, 80)]
    assert soak.memory(line)["slope"] == pytest.approx(10.0)
    assert soak.memory(line)["slope_second_half"] == pytest.approx(10.0)
    assert soak.memory([])["slope"] is None
    saw = [entry(k, 100.0 + k % (soak.FORGET * soak.BLOCK)) for k in range(450)]
    assert soak.memory(saw)["lowest_mib"] == [100.0, 100.0, 100.0]
    assert soak.memory(saw)["highest_mib"] == [299.0, 299.0, 149.0]
