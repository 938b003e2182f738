"""The quadruped in C MuJoCo: kinematics, limits, walking, standing, slopes, losing power."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from moonteam.physics.scene import Placement, Scene, build_scene, start_pose
from moonteam.physics.trials import tune
from moonteam.robots import legged
from moonteam.robots.base import CONTROL_PERIOD, Command
from moonteam.robots.legged import LEGGED
from moonteam.terrain.surface import Surface

FEET = [f"{leg}_foot" for leg in ("fl", "fr", "rl", "rr")]
FLAT = Surface(jnp.zeros((9, 9)), 0.25)
CONTROL = jax.jit(LEGGED.control)


def command(xy=(0.0, 0.0), speed=0.5, lost=False):
    return Command(jnp.array(xy, jnp.float32), jnp.float32(speed), jnp.array(lost))


def standing():
    qpos = jnp.array([0, 0, LEGGED.spawn_height, 1, 0, 0, 0, *LEGGED.home], jnp.float32)
    return qpos, jnp.zeros(18)


@pytest.fixture(scope="module")
def alone():
    model = LEGGED.load().compile()
    return model, mujoco.MjData(model)


def drive(scene: Scene, orders, seconds, yaw=0.0, kick=(0.0, 0.0), limp=0.0):
    """Runs one robot, started at `kick` m/s and without power for the first `limp` seconds.

    Returns its data, bases [T, 3] and the largest torque asked.
    """
    model, data = scene.model, mujoco.MjData(scene.model)
    data.qpos[:] = start_pose(scene.site, Placement("r", LEGGED, (0.0, 0.0), yaw))
    data.qvel[:2] = kick
    mujoco.mj_forward(model, data)
    state = LEGGED.init(jnp.asarray(data.qpos, jnp.float32), jnp.zeros(18))
    bases, most = [], 0.0
    for step in range(round(seconds / CONTROL_PERIOD)):
        now = orders._replace(lost=jnp.array(step * CONTROL_PERIOD < limp) | orders.lost)
        seen = (data.qpos.astype(np.float32), data.qvel.astype(np.float32))
        ctrl, state, _ = CONTROL(state, jnp.float32(0), *seen, now, scene.surface)
        data.ctrl[:] = ctrl
        most = max(most, float(np.abs(ctrl).max()))
        mujoco.mj_step(model, data, tune.SUBSTEPS)
        bases.append(data.qpos[:3].copy())
    return data, np.array(bases), most


def scene_of(heights) -> Scene:
    site = tune.site_of(heights, "test")
    return build_scene(site, [Placement("r", LEGGED, (0.0, 0.0))])


def ramp(degrees, size=33):
    x = (np.arange(size) - (size - 1) / 2) * 0.25
    return np.tile(np.tan(np.radians(degrees)) * x, (size, 1))


def upright(data):
    return 1.0 - 2.0 * (data.qpos[4] ** 2 + data.qpos[5] ** 2)


def test_feet_and_jacobians_are_mujocos(alone):
    model, data = alone
    rng = np.random.default_rng(0)
    for _ in range(20):
        data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
        data.qpos[7:] = rng.uniform(-1.2, 1.2, 12)
        mujoco.mj_forward(model, data)
        feet, jacobian = legged.leg_kinematics(jnp.asarray(data.qpos[7:].reshape(4, 3)))
        for n, name in enumerate(FEET):
            geom = model.geom(name)
            full = np.zeros((3, model.nv))
            mujoco.mj_jac(model, data, full, None, data.geom_xpos[geom.id], geom.bodyid[0])
            np.testing.assert_allclose(feet[n], data.geom_xpos[geom.id], atol=1e-6)
            np.testing.assert_allclose(jacobian[n], full[:, 6 + 3 * n : 9 + 3 * n], atol=1e-6)


def test_constants_are_the_models(alone):
    model, data = alone
    data.qpos[:] = standing()[0]
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    assert model.body_mass.sum() == pytest.approx(legged.MASS)
    np.testing.assert_allclose(np.diag(inertia)[3:6], legged.INERTIA, rtol=0.05)
    np.testing.assert_allclose(data.subtree_com[1] - data.qpos[:3], legged.CENTRE, atol=0.004)
    mine = np.diag(inertia)[6:9]
    np.testing.assert_allclose(mine, np.diag(legged.LEG_INERTIA), rtol=0.15)
    lowest = min(data.geom_xpos[model.geom(name).id][2] for name in FEET) - legged.FOOT_RADIUS
    assert abs(lowest) < 1e-3  # home and spawn height fit each other
    assert (model.actuator_ctrlrange == [-legged.TORQUE_LIMIT, legged.TORQUE_LIMIT]).all()
    assert (model.actuator_forcerange == model.actuator_ctrlrange).all()


def test_only_feet_and_inner_spheres_touch(alone):
    model, _ = alone
    touching = {model.geom(g).name for g in range(model.ngeom)
                if model.geom_conaffinity[g] or model.geom_contype[g]}
    others = {"front", "rear", *(foot.replace("foot", "knee") for foot in FEET)}
    assert touching == {*FEET, *others, "hull"}
    ground = {name for name in touching if int(model.geom(name).conaffinity[0]) & 1}
    assert ground == {*FEET, *others}


def test_torque_stays_within_limits_and_finite_whatever_the_state():
    rng = np.random.default_rng(1)
    qpos, qvel = standing()
    state = LEGGED.init(qpos, qvel)
    for size in (1.0, 30.0, 1e6, np.nan, np.inf):
        wild = qpos + np.float32(size) * rng.standard_normal(19).astype(np.float32)
        wild = wild.at[3:7].set(jnp.array([1.0, 0.0, 0.0, 0.0]))
        fast = np.float32(size) * rng.standard_normal(18).astype(np.float32)
        ctrl, after, told = CONTROL(state, jnp.float32(0), wild, fast, command((5, 5)), FLAT)
        assert np.abs(ctrl).max() <= legged.TORQUE_LIMIT
        leaves = jax.tree.leaves((ctrl, after, told))
        assert all(np.isfinite(np.asarray(leaf, np.float32)).all() for leaf in leaves)


def test_lost_or_fallen_means_no_torque():
    qpos, qvel = standing()
    state = LEGGED.init(qpos, qvel)
    ctrl, _, _ = CONTROL(state, jnp.float32(0), qpos, qvel, command((3, 0)), FLAT)
    assert np.abs(ctrl).max() > 0.1
    ctrl, _, told = CONTROL(state, jnp.float32(0), qpos, qvel, command((3, 0), lost=True), FLAT)
    assert not np.any(ctrl)
    assert float(told.power) == 0.0
    on_its_side = qpos.at[3:7].set(jnp.array([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0]))
    ctrl, _, _ = CONTROL(state, jnp.float32(0), on_its_side, qvel, command((3, 0)), FLAT)
    assert not np.any(ctrl)


def test_controller_is_pure_and_vmaps():
    qpos, qvel = standing()
    state = LEGGED.init(qpos, qvel)
    goals = jnp.array([[3.0, 0.0], [0.0, -2.0], [0.01, 0.0]])
    orders = Command(goals, jnp.full(3, 0.4), jnp.zeros(3, bool))
    many = jax.jit(jax.vmap(LEGGED.control, in_axes=(None, None, None, None, 0, None)))
    ctrl, states, _ = many(state, jnp.float32(0), qpos, qvel, orders, FLAT)
    for n in range(3):
        one = jax.tree.map(lambda leaf, n=n: leaf[n], orders)
        twice = [CONTROL(state, jnp.float32(0), qpos, qvel, one, FLAT) for _ in range(2)]
        np.testing.assert_array_equal(twice[0][0], twice[1][0])
        np.testing.assert_allclose(ctrl[n], twice[0][0], atol=1e-3)
        np.testing.assert_allclose(states.wanted[n], twice[0][1].wanted, atol=1e-6)
    assert not states.holding[0]
    assert states.holding[2]


@pytest.fixture(scope="module")
def walks():
    site = tune.course(7)
    starts, goals = tune.lanes(LEGGED, site)
    scene = build_scene(site, [Placement("r", LEGGED, (-4.5, 0.0))])
    return tune.walk(LEGGED, scene, starts, goals, 40.0)


def lane(walks, name):
    return tune.Walks(*(column[tune.LANES.index(name)] for column in walks))


@pytest.mark.parametrize("name", tune.LANES)
def test_walks_arrives_and_stands(walks, name):
    walk = lane(walks, name)
    assert walk.arrived
    assert not walk.fallen
    assert walk.torque <= legged.TORQUE_LIMIT
    assert walk.left < 0.1
    assert walk.rest < 0.03
    assert walk.tilt < np.radians(25)


def test_speed_on_flat_and_rough_ground(walks):
    for name, least in (("flat", 0.37), ("up 12", 0.2)):
        walk = lane(walks, name)
        assert walk.path / walk.seconds > least
    walk = lane(walks, "very rough")  # 7 cm rms; the 4 cm lane begins with a turn
    assert walk.path / walk.seconds > 0.3


def test_holds_its_place_on_a_slope_with_all_feet_down():
    scene = scene_of(ramp(15.0))
    data, bases, _ = drive(scene, command((2.0, 0.0), speed=0.0), 6.0, yaw=0.7)
    assert upright(data) > np.cos(np.radians(18))
    assert np.linalg.norm(bases[-1] - bases[300]) < 0.02
    names = {scene.model.geom(g).name for pair in data.contact.geom for g in pair}
    assert {f"r/{foot}" for foot in FEET} <= names


def test_catches_itself_after_a_push_from_the_side():
    scene = scene_of(np.zeros((33, 33)))
    data, bases, _ = drive(scene, command(speed=0.0), 5.0, kick=(0.2, 0.6))
    assert upright(data) > np.cos(np.radians(3))
    assert np.linalg.norm(data.qvel[:3]) < 0.03
    assert bases[:, 1].max() > 0.03  # it was pushed


def test_turns_in_place_towards_a_goal_behind():
    scene = scene_of(np.zeros((33, 33)))
    data, bases, most = drive(scene, command((-1.5, 0.0)), 12.0)
    assert np.linalg.norm(data.qpos[:2] - [-1.5, 0.0]) < 0.1
    assert np.linalg.norm(data.qvel[:3]) < 0.03
    assert bases[:, 0].max() < 0.1
    assert most < legged.TORQUE_LIMIT


def test_lies_down_when_lost_and_does_not_sink():
    scene = scene_of(np.zeros((33, 33)))
    data, bases, most = drive(scene, command(lost=True), 6.0)
    assert most == 0.0
    assert 0.02 < bases[-1, 2] < 0.15
    assert np.linalg.norm(data.qvel[:3]) < 0.05


def test_gets_up_from_lying_and_walks_on():
    scene = scene_of(np.zeros((33, 33)))
    data, bases, _ = drive(scene, command((1.0, 0.0)), 11.0, limp=3.0)
    assert bases[round(3.0 / CONTROL_PERIOD) - 1, 2] < 0.15
    assert np.linalg.norm(data.qpos[:2] - [1.0, 0.0]) < 0.1
    assert abs(data.qpos[2] - LEGGED.spawn_height) < 0.03
