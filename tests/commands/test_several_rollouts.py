"""`moonteam rollout A B`: one after the other, the film of the first beside the second."""

import contextlib
import json
import threading
from pathlib import Path

import pytest

from moonteam.cli import main
from moonteam.physics import backends
from moonteam.physics.backends import NativeBackend
from moonteam.report import video
from sim2grid.commands import rollout
from sim2grid.show import studio
from tests.commands.test_rollout import GOOD

HASTY = "max_steps: 1\n" + GOOD.replace("start: [1, 0]", "start: [2, 2]")
WORDS = ["--planner", "exact", "--backend", "native"]
SMALL = ["--layout", "map", "--size", "320", "180", "--fps", "3", "--seconds", "2"]
SAVED = {"report.json", "timing.json", "paths.png", "config.json"}


@pytest.fixture
def both(tmp_path):
    """Two missions of one name, of which the second fails."""
    found = []
    for folder, text in (("a", GOOD), ("b", HASTY)):
        (tmp_path / folder).mkdir()
        found.append(tmp_path / folder / "m.yaml")
        found[-1].write_text(text)
    return [str(file) for file in found]


def engine(second):
    """C MuJoCo that calls `second()` at each piece of what it drives after the first mission."""
    class Engine(NativeBackend):
        made = 0

        def __init__(self, *args, **options):
            super().__init__(*args, **options)
            Engine.made += 1

        def advance(self, state, commands, num_control_steps):
            if Engine.made > 1:
                second()
            return super().advance(state, commands, num_control_steps)

    return Engine


def names(folder):
    return {path.name for path in folder.iterdir()}


def test_a_film_is_drawn_while_the_next_mission_is_driven(both, tmp_path, capsys, monkeypatch):
    """The first film gets no picture before the second mission moves: it would wait for ever."""
    writing, moves, told, alone = video.writing, threading.Event(), [], tmp_path / "alone"
    assert main(["rollout", both[1], *WORDS, "--no-video", "--out", str(alone)]) == 1
    capsys.readouterr()

    @contextlib.contextmanager
    def gated(path, *rest, **options):
        told.append((path.parent.name, "begun"))
        with writing(path, *rest, **options) as add:
            assert moves.wait(300.0), "the second mission waits for the film"
            yield add
        told.append((path.parent.name, "whole"))

    monkeypatch.setattr(video, "writing", gated)
    monkeypatch.setattr(studio, "MOST_PROCESSES", 1)
    monkeypatch.setattr(backends, "NativeBackend", engine(moves.set))
    out = tmp_path / "out"
    assert main(["rollout", *both, *WORDS, *SMALL, "--json", "--out", str(out)]) == 1
    assert names(out) == {"m", "m-2"}
    captured = capsys.readouterr()
    reports = [json.loads((out / name / "report.json").read_text()) for name in ("m", "m-2")]
    assert json.loads(captured.out) == reports
    assert [report["success"] for report in reports] == [True, False]
    assert (out / "m-2" / "report.json").read_bytes() == (alone / "report.json").read_bytes()
    for file, name in zip(both, ("m", "m-2"), strict=True):
        assert names(out / name) == {*SAVED, "map.mp4", "report.html"}
        assert json.loads((out / name / "timing.json").read_text())["film_wall_s"] > 0
        config = json.loads((out / name / "config.json").read_text())
        assert config["options"]["mission"] == file
    assert told == [("m", "begun"), ("m", "whole"), ("m-2", "begun"), ("m-2", "whole")]
    assert f"mission 2 of 2: m, in {out / 'm-2'}" in captured.err


@pytest.mark.soak
def test_each_report_is_to_the_byte_that_of_the_mission_alone(tmp_path):
    """In steps and by the clock, each after the other, with films beside them."""
    missions = ["sampling", "demo"]
    for mission in missions:
        main(["rollout", mission, *WORDS, "--no-video", "--out", str(tmp_path / "alone" / mission)])
    main(["rollout", *missions, *WORDS, *SMALL, "--out", str(tmp_path)])
    for mission in missions:
        assert (tmp_path / mission / "report.json").read_bytes() == (
            tmp_path / "alone" / mission / "report.json").read_bytes()


def test_stopped_the_film_is_left_out_and_both_reports_stay(both, tmp_path, capsys, monkeypatch):
    """The film waits with its first picture until its processes are ended."""
    writing, ended, films = video.writing, threading.Event(), []

    class Film(studio.Shooting):
        def __init__(self, *args, **options):
            super().__init__(*args, **options)
            films.append(self)

        def stop(self):
            for drawing in self._crew:
                drawing.kill()
            ended.set()
            super().stop()

    @contextlib.contextmanager
    def gated(*args, **options):
        with writing(*args, **options) as add:
            def wait_and_add(picture):
                assert ended.wait(300.0)
                add(picture)
            yield wait_and_add

    def interrupt():
        raise KeyboardInterrupt

    monkeypatch.setattr(video, "writing", gated)
    monkeypatch.setattr(studio, "MOST_PROCESSES", 1)
    monkeypatch.setattr(studio, "Shooting", Film)
    monkeypatch.setattr(backends, "NativeBackend", engine(interrupt))
    out = tmp_path / "out"
    assert main(["rollout", *both, *WORDS, *SMALL, "--out", str(out)]) == 130
    assert names(out / "m") == names(out / "m-2") == SAVED
    assert json.loads((out / "m" / "report.json").read_text())["success"]
    assert json.loads((out / "m-2" / "report.json").read_text())["cause"] == "interrupted"
    assert f"{out / 'm'}/report.json holds the one before; its film" in capsys.readouterr().err
    [film] = films
    assert all(drawing._process.poll() is not None for drawing in film._crew)


@pytest.mark.parametrize(("old", "new", "options", "named"), [
    ("kind: drone", "kind: submarine", [], "second.yaml: robots[0].kind"),
    ("name: hop", "name: other", ["--camera", "hop"], "second.yaml: --camera"),
    ("", "", [], "second: holds report.json"),
])
def test_what_is_wrong_with_the_second_refuses_both(tmp_path, capsys, old, new, options, named):
    out = tmp_path / "out"
    (tmp_path / "first.yaml").write_text(GOOD)
    (tmp_path / "second.yaml").write_text(GOOD.replace(old, new))
    if not old:
        (out / "second").mkdir(parents=True)
        (out / "second" / "report.json").write_text("mine")
    before = sorted(tmp_path.rglob("*"))
    assert main(["rollout", str(tmp_path / "first.yaml"), str(tmp_path / "second.yaml"), *WORDS,
                 "--out", str(out), *options]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1, captured.err
    assert named in captured.err
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(("options", "found"), [
    ({}, ["runs/m-2", "runs/m-3", "runs/n"]), ({"force": True}, ["runs/m", "runs/m-2", "runs/n"]),
    ({"out": Path("runs")}, ["runs/m", "runs/m-2", "runs/n"])])
def test_no_two_missions_share_a_folder(tmp_path, monkeypatch, options, found):
    monkeypatch.chdir(tmp_path)
    Path("runs/m").mkdir(parents=True)
    Path("runs/m/report.json").write_text("{}")
    assert rollout._folders(rollout.Args(**options), ["m", "m", "n"]) == [*map(Path, found)]
