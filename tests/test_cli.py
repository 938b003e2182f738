"""The command's edges: help, unknown words, files that are whole or not there."""

import importlib
import math
from pathlib import Path

import numpy as np
import pytest

from moonteam import cli, files, loading, paths
from moonteam.errors import InputError


def test_usage_lists_every_command(capsys):
    assert cli.main(["--help"]) == 0
    shown = capsys.readouterr().out
    assert all(name in shown for name in cli.COMMANDS)
    assert cli.main([]) == 2


@pytest.mark.parametrize("words", [["fly"], ["evaluate"], ["evaluate", "nothing"], ["bench"]])
def test_unknown_commands_say_what_there_is(words, capsys):
    assert cli.main(words) == 2
    err = capsys.readouterr().err
    assert "no such command; one of:" in err
    assert err.count("\n") == 1


@pytest.mark.parametrize("group", ["evaluate", "bench", "check"])
def test_a_group_lists_its_commands(group, capsys):
    for word in cli.HELP:
        assert cli.main([group, word]) == 0
        shown = capsys.readouterr().out
        listed = [name for name in cli.COMMANDS if f"  {name} " in shown]
        assert listed == cli.members(group) != []


@pytest.mark.parametrize(("words", "line"), [
    ("trian quick", "moonteam trian: no such command; did you mean train? one of: train,"),
    ("evaluate exection", "did you mean evaluate execution? one of: evaluate grid,"),
    ("testsets imprt", "moonteam testsets: 'imprt' has no place here; see"),
    ("site --presett mare", "--presett: moonteam site has no such option; did you mean --preset?"),
    ("site --presett=mare", "did you mean --preset? see moonteam site --help"),
    ("site --preset mar", "--preset: 'mar' is not one of mare, highland, crater_rim, polar, flat; "
                          "did you mean mare?"),
    ("site --size wide", "--size: [FLOAT [FLOAT ...]] is needed: "),
    ("site --seed", "--seed: a value must follow: INT"),
    ("site mare", "moonteam site: 'mare' has no place here; see moonteam site --help"),
    ("testsets --sets 3x5", "moonteam testsets: --out PATH must be given; see"),
    ("testsets --out x --sets 3x55", "--sets: '3x55' is not one of "),
    ("train imitate quik", "PRESET: 'quik' is not one of quick, any_team; did you mean quick?"),
    ("train quick --familes.0.advantages critic", "did you mean --families.0.advantages?"),
    ("train quick --families.0.advantages critc", "did you mean critic?"),
    ("train qick", "qick: no such preset; did you mean quick? one of: quick,"),
    ("bench train qick", "qick: no such preset; did you mean quick? one of: quick,"),
    ("rollout outpst", "did you mean outpost? bundled missions: crater,"),
    ("plan 3x55", "did you mean 3x5? bundled missions: crater,"),
    ("plan 3x55:0", "did you mean 3x5? bundled testsets: 2x3,"),
    ("plan outpst", "did you mean outpost? bundled missions: crater,"),
    ("plan demo --planner exat", "did you mean exact?"),
    ("rollout demo --decode argmx", "did you mean argmax?"),
    ("rollout demo --decode best-of16", "did you mean best-of-K?"),
    ("rollout demo --policy any_tem", "did you mean any_team?"),
    ("site --travel weeled", "did you mean wheeled?"),
    ("check robot weeled", "did you mean wheeled?"),
    ("check planner exat", "did you mean exact?"),
    ("evaluate grid 3x55", "did you mean 3x5?"),
    ("evaluate grid 3x5 --decode argmx", "--decode: 'argmx' is not one of argmax, "),
    ("export any_tem --out x.onnx", "did you mean any_team?"),
    ("evaluate execution --site mar", "did you mean mare?")])
def test_a_name_that_is_nearly_right_is_said(words, line, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main(words.split()) == 2
    err = capsys.readouterr().err
    assert line in err
    assert err.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_every_command_has_help_with_examples(name, capsys):
    module = importlib.import_module(cli.COMMANDS[name][0])
    assert callable(module.run)
    with pytest.raises(SystemExit) as done:
        cli.main([*name.split(), "--help"])
    assert done.value.code == 0
    assert "Examples" in capsys.readouterr().out


def test_a_write_that_fails_leaves_the_old_file(tmp_path):
    path = tmp_path / "report.json"
    files.write_json(path, {"whole": True})

    def write_half():
        with files.replacing(path) as temporary:
            temporary.write_text("half")
            raise RuntimeError("disk full")

    with pytest.raises(RuntimeError, match="disk full"):
        write_half()
    assert path.read_text() == '{\n  "whole": true\n}\n'
    assert [p.name for p in tmp_path.iterdir()] == ["report.json"]


def test_json_has_no_nan_and_takes_numpy():
    assert files.dump_json({"a": math.nan, "b": np.float32(0.5), "c": np.arange(2)}) == (
        '{"a":null,"b":0.5,"c":[0,1]}')


def test_bundled_assets_are_found_by_name(tmp_path):
    assert paths.find("demo", "missions", ".yaml").name == "demo.yaml"
    with pytest.raises(InputError, match=r"bundled missions: .*demo"):
        paths.find("nowhere", "missions", ".yaml")
    with pytest.raises(InputError, match="no such file"):
        paths.find(str(tmp_path / "x.yaml"), "missions", ".yaml")
    with pytest.raises(InputError, match=r"did you mean outpost\?"):
        paths.find("outpots", "missions", ".yaml")


def test_a_folder_does_not_stand_before_a_bundled_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("demo", "any_team", "3x5", "mine"):
        (tmp_path / name).mkdir()
    assert paths.find("demo", "missions", ".yaml").parent.name == "missions"
    assert paths.find("any_team", "policies", ".safetensors").is_file()
    assert loading.load("demo").name == "demo"
    assert len(loading.load("3x5")) == 1000
    assert loading.load("3x5:2").id == loading.load("3x5")[2].id
    with pytest.raises(InputError, match=r"^mine: is a folder; "):
        loading.load("mine")
    (tmp_path / "demo").rmdir()
    (tmp_path / "demo").write_text("{}")
    assert paths.find("demo", "missions", ".yaml") == Path("demo")  # a file of one's own does
