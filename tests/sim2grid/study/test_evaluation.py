"""Evaluations of many missions: rows, baselines, failures, resuming; on sliding points.

Only the last test runs an engine.
"""

import contextlib
import functools
import io
import json
from typing import NamedTuple

import msgspec
import numpy as np
import pytest

from moonteam.cli import main
from moonteam.errors import InputError
from moonteam.physics.backends import make_backend
from moonteam.planners.kind import PlannerOptions
from moonteam.robots.base import CONTROL_PERIOD
from sim2grid.study import evaluation
from sim2grid.study.evaluation import Contender, Evaluation, Row, contenders
from sim2grid.study.fleet import Rates, Recipe, make_fleet
from sim2grid.study.restage import load_report, restage
from sim2grid.study.summary import document, failure_label, summarise

EXACT = Contender("closed", "barrier", "exact")
RECIPE = Recipe("flat", 0, 5, num_targets=2, side=6)


class State(NamedTuple):
    qpos: np.ndarray
    time: np.ndarray
    diverged: np.ndarray


class Log(NamedTuple):
    qpos: np.ndarray
    power: np.ndarray
    propellant_rate: np.ndarray


class SlidingRows:
    """Rows of points that slide to their waypoints; `bad` rows diverge after a second."""

    name, log_every = "sliding", 25

    def __init__(self, scene, bad=(), pull=1.0):
        self.bases = [robot.qpos.start for robot in scene.robots]
        self.bad, self.pull, self.looks = bad, pull, 0
        self.widths = set()

    def reset(self, qpos, batch=1):
        poses = np.array(qpos)
        return State(poses, np.zeros(len(poses)), np.zeros(len(poses), bool))

    def advance(self, state, commands, num_control_steps):
        self.looks += 1
        self.widths.add(len(state.qpos))
        qpos = state.qpos.copy()
        seconds = num_control_steps * CONTROL_PERIOD
        for base, command in zip(self.bases, commands, strict=True):
            away = np.asarray(command.xy) - qpos[:, base:base + 2]
            far = np.maximum(np.hypot(*away.T), 1e-9)
            step = np.minimum(far, np.asarray(command.speed) * seconds * self.pull)
            step[np.asarray(command.lost) | state.diverged] = 0.0
            qpos[:, base:base + 2] += away * (step / far)[:, None]
        time = state.time + seconds
        gone = state.diverged.copy()
        gone[list(self.bad)] |= time[list(self.bad)] > 1.0
        power = np.ones((len(qpos), 1, len(self.bases)))
        return State(qpos, time, gone), Log(qpos[:, None], power, power * 0.001)


fleets = functools.cache(make_fleet)


@pytest.fixture
def sliding(monkeypatch):
    """Evaluations run on sliding points; returns the options of their engines."""
    options = {}

    def engine(self, name):
        if name not in self._engines:
            pull = {"pull": 0.8} if name == "mjx" else {}
            self._engines[name] = SlidingRows(self._fleet.scene, **options | pull)
        return self._engines[name]

    monkeypatch.setattr(evaluation.Group, "_backend", engine)
    monkeypatch.setattr(evaluation, "make_fleet", fleets)
    return options


def table(who, **more):
    done = Evaluation([RECIPE], 5, who, width=2, **more)
    done.run()
    return done


def test_baselines_stand_side_by_side(sliding):
    rows = contenders(["grid", "closed", "open", "oracle"], ["barrier", "async"], [EXACT])
    assert [c.name for c in rows] == [
        "grid exact", "closed exact barrier", "closed exact async", "open exact",
        "oracle barrier", "oracle async"]
    done = table(rows)
    assert len(done.rows) == 6 * 5
    for number in range(5):
        by = {name: done.rows[name, number].report for name in [c.name for c in rows]}
        assert all(report.success for report in by.values())
        plan = by["grid exact"]
        assert plan.decisions == plan.grid_plan.makespan == by["closed exact barrier"].decisions
        assert by["open exact"].decisions == plan.decisions
        assert by["closed exact barrier"].inflation == 1.0
        assert by["oracle barrier"].seconds == by["closed exact barrier"].seconds
        assert plan.seconds <= by["closed exact barrier"].seconds
        assert by["closed exact async"].seconds <= by["closed exact barrier"].seconds
    assert {row.slot for row in done.rows.values()} == {0, 1}
    entry = done.entries[3]
    assert (entry.number, entry.mission.name) == (3, "flat-0-3")


