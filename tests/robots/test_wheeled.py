"""The rover: wheels that roll, slopes that it climbs and refuses, torques within limits."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from moonteam.robots import wheeled
from moonteam.robots.base import CONTROL_PERIOD, GRAVITY, Command
from moonteam.robots.wheeled import WHEELED
from moonteam.terrain.surface import Surface

WHEELS = 7 + wheeled.WHEELS, 6 + wheeled.WHEELS  # in qpos, in qvel


def to(xy, speed=0.5, lost=False):
    return Command(np.asarray(xy, np.float32), np.float32(speed), np.array(lost))


def distance(track, goal):
    return np.linalg.norm(track.qpos[-1, :2] - goal)


def test_model_is_what_the_controller_assumes():
    model = WHEELED.load().compile()
    assert model.body_subtreemass[1] == pytest.approx(wheeled.MASS)
    np.testing.assert_array_equal(model.jnt_qposadr[model.actuator_trnid[:, 0]], WHEELS[0])
    np.testing.assert_array_equal(np.abs(model.actuator_ctrlrange), wheeled.MAX_TORQUE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for name, x, y in (("front_left", 1, 1), ("back_left", -1, 1), ("front_right", 1, -1),
                       ("back_right", -1, -1)):
        wheel = model.geom(f"wheel_{name}").id
        np.testing.assert_allclose(
            data.geom_xpos[wheel], [x * wheeled.HALF_BASE, y * wheeled.HALF_TRACK,
                                    wheeled.WHEEL_RADIUS], atol=1e-6)
        assert model.geom_size[wheel, 0] == wheeled.WHEEL_RADIUS


@pytest.mark.parametrize("rms", [0.0, 0.04])
def test_reaches_random_waypoints(make_world, ground, rms):
    world = make_world(WHEELED, ground.rough(rms, 0.5, seed=1) if rms else ground.flat())
    rng = np.random.default_rng(3)
    for goal in rng.uniform(-2.5, 2.5, (3, 2)):
        track = world.drive(to(goal), 19.0)
        assert distance(track, goal) < 0.1
        assert np.linalg.norm(track.qvel[-1, :2]) < 0.02
        assert track.tilt.max() < np.deg2rad(25.0)


def test_wheels_roll_with_the_ground(make_world, ground):
    world = make_world(WHEELED, ground.flat(), (-4.0, 0.0))
    track = world.drive(to((4.0, 0.0)), 10.0)
    steady = (track.time > 4.0) & (track.time < 9.0)
    rim = track.qvel[steady][:, WHEELS[1]] * wheeled.WHEEL_RADIUS
    np.testing.assert_allclose(track.qvel[steady, 0], 0.5, atol=0.02)
    np.testing.assert_allclose(rim, np.tile(track.qvel[steady, :1], 4), atol=0.02)
    turned = (track.qpos[-1] - track.qpos[0])[WHEELS[0]] * wheeled.WHEEL_RADIUS
    np.testing.assert_allclose(turned, track.qpos[-1, 0] - track.qpos[0, 0], rtol=0.03)


def test_follows_its_line_and_turns_on_the_spot(make_world, ground):
    world = make_world(WHEELED, ground.rough(0.03, 0.5, seed=5), (-4.0, -2.0), yaw=-2.0)
    track = world.drive(to((4.0, 2.0)), 28.0)
    assert distance(track, (4.0, 2.0)) < 0.1
    cross = track.cross_track((-4.0, -2.0), (4.0, 2.0))
    assert np.sqrt(np.mean(cross**2)) < 0.1
    assert np.abs(cross).max() < 0.3


def test_backs_up_to_a_near_waypoint_behind(make_world, ground):
    world = make_world(WHEELED, ground.flat())
    track = world.drive(to((-1.0, 0.0)), 6.0)
    assert distance(track, (-1.0, 0.0)) < 0.1
    assert np.abs(track.qvel[:, 5]).max() < 0.1


def test_climbs_and_descends_15_degrees(make_world, ground):
    world = make_world(WHEELED, ground.ramp(15.0), (-2.0, 0.0))
    track = world.drive(to((5.0, 0.0)), 19.0)
    assert distance(track, (5.0, 0.0)) < 0.1
    assert track.qpos[-1, 2] > 5.0 * np.tan(np.deg2rad(15.0))
    down = world.drive(to((-2.0, 1.0)), 26.0)
    assert distance(down, (-2.0, 1.0)) < 0.1
    assert down.tilt.max() < np.deg2rad(25.0)


def test_refuses_20_degrees_but_comes_back(make_world, ground):
    world = make_world(WHEELED, ground.ramp(20.0), (-2.0, 0.0))
    track = world.drive(to((5.0, 0.0)), 12.0)
    assert track.qpos[:, 0].max() < 0.3
    assert np.abs(track.qvel[-1, :6]).max() < 0.02
    back = world.drive(to((-3.0, 0.0)), 16.0)
    assert distance(back, (-3.0, 0.0)) < 0.1


def test_parks_on_a_slope(make_world, ground):
    world = make_world(WHEELED, ground.ramp(15.0), (3.0, 0.0), yaw=0.8)
    settled = world.drive(to((0.0, 0.0), speed=0.0), 2.0)
    parked = world.drive(to((0.0, 0.0), speed=0.0), 8.0)
    assert np.linalg.norm(parked.qpos[-1, :2] - settled.qpos[-1, :2]) < 0.02


def test_all_wheels_carry_load_on_rough_ground(make_world, ground):
    world = make_world(WHEELED, ground.rough(0.04, 0.5, seed=2), (-2.0, 0.0))
    wheels = [world.scene.model.geom(f"robot/wheel_{end}_{side}").id
              for end in ("front", "back") for side in ("left", "right")]
    loaded = []

    def look(qpos):
        del qpos
        touching = world.data.contact.geom[world.data.contact.dist < 0.0]
        loaded.append(np.isin(wheels, touching))
        return to((2.0, 1.0))

    world.drive(look, 8.0)
    # Grounds made of facets make a light wheel hop: touching means once in a tenth of a second.
    window = np.lib.stride_tricks.sliding_window_view(loaded[100:], 12, axis=0)
    assert window.any(axis=-1).mean(axis=0).min() > 0.9


def test_lost_means_motors_off(make_world, ground):
    world = make_world(WHEELED, ground.flat())
    world.drive(to((4.0, 0.0)), 2.0)
    track = world.drive(to((4.0, 0.0), lost=True), 6.0)
    np.testing.assert_array_equal(track.ctrl, 0.0)
    np.testing.assert_array_equal(track.power, 0.0)
    energy = 0.5 * wheeled.MASS * np.sum(track.qvel[:, :3] ** 2, axis=1)
    assert energy[-1] < 0.5 * energy[0]  # it rolls out, nothing pushes it
    assert not world.data.xfrc_applied.any()
    assert not world.data.qfrc_applied.any()


def test_weight_rests_on_the_wheels(make_world, ground):
    world = make_world(WHEELED, ground.flat())
    world.drive(to((0.0, 0.0), speed=0.0), 3.0)
    force, total = np.zeros(6), 0.0
    for contact in range(world.data.ncon):
        mujoco.mj_contactForce(world.scene.model, world.data, contact, force)
        total += force[0]
    assert total == pytest.approx(wheeled.MASS * GRAVITY, rel=0.01)


def pulled(soft, seconds, spinning=0.45):
    """Mean of the wheels' torques N m, a step each, of a rover whose wheels spin on the spot."""
    surface = Surface(jnp.zeros((41, 41)), 0.25, soft=soft)
    control = jax.jit(WHEELED.control)
    qpos = np.zeros(13, np.float32)
    qpos[2], qpos[3] = wheeled.STANDING_HEIGHT, 1.0
    qvel = np.zeros(12, np.float32)
    state, torques = WHEELED.init(qpos, qvel), []
    for step in range(round(seconds / CONTROL_PERIOD)):
        backs = float(state.backing) > 0.0
        # Once it backs out its wheels turn as they are told to.
        qvel[WHEELS[1]] = (-wheeled.BACK_SPEED if backs else spinning) / wheeled.WHEEL_RADIUS
        qvel[0] = -wheeled.BACK_SPEED if backs else 0.0
        torque, state, _ = control(state, np.float32(step * CONTROL_PERIOD), qpos, qvel,
                                   to((4.0, 0.0)), surface)
        torques.append((float(np.mean(torque)), float(state.backing), bool(state.reverse)))
    return np.array(torques)


def test_a_rover_that_digs_itself_in_backs_out_and_tries_again():
    steps = pulled(True, 6.0)
    backing = steps[:, 1] > 0.0
    first = round(wheeled.PATIENCE / CONTROL_PERIOD)
    assert not backing[:first - 2].any(), "it has patience"
    assert backing[first:first + round(0.9 * wheeled.BACK_OUT / CONTROL_PERIOD)].all()
    again = first + round(1.2 * wheeled.BACK_OUT / CONTROL_PERIOD)
    assert not backing[again:again + 50].any(), "then it tries again"


def test_on_rigid_ground_it_never_backs_out():
    assert not (pulled(False, 4.0)[:, 1] > 0.0).any()


def test_wheels_that_grip_dig_nothing():
    steps = pulled(True, 4.0, spinning=0.05)
    assert not (steps[:, 1] > 0.0).any(), "too slow to dig"
