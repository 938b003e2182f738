"""What is there is not written over, and a folder has one command at a time."""

import errno
import os
import signal
import subprocess
import sys

import pytest

from moonteam import cli, files, outputs
from moonteam.errors import InputError

NAMES = ("a.txt", "b.txt")


def write(folder, text, names=NAMES, **options):
    with outputs.folder(folder, names, **options):
        for name in names:
            files.write_text(folder / name, text)


def texts(folder):
    return {path.name: path.read_text() for path in sorted(folder.iterdir())}


def test_what_is_there_stays_unless_it_is_forced(tmp_path):
    out = tmp_path / "runs" / "one"
    write(out, "first")
    (out / "mine.txt").write_text("not in the way")
    with pytest.raises(InputError, match=r"one: holds a.txt already; --force replaces what is"):
        write(out, "second")
    assert texts(out) == {"a.txt": "first", "b.txt": "first", "mine.txt": "not in the way"}
    write(out, "third", force=True)
    assert texts(out) == {"a.txt": "third", "b.txt": "third", "mine.txt": "not in the way"}


def test_what_goes_on_may_write_its_own(tmp_path):
    write(tmp_path, "first")
    write(tmp_path, "second", resume=True)
    assert texts(tmp_path) == {"a.txt": "second", "b.txt": "second"}
    with pytest.raises(InputError, match=r"holds a.txt already; --resume goes on with the run, "):
        write(tmp_path, "third", resume=False)
    with pytest.raises(InputError, match=r"^--force: is for a new run; --resume alone"):
        write(tmp_path, "third", resume=True, force=True)


def write_late(path):
    with files.replacing(path) as temporary:
        temporary.write_text("late")
        path.write_text("early")


def test_a_name_that_was_not_foretold_and_one_that_came_meanwhile(tmp_path):
    (tmp_path / "c.txt").write_text("mine")
    with outputs.folder(tmp_path, NAMES):
        with pytest.raises(InputError, match=r"c.txt: is there already; --force replaces it"):
            files.write_text(tmp_path / "c.txt", "lost")
        with pytest.raises(InputError, match=r"a.txt: is there already"):
            write_late(tmp_path / "a.txt")
        files.write_text(tmp_path / "b.txt", "once")
        files.write_text(tmp_path / "b.txt", "again, its own")
    assert texts(tmp_path) == {"a.txt": "early", "b.txt": "again, its own", "c.txt": "mine"}


@pytest.mark.parametrize("leads", ["to a file", "nowhere"])
def test_a_link_in_the_way(tmp_path, leads):
    target, out = tmp_path / "target", tmp_path / "out"
    out.mkdir()
    if leads == "to a file":
        target.write_text("mine")
    (out / "b.txt").symlink_to(target)
    with pytest.raises(InputError, match=r"out: holds b.txt, a symbolic link; --force replaces"):
        write(out, "lost")
    assert (out / "b.txt").is_symlink()
    write(out, "new", force=True)
    assert texts(out) == {"a.txt": "new", "b.txt": "new"}
    assert not (out / "b.txt").is_symlink()
    assert not target.exists() if leads == "nowhere" else target.read_text() == "mine"


def test_a_folder_that_is_a_link_or_has_one_inside(tmp_path):
    real, out, link = tmp_path / "real", tmp_path / "out", tmp_path / "link"
    real.mkdir()
    out.mkdir()
    link.symlink_to(real)
    (out / "inner").symlink_to(real)
    with pytest.raises(InputError, match=r"link: is a symbolic link; --force writes where it"):
        write(link, "x")
    with pytest.raises(InputError, match=r"inner: is a symbolic link; --force writes where it"):
        write(out, "x", ("inner/a.txt",))
    assert not list(real.iterdir())
    write(out, "x", ("inner/a.txt",), force=True)
    write(link, "y", force=True)
    assert texts(real) == {"a.txt": "y", "b.txt": "y"}
    (tmp_path / "gone").symlink_to(tmp_path / "nowhere")
    with pytest.raises(InputError, match="gone: is a symbolic link"):
        write(tmp_path / "gone", "x")
    write(real / "below", "through a link above", NAMES)  # who names it means it
    write(link / "beneath", "through a link above", NAMES)


def test_one_file(tmp_path):
    target, link = tmp_path / "a.onnx", tmp_path / "link.onnx"
    for text in ("first", "second"):
        with outputs.file(target, force=text == "second"):
            files.write_text(target, text)
    with pytest.raises(InputError, match=r"a.onnx: is there already"), outputs.file(target):
        pass
    link.symlink_to(target)
    with pytest.raises(InputError, match=r"link.onnx: is a symbolic link"), outputs.file(link):
        pass
    with outputs.file(link, force=True):
        files.write_text(link, "third")
    assert texts(tmp_path) == {"a.onnx": "second", "link.onnx": "third"}