def test_open_loop_fails_where_closed_loop_mends(sliding):
    recipe = Recipe("flat", 0, 5, num_targets=2, side=6, rates=Rates(new_targets=2))
    done = Evaluation([recipe], 4, contenders(["closed", "open"], ["barrier"], [EXACT]), width=4)
    done.run()
    closed = [done.rows["closed exact barrier", k].report for k in range(4)]
    blind = [done.rows["open exact", k].report for k in range(4)]
    assert all(report.success for report in closed)
    assert all(report.replans["new_target"] == 2 for report in closed)
    assert not any(report.success for report in blind)
    assert {report.cause for report in blind} == {"plan_over"}


def test_a_diverged_engine_costs_only_its_own_missions(sliding):
    sliding["bad"] = (1,)
    done = table([EXACT])
    causes = [done.rows[EXACT.name, k].report.cause for k in range(5)]
    assert causes[1] == "engine"
    assert causes[0] is causes[2] is causes[4] is None
    assert failure_label(done.rows[EXACT.name, 1]) == "engine"


def test_robots_lost_by_events_leave_missions_that_nobody_could_solve(sliding):
    recipe = Recipe("flat", 0, 6, num_targets=4, side=8, rates=Rates(lose=1.0))
    done = Evaluation([recipe], 10, [EXACT], width=5)
    done.run()
    rows = done.sorted_rows()
    stopped = [row for row in rows if not row.solvable]
    assert 0 < len(stopped) < 10
    assert all(row.report.cause == "unsolvable" for row in stopped)
    assert all(row.report.success for row in rows if row.solvable)
    figures = summarise(rows, 0)
    assert figures["success"] == pytest.approx(1 - len(stopped) / 10)
    assert figures["success_solvable"] == 1.0
    lost = [robot.lost for row in stopped for robot in row.report.robots if robot.lost]
    assert lost == ["event"] * len(stopped)
    assert failure_label(stopped[0]).startswith("unsolvable: ")


def test_what_is_done_is_not_done_again_and_the_report_is_the_same(sliding):
    whole = table([EXACT])
    kept: list[Row] = []

    def stop(row):
        kept.append(row)
        if len(kept) == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        table([EXACT], keep=stop)
    added: list[Row] = []
    rest = table([EXACT], rows={(row.contender, row.number): row for row in kept},
                 keep=added.append)
    assert len(added) == 2
    assert rest.sorted_rows() == whole.sorted_rows()


def test_figures_of_rows_known_by_arithmetic(sliding):
    done = table(contenders(["closed"], ["barrier", "async"], [EXACT]))
    rows = [row for row in done.sorted_rows() if row.contender == EXACT.name]
    failed = msgspec.structs.replace(rows[0], report=msgspec.structs.replace(
        rows[0].report, success=False, cause="max_steps", inflation=None))
    figures = summarise([failed, *rows[1:]], 0)
    assert (figures["missions"], figures["solved"], figures["solvable"]) == (5, 4, 5)
    assert figures["success"] == 0.8
    won = [row.report for row in rows[1:]]
    assert figures["seconds"] == pytest.approx(np.mean([r.seconds for r in won]))
    assert figures["inflation"] == pytest.approx(1.0)
    assert figures["slowdown"] == pytest.approx(
        sum(r.seconds for r in won) / sum(row.nominal_s for row in rows[1:]))
    assert figures["wrong_cell_rate"] == 0.0
    assert figures["intervals"]["success"] == pytest.approx([0.3755, 0.9638], abs=1e-3)
    assert figures["intervals"]["wrong_cell_rate"][1] > 0.0, "none of so few proves nothing"


