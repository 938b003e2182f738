"""Sensitivity: what each quantity changes, and that nothing else changes with it."""

import json
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from moonteam.cli import main
from moonteam.robots.base import CONTROL_PERIOD, Command
from moonteam.terrain.site import make_site
from sim2grid.measure.slip import ground_height
from sim2grid.study import sensitivity
from sim2grid.study.fleet import Recipe, make_fleet
from sim2grid.study.sensitivity import (
    DelayedBackend,
    NoisyExecution,
    Setting,
    Sweep,
    set_friction,
    settings,
    strewn,
    tilted,
)

CHUNK = 5 * CONTROL_PERIOD


@pytest.fixture(scope="module")
def rocky():
    site = make_site("highland", 1, 24.0)
    assert site.boulders
    return site


def test_a_slope_is_added_to_the_ground_and_boulders_stay_as_deep(rocky):
    steep = tilted(rocky, np.radians(10.0))
    rise = np.diff(steep.heights.astype(float) - rocky.heights, axis=1) / rocky.spacing
    np.testing.assert_allclose(np.degrees(np.arctan(rise)), 10.0, atol=1e-3)
    assert depths(steep) == pytest.approx(depths(rocky), abs=1e-5)
    assert tilted(rocky, 0.0).heights.tobytes() == rocky.heights.tobytes()


def depths(site):
    height = ground_height(site.heights, site.spacing)
    return sorted(float(b.centre[2] - height(b.centre[:2])) for b in site.boulders)


def test_boulders_come_in_multiples_of_the_presets(rocky):
    own = {tuple(b.centre[:2]) for b in rocky.boulders}
    assert strewn(rocky, 0.0).boulders == ()
    assert {tuple(b.centre[:2]) for b in strewn(rocky, 1.0).boulders} == own
    assert len(strewn(rocky, 0.5).boulders) == round(0.5 * len(own))
    four = strewn(rocky, 4.0)
    assert own < {tuple(b.centre[:2]) for b in four.boulders}
    assert four.heights is rocky.heights
    assert all(abs(depth) < 3.0 for depth in depths(four)), "none hangs in the air"


def test_friction_is_that_of_ground_and_boulders_alone():
    fleet = make_fleet(Recipe("flat", 0, 0, num_targets=1, side=4), 1)
    before = fleet.scene.model.geom_friction.copy()
    set_friction(fleet, 0.3)
    changed = np.flatnonzero((fleet.scene.model.geom_friction != before).any(axis=1))
    assert [fleet.scene.model.geom(g).name for g in changed] == ["ground"]
    assert fleet.scene.model.geom_friction[changed[0], 0] == pytest.approx(0.3)


class Listening:
    """An engine of two rows that writes down which command was in force in each sample."""

    log_every = 5
    scene = SimpleNamespace(robots=[SimpleNamespace(qpos=slice(0, 7))])

    def __init__(self):
        self.heard = []

    def advance(self, state, commands, num_control_steps):
        count = num_control_steps // self.log_every
        xs = np.asarray(commands[0].xy)[:, 0]
        self.heard += [(xs, np.asarray(commands[0].speed))] * count
        log = SimpleNamespace(qpos=jnp.zeros((2, count, 7)))
        later = SimpleNamespace(time=state.time + count * CHUNK, qpos=state.qpos)
        return later, {"qpos": log.qpos}


def command(x):
    return (Command(jnp.array([[x, 0.0]] * 2), jnp.full(2, 0.5), jnp.zeros(2, bool)),)


def test_commands_arrive_late_and_before_them_robots_hold_their_places():
    engine = Listening()
    delayed = DelayedBackend(engine, 3 * CHUNK)
    assert delayed.delay_s == pytest.approx(3 * CHUNK)
    state = SimpleNamespace(time=np.zeros(2), qpos=np.full((2, 7), 9.0))
    for x in (1.0, 2.0):
        state, log = delayed.advance(state, command(x), 10)
    assert log["qpos"].shape == (2, 2, 7)
    assert [xs[0] for xs, _ in engine.heard] == [9.0, 9.0, 9.0, 1.0]
    assert [speed[0] for _, speed in engine.heard] == [0.0, 0.0, 0.0, 0.5]
    state.time[1] = 0.0  # a new mission begins in the second row
    state, _ = delayed.advance(state, command(3.0), 20)
    assert [xs[0] for xs, _ in engine.heard[4:]] == [1.0, 2.0, 2.0, 3.0]
    assert [xs[1] for xs, _ in engine.heard[4:]] == [9.0, 9.0, 9.0, 3.0]


