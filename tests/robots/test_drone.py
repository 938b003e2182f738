"""The thruster hopper: what holds it up, what limits it, how well it follows a line."""

import mujoco
import numpy as np
import pytest

from moonteam.robots import drone
from moonteam.robots.base import GRAVITY, Command
from moonteam.robots.drone import DRONE
from moonteam.terrain.site import Boulder

WEIGHT = 5.0 * GRAVITY


def to(xy, speed=2.0, lost=False):
    return Command(np.asarray(xy, np.float32), np.float32(speed), np.array(lost))


@pytest.fixture(scope="module")
def flight(make_world, ground):
    """15 m over rolling ground at 2 m/s, with time to settle."""
    world = make_world(DRONE, ground.rough(0.3, 4.0, seed=1), (-7.0, -3.0), yaw=0.7)
    return world, world.drive(to((7.0, 4.0)), 20.0)


def test_model_is_what_the_controller_assumes():
    model = DRONE.load().compile()
    assert pytest.approx(5.0) == drone.MASS == model.body_subtreemass[1]
    ratio = 4 * drone.MAX_THRUST / (drone.MASS * GRAVITY)
    assert 2.8 < ratio < 3.2
    np.testing.assert_array_equal(model.actuator_ctrlrange[:, 0], 0.0)
    np.testing.assert_array_equal(model.actuator_ctrlrange[:, 1], drone.MAX_THRUST)


def test_hover_thrust_is_the_weight_on_the_moon(make_world, ground):
    world = make_world(DRONE, ground.flat())
    track = world.drive(to((0.0, 0.0), speed=0.0), 10.0)
    late = track.time > 8.0
    upright = np.cos(np.deg2rad(8.0))  # the thrusters lean by 8 degrees
    lift = track.ctrl[late].sum(axis=1) * upright
    np.testing.assert_allclose(lift, WEIGHT, rtol=2e-3)
    np.testing.assert_allclose(track.qpos[late, 2], drone.CRUISE_HEIGHT, atol=0.02)
    np.testing.assert_allclose(track.qpos[late, :2], 0.0, atol=0.05)
    # Propellant by the rocket equation's rate: thrust / (Isp g0).
    np.testing.assert_allclose(track.propellant[late], WEIGHT / upright / (220.0 * 9.80665),
                               rtol=2e-3)


def test_tracks_a_line_at_two_metres_a_second(flight):
    _, track = flight
    cross = track.cross_track((-7.0, -3.0), (7.0, 4.0))
    assert np.sqrt(np.mean(cross**2)) < 0.15
    speed = np.linalg.norm(track.qvel[:, :2], axis=1)
    assert 1.9 < speed.max() < 2.2
    assert np.linalg.norm(track.qpos[-1, :2] - (7.0, 4.0)) < 0.1
    assert speed[-1] < 0.05


def test_stays_above_the_ground(flight):
    world, track = flight
    height = track.qpos[:, 2] - np.asarray(world.scene.surface.height(track.qpos[:, :2]))
    cruising = track.time > 4.0
    assert height[cruising].min() > 1.0
    assert height[cruising].max() < 2.6


@pytest.mark.parametrize("start", [-7.0, -2.2])
def test_flies_over_a_boulder_taller_than_itself(make_world, ground, start):
    """1.8 m high in the way, in full flight and right after take-off."""
    rock = Boulder(np.array([0.0, 0.1, 0.6]), 1.2, np.zeros((0, 3)))
    world = make_world(DRONE, ground.flat(), (start, 0.0), boulders=[rock])
    touched = []

    def look(qpos):
        del qpos
        touched.append(world.scene.model.geom("boulder0").id in world.data.contact.geom)
        return to((7.0, 0.0))

    track = world.drive(look, 14.0)
    assert not any(touched)
    gap = np.linalg.norm(track.qpos[:, :3] - rock.centre, axis=1) - rock.radius
    assert gap.min() > 0.45 + 0.3  # well clear of a body that reaches 0.4 m from its middle
    above = track.qpos[:, 2][np.linalg.norm(track.qpos[:, :2], axis=1) < 1.5]
    assert above.min() > 1.8 + drone.STANDING_HEIGHT + 0.3
    assert np.linalg.norm(track.qpos[-1, :2] - (7.0, 0.0)) < 0.1
    assert np.sqrt(np.mean(track.cross_track((start, 0.0), (7.0, 0.0)) ** 2)) < 0.15


