"""Nothing but gravity, contacts and actuators within their limits moves the three robots."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from moonteam.physics.scene import Placement, Scene, build_scene
from moonteam.robots import KINDS, OWN
from moonteam.robots.base import CONTROL_PERIOD, GRAVITY, PHYSICS_DT, Command
from moonteam.terrain.site import make_site

SUBSTEPS = round(CONTROL_PERIOD / PHYSICS_DT)
GOALS = {"drone": (4.0, -6.0), "legged": (3.0, 1.0), "wheeled": (4.0, 5.0)}
KEPT = ("actuator_force", "xfrc_applied", "qfrc_applied", "qfrc_passive")


@pytest.fixture(scope="module")
def scene() -> Scene:
    places = {"drone": (-3.0, -4.0), "legged": (0.0, 0.0), "wheeled": (-1.0, 4.0)}
    return build_scene(make_site("mare", 2, 20.0), [
        Placement(name, KINDS.get(name), places[name], 0.5) for name in OWN])


@pytest.fixture(scope="module")
def drive(scene):
    """All three under way for four seconds on the Moon: what the engine logged, each step."""
    model, data = scene.model, mujoco.MjData(scene.model)
    data.qpos[:] = scene.qpos0
    mujoco.mj_forward(model, data)
    start = data.qpos.astype(np.float32), data.qvel.astype(np.float32)
    states = [r.kind.init(start[0][r.qpos], start[1][r.qvel]) for r in scene.robots]
    controls = [jax.jit(r.kind.control) for r in scene.robots]
    log: dict[str, list[np.ndarray]] = {name: [] for name in KEPT}
    for _ in range(round(4.0 / CONTROL_PERIOD)):
        qpos, qvel = data.qpos.astype(np.float32), data.qvel.astype(np.float32)
        for i, robot in enumerate(scene.robots):
            goal = jnp.array(GOALS[robot.name], jnp.float32)
            order = Command(goal, jnp.float32(robot.kind.speed), jnp.array(False))
            data.ctrl[robot.ctrl], states[i], _ = controls[i](
                states[i], jnp.float32(data.time), qpos[robot.qpos], qvel[robot.qvel], order,
                scene.surface)
        for _ in range(SUBSTEPS):
            mujoco.mj_step(model, data)
            for name, rows in log.items():
                rows.append(getattr(data, name).copy())
    moved = [float(np.hypot(*(data.qpos - scene.qpos0)[r.qpos][:2])) for r in scene.robots]
    assert min(moved) > 0.8  # a test of standing still would prove nothing
    return {name: np.array(rows) for name, rows in log.items()}


def test_no_actuator_exceeds_its_limit(scene, drive):
    low, high = scene.model.actuator_forcerange.T
    assert scene.model.actuator_forcelimited.all()
    assert (drive["actuator_force"] >= low - 1e-9).all()
    assert (drive["actuator_force"] <= high + 1e-9).all()
    effort = np.abs(drive["actuator_force"]).max(axis=0)
    assert (effort > 0.0).all()


def test_free_bodies_feel_no_outside_force(scene, drive):
    assert not drive["xfrc_applied"].any()
    assert not drive["qfrc_applied"].any()
    for robot in scene.robots:
        free = slice(robot.qvel.start, robot.qvel.start + 6)
        assert not drive["qfrc_passive"][:, free].any()  # joints have friction, bases have none


def energy(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    """Kinetic and potential J, springs included."""
    mujoco.mj_energyPos(model, data)
    mujoco.mj_energyVel(model, data)
    return float(data.energy.sum())


def passive(scene: Scene, seconds: float, height: float, spin: float) -> np.ndarray:
    """Energy J after each step of all three without power, begun `height` m up and spinning."""
    model, data = scene.model, mujoco.MjData(scene.model)
    data.qpos[:] = scene.qpos0
    for robot in scene.robots:
        data.qpos[robot.qpos.start + 2] += height
        data.qvel[robot.qvel.start + 3:robot.qvel.start + 6] = spin
    mujoco.mj_forward(model, data)
    levels = [energy(model, data)]
    for _ in range(round(seconds / PHYSICS_DT)):
        mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        levels.append(energy(model, data))
    return np.array(levels)


def test_without_power_energy_is_never_won(scene):
    """In flight it may only go into joint friction; the fall from 3 m ends on the ground."""
    flight = passive(scene, 1.2, 3.0, 1.0)
    assert (np.diff(flight) < 1e-3).all()
    assert flight[0] - flight[-1] < 0.05 * flight[0]
    fall = passive(scene, 4.0, 0.5, 0.0)
    masses = (KINDS.get(name).load().compile().body_mass.sum() for name in OWN)
    lost = 0.5 * GRAVITY * sum(masses)
    assert fall.max() < fall[0] + 1e-3
    assert fall[0] - fall[-1] > 0.8 * lost

