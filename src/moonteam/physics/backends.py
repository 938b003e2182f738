"""The two engines behind one small interface: same scene, same controllers.

`MjxBackend`: MuJoCo MJX, one jitted scan over control steps, vmapped over worlds; for
accelerators, and for differentiating or tracing through. `NativeBackend`: C MuJoCo on a
thread pool with the jitted controllers called in between; the fast one on a CPU.

Letters: B worlds, R robots, T log samples. A control step is CONTROL_PERIOD seconds: every
controller is called once, then the physics takes its substeps with the controls held.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Sequence
from functools import cache, partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array
from mujoco.batch import Batch

from moonteam import trees
from moonteam.physics import mjx
from moonteam.physics.grounds import Ground, Grounds, standing
from moonteam.physics.regolith.bed import Bed
from moonteam.physics.regolith.forces import Memory, fresh, soil_forces
from moonteam.physics.regolith.treads import FELT_FIELDS, WIDTH, Treads, felt_of, radii
from moonteam.physics.scene import Scene, SceneRobot
from moonteam.robots.base import CONTROL_PERIOD, Command
from moonteam.terrain.surface import Surface

MAX_SPEED = 100.0
"""Any velocity above this, m/s or rad/s, counts as divergence."""

Controls = tuple[Any, ...]  # one controller state per robot, leaves with leading [B]
Commands = tuple[Command, ...]  # one per robot, leaves with leading [B]


class WorldState(NamedTuple):
    """All that a simulation needs to go on. Copy it to branch; slice it to pick worlds."""

    time: Array  # [B] s
    qpos: Array  # [B, nq]
    qvel: Array  # [B, nv]
    act: Array  # [B, na] actuator activations
    warmstart: Array  # [B, nv] the contact solver's last accelerations
    diverged: Array  # [B] bool: not a number or far too fast; the world is frozen since
    control: Controls
    soil: Memory  # what soil that gives way remembers of each tread, leaves with leading [B]
    felt: Array  # [B, C, 25] what treads did in the last physics step: `Felt`
    which: Array | None = None  # [B] the scene's ground that each stands on; None: it has but one


class Log(NamedTuple):
    """What happened, a sample each `log_every` control steps."""

    qpos: Array  # [B, T, nq] at the end of the sample's interval
    power: Array  # [B, T, R] W, mean over the interval
    propellant_rate: Array  # [B, T, R] kg/s, mean over the interval
    treads: Array  # [B, T, C, 3] slip, sinkage m and load N, means over the interval; C = 0: rigid


class Backend(Protocol):
    """An engine that advances B worlds of one scene."""

    name: str
    scene: Scene
    log_every: int

    def reset(self, qpos: np.ndarray | None = None, batch: int = 1,
              which: npt.ArrayLike | None = None) -> WorldState:
        """Worlds at rest: at qpos [B, nq], or `batch` copies of the scene's start.

        `which` [B]: the ground that each stands on, by its index in `scene.sites`; the first.
        Raises ValueError for one that is not there.
        """
        ...

    def advance(
        self, state: WorldState, commands: Commands, num_control_steps: int
    ) -> tuple[WorldState, Log]:
        """Runs `num_control_steps` (a multiple of log_every) with the commands held."""
        ...

    def compile(self, batch: int, num_control_steps: int) -> float:
        """Compiles that size of advance; returns the seconds it took."""
        ...


def make_backend(name: str, scene: Scene, *, log_every: int = 5, threads: int = 0) -> Backend:
    """`mjx` or `native`. Raises ValueError for another name.

    Args:
      name: which engine.
      scene: what to simulate.
      log_every: control steps between two samples of the log.
      threads: of the native engine; 0 for all CPUs.
    """
    if name == "mjx":
        return MjxBackend(scene, log_every)
    if name == "native":
        return NativeBackend(scene, log_every, threads)
    raise ValueError(f"no backend {name!r}; backends: mjx, native")


def hold(scene: Scene, batch: int) -> Commands:
    """Commands [B] that tell every robot to hold its place."""
    return tuple(
        Command(jnp.tile(jnp.asarray(scene.qpos0[r.qpos][:2], jnp.float32), (batch, 1)),
                jnp.zeros(batch), jnp.zeros(batch, bool))
        for r in scene.robots)


def _substeps(scene: Scene) -> int:
    """Physics steps in a control step. Raises ValueError unless the one divides the other."""
    ratio = CONTROL_PERIOD / scene.model.opt.timestep
    if abs(ratio - round(ratio)) > 1e-6 or ratio < 1:
        raise ValueError(f"physics step {scene.model.opt.timestep} s must divide "
                         f"the control period {CONTROL_PERIOD} s")
    return round(ratio)


def _start_controls(robots: Sequence[SceneRobot], qpos: Array, qvel: Array) -> Controls:
    """Fresh controller states of one world: qpos [nq], qvel [nv]."""
    return tuple(r.kind.init(qpos[r.qpos], qvel[r.qvel]) for r in robots)


def _call_controllers(
    robots: Sequence[SceneRobot], nu: int, surface: Surface, time: Array, qpos: Array,
    qvel: Array, controls: Controls, commands: Commands,
) -> tuple[Array, Controls, Array, Array]:
    """All controllers of one world: ctrl [nu], their states, power [R], propellant [R]."""
    ctrl = jnp.zeros(nu)
    states, power, propellant = [], [], []
    for robot, memory, command in zip(robots, controls, commands, strict=True):
        action, memory, told = robot.kind.control(
            memory, time, qpos[robot.qpos], qvel[robot.qvel], command, surface)
        ctrl = ctrl.at[robot.ctrl].set(action)
        states.append(memory)
        power.append(told.power)
        propellant.append(told.propellant)
    return ctrl, tuple(states), jnp.stack(power), jnp.stack(propellant)


def _soil(bed: Bed, surface: Surface, memory: Memory, felt: Array
          ) -> tuple[Array, Array, Memory, Array]:
    """Soil of one world: from its memory and what is felt [C, WIDTH] the forces on the treads'
    bodies [C, 6], the radii of their spheres [C], the new memory, and what is told of it [C, 3].
    """
    forces, memory, told = soil_forces(bed, surface, memory, felt_of(felt))
    return forces, radii(bed, memory.depth), memory, jnp.stack(told, axis=1)


def _bad(qpos: Array, qvel: Array) -> Array:
    """Whether a world [..., nq], [..., nv] has blown up: bool [...]."""
    finite = jnp.isfinite(qpos).all(axis=-1) & jnp.isfinite(qvel).all(axis=-1)
    return ~finite | (jnp.abs(qvel).max(axis=-1) > MAX_SPEED)


def _strong(tree: Any) -> Any:
    """The same arrays with fixed types, so that a compiled program takes them."""
    return jax.tree.map(
        lambda a: jnp.asarray(a, jnp.float32 if jnp.issubdtype(a.dtype, jnp.floating)
                              else a.dtype), tree)


def _check_steps(num_control_steps: int, log_every: int) -> None:
    if num_control_steps < 1 or num_control_steps % log_every:
        raise ValueError(f"{num_control_steps} control steps are not a multiple of "
                         f"log_every = {log_every}")


class MjxBackend:
    """MuJoCo MJX. Model and ground are arguments of the compiled function, not constants in
    it, so sites of one size share a compilation, within a process and in JAX's cache on disk.
    `model` is the scene's, as MJX has it.
    """

    name = "mjx"

    def __init__(self, scene: Scene, log_every: int = 5):
        self.scene = scene
        self.log_every = log_every
        self._substeps = _substeps(scene)
        with jax.numpy_rank_promotion("allow"):
            self.model = mjx.without_sensors(mjx.put_model(scene.model))
            self._blank = mjx.make_data(scene.model)
        self._programs: dict[tuple[int, int], jax.stages.Compiled] = {}
        self._reset = jax.jit(jax.vmap(
            lambda qpos, qvel: _start_controls(scene.robots, qpos, qvel)))

    def reset(self, qpos: np.ndarray | None = None, batch: int = 1,
              which: npt.ArrayLike | None = None) -> WorldState:
        """Worlds at rest: see `Backend`."""
        return _at_rest(self.scene, self._reset, qpos, batch, which)

    def advance(
        self, state: WorldState, commands: Commands, num_control_steps: int
    ) -> tuple[WorldState, Log]:
        """Runs `num_control_steps` (a multiple of log_every) with the commands held."""
        key = self._key(state.qpos.shape[0], num_control_steps)
        if key not in self._programs:
            self.compile(*key)
        return self._programs[key](self.model, self.scene.ground, _strong(state),
                                   _strong(commands))

    def compile(self, batch: int, num_control_steps: int) -> float:
        """Compiles that size of advance; returns the seconds it took."""
        key = self._key(batch, num_control_steps)
        state, commands = self.reset(batch=batch), hold(self.scene, batch)
        begun = time.perf_counter()
        advance = jax.jit(self.traced, static_argnames="num_control_steps")
        self._programs[key] = advance.lower(
            self.model, self.scene.ground, state, commands,
            num_control_steps=num_control_steps).compile(in_order())
        return time.perf_counter() - begun

    def _key(self, batch: int, num_control_steps: int) -> tuple[int, int]:
        _check_steps(num_control_steps, self.log_every)
        return batch, num_control_steps

    def traced(self, model: mjx.Model, ground: Ground, state: WorldState,
               commands: Commands, num_control_steps: int) -> tuple[WorldState, Log]:
        """`advance` as a pure function of model and ground, to be part of a larger program."""
        def sample(worlds: WorldState, _: None) -> tuple[WorldState, Log]:
            def step(carry: WorldState, _: None) -> tuple[WorldState, tuple[Array, Array, Array]]:
                return jax.vmap(self._control_step, in_axes=(None, None, 0, 0))(
                    model, ground, carry, commands)

            worlds, told = jax.lax.scan(step, worlds, None, length=self.log_every)
            return worlds, Log(worlds.qpos, *(x.mean(axis=0) for x in told))

        state, log = jax.lax.scan(
            sample, state, None, length=num_control_steps // self.log_every)
        return _strong(state), jax.tree.map(lambda a: jnp.swapaxes(a, 0, 1), log)

    def _control_step(self, model: mjx.Model, ground: Ground, world: WorldState,
                      commands: Commands) -> tuple[WorldState, tuple[Array, Array, Array]]:
        """One control step of one world; a diverged world stays as it is."""
        ground = ground.under(world.which)
        ctrl, controls, power, propellant = _call_controllers(
            self.scene.robots, self.scene.model.nu, ground.surface, world.time, world.qpos,
            world.qvel, world.control, commands)
        treads, soil, told = self.scene.treads, world.soil, jnp.zeros((0, 3))
        # MJX broadcasts freely; only our own code is held to explicit ranks.
        with jax.numpy_rank_promotion("allow"):
            data = self._blank.replace(
                time=world.time, qpos=world.qpos, qvel=world.qvel, act=world.act,
                qacc_warmstart=world.warmstart, ctrl=ctrl)
            if ground.rocks is not None and world.which is not None:
                model = ground.rocks.model(model, world.which)
            if ground.bed is not None:
                forces, size, soil, told = _soil(ground.bed, ground.surface, soil, world.felt)
                data = data.replace(xfrc_applied=data.xfrc_applied.at[treads.bodies].add(forces))
                model = model.replace(geom_size=model.geom_size.at[treads.geoms, 0].set(size))
            data = jax.lax.fori_loop(
                0, self._substeps, lambda _, d: mjx.step(model, d), data)
            felt = world.felt
            if ground.bed is not None:
                felt = treads.felt(data, mjx.normal_forces(model, data, treads.geoms), jnp)
        bad = _bad(data.qpos, data.qvel)
        moved = WorldState(data.time, data.qpos, data.qvel, data.act, data.qacc_warmstart,
                           jnp.zeros((), bool), controls, soil, felt, world.which)
        stopped = world._replace(qvel=jnp.zeros_like(world.qvel), diverged=jnp.ones((), bool))
        frozen = world.diverged | bad
        spent = (power, propellant, told)
        return (trees.where(frozen, stopped, moved),
                trees.where(frozen, jax.tree.map(jnp.zeros_like, spent), spent))


def _control_world(scene: Scene, memories: Any, orders: Any, ground: Ground, which: Array | None,
                   seen: Array, memory: Array, told: Array) -> tuple[Array, Array]:
    """One world: seen [1 + nq + nv + C WIDTH], the memory of controllers and soil and the commands
    side by side, which have the shapes of `memories` and `orders`.

    Returns ctrl, power, propellant, what is told of the treads, the soil's forces and the treads'
    radii side by side [nu + 2 R + (3 + 6 + 1) C], and the new memory.
    """
    ground = ground.under(which)
    nq, nv = scene.model.nq, scene.model.nv
    now, qpos, qvel, felt = jnp.split(seen, (1, 1 + nq, 1 + nq + nv))
    before, soil = _shaped(memories, memory)
    ctrl, controls, power, propellant = _call_controllers(
        scene.robots, scene.model.nu, ground.surface, now[0], qpos, qvel,
        before, _shaped(orders, told))
    out = [ctrl, power, propellant]
    if ground.bed is not None:
        forces, size, soil, of_treads = _soil(ground.bed, ground.surface, soil,
                                              felt.reshape((-1, WIDTH)))
        out += [of_treads.reshape(-1), forces.reshape(-1), size]
    leaves = [leaf.reshape(-1).astype(jnp.float32) for leaf in jax.tree.leaves((controls, soil))]
    return jnp.concatenate(out), jnp.concatenate(leaves)


class NativeBackend:
    """C MuJoCo: `mujoco.batch` steps the worlds on a thread pool, bit-identical at any number
    of threads; all controllers of all worlds are one jitted call on the CPU in between.

    `physics_s` adds up the wall seconds spent in C MuJoCo.
    """

    name = "native"

    def __init__(self, scene: Scene, log_every: int = 5, threads: int = 0):
        self.scene = scene
        self.log_every = log_every
        self.physics_s = 0.0
        self._threads = threads or os.cpu_count() or 1
        self._substeps = _substeps(scene)
        self._batch: Batch | None = None
        self._cpu = jax.local_devices(backend="cpu")[0]
        self._ground = jax.device_put(scene.ground, self._cpu)
        start = partial(_start_controls, scene.robots)
        model = scene.model
        self._memory = jax.eval_shape(
            lambda *a: (_strong(start(*a)), fresh(len(scene.treads.geoms))),
            jnp.zeros(model.nq), jnp.zeros(model.nv))
        self._told = jax.tree.map(lambda a: a[0], hold(scene, 1))
        self._reset = jax.jit(jax.vmap(start))
        # Called every control step: few, flat arrays, and jit's own fast dispatch.
        self._controllers = jax.jit(
            # Not a method: the engine would hold itself until the garbage collector comes by.
            jax.vmap(partial(_control_world, scene, self._memory, self._told),
                     in_axes=(None, 0, 0, 0, 0)),
            compiler_options=in_order())

    def reset(self, qpos: np.ndarray | None = None, batch: int = 1,
              which: npt.ArrayLike | None = None) -> WorldState:
        """Worlds at rest: see `Backend`."""
        with jax.default_device(self._cpu):
            return _at_rest(self.scene, self._reset, qpos, batch, which)

    def advance(
        self, state: WorldState, commands: Commands, num_control_steps: int
    ) -> tuple[WorldState, Log]:
        """Runs `num_control_steps` (a multiple of log_every) with the commands held.

        The arrays that it returns are NumPy's.
        """
        _check_steps(num_control_steps, self.log_every)
        batch, nu = state.qpos.shape[0], self.scene.model.nu
        worlds = _Worlds(self._pool(batch), state, self.scene.treads, self.scene.grounds)
        told, memory, which = _flat(commands, batch), *self._remember(state, batch)
        samples = num_control_steps // self.log_every
        num_treads = len(self.scene.treads.geoms)
        logged = 2 * len(self.scene.robots) + 3 * num_treads
        qpos = np.empty((batch, samples, self.scene.model.nq), np.float32)
        costs = np.zeros((batch, samples, logged), np.float32)
        for step in range(num_control_steps):
            out, memory = self._controllers(self._ground, which, worlds.seen(), memory, told)
            rows = np.asarray(out)
            begun = time.perf_counter()
            worlds.step(rows[:, :nu], rows[:, nu + logged:], self._substeps)
            self.physics_s += time.perf_counter() - begun
            sample = step // self.log_every
            costs[:, sample] += np.where(worlds.diverged[:, None], 0.0, rows[:, nu:nu + logged])
            if (step + 1) % self.log_every == 0:
                qpos[:, sample] = worlds.qpos
        power, propellant, treads = np.split(
            costs / self.log_every, np.cumsum([len(self.scene.robots)] * 2), axis=2)
        log: Any = (qpos, power, propellant, treads.reshape(batch, samples, num_treads, 3))
        return worlds.state(*_shaped(self._memory, np.asarray(memory))), Log(*log)

    def compile(self, batch: int, num_control_steps: int) -> float:
        """Compiles the controllers for B worlds; returns the seconds it took."""
        _check_steps(num_control_steps, self.log_every)
        state = self.reset(batch=batch)
        worlds = _Worlds(self._pool(batch), state, self.scene.treads, self.scene.grounds)
        begun = time.perf_counter()
        memory, which = self._remember(state, batch)
        jax.block_until_ready(self._controllers(
            self._ground, which, worlds.seen(), memory, _flat(hold(self.scene, batch), batch)))
        return time.perf_counter() - begun

    def _remember(self, state: WorldState, batch: int) -> tuple[Array, Array | None]:
        """The memory of controllers and soil [B, n] where the next one will be, lest jit compile
        twice, and the worlds' grounds.
        """
        return jax.device_put((_flat((state.control, state.soil), batch), state.which), self._cpu)

    def _pool(self, batch: int) -> Batch:
        if self._batch is None or self._batch.nsim != batch:
            self._batch = Batch(self.scene.model, batch, min(self._threads, batch))
        return self._batch


@cache
def in_order() -> dict[str, str | bool]:
    """XLA's options, where it knows them, to run a CPU program's operations one after the other.

    A call of the controllers is some hundred operations of a microsecond or less; XLA would
    hand part of them to other threads, which costs more than the operations. And LAPACK's batched
    factorisations, which MJX has, wait for threads of the very pool that they would be handed to:
    where all of those factorise at once, with two cores soon, they wait for ever.
    """
    options: dict[str, str | bool] = {
        "xla_cpu_scheduler_type": "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED"}
    try:
        jax.jit(lambda x: x + 1, compiler_options=options).lower(0).compile()
    except jax.errors.JaxRuntimeError:
        return {}
    return options


def _flat(tree: Any, batch: int) -> np.ndarray:
    """The leaves [B, ...] of a tree side by side: [B, n] float32. `_shaped` undoes it."""
    leaves = [np.asarray(leaf, np.float32).reshape(batch, -1) for leaf in jax.tree.leaves(tree)]
    return np.concatenate(leaves, axis=1)


def _shaped(like: Any, rows: Any) -> Any:
    """Rows [..., n] cut into the leaves of `like`, a tree of one world: leaves [..., *shape]."""
    leaves, treedef = jax.tree.flatten(like)
    ends = np.cumsum([0] + [math.prod(leaf.shape) for leaf in leaves]).tolist()
    lead = rows.shape[:-1]
    parts = [rows[..., i:j].reshape(lead + leaf.shape).astype(leaf.dtype)
             for leaf, i, j in zip(leaves, ends[:-1], ends[1:], strict=True)]
    return jax.tree.unflatten(treedef, parts)


class _Worlds:
    """The rows of a batch while they are advanced, with the guard against divergence."""

    def __init__(self, batch: Batch, state: WorldState, treads: Treads, grounds: Grounds | None):
        self._batch, self._treads, self._which = batch, treads, state.which
        if grounds is not None:
            for name, values in grounds.fields.items():
                batch.expand(name)[:, grounds.geoms] = values[np.asarray(state.which)]
        self._time, self.qpos = batch.bind("time"), batch.bind("qpos")
        self._qvel, self._act = batch.bind("qvel"), batch.bind("act")
        self._warmstart, self._ctrl = batch.bind("qacc_warmstart"), batch.bind("ctrl")
        self._time[:] = np.asarray(state.time).reshape(self._time.shape)
        self.qpos[:], self._qvel[:] = np.asarray(state.qpos), np.asarray(state.qvel)
        self._act[:], self._warmstart[:] = np.asarray(state.act), np.asarray(state.warmstart)
        self.diverged = np.array(state.diverged)
        self._felt = np.array(state.felt, np.float32)
        width = 1 + self.qpos.shape[1] + self._qvel.shape[1] + self._felt[0].size
        self._seen = np.empty((len(self.qpos), width), np.float32)
        if len(treads.geoms):
            self._forces, self._sizes = batch.bind("xfrc_applied"), batch.expand("geom_size")
            for name in FELT_FIELDS:
                batch.bind(name)
            # A body may have several treads.
            self._of = (np.arange(self._forces.shape[1])[:, None] == treads.bodies).astype(float)

    def seen(self) -> np.ndarray:
        """Time, qpos, qvel and what treads feel side by side [B, 1 + nq + nv + C WIDTH] in the
        controllers' precision.

        The same memory at every call.
        """
        nq, nv = self.qpos.shape[1], self._qvel.shape[1]
        self._seen[:, 0] = self._time
        self._seen[:, 1:1 + nq] = self.qpos
        self._seen[:, 1 + nq:1 + nq + nv] = self._qvel
        self._seen[:, 1 + nq + nv:] = self._felt.reshape(len(self._felt), -1)
        return self._seen

    def step(self, ctrl: np.ndarray, soil: np.ndarray, substeps: int) -> None:
        """One control step of the worlds that still run; one that blows up goes back to
        where it was before the step and stays there.

        `soil`: forces on the treads' bodies and the treads' radii, side by side [B, 7 C].
        """
        before = self.qpos.copy()
        self._ctrl[:] = ctrl
        count = len(self._treads.geoms)
        if count:
            forces = soil[:, :6 * count].reshape(-1, count, 6)
            np.matmul(self._of, forces, out=self._forces)
            self._sizes[:, self._treads.geoms, 0] = soil[:, 6 * count:]
        if not self.diverged.any():
            self._batch.step(nstep=substeps)
        elif not self.diverged.all():
            self._batch.step(ids=np.flatnonzero(~self.diverged), nstep=substeps)
        if count:
            loads = self._batch.sensordata[:, self._treads.sensors]
            np.copyto(self._felt, self._treads.felt(self._batch, loads, np), casting="same_kind",
                      where=~self.diverged[:, None, None])
        # Not a number makes this comparison false, too.
        bad = ~(np.abs(self._qvel).max(axis=1) <= MAX_SPEED)
        bad |= ~np.isfinite(self.qpos).all(axis=1)
        if bad.any():
            self.diverged |= bad
            self.qpos[bad] = before[bad]
            self._qvel[bad] = self._warmstart[bad] = 0.0

    def state(self, controls: Controls, soil: Memory) -> WorldState:
        """The worlds as they now are."""
        def single(rows: np.ndarray) -> Any:
            return rows.astype(np.float32)

        gone: Any = self.diverged
        return WorldState(single(self._time), single(self.qpos), single(self._qvel),
                          single(self._act), single(self._warmstart), gone, controls, soil,
                          single(self._felt), self._which)


def _at_rest(scene: Scene, start: Any, qpos: np.ndarray | None, batch: int,
             which: npt.ArrayLike | None) -> WorldState:
    places = np.tile(scene.qpos0, (batch, 1)) if qpos is None else np.asarray(qpos)
    size, model, num_treads = len(places), scene.model, len(scene.treads.geoms)
    held = jnp.asarray(places, jnp.float32)
    still = jnp.zeros((size, model.nv))
    return WorldState(jnp.zeros(size), held, still, jnp.zeros((size, model.na)), still,
                      jnp.zeros(size, bool), _strong(start(held, still)),
                      jax.tree.map(lambda a: jnp.zeros((size, *a.shape)), fresh(num_treads)),
                      jnp.zeros((size, num_treads, WIDTH)),
                      standing(scene.grounds, size, which))