def test_engines_are_held_against_each_other(sliding):
    who = contenders(["grid", "closed"], ["barrier"], [EXACT], ["native", "mjx"])
    assert [c.name for c in who] == [
        "grid exact", "closed exact barrier", "closed exact barrier mjx"]
    done = table(who)
    rows = done.sorted_rows()
    report = document(rows, done.entries, who, {}, {}, 0)
    (line,) = report["comparisons"]
    native = [row.report for row in rows if row.contender == "closed exact barrier"]
    mjx = [row.report for row in rows if row.contender == "closed exact barrier mjx"]
    assert {r.backend for r in mjx} == {"mjx"}
    assert line["seconds"] == pytest.approx(
        sum(r.seconds for r in mjx) / sum(r.seconds for r in native))
    assert line["seconds"] > 1.0  # its points are pulled less hard
    assert line["seconds_more"] == pytest.approx(
        np.mean([r.seconds for r in mjx]) - np.mean([r.seconds for r in native]))
    assert report["differences"] == []  # the same decisions in every mission
    odd = next(row for row in rows if row.contender.endswith("mjx"))
    robots = (msgspec.structs.replace(odd.report.robots[0], timeouts=1), *odd.report.robots[1:])
    failed = msgspec.structs.replace(odd, report=msgspec.structs.replace(
        odd.report, success=False, cause="max_steps", robots=robots))
    changed = [failed if row is odd else row for row in rows]
    report = document(changed, done.entries, who, {}, {}, 0)
    (found,) = report["differences"]
    assert found["number"] == odd.number
    assert found["why"] == f"{robots[0].name}: timeouts 1 against 0"
    assert found["this"].startswith("max steps, ")
    assert found["other"].startswith("solved, ")
    (line,) = report["comparisons"]
    assert (line["both_solved"], line["only_other"], line["only_this"]) == (4, 1, 0)


def command(*words):
    return said("--planner", "exact", "--site", "flat", "--side", "6", "--targets", "2",
                "--width", "2", *words)


def said(*words):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(["evaluate", "execution", *words])
    return code, out.getvalue(), err.getvalue()


CLOCKED = "tests/evaluation/nearest.py"


@pytest.mark.parametrize(("words", "expected"), [
    (["--mission", "demo", "demo"], "--mission: give each once"),
    (["--mission", "demo", "--count", "3"], "--count: is for random missions"),
    (["--mission", "demo", "--team", "drone"], "--team: is for random missions"),
    (["--mission", "outpots"], "outpots: no such file; did you mean outpost"),
    (["--mission", "demo", "sampling"], "sampling: clock: is by the clock, which --mode clock"),
    (["--unfold", "hidden"], "--unfold: its missions are by the clock; --mode clock"),
    (["--search", "middle"], "--search: is for missions by the clock that unfold; --mode clock"),
    (["--futures", "16", "--mode", "clock", "barrier"], "--futures: is for missions by the clock"),
    (["--unfold", "hidden", "--mode", "clock", "--lose", "1"], "--lose: comes at decisions"),
    (["--unfold", "hidden", "--mode", "clock", "--search", "middle", "--count", "1"],
     "--search middle: has no effect where targets are hidden"),
    (["--mode", "clock", "--futures", "1"], "--futures: 1 is not allowed; 2 to 4096"),
    (["--mode", "clock", "--search", "sweep", "--count", "1", "--side", "6", "--targets", "1"],
     "--search: has no effect in mare-0-0"),
    (["--dem", "none.tif"], "none.tif: no such file"),
    (["--dem", "examples/ground/rim.tif", "--centre", "30", "0"],
     "rim.tif: is too small: 32 by 32 m of ground are needed around 30 m east, 0 m north"),
    (["--dem", "examples/ground/rim.tif", "--units", "degrees", "--centre", "98", "0"],
     "rim.tif: centre: 98, 0 is not allowed; a latitude"),
    (["--dem", "examples/ground/rim.tif", "--rotation", "nan"], "rim.tif: rotation: nan is not"),
])
def test_what_is_asked_of_ones_own_in_vain_gets_one_line(words, expected, tmp_path):
    code, text, err = said(*words, "--planner", "exact", "--out", str(tmp_path / "out"))
    assert (code, text) == (2, "")
    assert expected in err
    assert err.count("\n") == 1
    assert not (tmp_path / "out" / "config.json").exists()


