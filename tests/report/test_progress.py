"""What is shown while something runs: all of it on a terminal, none of it elsewhere."""

import sys

import pytest

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
