"""How fast the backends step a scene: compilation, controllers and physics apart."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from moonteam.errors import InputError
from moonteam.physics.backends import Backend, Commands, NativeBackend, hold, make_backend
from moonteam.physics.scene import Placement, Scene, build_scene, check_starts, start_pose
from moonteam.robots import KINDS, OWN
from moonteam.robots.base import CONTROL_PERIOD, Command, RobotKind, Telemetry
from moonteam.terrain.site import Site, make_site, with_soil
from moonteam.terrain.surface import Surface

SPREAD = 3.0
"""Distance between robots at the start, m."""


def own_robots(preset: str, seed: int, samples: int, sites: int = 1, ground: str = "rigid"
               ) -> Scene:
    """One robot of each kind of ours on a site of samples x samples at 0.25 m, or on several: the
    first of the seeds from `seed` on where the robots can stand. `ground` as in a mission.

    Raises InputError where they cannot, be it on one site in 20.
    """
    team = _team()

    def made(number: int) -> Site:
        site = make_site(preset, number, (samples - 1) * 0.25)
        return with_soil(site, "nominal") if ground == "regolith" else site

    if sites == 1:
        return build_scene(made(seed), team)
    found: list[Site] = []
    for index in range(20 * sites):
        site = made(seed + index)
        with suppress(InputError):
            check_starts(site, team)
            found.append(site)
        if len(found) == sites:
            return build_scene(found, team)
    raise InputError("--sites", f"the robots can stand on {len(found)} of {20 * sites} sites only")


def _team() -> list[Placement]:
    return [Placement(name, KINDS.get(name), (SPREAD * (i - 1), 0.0))
            for i, name in enumerate(OWN)]


def drive(scene: Scene, batch: int, way: float = 1.0) -> Commands:
    """Commands that keep every robot moving: 4 m ahead (or behind) at its own speed."""
    ahead = jnp.array([[0.0, 4.0 * way]])
    return tuple(c._replace(xy=c.xy + ahead, speed=jnp.full(batch, r.kind.speed))
                 for c, r in zip(hold(scene, batch), scene.robots, strict=True))


def measure(scene: Scene, name: str, batch: int, seconds: float, threads: int) -> dict[str, Any]:
    """One row: a backend with a number of worlds, run for about `seconds` of wall clock.

    Keys: compile_s; steps_per_s of all worlds together, controllers included;
    physics_steps_per_s without them: of the same run on native, of a run with limp robots on
    mjx, whose work is the same whatever they do; controllers_add, the time that all else takes
    as a share of the physics'; real_time_factor, simulated seconds of all worlds a wall second;
    cpu_s, processor seconds for one simulated second of one world; peak_memory_mb of the
    process so far.
    """
    backend = make_backend(name, scene, threads=threads)
    per_chunk = CHUNK * round(CONTROL_PERIOD / scene.model.opt.timestep) * batch
    compile_s = backend.compile(batch, CHUNK)
    run = _Run(backend, batch)
    run.chunk()
    native = isinstance(backend, NativeBackend)
    if native:
        backend.physics_s = 0.0
    cpu, chunks, taken = time.process_time(), *run.chunks(seconds)
    cpu = time.process_time() - cpu
    if native:
        physics_s = backend.physics_s
    else:
        limp = replace(scene, robots=tuple(replace(r, kind=_limp(r.kind)) for r in scene.robots))
        idle = _Run(make_backend(name, limp), batch)
        idle.chunk()
        count, spent = idle.chunks(seconds / 2)
        physics_s = spent * chunks / count
    steps, simulated = chunks * per_chunk, chunks * CHUNK * CONTROL_PERIOD * batch
    row = {"backend": name, "worlds": batch, "compile_s": compile_s,
           "steps_per_s": steps / taken, "physics_steps_per_s": steps / physics_s,
           "controllers_add": taken / physics_s - 1.0, "real_time_factor": simulated / taken,
           "cpu_s": cpu / simulated, "diverged": run.diverged(),
           "peak_memory_mb": peak_memory_mb()}
    return row | ({"threads": threads} if native else {})


CHUNK = 25
"""Control steps of one call of a backend."""

LAP = 40
"""Chunks that the robots go one way before they turn back."""


class _Run:
    """Worlds of a backend that are kept moving."""

    def __init__(self, backend: Backend, batch: int):
        self._backend, self._count = backend, 0
        if backend.scene.grounds is None:
            self._state = backend.reset(batch=batch)
        else:
            sites, team = backend.scene.sites, _team()
            starts = np.stack([np.concatenate([start_pose(site, one) for one in team])
                               for site in sites])
            which = np.arange(batch) % len(sites)
            self._state = backend.reset(starts[which], batch, which)
        self._ways = [drive(backend.scene, batch, way) for way in (1.0, -1.0)]

    def chunk(self) -> None:
        """One call of the backend, finished."""
        commands = self._ways[self._count // LAP % 2]
        self._state, log = self._backend.advance(self._state, commands, CHUNK)
        jax.block_until_ready(log)
        self._count += 1

    def chunks(self, seconds: float) -> tuple[int, float]:
        """As many calls as fit (at least two), and the wall seconds they took."""
        count, begun = 0, time.perf_counter()
        while count < 2 or time.perf_counter() - begun < seconds:
            self.chunk()
            count += 1
        return count, time.perf_counter() - begun

    def diverged(self) -> int:
        """Worlds that blew up."""
        return int(np.asarray(self._state.diverged).sum())


def _limp(kind: RobotKind) -> RobotKind:
    """The robot with a controller that does nothing."""
    actuators = kind.load().compile().nu

    def control(state: Array, time: Array, qpos: Array, qvel: Array, command: Command,
                surface: Surface) -> tuple[Array, Array, Telemetry]:
        del time, qpos, qvel, command, surface
        return jnp.zeros(actuators), state, Telemetry(jnp.zeros(()), jnp.zeros(()))

    return replace(kind, init=lambda qpos, qvel: jnp.zeros(()), control=control)


def device_name() -> str:
    """What JAX runs on, e.g. ``cpu`` or the name of the accelerator."""
    return jax.devices()[0].device_kind


def peak_memory_mb() -> float:
    """Most memory that this process had so far; on an accelerator, that of the device."""
    stats = jax.devices()[0].memory_stats() or {}
    if "peak_bytes_in_use" in stats:
        return stats["peak_bytes_in_use"] / 1e6
    # Linux counts in KiB, macOS in bytes.
    unit = 1.0 if sys.platform == "darwin" else 1024.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


def resident_mb() -> float:
    """Memory that this process holds now; where the system does not say, the most so far."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return peak_memory_mb()
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def compile_times(backend: str, batch: int, options: Sequence[str]) -> dict[str, Any]:
    """Seconds to compile in a fresh process, with an empty cache and with the cache filled."""
    row: dict[str, Any] = {"backend": backend, "worlds": batch}
    words = [sys.executable, "-m", "moonteam.cli", "bench", "physics", "--json", "--backend",
             backend, "--worlds", str(batch), "--seconds", "0.01", *options]
    with tempfile.TemporaryDirectory() as folder:
        for key in ("cold_s", "cached_s"):
            done = subprocess.run(words, env=os.environ | {"MOONTEAM_CACHE": folder},
                                  capture_output=True, text=True, check=True)
            row[key] = json.loads(done.stdout)["rows"][0]["compile_s"]
    return row
