"""Every registered kind of robot keeps what all must keep, and checks can fail."""

import dataclasses
import json

import jax.numpy as jnp
import pytest

from moonteam.cli import main
from moonteam.physics.trials.conformance import check
from moonteam.robots import KINDS


@pytest.mark.parametrize("name", [
    name if name == "wheeled" else pytest.param(name, marks=pytest.mark.soak)
    for name in KINDS.names()])
def test_every_registered_kind_conforms(name):
    failed = [(c.name, c.detail) for c in check(KINDS.get(name)) if not c.passed]
    assert failed == []


def test_a_kind_that_asks_for_too_much_and_does_not_stay_up_is_told(tmp_path, monkeypatch, capsys):
    wheeled = KINDS.get("wheeled")

    def wild(state, time, qpos, qvel, command, surface):
        ctrl, state, told = wheeled.control(state, time, qpos, qvel, command, surface)
        return jnp.full_like(ctrl, 1e3), state, told

    broken = dataclasses.replace(wheeled, name="broken", control=wild)
    monkeypatch.setitem(KINDS._own, "broken", broken)
    assert main(["check", "robot", "broken", "--json"]) == 1
    document = json.loads(capsys.readouterr().out)
    assert not document["passed"]
    failed = {c["name"] for c in document["checks"] if not c["passed"]}
    assert "limits" in failed
    assert "goes" in failed
    assert "model" not in failed


def test_an_unknown_kind_is_one_line(capsys):
    assert main(["check", "robot", "weeled"]) == 2
    err = capsys.readouterr().err
    assert "did you mean wheeled?" in err
    assert err.count("\n") == 1