def test_yaw_stays_where_it_was(flight):
    _, track = flight
    w, x, y, z = track.qpos[:, 3:7].T
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    assert np.abs(yaw - 0.7).max() < 0.2
    assert np.abs(track.qvel[-1, 5]) < 0.02


def test_turns_sharply_without_losing_the_line(make_world, ground):
    """A new waypoint in full flight: the drone brakes, turns and settles."""
    world = make_world(DRONE, ground.flat(), (-5.0, 0.0))
    world.drive(to((5.0, 0.0)), 4.0)
    track = world.drive(to((0.0, 5.0)), 12.0)
    assert np.linalg.norm(track.qpos[-1, :2] - (0.0, 5.0)) < 0.1
    assert track.tilt.max() < np.deg2rad(50.0)


def test_recovers_from_a_tumble(make_world, ground):
    world = make_world(DRONE, ground.flat())
    world.drive(to((0.0, 0.0), speed=0.0), 5.0)
    world.data.qvel[3:6] = [3.0, -3.0, 2.0]
    world.data.qpos[2] += 8.0  # it needs height to do so
    track = world.drive(to((0.0, 0.0), speed=0.0), 12.0)
    assert track.tilt[-1] < 0.05
    assert np.abs(track.qvel[-1, 3:6]).max() < 0.05


def test_lands_and_shuts_down(make_world, ground):
    world = make_world(DRONE, ground.ramp(8.0), (-2.0, 0.0))
    world.drive(to((3.0, 1.0)), 10.0)
    track = world.drive(to((3.0, 1.0), speed=-1.0), 10.0)
    assert np.linalg.norm(track.qpos[-1, :2] - (3.0, 1.0)) < 0.2
    assert track.tilt[-1] < np.deg2rad(12.0)
    assert np.abs(track.qvel[-1]).max() < 0.05
    np.testing.assert_array_equal(track.ctrl[-1], 0.0)


def test_lost_means_thrust_off_and_free_fall(make_world, ground):
    """Nothing but gravity acts then: the fall is a parabola and the spin goes on."""
    world = make_world(DRONE, ground.flat())
    world.drive(to((6.0, 0.0)), 4.0)
    before = world.data.qvel.copy()
    track = world.drive(to((6.0, 0.0), lost=True), 0.6)
    np.testing.assert_array_equal(track.ctrl, 0.0)
    fall = before[2] - GRAVITY * 0.6
    np.testing.assert_allclose(track.qvel[-1, :3], [before[0], before[1], fall], atol=1e-3)
    inertia = world.scene.model.body_inertia[world.scene.robots[0].body]
    spin = np.linalg.norm(inertia * track.qvel[:, 3:6], axis=1)
    np.testing.assert_allclose(spin, spin[0], atol=1e-4)
    rest = world.drive(to((6.0, 0.0), lost=True), 8.0)
    assert rest.qpos[-1, 2] > 0.05  # on the ground, not under it
    assert not world.data.xfrc_applied.any()
    assert not world.data.qfrc_applied.any()


def test_thrusters_push_along_their_axes(make_world, ground):
    """Equal thrusts lift without pushing sideways; the lean alone yaws."""
    world = make_world(DRONE, ground.flat())
    model, data = world.scene.model, world.data
    data.qpos[:7] = [0, 0, 50, 1, 0, 0, 0]
    data.qvel[:] = 0.0
    data.ctrl[:] = 2.0
    mujoco.mj_forward(model, data)
    lift = 4 * 2.0 * np.cos(np.deg2rad(8.0)) / drone.MASS - GRAVITY
    np.testing.assert_allclose(data.qacc[:6], [0, 0, lift, 0, 0, 0], atol=1e-3)
    data.ctrl[:] = [3.0, 1.0, 3.0, 1.0]
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.qacc[:5], [0, 0, lift, 0, 0], atol=1e-3)
    assert data.qacc[5] > 0.5
