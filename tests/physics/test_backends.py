import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from moonteam.physics.backends import MjxBackend, NativeBackend, hold, make_backend
from moonteam.physics.scene import Placement, build_scene
from moonteam.robots.base import CONTROL_PERIOD, GRAVITY
from moonteam.terrain.site import make_site

STEPS = 50


@pytest.fixture(scope="module")
def scene(sled):
    return build_scene(make_site("mare", 2, 16.0), [
        Placement("one", sled.kind, (-2.0, 1.0)), Placement("two", sled.kind, (2.0, -1.0), 1.5)])


@pytest.fixture(scope="module")
def mjx_backend(scene):
    backend = make_backend("mjx", scene)
    assert backend.compile(2, STEPS) > 0
    return backend


def push(scene, batch, speeds):
    """Commands with each robot's throttle."""
    return tuple(c._replace(speed=jnp.full(batch, s))
                 for c, s in zip(hold(scene, batch), speeds, strict=True))


def run(backend, commands, chunks, batch=1, qpos=None):
    state = backend.reset(qpos, batch)
    logs = []
    for _ in range(chunks):
        state, log = backend.advance(state, commands, STEPS)
        logs.append(log)
    return state, jax.tree.map(lambda *a: np.concatenate(a, axis=1), *logs)


def test_the_backends_agree(scene, mjx_backend):
    commands = push(scene, 2, (1.0, 0.6))
    native, log = run(NativeBackend(scene), commands, 4, 2)
    mjx, mjx_log = run(mjx_backend, commands, 4, 2)
    travelled = np.abs(np.asarray(native.qpos[0]) - scene.qpos0)[[0, 8]].max()
    assert travelled > 0.3
    for robot in scene.robots:
        apart = np.asarray(native.qpos - mjx.qpos)[:, robot.qpos][:, :3]
        assert np.abs(apart).max() < 0.03
    assert log.qpos.shape == mjx_log.qpos.shape == (2, 4 * STEPS // 5, scene.model.nq)
    assert np.allclose(log.power, mjx_log.power, atol=0.3)
    assert np.allclose(log.propellant_rate, mjx_log.propellant_rate)
    assert float(mjx.time[0]) == pytest.approx(4 * STEPS * CONTROL_PERIOD, rel=1e-4)
    assert float(native.control[0][0]) == float(mjx.control[0][0]) == 4 * STEPS


def test_mjx_compiles_once_for_a_size(scene, mjx_backend):
    before = dict(mjx_backend._programs)
    state, commands = mjx_backend.reset(batch=2), push(scene, 2, (0.2, 0.2))
    for _ in range(2):
        state, _ = mjx_backend.advance(state, commands, STEPS)
    assert mjx_backend._programs == before


def test_a_world_that_blows_up_stops_alone(scene, mjx_backend):
    for backend in (NativeBackend(scene), mjx_backend):
        state = backend.reset(batch=2)
        state = state._replace(qvel=state.qvel.at[1, 0].set(jnp.nan))
        after, log = backend.advance(state, push(scene, 2, (1.0, 1.0)), STEPS)
        assert after.diverged.tolist() == [False, True]
        assert np.isfinite(after.qpos).all()
        assert np.isfinite(log.qpos).all()
        assert np.allclose(after.qpos[1], state.qpos[1], atol=1e-6)
        assert np.abs(after.qpos[0] - state.qpos[0])[0] > 1e-3
        assert not np.asarray(log.power[1]).any()
        whole = backend.reset(batch=2)
        calm, calm_log = backend.advance(whole, push(scene, 2, (1.0, 1.0)), STEPS)
        for one, other in ((after.qpos, calm.qpos), (after.qvel, calm.qvel), *zip(
                log, calm_log, strict=True)):
            assert np.asarray(one)[0].tobytes() == np.asarray(other)[0].tobytes()
        again, _ = backend.advance(after, push(scene, 2, (1.0, 1.0)), STEPS)
        assert np.allclose(again.qpos[1], after.qpos[1])


def test_the_same_run_twice_is_the_same_to_the_bit(scene):
    one, two = (run(NativeBackend(scene), push(scene, 3, (1.0, 0.3)), 2, 3)[1] for _ in range(2))
    assert one.qpos.tobytes() == two.qpos.tobytes()


def test_threads_and_company_change_nothing(scene):
    commands = push(scene, 1, (1.0, 0.3))
    alone = run(NativeBackend(scene, threads=1), commands, 1)[1]
    many = run(NativeBackend(scene, threads=2), push(scene, 3, (1.0, 0.3)), 1, 3)[1]
    assert alone.qpos[0].tobytes() == many.qpos[2].tobytes()


def test_an_advance_in_two_halves_is_the_whole(scene):
    backend, commands = NativeBackend(scene), push(scene, 1, (0.7, 0.7))
    whole, _ = backend.advance(backend.reset(), commands, 2 * STEPS)
    half, _ = backend.advance(backend.reset(), commands, STEPS)
    half, _ = backend.advance(half, commands, STEPS)
    assert np.allclose(whole.qpos, half.qpos, atol=1e-3)  # the state between is single precision


def test_a_lost_robot_does_nothing(scene):
    commands = tuple(c._replace(lost=jnp.ones(1, bool)) for c in push(scene, 1, (1.0, 1.0)))
    _, log = run(NativeBackend(scene), commands, 1)
    assert not log.power.any()
    assert not log.propellant_rate.any()


def test_steps_must_fit_the_log(scene):
    backend = NativeBackend(scene, log_every=5)
    with pytest.raises(ValueError, match="multiple of log_every"):
        backend.advance(backend.reset(), hold(scene, 1), 7)
    with pytest.raises(ValueError, match="native"):
        make_backend("warp", scene)


def energy(model, qpos, qvel) -> float:
    """Kinetic and potential energy J."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_forward(model, data)
    mujoco.mj_energyPos(model, data)
    mujoco.mj_energyVel(model, data)
    return float(data.energy.sum())


def test_a_free_fall_keeps_its_energy_and_gravity(scene):
    backend = NativeBackend(scene)
    high = scene.qpos0[None].copy()
    high[:, [2, 9]] += 20.0
    state = backend.reset(high)
    before = energy(scene.model, state.qpos[0], state.qvel[0])
    after, _ = backend.advance(state, hold(scene, 1), STEPS)
    fallen = 0.5 * GRAVITY * (STEPS * CONTROL_PERIOD) ** 2
    assert float(state.qpos[0, 2] - after.qpos[0, 2]) == pytest.approx(fallen, rel=0.02)
    assert energy(scene.model, after.qpos[0], after.qvel[0]) == pytest.approx(before, rel=1e-3)


def test_on_the_ground_energy_is_only_lost(scene, sled):
    backend = NativeBackend(scene)
    qpos = scene.qpos0[None].copy()
    qpos[:, [2, 9]] += 0.5
    state = backend.reset(qpos)
    levels = [energy(scene.model, state.qpos[0], state.qvel[0])]
    for _ in range(8):
        state, _ = backend.advance(state, hold(scene, 1), STEPS)
        levels.append(energy(scene.model, state.qpos[0], state.qvel[0]))
    # Not step by step: a contact holds some energy while it is pressed.
    assert max(levels[1:]) < levels[0]
    assert levels[-1] < levels[0] - 0.5 * sled.mass * GRAVITY * 0.5
    assert np.abs(state.qvel).max() < 0.05


def test_only_actuators_and_contacts_push(scene, sled):
    """Newton's second law on the log: the sled's acceleration is thrust and contact, no more."""
    backend = NativeBackend(scene)
    high = scene.qpos0[None].copy()
    high[:, [2, 9]] += 20.0
    high[:, 3:7] = high[:, 10:14] = [1, 0, 0, 0]
    state, _ = backend.advance(backend.reset(high), push(scene, 1, (1.0, 0.0)), STEPS)
    seconds = STEPS * CONTROL_PERIOD
    one, two = (np.asarray(state.qvel[0, r.qvel])[:3] for r in scene.robots)
    thrown = [sled.push / sled.mass * seconds, 0, -GRAVITY * seconds]
    assert np.allclose(one, thrown, rtol=0.01, atol=1e-3)
    assert np.allclose(two, [0, 0, -GRAVITY * seconds], rtol=0.01, atol=1e-3)
    data = backend._batch.get_data(0)
    assert not data.xfrc_applied.any()
    assert not data.qfrc_applied.any()


def test_mjx_worlds_do_not_share_anything(scene, mjx_backend):
    assert isinstance(mjx_backend, MjxBackend)
    speeds = jnp.array([0.0, 1.0])
    commands = tuple(c._replace(speed=speeds) for c in hold(scene, 2))
    state, _ = mjx_backend.advance(mjx_backend.reset(batch=2), commands, STEPS)
    moved = np.linalg.norm(np.asarray(state.qpos)[:, :2] - scene.qpos0[:2], axis=1)
    assert moved[0] < 0.02 < moved[1]


FACTORISES = """
import sys
import jax
import jax.numpy as jnp
from moonteam.physics.backends import in_order

jax.config.update("jax_cpu_enable_async_dispatch", False)

def step(_, a):
    found = [jnp.linalg.cholesky(a[i]) for i in range(8)]
    return jnp.stack([one @ one.swapaxes(-1, -2) for one in found])

x = jax.random.normal(jax.random.key(0), (8, 64, 40, 40))
a = x @ x.swapaxes(-1, -2) + 40 * jnp.eye(40)
many = jax.jit(lambda a: jax.lax.fori_loop(0, 60, step, a))
assert bool(jnp.isfinite(many.lower(a).compile(in_order())(a)).all())
"""


def test_batches_that_are_factorised_side_by_side_do_not_wait_for_each_other():
    """As XLA compiles it by default this never ends on two cores."""
    environment = os.environ | {"JAX_PLATFORMS": "cpu"}
    subprocess.run([sys.executable, "-c", FACTORISES], env=environment, timeout=300, check=True)