def test_planners_decide_in_the_modes_that_they_can():
    options = PlannerOptions()
    mine = "examples/nearest_planner.py:NearestPlanner"
    steps, timed = evaluation.deciders(mine, options, ("barrier", "clock"))
    assert (steps.who, timed) == ("NearestPlanner", None)
    steps, timed = evaluation.deciders(f"{CLOCKED}:Nearest", options, ("async", "clock"))
    assert (steps, timed.who) == (None, "Nearest")
    steps, timed = evaluation.deciders("exact", options, ("async", "clock"))
    assert (steps.who, timed.who) == ("exact", "exact")
    assert evaluation.deciders("exact", options, ("clock",))[0] is None
    rows = contenders(["closed"], ["async", "clock"], [steps], ["native"],
                      [msgspec.structs.replace(timed, planner=f"{CLOCKED}:Nearest")])
    assert [c.name for c in rows] == ["closed exact async", "closed Nearest clock"]


def test_the_command_writes_its_folder_and_goes_on_where_it_was_stopped(
        sliding, tmp_path, monkeypatch):
    words = ["--count", "4", "--loop", "closed", "open", "--json", "--out", str(tmp_path)]
    code, text, _ = command(*words)
    assert code == 0
    report = json.loads(text)
    assert report == json.loads((tmp_path / "report.json").read_text())
    assert report["kind"] == "execution"
    assert [line["solved"] for line in report["summary"]] == [4, 4]
    assert len(report["missions"]) == 4
    assert len((tmp_path / "rows.csv").read_text().splitlines()) == 9
    assert "closed" in (tmp_path / "table.md").read_text()
    assert report["meta"]["command"] == (
        "moonteam evaluate execution --targets 2 --side 6 --site flat --count 4 "
        "--loop closed open --planner exact --width 2")
    journal = tmp_path / "rows.jsonl"
    lines = journal.read_text().splitlines(keepends=True)
    assert len(lines) == 8
    journal.write_text("".join(lines[:5]) + lines[5][:40])  # cut off in the middle of a line
    code, text, _ = command(*words, "--resume")
    again = json.loads(text)
    assert code == 0
    assert again["rows"] == report["rows"]
    assert again["summary"] == report["summary"]
    code, _, err = command(*words, "--resume", "--seed", "1")
    assert code == 2
    assert "made with other options: seed" in err


CLOCKED_MISSION = """
name: tiny
clock: seconds
map: {size: [8, 8], cell_m: 1.0}
site: {preset: flat, seed: 0}
robots:
  - {name: hopper, kind: drone, skills: [eye], start: [1, 1.5]}
  - {name: rover, kind: wheeled, skills: [eye, drill], start: [5, 1]}
targets:
  - {name: look, at: [5.5, 6], skills: [eye], service: 2}
  - {name: core, at: [4, 3], skills: [drill], after: [look], service: 1}
"""


def test_a_mission_of_ones_own_by_the_clock_with_a_planner_of_ones_own(sliding, tmp_path):
    path = tmp_path / "tiny.yaml"
    path.write_text(CLOCKED_MISSION)
    code, text, _ = said("--mission", str(path), "--mode", "clock", "--planner",
                         f"{CLOCKED}:Nearest", "exact", "--json")
    assert code == 0
    report = json.loads(text)
    assert [(row["report"]["mission"], row["contender"]) for row in report["rows"]] == [
        ("tiny", f"closed {who} clock") for who in ("Nearest", "exact")]
    assert all(row["report"]["success"] for row in report["rows"])
    assert report["rows"][0]["nominal_s"] > 0
    assert report["missions"][0]["mission"]["robots"][0]["start"] == [1, 1.5]


