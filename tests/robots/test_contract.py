"""What every kind of robot promises to the scene and the backends."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from moonteam.robots import KINDS, OWN
from moonteam.robots.base import Command
from moonteam.terrain.surface import Surface

FLAT = Surface(jnp.zeros((33, 33)), 0.25)


@pytest.fixture(params=OWN, scope="module")
def kind(request):
    return KINDS.get(request.param)


@pytest.fixture(scope="module")
def model(kind):
    return kind.load().compile()


def standing(kind, model):
    qpos = np.concatenate([[0.0, 0.0, kind.spawn_height, 1.0, 0.0, 0.0, 0.0], kind.home])
    return qpos.astype(np.float32), np.zeros(model.nv, np.float32)


def test_names_and_numbers(kind):
    assert KINDS.get(kind.name) is kind
    assert kind.speed > 0.0
    assert 0.1 < kind.footprint < 1.0
    assert np.deg2rad(10.0) < kind.max_slope < np.deg2rad(45.0)


def test_base_is_the_first_body_and_free(kind, model):
    assert model.body(kind.base).id == 1
    assert model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
    assert (model.jnt_type[1:] != mujoco.mjtJoint.mjJNT_FREE).all()
    assert model.nq == 7 + len(kind.home)
    assert model.body_rootid[1:].tolist() == [1] * (model.nbody - 1)


def test_every_actuator_has_limits(model):
    assert model.nu > 0
    assert model.actuator_ctrllimited.all()
    assert (model.actuator_ctrlrange[:, 1] > model.actuator_ctrlrange[:, 0]).all()


def test_nothing_else_can_push(model):
    """No tendon, equality, fluid or gravity compensation carries the robot."""
    assert model.neq == 0
    assert not model.body_gravcomp.any()
    assert model.opt.density == 0.0
    assert model.opt.viscosity == 0.0


def test_contact_bits_are_the_agreed_ones(model):
    bits = set(zip(model.geom_contype.tolist(), model.geom_conaffinity.tolist(), strict=True))
    assert bits <= {(0, 1), (2, 2), (0, 0)}
    feet = (model.geom_contype == 0) & (model.geom_conaffinity == 1)
    assert (model.geom_type[feet] == mujoco.mjtGeom.mjGEOM_SPHERE).all()
    assert not model.geom_margin.any()


def test_stands_on_the_ground_without_sinking_in(kind, model):
    data = mujoco.MjData(model)
    data.qpos[:], _ = standing(kind, model)
    mujoco.mj_forward(model, data)
    feet = (model.geom_contype == 0) & (model.geom_conaffinity == 1)
    lowest = np.min(data.geom_xpos[feet, 2] - model.geom_size[feet, 0])
    assert -0.001 <= lowest <= 0.005


def test_footprint_covers_what_touches_the_ground(kind, model):
    data = mujoco.MjData(model)
    data.qpos[:], _ = standing(kind, model)
    mujoco.mj_forward(model, data)
    feet = (model.geom_contype == 0) & (model.geom_conaffinity == 1)
    low = feet & (data.geom_xpos[:, 2] - model.geom_size[:, 0] < 0.01)
    reach = np.linalg.norm(data.geom_xpos[low, :2], axis=1).max()
    assert reach < kind.footprint + 0.1
    assert kind.footprint < reach + 0.25


def test_controller_keeps_its_limits_whatever_happens(kind, model):
    """Random states, tumbling, underground, not a number: finite controls within the limits."""
    rng = np.random.default_rng(0)
    count = 400
    qpos, qvel = (np.tile(a, (count, 1)) for a in standing(kind, model))
    qpos[1:] += rng.normal(0.0, 3.0, (count - 1, model.nq)).astype(np.float32)
    qvel[1:] += rng.normal(0.0, 5.0, (count - 1, model.nv)).astype(np.float32)
    states = jax.vmap(kind.init)(qpos, qvel)  # before the bad numbers come
    qpos[1], qvel[2], qpos[3, 3:7] = np.nan, np.inf, 0.0
    lost = np.arange(count) % 7 == 6
    commands = Command(rng.normal(0.0, 9.0, (count, 2)).astype(np.float32),
                       rng.uniform(-1.0, 3.0, count).astype(np.float32), lost)
    control = jax.jit(jax.vmap(kind.control, (0, None, 0, 0, 0, None)))
    ctrl, after, telemetry = control(states, jnp.float32(0.1), qpos, qvel, commands, FLAT)
    assert ctrl.shape == (count, model.nu)
    assert ctrl.dtype == jnp.float32
    assert np.isfinite(ctrl).all()
    low, high = model.actuator_ctrlrange.astype(np.float32).T
    assert (np.asarray(ctrl) >= low).all()
    assert (np.asarray(ctrl) <= high).all()
    np.testing.assert_array_equal(np.asarray(ctrl)[lost], 0.0)
    assert np.any(np.asarray(ctrl) == high)  # the limits were tried
    assert telemetry.power.shape == telemetry.propellant.shape == (count,)
    assert (np.asarray(telemetry.power)[4:] >= 0.0).all()
    # The state must keep its shapes and types, or a scan over control steps cannot carry it.
    jax.tree.map(lambda a, b: (np.testing.assert_equal(a.shape, b.shape),
                               np.testing.assert_equal(a.dtype, b.dtype)), states, after)
