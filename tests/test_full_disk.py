"""A disk that takes no more: one line, what was there stays, and no half of a file is left.

A limit on the size of files stands for the disk: writes beyond it fail half-way, those of ffmpeg,
tensorstore and GDAL too.
"""

import contextlib
import errno
import os
import resource
import zlib

import numpy as np
import pytest

from moonteam import compilation, files
from moonteam.errors import InputError
from moonteam.report import tables, video
from moonteam.terrain.generate import write_dem
from training.run import checkpoints
from training.run.checkpoints import About

NOISE = np.random.default_rng(0).integers(0, 255, 200_000, dtype=np.uint8)


@contextlib.contextmanager
def disk(room):
    """No file grows beyond so many bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def text(path):
    files.write_text(path, "x" * 200_000)


def array(path):
    with files.replacing(path) as temporary:
        np.save(temporary, NOISE)


def arrays(path):
    with files.replacing(path) as temporary:
        np.savez_compressed(temporary, allow_pickle=False, noise=NOISE)


def raster(path):
    with files.replacing(path) as temporary:
        write_dem(temporary, NOISE[:160_000].reshape(400, 400).astype(float), 0.25)


def picture(path):
    from PIL import Image

    with files.replacing(path) as temporary:
        Image.fromarray(NOISE[:160_000].reshape(400, 400)).save(temporary)


def film(path):
    with video.writing(path, (64, 64), 10, crf=1) as add:
        for k in range(12):
            add(np.roll(NOISE, k)[:64 * 64 * 3].reshape(64, 64, 3))


@pytest.mark.parametrize(("write", "name"), [
    (text, "report.json"), (array, "heights.npy"), (arrays, "maps.npz"), (raster, "heights.tif"),
    (picture, "curve.png"), (film, "video.mp4")])
def test_a_file_is_whole_or_as_it_was(tmp_path, write, name):
    path = tmp_path / name
    for before in (None, b"before"):
        if before:
            path.write_bytes(before)
        with disk(20_000), pytest.raises(InputError) as refused:
            write(path)
        assert str(refused.value).startswith(f"{path}: cannot be written: ")
        assert len(str(refused.value)) < len(str(path)) + 120
        assert [one.name for one in tmp_path.iterdir()] == ([name] if before else [])
        assert not before or path.read_bytes() == before
    write(path)
    assert path.stat().st_size > 20_000


def test_a_film_cut_off_by_its_pictures_is_no_film(tmp_path):
    """What is raised while a picture is drawn is passed on, and ffmpeg does not outlive it."""
    with pytest.raises(ZeroDivisionError), video.writing(tmp_path / "a.mp4", (64, 64), 10, 23):
        raise ZeroDivisionError
    assert not list(tmp_path.iterdir())


def test_a_line_is_added_whole_or_not_at_all(tmp_path):
    path = tmp_path / "rows.jsonl"
    files.append(path, "1" * 900 + "\n")
    with disk(1500), pytest.raises(InputError, match=r"rows.jsonl: cannot be written: File too "):
        files.append(path, "2" * 900 + "\n")
    files.append(path, "3\n")
    assert path.read_text() == "1" * 900 + "\n3\n"


def test_a_checkpoint_and_the_one_before(tmp_path, caplog):
    def save(number, size):
        about = About("phase", number, number, 0, 0.0, {}, {})
        return checkpoints.save(tmp_path, {"weights": NOISE[:size]}, about)

    first = save(1, 20_000)
    with disk(60_000), pytest.raises(InputError) as refused:
        save(2, 200_000)
    assert str(refused.value) == (f"{tmp_path}/00000002: checkpoint could not be written: File too "
                                  f"large; the last good checkpoint is {first}")
    assert not caplog.records, "nor a traceback of Orbax's threads"
    assert list(tmp_path.iterdir()) == [first]
    assert (checkpoints.read(first)[1]["['weights']"] == NOISE[:20_000]).all()


def test_files_of_a_report_go_together(tmp_path):
    from moonteam import outputs

    names = ("bench.json", "table.md")
    meta = {"command": "moonteam bench", "commit": None, "seed": 0, "versions": {"jax": "1"},
            "hardware": {"cores": 1, "processor": "p", "jax_device": "cpu"}}
    with outputs.folder(tmp_path, names):
        tables.save_plain(tmp_path, "bench", {"notes": [], "meta": meta}, [])
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert set(before) == set(names)
    with disk(20_000), pytest.raises(InputError, match=r"table.md: cannot be written"), \
            outputs.folder(tmp_path, names, force=True):
        tables.save_plain(tmp_path, "bench", {"notes": ["new"], "meta": meta},
                          [(["title"], [["x" * 30_000]])])
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_the_compilation_cache_holds_whole_entries(tmp_path):
    """An entry that finds no room is not there; half of one would be complained about for good."""
    from jax._src.lru_cache import LRUCache

    compilation.enable_cache()
    value = zlib.compress(NOISE.tobytes())
    cache, beside = (LRUCache(str(tmp_path), max_size=-1) for _ in range(2))
    with disk(20_000):
        cache.put("key", value)
    assert not list(tmp_path.iterdir())
    assert cache.get("key") is None
    cache.put("key", value)
    beside.put("key", b"another process came later")
    assert beside.get("key") == value
    assert len(list(tmp_path.iterdir())) == 1


def test_numba_without_room_for_its_cache(monkeypatch):
    @compilation.njit(cache=True)
    def double(x):
        return 2 * x

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(double._cache._cache_file, "save", full)
    assert double(21) == 42