def fail_half_way(folder):
    with outputs.folder(folder, NAMES, force=True):
        files.write_text(folder / "a.txt", "new")
        with files.replacing(folder / "b.txt") as temporary:
            temporary.write_text("half")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_old_files_stay_together_where_a_new_one_fails(tmp_path):
    write(tmp_path, "old")
    with pytest.raises(InputError, match=r"b.txt: cannot be written: No space left on device"):
        fail_half_way(tmp_path)
    assert texts(tmp_path) == {"a.txt": "old", "b.txt": "old"}


def test_a_run_begins_anew_only_when_it_can(tmp_path):
    """`clear` takes an earlier run's files and folders, of links the links, and nothing else."""
    kept = tmp_path / "kept"
    kept.mkdir()
    (kept / "x").write_text("x")
    out = tmp_path / "out"
    (out / "deep" / "er").mkdir(parents=True)
    (out / "link").symlink_to(kept)
    write(out, "old")
    (out / "mine").write_text("mine")
    with outputs.folder(out, (*NAMES, "deep", "link"), force=True):
        assert texts(kept) == {"x": "x"}
        assert (out / "a.txt").exists()
        outputs.clear(out, (*NAMES, "deep", "link"))
        files.write_text(out / "a.txt", "new")
        assert (out / "a.txt").read_text() == "new", "at once: a run writes as it goes"
    assert texts(out) == {"a.txt": "new", "mine": "mine"}
    assert texts(kept) == {"x": "x"}


def test_nothing_is_left_of_a_command_that_wrote_nothing(tmp_path):
    with pytest.raises(InputError), outputs.folder(tmp_path / "runs" / "one", NAMES):
        raise InputError("--seed", "is not allowed")
    assert not (tmp_path / "runs").exists()
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match="file is a file; a folder is needed"):
        write(tmp_path / "file", "x")


def test_the_first_free_folder(tmp_path):
    base = tmp_path / "outpost"
    assert outputs.free(base, NAMES) == base
    write(base, "x")
    assert outputs.free(base, NAMES) == tmp_path / "outpost-2"
    (tmp_path / "outpost-2").symlink_to(tmp_path)
    (tmp_path / "outpost-3").write_text("a file")
    (tmp_path / "outpost-4").mkdir()
    assert outputs.free(base, NAMES) == tmp_path / "outpost-4"


HOLD = """
import sys, time
from pathlib import Path
from moonteam import outputs
with outputs.folder(Path(sys.argv[1]), ("a.txt",)):
    print("held", flush=True)
    time.sleep(60)
"""


def test_two_processes_and_one_folder(tmp_path):
    """The second is told who the first is; one that was killed holds nothing."""
    out = tmp_path / "run"
    child = subprocess.Popen([sys.executable, "-c", HOLD, str(out)], stdout=subprocess.PIPE,
                             text=True)
    try:
        assert child.stdout is not None
        assert child.stdout.readline() == "held\n"
        for options in ({}, {"resume": True}, {"force": True}):
            with pytest.raises(InputError) as refused:
                write(out, "x", **options)
            assert str(refused.value).startswith(f"{out}: is in use by process {child.pid} on ")
            assert "(moonteam " in str(refused.value)
        assert outputs.free(out, NAMES) == tmp_path / "run-2"
    finally:
        child.send_signal(signal.SIGKILL)
        child.communicate()
    assert (out / outputs.LOCK).exists(), "a lock that nobody holds"
    write(out, "x")
    assert texts(out) == {"a.txt": "x", "b.txt": "x"}


