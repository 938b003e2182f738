"""What is shown while something runs: all of it on a terminal, none of it elsewhere."""

import itertools
import sys
import time
from types import SimpleNamespace

import pytest

from moonteam import compilation
from moonteam.report import progress


def show():
    """Uses all that there is; returns what came through."""
    with progress.bar("walk [1]", 3, 1) as update, progress.busy("thinking") as think:
        update(2, "2 of 3")
        think("still thinking")
    progress.say("moonteam: compiling")
    return list(progress.track("abc", "letters", 3))


def test_without_a_terminal_nothing_is_shown(capsys):
    assert show() == ["a", "b", "c"]
    captured = capsys.readouterr()
    assert captured.out == captured.err == ""


def test_on_a_terminal_it_goes_to_standard_error_alone(capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert show() == ["a", "b", "c"]
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "moonteam: compiling" in captured.err


def test_an_interruption_comes_through(monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with pytest.raises(KeyboardInterrupt), progress.bar("walk", 3):
        raise KeyboardInterrupt


def test_time_left_is_by_what_was_done_since_the_bar_began():
    now = 0.0
    pace = progress.Pace(100, 40, clock=lambda: now)
    assert pace.left(40) is None
    now = 10.0
    assert pace.left(60) == pytest.approx(20.0)  # 2 a second, 40 to go
    now = 12.0
    assert pace.left(100) == 0.0
    assert [progress.hours(s) for s in (None, 61.4, 7325)] == ["-:--:--", "0:01:01", "2:02:05"]


def test_pieces_that_overlap_count_once():
    """Told of as they end: [0, 4] with [1, 3] in it, [3, 6] beside it, and [8, 9]."""
    ends = iter([3.0, 4.0, 6.0, 9.0])
    spent = compilation.Spent(now=lambda: next(ends))
    seconds = [spent.seconds for length in (2, 4, 3, 1) if spent.add(length) is None]
    assert seconds == [2.0, 4.0, 6.0, 7.0]


def test_the_clock_stands_still_while_jax_and_numba_compile():
    import jax
    import numba

    def heavy(x):
        for _ in range(300):
            x = jax.numpy.sin(x) + 1
        return x

    compilation.spent_compiling()
    for compiled in (lambda: jax.jit(heavy).lower(jax.numpy.zeros(3)),
                     lambda: numba.njit(cache=False)(lambda x: x + 1)(1)):
        begun, spent = time.perf_counter(), compilation.spent_compiling()
        compiled()
        took, heard = time.perf_counter() - begun, compilation.spent_compiling() - spent
        assert 0.5 * took < heard <= took


def test_the_first_time_left_leaves_compiling_out(monkeypatch):
    """Of three pieces the first compiles for a minute, and each works for a second."""
    seconds, spent = itertools.count(0.0, 1.0), 0.0
    monkeypatch.setattr(compilation, "time", SimpleNamespace(
        perf_counter=lambda: next(seconds) + spent))
    monkeypatch.setattr(compilation, "spent_compiling", lambda: spent)
    pace = progress.Pace(3, 0, compilation.working_time)
    spent += 60.0
    assert pace.left(1) == pytest.approx(2.0)


def test_elsewhere_plain_lines_say_how_far_and_how_long_where_they_are_asked_for(
        capsys, monkeypatch):
    now = iter([0.0, 4.0, 12.0, 13.0, 24.0])
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(now))
    with progress.bar("video", 40, plain_s=10.0) as update:
        for done in (5, 10, 11, 20):
            update(done, "video.mp4")
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.splitlines() == [
        "moonteam: video 10 of 40, about 0:36 left (video.mp4)",
        "moonteam: video 20 of 40, about 0:24 left (video.mp4)"]
