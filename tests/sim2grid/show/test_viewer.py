"""The live window: one clear line without a display; with one, it is told what happened."""

import contextlib
import warnings
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from mujoco import viewer as mujoco_viewer

from moonteam.cli import main
from sim2grid.loop.drive import run
from sim2grid.loop.execution import Execution
from sim2grid.loop.prepare import prepare
from sim2grid.show import viewer
from sim2grid.show.viewer import LiveView


class Window:
    """What `launch_passive` gives, without a screen."""

    def __init__(self, model, data, **options):
        self.user_scn = mujoco.MjvScene(model, 1000)
        self.cam, self.data, self.seen, self.closed = mujoco.MjvCamera(), data, [], False

    def lock(self):
        return contextlib.nullcontext()

    def is_running(self):
        return len(self.seen) < 30  # then the person closes it

    def sync(self):
        self.seen.append(self.data.qpos.copy())

    def close(self):
        self.closed = True


def test_without_a_display_one_line_code_two_nothing_written(tmp_path, capsys, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    import glfw

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if glfw.init():
            pytest.skip("this machine opens windows without being told where")
    out = tmp_path / "out"
    assert main(["rollout", "demo", "--viewer", "--planner", "exact", "--out", str(out)]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert "--viewer: no display here" in said.err
    assert not out.exists()


def test_the_window_sees_every_pose_and_the_targets_until_it_is_closed(
        mission, script, monkeypatch):
    windows = []
    monkeypatch.setattr(mujoco_viewer, "launch_passive",
                        lambda *given, **options: windows.append(Window(*given)) or windows[0])
    monkeypatch.setattr(viewer.time, "sleep", lambda seconds: None)
    spec = mission(["a drone A 0 0"], ["A OR 2 0"], size=(3, 3), site={"preset": "flat"})
    prepared = prepare(spec, "test")
    execution = Execution(spec, prepared.scenario, script("right", "right"), prepared.bodies,
                          prepared.frame)
    counts = []
    with LiveView(prepared, 1) as view:
        def look():
            view.show(execution)
            counts.append(windows[0].user_scn.ngeom)

        run([execution], Sliding(prepared.scene.qpos0), prepared.scene.qpos0, look)
    assert execution.record.success
    assert windows[0].closed
    assert len(windows[0].seen) == 30, "nothing more once it is closed"
    np.testing.assert_allclose(windows[0].seen[10], execution.record.qpos[1][9], atol=1e-6)
    assert counts[0] > 10, "target, waypoint"


class Sliding:
    """One world in which the robot slides towards its waypoint at half a metre a second."""

    log_every = 1

    def __init__(self, qpos):
        self.qpos = qpos

    def reset(self, qpos=None, batch=1):
        return SimpleNamespace(qpos=self.qpos.copy(), diverged=np.zeros(1, bool))

    def advance(self, state, commands, num_control_steps):
        log, qpos = [], state.qpos
        for _ in range(num_control_steps):
            qpos = qpos.copy()
            away = np.asarray(commands[0].xy[0]) - qpos[:2]
            qpos[:2] += away * min(1.0, 0.004 / max(np.hypot(*away), 1e-9))
            log.append(qpos)
        nothing = np.zeros((1, num_control_steps, 1))
        after = SimpleNamespace(qpos=qpos, diverged=np.zeros(1, bool))
        return after, SimpleNamespace(qpos=np.stack(log)[None], power=nothing,
                                      propellant_rate=nothing)