def test_an_interrupted_command_saves_what_is_done(sliding, tmp_path, monkeypatch):
    keep = evaluation.Group._keep

    def stop(self, contender, k, *rest):
        keep(self, contender, k, *rest)
        if len(self._all.rows) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(evaluation.Group, "_keep", stop)
    code, _, err = command("--count", "4", "--out", str(tmp_path))
    assert code == 130
    assert "--resume goes on" in err
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["interrupted"]
    assert len(report["rows"]) == 2


@pytest.mark.parametrize(("words", "expected"), [
    (["--count", "0"], "--count: 0 is not allowed; 1 to 100000"),
    (["--lose", "1.5"], "--lose: 1.5 is not allowed; 0 to 1"),
    (["--resume"], "--resume: needs the folder"),
    (["--loop", "open", "open"], "--loop: give each once"),
    (["--new-targets", "20", "--count", "1"], "22 targets"),
    (["--planner", "policy", "--policy", "nobody", "--count", "1"], "nobody: no such file"),
    (["--mission", "demo"], "--site: is for random missions; those of --mission say it"),
    (["--team", "wheled"], "--team: wheled: no such robot kind; did you mean wheeled?"),
    (["--dem", "none.tif"], "--site: give presets or an elevation model, not both"),
    (["--detrend"], "--detrend: is for an elevation model; give --dem too"),
    (["--planner", f"{CLOCKED}:Nearest"], "has no reset; a planner has reset and act"),
    (["--planner", "examples/nearest_planner.py:NearestPlanner", "--mode", "clock"],
     "has no plan; a planner by the clock has plan(moment)"),
    (["--planner", f"{CLOCKED}:NOT_A_PLANNER"], "a planner is a class, or a function"),
])
def test_mistakes_get_one_line_and_nothing_runs(sliding, words, expected):
    code, text, err = command(*words)
    assert code == 2
    assert text == ""
    assert expected in err
    assert err.count("\n") == 1


def test_a_mission_of_a_report_can_be_repeated_alone(sliding, tmp_path):
    command("--count", "3", "--loop", "grid", "closed", "open", "--out", str(tmp_path))
    report = load_report(tmp_path / "report.json")
    for name in (None, "open exact"):
        staged = restage(report, 2, "report.json", name)
        assert staged.width == 2
        assert staged.row.slot == 0
        staged.run(SlidingRows(staged.prepared.scene))
        assert staged.execution.record.success
        assert staged.execution.record.seconds() == pytest.approx(staged.row.report.seconds)
        assert len(staged.execution.record.decisions) == staged.row.report.decisions
    with pytest.raises(InputError, match="holds no mission 7 of `closed exact barrier`"):
        restage(report, 7, "report.json")
    with pytest.raises(InputError, match="no contender 'grid exact' in physics"):
        restage(report, 0, "report.json", "grid exact")
    with pytest.raises(InputError, match=r"is no report\.json"):
        load_report(tmp_path / "config.json")


def test_on_the_engine_a_mission_does_not_depend_on_its_company():
    """Bits: 3 missions on 2 rows, then the last one alone, in a row that another used before."""
    small = Recipe("flat", 0, 5, num_targets=1, side=4)
    done = Evaluation([small], 3, [EXACT], width=2)
    done.run()
    rows = done.sorted_rows()
    assert all(row.report.success for row in rows)
    alone = Evaluation([small], 3, [EXACT], width=2,
                       rows={(row.contender, row.number): row for row in rows[:2]})
    alone.run()
    assert alone.sorted_rows()[2] == rows[2]