def test_many_processes_and_one_folder(tmp_path):
    """Of those that come at once one holds it at a time, whatever the others do meanwhile."""
    once = """
import sys
from pathlib import Path
from moonteam import files, outputs
from moonteam.errors import InputError
out, won = Path(sys.argv[1]), 0
for _ in range(200):
    try:
        with outputs.folder(out, ("inside",), force=True):
            (out / "inside").touch(exist_ok=False)
            (out / "inside").unlink()
            won += 1
    except InputError as error:
        assert "in use by" in str(error), error
print(won)
"""
    children = [subprocess.Popen([sys.executable, "-c", once, str(tmp_path / "run")],
                                 stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
                for _ in range(4)]
    said = [child.communicate() for child in children]
    assert [err for _, err in said] == [""] * 4
    assert all(int(out) > 0 for out, _ in said)


def test_what_is_written_is_declared():
    """Every command that takes --out holds its folder for the files that its help names."""
    import dataclasses
    import importlib

    by_themselves = {"rollout", "train", "export", "testsets", "testsets import"}
    for name, (place, _) in cli.COMMANDS.items():
        module = importlib.import_module(place)
        fields = {field.name for field in dataclasses.fields(module.Args)}
        if "out" in fields:
            assert "force" in fields, name
            assert hasattr(module, "FILES") or name in by_themselves, name


def test_a_clock_that_stands_still_is_no_lock(tmp_path):
    """An old lock file without a lock does not block, whatever its age or its text."""
    (tmp_path / outputs.LOCK).write_text("process 1 on elsewhere (moonteam train)")
    os.utime(tmp_path / outputs.LOCK, (4e9, 4e9))  # years from now
    write(tmp_path, "x")
    assert texts(tmp_path) == {"a.txt": "x", "b.txt": "x"}


WRITERS = {
    "plan": ("plan outpost", "plan.json"),
    "replay": ("replay s.json a.json", "replay.json"),
    "site": ("site --preset flat", "heights.tif"),
    "evaluate grid": ("evaluate grid 3x5", "rows.csv"),
    "evaluate sets": ("evaluate sets", "report.json"),
    "evaluate replanning": ("evaluate replanning", "replanning.png"),
    "evaluate unfolding": ("evaluate unfolding", "unfolding.png"),
    "evaluate peers": ("evaluate peers", "peers.json"),
    "evaluate timing": ("evaluate timing", "timing.csv"),
    "evaluate preference": ("evaluate preference 3x5 --policy any_team", "preference.png"),
    "evaluate traverse": ("evaluate traverse", "wheeled-rim.mp4"),
    "evaluate slopes": ("evaluate slopes", "slopes.json"),
    "evaluate soil": ("evaluate soil", "soil.png"),
    "evaluate paces": ("evaluate paces", "paces.json"),
    "evaluate execution": ("evaluate execution", "rows.jsonl"),
    "evaluate sensitivity": ("evaluate sensitivity", "curves.png"),
    "evaluate soak": ("evaluate soak", "rows.jsonl"),
    "bench grid": ("bench grid", "bench.json"),
    "bench travel": ("bench travel", "table.md"),
    "bench train": ("bench train", "bench_train.json"),
    "bench physics": ("bench physics", "bench_physics.json"),
    "bench execution": ("bench execution", "table.md"),
    "rollout": ("rollout outpost", "video.mp4"),
    "doctor": ("doctor", "doctor.json"),
    "train": ("train small", "metrics.jsonl"),
    "train quick": ("train quick", "checkpoints"),
    "train imitate": ("train imitate quick", "policy.safetensors"),
    "train guide": ("train guide", "curve.png"),
    "train compare": ("train compare runs/none", "curves.png"),
    "testsets": ("testsets --sets 3x5", "3x5.jsonl"),
}


def test_every_writer_is_asked():
    known = {name for name in cli.COMMANDS if not name.startswith("check")}
    assert known - set(WRITERS) == {"export", "testsets import"}


@pytest.mark.parametrize("name", WRITERS)
def test_every_command_leaves_what_is_there(tmp_path, name, capsys):
    """Before it reads or computes anything: even what it was asked for may be missing."""
    words, held = WRITERS[name]
    out = tmp_path / "out"
    for link in (False, True):
        if link:
            (out / held).rename(tmp_path / "mine")
            (out / held).symlink_to(tmp_path / "mine")
        else:
            out.mkdir()
            (out / held).write_text("mine")
        assert cli.main([*words.split(), "--out", str(out)]) == 2
        line = f"moonteam: {out}: holds {held}" + (", a symbolic link" if link else " already")
        assert capsys.readouterr().err.startswith(line)
        assert [path.name for path in out.iterdir()] == [held]
        assert (out / held).is_symlink() == link
        assert (out / held).read_text() == "mine"


@pytest.mark.parametrize("words", ["export any_team --out mine.onnx",
                                   "testsets import none --format dcmrta --out mine.jsonl"])
def test_one_file_that_is_there(tmp_path, monkeypatch, words, capsys):
    monkeypatch.chdir(tmp_path)
    name = words.split()[-1]
    (tmp_path / name).write_text("mine")
    assert cli.main(words.split()) == 2
    assert capsys.readouterr().err == (f"moonteam: {name}: is there already; --force replaces it, "
                                       "or choose another --out\n")
    assert texts(tmp_path) == {name: "mine"}


def test_every_command_says_who_has_its_folder(tmp_path, capsys):
    child = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE,
                             text=True)
    try:
        assert child.stdout is not None
        child.stdout.readline()
        for words in ("train quick --resume", "train small --force", "evaluate execution --resume",
                      "rollout outpost --force", "plan outpost"):
            assert cli.main([*words.split(), "--out", str(tmp_path)]) == 2
            assert capsys.readouterr().err.startswith(
                f"moonteam: {tmp_path}: is in use by process {child.pid} on ")
    finally:
        child.kill()
        child.communicate()
