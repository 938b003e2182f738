"""Robots on regolith in both engines."""

import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from moonteam.physics import mjx
from moonteam.physics.backends import hold, make_backend
from moonteam.physics.regolith import wheel
from moonteam.physics.scene import Placement, build_scene
from moonteam.physics.trials.slopes import incline
from moonteam.robots import KINDS, OWN
from moonteam.robots.base import GRAVITY, Command
from moonteam.robots.wheeled import MASS
from moonteam.terrain.site import make_site, with_soil


def scene_on(degrees, kind="wheeled", start=-6.0):
    return build_scene(with_soil(incline(degrees, False, 0.0, 0), "nominal"),
                       [Placement("robot", KINDS.get(kind), (start, 0.0))])


def driven(scene, backend, seconds):
    """Log of a drive eastwards."""
    engine = make_backend(backend, scene, threads=1)
    command = (Command(jnp.array([[6.5, 0.0]]), jnp.full(1, 0.5), jnp.zeros(1, bool)),)
    state, log = engine.advance(engine.reset(), command, round(seconds / 0.04) * 5)
    return state, log


def steady(log):
    """Mean slip of the wheels and speed m/s while on the plane's middle."""
    x = np.asarray(log.qpos)[0, :, 0]
    at = (x > -2.0) & (x < 1.0)
    assert at.sum() > 20
    speed = np.diff(x[at]).mean() / 0.04
    return float(np.asarray(log.treads)[0][at][:, :, 0].mean()), float(speed)


@pytest.mark.parametrize("degrees", [0.0, 8.0])
def test_a_rover_slips_as_its_wheels_do_and_is_that_much_slower(degrees):
    _, log = driven(scene_on(degrees), "native", 24.0)
    slip, speed = steady(log)
    soil = with_soil(incline(degrees, False, 0.0, 0), "nominal").soil
    slips = np.linspace(0.0, 1.0, 101)
    load = MASS * GRAVITY / 4 * math.cos(math.radians(degrees))
    pull = wheel.curves(wheel.Shape(0.13, 0.10, 0.01), soil, np.array([load]), slips).pull[0]
    assert slip == pytest.approx(float(np.interp(math.tan(math.radians(degrees)), pull, slips)),
                                 abs=0.03)
    assert speed / math.cos(math.radians(degrees)) == pytest.approx(0.5 * (1 - slip), rel=0.05)


@pytest.mark.soak
def test_both_engines_slip_alike():
    slips = [steady(driven(scene_on(8.0), name, 22.0)[1])[0] for name in ("native", "mjx")]
    assert slips[0] == pytest.approx(slips[1], abs=0.01)


def test_a_wheel_that_has_sunk_stands_lower():
    scene = scene_on(0.0)
    engine = make_backend("native", scene, threads=1)
    state, log = engine.advance(engine.reset(), hold(scene, 1), 500)
    depth = np.asarray(log.treads)[0, -1, :, 1]
    assert (depth > 0.0005).all()
    assert (depth < 0.02).all()
    load = np.asarray(log.treads)[0, -1, :, 2]
    assert load.sum() == pytest.approx(MASS * GRAVITY, rel=0.02), "the contact carries the weight"
    data = mujoco.MjData(scene.model)
    data.qpos[:] = np.asarray(state.qpos)[0]
    mujoco.mj_kinematics(scene.model, data)
    lowest = data.geom_xpos[scene.treads.geoms, 2] - 0.14
    # Grousers of 10 mm are in the soil, and the rim as deep as it has sunk.
    assert lowest == pytest.approx(-0.010 - depth, abs=0.002)


def test_a_robot_that_stands_on_a_slope_stays_there():
    for kind in ("wheeled", "legged"):
        scene = scene_on(10.0, kind, start=0.0)
        engine = make_backend("native", scene, threads=1)
        state, _ = engine.advance(engine.reset(), hold(scene, 1), 375)
        before = np.asarray(state.qpos)[0, :2]
        state, _ = engine.advance(state, hold(scene, 1), 1250)
        assert np.linalg.norm(np.asarray(state.qpos)[0, :2] - before) < 0.03, kind


def test_going_on_from_a_state_is_as_never_to_have_stopped():
    scene = scene_on(8.0)
    engine = make_backend("native", scene, threads=1)
    command = (Command(jnp.array([[6.5, 0.0]]), jnp.full(1, 0.5), jnp.zeros(1, bool)),)
    whole, _ = engine.advance(engine.reset(), command, 200)
    part, _ = engine.advance(engine.reset(), command, 100)
    part, _ = make_backend("native", scene, threads=1).advance(part, command, 100)
    # The engine computes in double precision; a state is kept in single.
    assert np.asarray(part.qpos) == pytest.approx(np.asarray(whole.qpos), abs=2e-4)


def test_each_world_of_a_batch_has_its_own_soil_under_it():
    scene = scene_on(8.0)
    engine = make_backend("native", scene, threads=2)
    command = (Command(jnp.array([[6.5, 0.0], [-6.0, 0.0]]), jnp.full(2, 0.5),
                       jnp.zeros(2, bool)),)
    _, log = engine.advance(engine.reset(batch=2), command, 500)
    alone = make_backend("native", scene, threads=1)
    one = (Command(*(a[:1] for a in command[0])),)
    _, first = alone.advance(alone.reset(), one, 500)
    assert np.asarray(log.qpos)[0] == pytest.approx(np.asarray(first.qpos)[0], abs=1e-5)
    assert np.asarray(log.treads)[1, -1, :, 1].max() < np.asarray(log.treads)[0, -1, :, 1].min()


def test_rigid_ground_tells_nothing_of_treads_and_rubs_as_before():
    scene = build_scene(make_site("flat", 0, 12.0), [
        Placement("robot", KINDS.get("wheeled"), (0.0, 0.0))])
    engine = make_backend("native", scene, threads=1)
    _, log = engine.advance(engine.reset(), hold(scene, 1), 5)
    assert log.treads.shape == (1, 1, 0, 3)
    assert scene.model.nsensor == 0
    assert scene.model.geom_condim[scene.model.geom("ground").id] == 3


@pytest.mark.parametrize("kind", OWN)
def test_every_sphere_of_a_kind_that_meets_the_ground_is_a_tread(kind):
    scene = scene_on(0.0, kind, start=0.0)
    model = scene.model
    meets = [g for g in range(model.ngeom) if model.geom_bodyid[g] and model.geom_contype[g] == 0
             and model.geom_conaffinity[g] == 1]
    assert sorted(scene.treads.geoms) == meets
    assert scene.bed is not None
    assert scene.bed.table.shape[0] == len(meets)
    assert bool(np.asarray(scene.bed.rolls).all()) == KINDS.get(kind).tread.rolls


def test_loads_from_the_contacts_are_those_of_the_touch_sensors():
    scene = scene_on(0.0)
    model, data = mjx.put_model(scene.model), mjx.make_data(scene.model)
    data = data.replace(qpos=make_backend("mjx", scene).reset().qpos[0])

    @jax.jit
    def settled(data):
        with jax.numpy_rank_promotion("allow"):
            data = jax.lax.fori_loop(0, 40, lambda _, d: mjx.step(model, d), data)
            return (data.sensordata[scene.treads.sensors],
                    mjx.normal_forces(model, data, scene.treads.geoms))

    sensed, summed = settled(data)
    assert np.count_nonzero(sensed) >= 3
    np.testing.assert_allclose(summed, sensed, rtol=1e-6)
