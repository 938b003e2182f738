"""Worlds of one batch on different sites: each ends where it ends alone on its own."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from moonteam.errors import InputError
from moonteam.physics.backends import hold, make_backend
from moonteam.physics.grounds import PARKED
from moonteam.physics.scene import Placement, build_scene, start_pose
from moonteam.robots import KINDS
from moonteam.terrain.site import make_site, with_soil

STEPS = 50
SITES = [make_site("crater_rim", 14, 16.0), make_site("mare", 2, 16.0), make_site("flat", 0, 16.0)]
PLACES = {"one": (-2.0, 1.0), "two": (2.0, -1.0)}
WHICH = [0, 1, 0, 2, 1, 2]


def team(kind):
    return [Placement(name, kind, xy) for name, xy in PLACES.items()]


def poses(sites, which, kind):
    """Starts [B, nq] of worlds, each on its own site."""
    stand = [np.concatenate([start_pose(site, place) for place in team(kind)]) for site in sites]
    return np.stack([stand[g] for g in which])


def run(name, scene, qpos, which, commands, chunks=3):
    backend = make_backend(name, scene)
    state = backend.reset(qpos, which=which)
    for _ in range(chunks):
        state, log = backend.advance(state, commands, STEPS)
    return jax.device_get(state), jax.device_get(log)


def driving(scene, batch, throttle=1.0):
    """Commands 3 m ahead."""
    return tuple(c._replace(xy=c.xy + jnp.array([[3.0, 1.0]]), speed=jnp.full(batch, throttle))
                 for c in hold(scene, batch))


def compare(name, sites, which, kind, atol=0.0, alone_on=None):
    """Runs worlds together, and those of each site, or of some, alone, in the same rows of as wide
    an engine.
    """
    mixed, qpos = build_scene(sites, team(kind)), poses(sites, which, kind)
    commands = driving(mixed, len(which))
    together, log = run(name, mixed, qpos, which, commands)
    assert not together.diverged.any()
    assert np.abs(together.qpos - qpos).max() > 0.1
    for g in alone_on or sorted(set(which)):
        rows = [b for b, one in enumerate(which) if one == g]
        alone, its = run(name, build_scene(sites[g], team(kind)), np.repeat(
            qpos[rows[:1]], len(which), axis=0), None, commands)
        assert np.abs(together.qpos[rows] - alone.qpos[rows]).max() <= atol
        assert np.abs(log.qpos[rows] - its.qpos[rows]).max() <= atol


def test_a_world_ends_where_it_ends_alone_to_the_bit(sled):
    compare("native", SITES, WHICH, sled.kind)


def test_a_world_without_any_boulders_too(sled):
    bare = [replace(site, boulders=()) for site in SITES]
    compare("native", bare, WHICH, sled.kind)


def test_a_world_on_soil_of_its_own_ends_where_it_ends_alone():
    soft = [with_soil(site, soil) for site, soil in zip(SITES[1:], ("loose", "dense"), strict=True)]
    compare("native", soft, [0, 1, 1, 0], KINDS.get("wheeled"), atol=1e-5)


@pytest.mark.parametrize("soil", [None, "nominal"])
def test_mjx_agrees_with_itself_alone(sled, soil):
    kind = KINDS.get("wheeled") if soil else sled.kind
    sites = [with_soil(site, soil) if soil else site for site in SITES[1:]]
    compare("mjx", sites, [0, 1, 1, 0], kind, atol=1e-4, alone_on=[1])  # the others cost a minute


@pytest.mark.parametrize("name", ["native", "mjx"])
def test_boulders_and_heights_are_the_worlds_own(sled, name):
    """A sled dropped on a boulder of its own site is held up; on the other there is none."""
    stony, bare = SITES[0], replace(SITES[0], boulders=())
    boulder = max(stony.boulders, key=lambda b: b.centre[2])
    scene = build_scene([bare, stony], team(sled.kind))
    qpos = np.tile(scene.qpos0, (2, 1))
    qpos[:, :2], qpos[:, 2] = boulder.centre[:2], boulder.centre[2] + boulder.radius + 0.3
    state, _ = run(name, scene, qpos, [0, 1], hold(scene, 2), 2)
    fell = qpos[:, 2] - state.qpos[:, 2]
    assert fell[0] > fell[1] + 0.1


def test_one_site_many_times_is_that_site_to_the_bit(sled):
    site, kind = SITES[0], sled.kind
    one, many = build_scene(site, team(kind)), build_scene([site] * 3, team(kind))
    assert build_scene([site], team(kind)).grounds is None
    commands = driving(one, 3)
    first, _ = run("native", one, np.tile(one.qpos0, (3, 1)), None, commands)
    second, _ = run("native", many, np.tile(one.qpos0, (3, 1)), [2, 0, 1], commands)
    assert first.which is None
    assert second.which.tolist() == [2, 0, 1]
    assert first.qpos.tobytes() == second.qpos.tobytes()


def test_boulders_that_a_site_lacks_are_parked(sled):
    scene = build_scene([SITES[2], SITES[0]], team(sled.kind))
    assert scene.sites == (SITES[2], SITES[0])
    count = len(SITES[0].boulders)
    assert count > 0
    heights = scene.grounds.fields["geom_pos"][:, 1:, 2]
    assert (heights[0] == PARKED).all()
    assert np.allclose(heights[1], [b.centre[2] for b in SITES[0].boulders])


def test_unlike_sites_and_grounds_that_are_not_there_are_refused(sled):
    with pytest.raises(InputError, match="same grid"):
        build_scene([SITES[0], make_site("mare", 2, 20.0)], team(sled.kind))
    with pytest.raises(InputError, match="all rigid or all regolith"):
        build_scene([SITES[0], with_soil(SITES[1], "nominal")], team(sled.kind))
    scene = build_scene(SITES, team(sled.kind))
    with pytest.raises(ValueError, match="0 to 2"):
        make_backend("native", scene).reset(batch=2, which=[0, 3])
