"""A hand-made trajectory whose every metric is known by arithmetic."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

from moonteam.robots.drone import DRONE
from moonteam.robots.legged import LEGGED
from moonteam.robots.legs import FOOT_RADIUS, HIP_X, LINK
from moonteam.robots.wheeled import WHEEL_RADIUS, WHEELED, WHEELS
from moonteam.terrain.surface import Surface
from sim2grid.frame import Frame, tilt
from sim2grid.loop.record import Decision, Leg, Loss, Record, Solve
from sim2grid.measure.metrics import GridPlan, Track, cross_track, make_report
from sim2grid.measure.slip import expected, ground_height, slip


def quat_about_x(angle):
    return np.array([np.cos(angle / 2), np.sin(angle / 2), 0.0, 0.0])


def straight_then_back(mission):
    """One rover, 3 x 1 cells of 2 m: a move in 4 s, a time-out of 6 s that ends where it began.

    First leg from (-2, 0) to (0, 0), driven at y = 0.3; second from (0, 0) towards (2, 0), of
    which it drives 1 m and 1 m back. Logged once a second.
    """
    spec = mission(["r wheeled A 0 0"], ["A OR 1 0", "A OR 2 0"], size=(3, 1), cell_m=2.0)
    record = Record(list(spec.targets), ["near", "far"])
    times = np.arange(0.0, 11.0)
    x = np.array([-2, -1.5, -1, -0.5, 0, 0.5, 1, 1, 0.5, 0, 0])
    y = np.array([0, 0.3, 0.3, 0.3, 0, 0, 0, 0, 0, 0, 0])
    qpos = np.zeros((11, 13))
    qpos[:, 0], qpos[:, 1] = x, y
    qpos[:, 3:7] = quat_about_x(0.0)
    # It faces east; its wheels turn a quarter more than the way it makes along x.
    qpos[:, 7 + WHEELS] = (1.25 * (x + 2) / WHEEL_RADIUS)[:, None]
    qpos[6, 3:7] = quat_about_x(np.radians(20))
    power = np.full((11, 1), 5.0)
    power[0] = 1000.0  # belongs to no step
    rate = np.full((11, 1), 0.002)
    record.log(times, qpos, power, rate)
    record.legs = [
        Leg(0, 0, 3, (0, 0), (1, 0), np.array([-2.0, 0]), np.array([0.0, 0]), 0, 9, 4, "arrived",
            (1, 0)),
        Leg(0, 1, 3, (1, 0), (2, 0), np.array([0.0, 0]), np.array([2.0, 0]), 4, 10, 10, "timeout",
            (1, 0)),
    ]
    zero = np.zeros((1, 2), np.int32)
    record.decisions = [Decision(d, 4.0 * d, zero, np.array([3], np.int32), np.zeros(2, bool))
                        for d in (0, 1)]
    record.solves = [Solve(0, 1, 4.0, (0,), (0.0,))]
    record.losses = [Loss(0, "stuck", 2, 10.0)]
    record.replans = [(2, "timeout"), (2, "robot_lost")]
    record.failure, record.detail = "unsolvable", "far"
    return spec, record


def test_every_metric_of_a_known_trajectory(mission):
    spec, record = straight_then_back(mission)
    report = make_report(
        record, spec, Frame((3, 1), 2.0), [0], planner="exact", objective="makespan",
        mode="barrier", backend="native", seed=3, grid_plan=GridPlan(True, 2, 2),
        kinds={"wheeled": WHEELED})
    assert (report.success, report.cause, report.detail) == (False, "unsolvable", "far")
    assert (report.seconds, report.decisions, report.moves) == (10.0, 2, 2)
    assert report.inflation is None, "a failed mission has none"
    assert report.replans == {"robot_lost": 1, "timeout": 1}
    near, far = report.targets
    assert (near.solved, near.decision, near.time_s) == (True, 1, 4.0)
    assert (near.robots, near.distance_m) == (("r",), (0.0,))
    assert (far.solved, far.decision, far.time_s, far.robots) == (False, None, None, ())
    robot = report.robots[0]
    assert (robot.moves, robot.arrivals, robot.timeouts, robot.wrong_cells) == (2, 1, 1, 1)
    assert robot.wrong_cell_rate == 0.5
    assert robot.seconds_per_move == 4.0
    # errors: 0.3, 0.3, 0.3, 0 on the first leg, six zeros on the second
    assert robot.cross_track_rms_m == pytest.approx(np.sqrt(3 * 0.09 / 10), abs=1e-4)
    assert robot.cross_track_p95_m == pytest.approx(0.3, abs=1e-4)
    assert robot.max_tilt_deg == pytest.approx(20.0, abs=1e-3)
    # 2 m, then 1 m there and back: 4 m real, the wheels count 1.25 times as much
    assert robot.slip == pytest.approx((5.0 - 4.0) / 5.0, abs=1e-4)
    assert (robot.falls, robot.stuck, robot.lost, robot.lost_s) == (0, 1, "stuck", 10.0)
    assert robot.distance_m == pytest.approx(2 * np.hypot(0.5, 0.3) + 1.0 + 2.0, abs=1e-4)
    assert robot.energy_j == 50.0
    assert robot.propellant_kg == pytest.approx(0.02)
    assert robot.final_cell == (1, 0)


def test_inflation_is_decisions_over_the_grid_plan(mission):
    spec, record = straight_then_back(mission)
    record.success, record.failure = True, None
    report = make_report(
        record, spec, Frame((3, 1), 2.0), [0], planner="exact", objective=None, mode="barrier",
        backend="native", seed=0, grid_plan=GridPlan(True, 1, 1))
    assert report.inflation == 2.0


def test_tilt_does_not_depend_on_heading():
    for heading in (0.0, 1.0, 3.0):
        about_z = np.array([np.cos(heading / 2), 0, 0, np.sin(heading / 2)])
        w, x, y, z = about_z
        a, b, _, _ = quat_about_x(0.4)
        tilted = np.array([w * a - x * b, w * b + x * a, y * a + z * b, z * a - y * b])
        assert tilt(tilted) == pytest.approx(0.4)
    assert tilt(quat_about_x(np.pi)) == pytest.approx(np.pi)


def test_cross_track_of_a_slanted_leg():
    track = Track(np.array([0.0, 1.0]), np.array([[0.0, 0, 0], [1.0, 0, 0]]), np.zeros(2),
                  np.zeros(2), np.zeros(2))
    leg = Leg(0, 0, 3, (0, 0), (1, 0), np.zeros(2), np.array([3.0, 4.0]), 0, 9, 1, "arrived")
    np.testing.assert_allclose(cross_track(track, [leg]), [0.8])


def flat(xy):
    return np.zeros(xy.shape[:-1])


def rover(x, turned, heading=0.0):
    """Chassis at x [T] m along its heading, wheels turned [T] rad, or [T, 4]."""
    qpos = np.zeros((len(x), 13))
    qpos[:, 0], qpos[:, 1] = x * np.cos(heading), x * np.sin(heading)
    qpos[:, 3], qpos[:, 6] = np.cos(heading / 2), np.sin(heading / 2)
    turned = np.asarray(turned)
    qpos[:, 7 + WHEELS] = turned if turned.ndim == 2 else turned[:, None]
    return qpos


def test_slip_of_wheels_from_none_to_all_either_way():
    x = np.linspace(0.0, 2.0, 21)
    for heading in (0.0, 2.0):
        assert slip(WHEELED, rover(x, x / WHEEL_RADIUS, heading)) == pytest.approx(0.0, abs=1e-9)
    assert slip(WHEELED, rover(-x, -x / WHEEL_RADIUS)) == pytest.approx(0.0), "backwards too"
    assert slip(WHEELED, rover(0 * x, x / WHEEL_RADIUS)) == 1.0, "spins on the spot"
    assert slip(WHEELED, rover(x, 0 * x)) == -1.0, "slides with its wheels braked"
    assert slip(WHEELED, rover(0 * x, 0 * x)) is None, "never moved"
    left_against_right = np.outer(x / WHEEL_RADIUS, [1.0, 1.0, -1.0, -1.0])
    assert slip(WHEELED, rover(0 * x, left_against_right)) is None, "turning is not slipping"
    assert slip(DRONE, rover(x, x)[:, :7]) is None


def pendulum(share, height=0.0):
    """Four straight legs swing over their feet, which roll; the base makes `share` of the way."""
    angle = np.linspace(-0.2, 0.2, 41)
    way = FOOT_RADIUS * angle + 2 * LINK * np.sin(angle)
    qpos = np.zeros((41, 19))
    qpos[:, 0] = share * way
    qpos[:, 2] = height + FOOT_RADIUS + 2 * LINK * np.cos(angle)
    qpos[:, 3] = 1.0
    qpos[:, [8, 11, 14, 17]] = angle[:, None]  # the hips; abduction and knees stay at 0
    return qpos


def test_slip_of_feet_that_hold_slide_or_do_not_touch():
    assert slip(LEGGED, pendulum(1.0), flat) == pytest.approx(0.0, abs=1e-4)
    assert slip(LEGGED, pendulum(0.8), flat) == pytest.approx(0.2, abs=1e-4)
    assert slip(LEGGED, pendulum(0.0), flat) == pytest.approx(1.0)
    assert slip(LEGGED, pendulum(1.0, height=0.01), flat) is None, "no foot touches"
    assert slip(LEGGED, pendulum(1.0)) is None, "nobody knows the ground"
    sledge = pendulum(1.0)[[20] * 41]
    sledge[:, 0] = np.linspace(0.0, HIP_X, 41)
    assert slip(LEGGED, sledge, flat) == pytest.approx(-1.0)


def test_what_a_way_on_regolith_is_expected_to_take_follows_the_slopes_along_it():
    """Up 4 degrees and down again: what is known of both slopes, weighted by their lengths."""
    slope = math.radians(4.0)

    def ridge(xy):
        return np.tan(slope) * (2.0 - np.abs(xy[..., 0] - 2.0))

    pace = WHEELED.paces["nominal"]
    x = np.linspace(0.0, 4.0, 401)
    its, energy = expected(pace, rover(x, x), ridge)
    up, down = (float(np.interp(s, pace.slopes, pace.slip)) for s in (slope, -slope))
    counted = 2.0 / (1.0 - up) + 2.0 * (1.0 + min(down, 0.0))
    assert its == pytest.approx((counted - 4.0) / counted, abs=0.02)
    joules = [float(np.interp(s, pace.slopes, pace.energy)) for s in (slope, -slope)]
    assert energy == pytest.approx(2.0 * sum(joules), rel=0.05)
    legs, spent = expected(LEGGED.paces["nominal"], rover(x, x), ridge)
    assert legs is None
    assert spent > 60.0
    assert expected(pace, rover(0 * x, x), ridge) == (None, None), "never moved"


def test_the_ground_under_feet_is_the_surface_of_the_physics():
    rng = np.random.default_rng(0)
    heights = rng.normal(size=(9, 13)).astype(np.float32)
    xy = rng.uniform(-2.0, 2.0, size=(50, 4, 2))
    surface = Surface(jnp.asarray(heights), 0.25)
    np.testing.assert_allclose(ground_height(heights, 0.25)(xy),
                               surface.height(jnp.asarray(xy, jnp.float32)), atol=1e-5)
