"""How fast the backends step a scene: compilation, controllers and physics apart."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from mujoco.batch import Batch

from moonteam.physics.backends import Commands, NativeBackend, hold, make_backend
from moonteam.physics.scene import Placement, Scene, build_scene
from moonteam.robots import KINDS
from moonteam.robots.base import CONTROL_PERIOD
from moonteam.terrain.site import make_site

SPREAD = 3.0
"""Distance between robots at the start, m."""


def three_robots(preset: str, seed: int, samples: int) -> Scene:
    """One robot of each kind on a site of samples x samples at 0.25 m."""
    site = make_site(preset, seed, (samples - 1) * 0.25)
    return build_scene(site, [Placement(name, kind, (SPREAD * (i - 1), 0.0))
                              for i, (name, kind) in enumerate(KINDS.items())])


def drive(scene: Scene, batch: int) -> Commands:
    """Commands that keep every robot moving: 4 m ahead at its own speed."""
    ahead = jnp.array([[0.0, 4.0]])
    return tuple(c._replace(xy=c.xy + ahead, speed=jnp.full(batch, r.kind.speed))
                 for c, r in zip(hold(scene, batch), scene.robots, strict=True))


def measure(scene: Scene, name: str, batch: int, seconds: float, threads: int) -> dict[str, Any]:
    """One row: a backend with a number of worlds, run for about `seconds` of wall clock.

    Keys: compile_s; steps_per_s of all worlds together, controllers included;
    real_time_factor, simulated seconds of all worlds a wall second; controllers_s, the
    controllers' share of one simulated second of one world; for native also
    physics_steps_per_s, without any controller.
    """
    backend = make_backend(name, scene, threads=threads)
    chunk = 25
    compile_s = backend.compile(batch, chunk)
    state, commands = backend.reset(batch=batch), drive(scene, batch)
    state, _ = backend.advance(state, commands, chunk)

    def advance() -> None:
        nonlocal state
        state, log = backend.advance(state, commands, chunk)
        jax.block_until_ready(log)

    rate = repeats_per_second(advance, seconds)
    per_step = chunk * round(CONTROL_PERIOD / scene.model.opt.timestep) * batch
    row = {"backend": name, "worlds": batch, "compile_s": compile_s,
           "steps_per_s": rate * per_step,
           "real_time_factor": rate * per_step * scene.model.opt.timestep,
           "controllers_s": _controllers_alone(scene, batch, seconds / 2),
           "diverged": int(np.asarray(state.diverged).sum())}
    if name == "native":
        row |= {"threads": threads,
                "physics_steps_per_s": _physics_alone(scene, batch, seconds, threads)}
    return row


def repeats_per_second(call: Callable[[], None], seconds: float) -> float:
    """How often a call runs in a second, from as many calls as fit (at least two)."""
    count, begun = 0, time.perf_counter()
    while count < 2 or time.perf_counter() - begun < seconds:
        call()
        count += 1
    return count / (time.perf_counter() - begun)


def device_name() -> str:
    """What JAX runs on, e.g. ``cpu`` or the name of the accelerator."""
    return jax.devices()[0].device_kind


def _physics_alone(scene: Scene, batch: int, seconds: float, threads: int) -> float:
    """Steps a second of C MuJoCo with the controls at zero, robots resting on the ground."""
    worlds = Batch(scene.model, batch, threads)
    worlds.bind("qpos")[:] = scene.qpos0
    worlds.step(nstep=50)
    return repeats_per_second(lambda: worlds.step(nstep=50), seconds) * 50 * batch


def _controllers_alone(scene: Scene, batch: int, seconds: float) -> float:
    """Wall seconds that the controllers of one world take for one simulated second, when
    `batch` worlds are called together.
    """
    backend = NativeBackend(scene, threads=1)
    state, commands = backend.reset(batch=batch), drive(scene, batch)
    arguments = (scene.surface, state.time, state.qpos, state.qvel, state.control, commands)
    jax.block_until_ready(backend.controllers(*arguments))
    rate = repeats_per_second(
        lambda: jax.block_until_ready(backend.controllers(*arguments)), seconds)
    return 1.0 / (rate * CONTROL_PERIOD * batch)