def test_missions_on_several_sites_stand_in_one_line_and_each_can_be_repeated(capsys, tmp_path):
    words = ["evaluate", "execution", "--site", "highland", "--sites", "2", "--site-seed", "3",
             "--side", "6", "--targets", "1", "--count", "4", "--width", "4", "--planner", "exact"]
    assert main([*words, "--out", str(tmp_path / "mixed"), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert [row["site_seed"] for row in report["rows"]] == [3, 4, 3, 4]
    (line,) = report["summary"]
    assert (line["site_seed"], line["sites"], line["missions"]) == (3, 2, 4)
    assert "highland 3 to 4" in (tmp_path / "mixed" / "table.md").read_text()
    staged = restage(report, 1, "report.json")
    staged.run(make_backend("native", staged.prepared.scene))
    assert staged.execution.record.seconds() == pytest.approx(staged.row.report.seconds)
    assert len(staged.execution.record.decisions) == staged.row.report.decisions


def test_many_sites_are_for_presets(capsys, tmp_path):
    heights = tmp_path / "flat.npy"
    np.save(heights, np.zeros((64, 64)))
    assert main(["evaluate", "execution", "--sites", "2", "--dem", str(heights)]) == 2
    assert "--sites" in capsys.readouterr().err


@pytest.mark.soak
def test_both_engines_tell_the_same_of_many_missions(capsys):
    """The first of the 200 missions in docs/results/execution.md: success and seconds agree.

    As many as it takes for the interval to be narrow: now and then a mission takes another course.
    """
    words = ["evaluate", "execution", "--site", "highland", "--side", "8", "--targets", "3",
             "--lose", "0.3", "--count", "60", "--planner", "exact", "--width", "20", "--json"]
    assert main([*words, "--backend", "native", "mjx"]) == 0
    report = json.loads(capsys.readouterr().out)
    native, mjx = report["summary"]
    (low, high), (least, most) = (line["intervals"]["success"] for line in (native, mjx))
    assert max(low, least) <= min(high, most)
    (compared,) = report["comparisons"]
    assert compared["only_this"] + compared["only_other"] <= 1
    low, high = compared["intervals"]["seconds_more"]
    assert -0.02 * native["seconds"] < low <= high < 0.02 * native["seconds"]


def test_the_fused_backend_stands_in_the_table_or_says_what_it_takes(capsys):
    words = ["evaluate", "execution", "--site", "flat", "--side", "4", "--targets", "1",
             "--count", "2", "--width", "2", "--json"]
    assert main([*words, "--backend", "native", "fused", "--mode", "barrier", "async"]) == 0
    report = json.loads(capsys.readouterr().out)
    names = [c["name"] for c in report["contenders"]]
    assert names == ["closed any_team barrier", "closed any_team barrier fused",
                     "closed any_team async"]
    rows = {(row["contender"], row["number"]): row["report"] for row in report["rows"]}
    for number in range(2):
        plain, fused = (rows[names[k], number] for k in (0, 1))
        assert fused["success"]
        assert fused["decisions"] == plain["decisions"]
        assert fused["seconds"] == pytest.approx(plain["seconds"], abs=0.5)
    assert any("fused: the whole loop" in note for note in report["notes"])
    for refused in (["--planner", "exact"], ["--lose", "1"], ["--decode", "best-of-4"]):
        assert main([*words, "--backend", "fused", *refused]) == 2
        assert "--backend fused" in capsys.readouterr().err


def test_missions_that_unfold_are_driven_and_end_the_same_alone(tmp_path):
    out = tmp_path / "out"
    code, text, err = command("--mode", "clock", "--unfold", "hidden", "--count", "2", "--search",
                              "nearest", "places", "--out", str(out), "--json")
    assert code == 0, err
    report = json.loads(text)
    assert [c["name"] for c in report["contenders"]] == [
        "closed exact nearest clock", "closed exact places clock"]
    for row in report["rows"]:
        assert row["report"]["success"], row["report"]
        assert row["report"]["replans"]["found"] >= 1
    [line] = report["comparisons"]
    assert line["over"] == "closed exact nearest clock"
    assert line["both_solved"] == 2
    assert [line["planner"] for line in report["summary"]] == ["exact nearest", "exact places"]
    code = main(["rollout", "--from", str(out / "report.json"), "--mission", "1", "--no-video",
                 "--contender", "closed exact places clock", "--out", str(tmp_path / "again")])
    assert code == 0
    again = json.loads((tmp_path / "again" / "report.json").read_text())
    [first] = [row["report"] for row in report["rows"]
               if row["number"] == 1 and "places" in row["contender"]]
    assert again["seconds"] == first["seconds"]