def test_no_delay_is_no_change():
    engine = Listening()
    delayed = DelayedBackend(engine, 0.0)
    state = SimpleNamespace(time=np.zeros(2), qpos=np.zeros((2, 7)))
    delayed.advance(state, command(1.0), 25)
    assert [xs[0] for xs, _ in engine.heard] == [1.0] * 5


@pytest.fixture
def noisy(mission, execute, script, monkeypatch):
    """A mission on sliding points with an error to begin with, and steps for its script."""
    def run(noise_m, error, *steps):
        def make(*given, **options):
            execution = NoisyExecution(*given, noise_m=noise_m, **options)
            execution._error[:] = error
            return execution

        monkeypatch.setitem(execute.__globals__, "Execution", make)
        spec = mission(["a wheeled A 0 0"], ["A OR 2 0"], max_steps=4)
        return execute(spec, script(*steps))

    return run


def test_a_robot_drives_to_where_it_believes_the_waypoint_to_be(noisy):
    assert noisy(0.0, np.zeros(2), "right", "right").record.success
    done = noisy(0.6, np.zeros(2), "right", "right")
    truth = done.record.qpos[-1][-1][:2]
    assert done.record.qpos[0][0][:2].tolist() == [-1.5, -1.5], "the log is true"
    np.testing.assert_allclose(done._positions(done.record.qpos[-1])[-1, 0, :2],
                               truth + done._error[0], atol=1e-6)


def test_only_where_a_robot_truly_stands_solves_a_target(noisy, monkeypatch):
    monkeypatch.setattr(sensitivity, "NOISE_TIME_S", 1e9)  # the error stays as it is
    east = noisy(1e-9, np.array([0.6, 0.0]), "right", "stay")  # it believes to begin in cell 1
    assert not east.record.success, "it stands 0.6 m west of the target's centre"
    arrived = [leg.end_cell for leg in east.record.legs if leg.ended == "arrived"]
    assert (2, 0) in arrived, "and believes to be there"


def test_the_usual_setting_is_run_once():
    keys = [setting.key for setting in settings(("slope", "friction", "delay"))]
    assert keys.count("usual") == 3
    assert len(set(keys)) == len(keys) - 2
    assert Setting("slope", 4.0).key == "slope 4"


def test_the_command_draws_its_curves_and_goes_on_where_it_was(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sensitivity.SWEEPS, "friction", Sweep("friction", 0.75, (0.75,)))
    monkeypatch.setitem(sensitivity.SWEEPS, "delay", Sweep("delay, s", 0.0, (0.0, 0.4)))
    out = tmp_path / "out"
    words = ["evaluate", "sensitivity", "--site", "flat", "--side", "4", "--targets", "1",
             "--count", "1", "--quantity", "friction", "delay", "--json", "--out", str(out)]
    assert main(words) == 0
    report = json.loads(capsys.readouterr().out)
    assert {(c["quantity"], len(c["points"])) for c in report["curves"]} == {
        ("friction", 1), ("delay", 2)}
    points = report["curves"][1]["points"]
    assert [at["missions"] for at in points] == [1, 1]
    assert points[1]["seconds"] >= points[0]["seconds"]
    assert [row["setting"] for row in report["rows"]] == ["usual", "delay 0.4"]
    assert {p.name for p in out.iterdir()} == {
        "config.json", "report.json", "report.html", "curves.png", "rows.jsonl", "table.md"}
    usual, late = points
    assert (f"| delay, s | 0.4 | {report['curves'][1]['contender']} | {late['solved']} of 1 | "
            in (out / "table.md").read_text())
    assert usual["solved"] == 1
    lines = (out / "rows.jsonl").read_text().splitlines(keepends=True)
    (out / "rows.jsonl").write_text(lines[0] + lines[1][:40])
    assert main([*words, "--resume"]) == 0
    again = json.loads(capsys.readouterr().out)
    assert again["curves"] == report["curves"]


@pytest.mark.parametrize(("options", "named"), [
    (["--count", "0"], "--count: 0 is not allowed"),
    (["--resume"], "--out DIR"),
    (["--quantity", "slope", "slope"], "each once"),
    (["--planner", "policy", "--policy", "nobody"], "nobody"),
])
def test_bad_options_one_line_code_two_nothing_written(tmp_path, capsys, options, named):
    given = [] if "--resume" in options else ["--out", str(tmp_path / "out")]
    assert main(["evaluate", "sensitivity", *options, *given]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert named in message
    assert list(tmp_path.iterdir()) == []
