"""The two engines on the real robots: one sequence of commands, two nearly equal drives.

What is left between them: MJX works in single precision and meets a height field facet by
facet, C MuJoCo in double precision and prism by prism. Both must be given iterations enough for
the contact solver to converge: with four, a skidding wheel of the rover was 4 cm off in 5 s.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from moonteam.physics.backends import MjxBackend, NativeBackend, hold
from moonteam.physics.scene import Placement, build_scene
from moonteam.robots import KINDS, OWN
from moonteam.robots.base import CONTROL_PERIOD
from moonteam.terrain.site import make_site

CHUNK = 25
SECONDS = 5.0


@pytest.fixture(scope="module")
def scene():
    return build_scene(make_site("mare", 0, 16.0), [
        Placement(name, KINDS.get(name), (3.0 * (i - 1), 0.0), 0.3 * i)
        for i, name in enumerate(OWN)])


def sequence(scene):
    """A command for each chunk: ahead, then aside, then stop."""
    legs = [((0.0, 2.5), 1.0), ((1.5, 2.0), 1.0), ((1.5, 2.0), 0.0)]
    for step in range(round(SECONDS / CONTROL_PERIOD) // CHUNK):
        away, pace = legs[min(step // 10, 2)]
        yield tuple(c._replace(xy=c.xy + jnp.array([away]), speed=jnp.full(1, pace * r.kind.speed))
                    for c, r in zip(hold(scene, 1), scene.robots, strict=True))


def drive(backend):
    state, rows = backend.reset(), []
    for commands in sequence(backend.scene):
        state, log = backend.advance(state, commands, CHUNK)
        rows.append(log)
    return jax.tree.map(lambda *a: np.concatenate(a, axis=1)[0], *rows)


def test_both_engines_drive_the_three_robots_alike(scene):
    native, mjx = drive(NativeBackend(scene)), drive(MjxBackend(scene))
    assert len(native.qpos) == round(SECONDS / CONTROL_PERIOD / 5)
    for i, robot in enumerate(scene.robots):
        ours, theirs = (log.qpos[:, robot.qpos][:, :3] for log in (native, mjx))
        assert np.linalg.norm(ours[-1, :2] - scene.qpos0[robot.qpos][:2]) > 0.8
        apart = np.linalg.norm(ours - theirs, axis=1)
        print(f"{robot.name}: at most {1000 * apart.max():.1f} mm apart")
        assert apart.max() < 0.02, robot.name
        energy = (log.power[:, i].mean() for log in (native, mjx))
        assert next(energy) == pytest.approx(next(energy), rel=0.05)
