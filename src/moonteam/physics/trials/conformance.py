"""What every kind of robot must keep, ours and a user's: the checks behind `moonteam check robot`.

Each check answers with one line; a kind conforms if all pass. Drives are in C MuJoCo on level
ground; the last check puts the kind into both engines.

Letters: B worlds, T control steps, J joints.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from moonteam.physics.backends import MjxBackend, NativeBackend, hold
from moonteam.physics.scene import Placement, Scene, build_scene
from moonteam.robots.base import CONTROL_PERIOD, GLYPHS, PHYSICS_DT, Command, RobotKind
from moonteam.terrain.site import SPACING, Site
from moonteam.terrain.surface import Surface

STAND_SECONDS, WAY, REST_SECONDS = 4.0, 10.0, 3.0  # s, m, s
ARRIVED, SETTLED, UPRIGHT = 0.15, 0.15, math.radians(20.0)  # m, m, rad
PATIENCE, START_SECONDS = 2.0, 6.0  # times the way at the kind's own speed, and s beyond
DRIFT = 0.02  # m that the two engines may be apart
ENGINE_SECONDS = 2.0
TWINS, STATES = 4, 400  # worlds batched against single ones; states that must be survived
SINK, GAP = 0.001, 0.02  # m that feet may stand in, or above, the ground at the start


class Check(NamedTuple):
    """One answer."""

    name: str
    passed: bool
    detail: str  # what was measured, or what is wrong

    def document(self) -> dict:
        """For JSON."""
        return self._asdict()


class Broken(Exception):
    """What is wrong, in a few words."""


class Drive(NamedTuple):
    """What happened at each control step."""

    qpos: np.ndarray  # [T, 7 + J]
    ctrl: np.ndarray  # [T, nu]
    force: np.ndarray  # [T, nu] N or N m, after the last physics step

    @property
    def tilt(self) -> np.ndarray:
        """[T] rad, base z axis from the vertical."""
        x, y = self.qpos[:, 4], self.qpos[:, 5]
        return np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0))


def check(kind: RobotKind, told: Callable[[Check], None] = lambda check: None) -> list[Check]:
    """All checks of a kind in their order; `told` hears of each as it ends.

    Whatever the kind's own code raises fails the check in which it does. Where the model cannot
    be used the others are not tried.
    """
    trial, found = _Trial(kind), []
    for name, ask in CHECKS.items():
        if name != "fields" and any(not c.passed and c.name == "model" for c in found):
            answer = Check(name, False, "not tried: the model cannot be used")
        else:
            try:
                answer = Check(name, True, ask(trial))
            except Broken as problem:
                answer = Check(name, False, str(problem))
            except Exception as error:  # the user's own code: anything can come
                answer = Check(name, False, " ".join(f"{type(error).__name__}: {error}".split()))
        found.append(answer)
        told(answer)
    return found


class _Trial:
    """A kind under trial; what several checks need is made once."""

    def __init__(self, kind: RobotKind):
        self.kind = kind
        self.control = jax.jit(kind.control)

    @cached_property
    def model(self) -> mujoco.MjModel:
        return self.kind.load().compile()

    @cached_property
    def scene(self) -> Scene:
        """Level ground with the robot at its west end, facing east."""
        samples = round((WAY + 6.0) / SPACING) + 1
        heights = np.zeros((33, samples), np.float32)
        start = (-WAY / 2, 0.0)
        return build_scene(Site("level", 0, heights, SPACING),
                           [Placement("robot", self.kind, start)])

    @cached_property
    def stood(self) -> Drive:
        return self._drive(self._command(0.0, 0.0), STAND_SECONDS)

    @cached_property
    def went(self) -> Drive:
        """10 m and a rest."""
        seconds = PATIENCE * WAY / self.kind.speed + START_SECONDS
        return self._drive(self._command(WAY, self.kind.speed), seconds, WAY)

    def _command(self, ahead: float, speed: float) -> Command:
        x, y = self.scene.qpos0[self.scene.robots[0].qpos][:2]
        return _asked(np.array([x + ahead, y], np.float32), np.float32(speed), np.array(False))

    def _drive(self, command: Command, seconds: float, ahead: float | None = None) -> Drive:
        """Runs from the start; with `ahead`, until REST_SECONDS after it came so far."""
        model, data = self.scene.model, mujoco.MjData(self.scene.model)
        data.qpos[:] = self.scene.qpos0
        mujoco.mj_forward(model, data)
        state = self.kind.init(*(jnp.asarray(a, jnp.float32) for a in (data.qpos, data.qvel)))
        rows, rest, substeps = [], math.inf, round(CONTROL_PERIOD / PHYSICS_DT)
        for _ in range(round(seconds / CONTROL_PERIOD)):
            ctrl, state, _ = self.control(
                state, np.float32(data.time), data.qpos.astype(np.float32),
                data.qvel.astype(np.float32), command, self.scene.surface)
            data.ctrl[:] = ctrl
            mujoco.mj_step(model, data, substeps)
            rows.append((data.qpos.copy(), np.asarray(ctrl, float), data.actuator_force.copy()))
            if not np.isfinite(data.qpos).all():
                raise Broken(f"blew up after {data.time:.2f} s")
            there = ahead is not None and np.hypot(*(data.qpos[:2] - command.xy)) < ARRIVED
            rest = rest - CONTROL_PERIOD if rest < math.inf else (
                REST_SECONDS if there else math.inf)
            if rest <= 0.0:
                break
        return Drive(*(np.array(column) for column in zip(*rows, strict=True)))


def _must(holds: object, problem: str) -> None:
    if not holds:
        raise Broken(problem)


def _fields(trial: _Trial) -> str:
    kind = trial.kind
    for name, word in (("name", kind.name), ("callsign", kind.callsign or kind.name)):
        _must(re.fullmatch(r"[A-Za-z][\w-]*", word), f"{name} {word!r}: letters, digits, - and _")
    _must(kind.glyph in GLYPHS, f"glyph {kind.glyph!r} is not one of {', '.join(GLYPHS)}")
    _must(re.fullmatch("#[0-9a-fA-F]{6}", kind.colour), f"colour {kind.colour!r} is not #rrggbb")
    for name, low, high in (
            ("speed", 0.01, 20.0), ("footprint", 0.02, 5.0), ("spawn_height", 0.01, 5.0),
            ("max_slope", 0.0, math.pi / 2), ("max_step", 0.0, math.inf), ("slowing", 0.0, 0.9),
            ("fall_tilt", 0.1, math.pi), ("contacts", 1, 100)):
        value = getattr(kind, name)
        _must(low <= value <= high, f"{name} {value:g} is not in {low:g} to {high:g}")
    _must(kind.camera.distance > 0 and kind.camera.seconds > 0, "camera: numbers above 0")
    _must(np.isfinite(kind.home).all(), "home: not a number")
    return (f"{kind.speed:g} m/s, {'flies' if kind.flies else 'on the ground'}, slopes to "
            f"{math.degrees(kind.max_slope):.0f} degrees")


def _model(trial: _Trial) -> str:
    kind, model = trial.kind, trial.model
    _must(model.nbody > 1 and model.body(1).name == kind.base, f"{kind.base} is not the first body")
    free = model.jnt_type == mujoco.mjtJoint.mjJNT_FREE
    _must(model.njnt > 0 and free[0], f"{kind.base} has no free joint")
    hinges = np.isin(model.jnt_type[1:], (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE))
    _must(hinges.all(), "joints beyond the first must be hinges or slides")
    _must((model.body_rootid[1:] == 1).all(), "more than one tree of bodies")
    _must(model.nq == 7 + len(kind.home), f"home has {len(kind.home)} angles for {model.nq - 7}")
    _must(model.nu > 0, "no actuator")
    _must(model.actuator_ctrllimited.all(), "an actuator has no ctrlrange")
    low, high = model.actuator_ctrlrange.T
    _must((high > low).all(), "an actuator's ctrlrange is empty")
    _must(model.neq == 0, "equality constraints carry it")
    _must(not model.body_gravcomp.any(), "gravity is compensated")
    _must(not model.geom_margin.any(), "a geom has a margin, which MJX has not on height fields")
    bits = set(zip(model.geom_contype.tolist(), model.geom_conaffinity.tolist(), strict=True))
    _must(bits <= {(0, 1), (2, 2), (0, 0)},
          "contype/conaffinity other than 0/1 (foot or wheel), 2/2 (hull) and 0/0 (seen only)")
    _must(_feet(model).any(), "nothing touches the ground (contype 0, conaffinity 1)")
    types = set(model.geom_type[_feet(model)].tolist())
    _must(types == {int(mujoco.mjtGeom.mjGEOM_SPHERE)}, "what touches the ground must be spheres")
    _must(trial.scene.model.nq == model.nq, "does not fit into a scene")
    return f"{model.body_mass.sum():.1f} kg, {model.nq - 7} joints, {model.nu} actuators"


def _feet(model: mujoco.MjModel) -> np.ndarray:
    """[geoms] bool, those that touch the ground."""
    return (model.geom_contype == 0) & (model.geom_conaffinity == 1)


def _starts(trial: _Trial) -> str:
    """Its feet are on the ground at home, not in it, and within the footprint."""
    kind, model = trial.kind, trial.model
    data = mujoco.MjData(model)
    data.qpos[:] = np.concatenate([[0, 0, kind.spawn_height, 1, 0, 0, 0], kind.home])
    mujoco.mj_forward(model, data)
    feet = _feet(model)
    gaps = data.geom_xpos[feet, 2] - model.geom_size[feet, 0]
    _must(-SINK <= gaps.min() <= GAP, f"at spawn_height its feet are {gaps.min():+.3f} m "
          f"from the ground; {-SINK:g} to {GAP:g} m")
    reach = np.linalg.norm(data.geom_xpos[feet][gaps < GAP, :2], axis=1).max()
    _must(kind.footprint - 0.25 < reach < kind.footprint + 0.1,
          f"footprint is {kind.footprint:g} m, feet reach {reach:.2f} m")
    return f"feet {1000 * gaps.min():.1f} mm from the ground, out to {reach:.2f} m"


def _stands(trial: _Trial) -> str:
    drive = trial.stood
    moved = float(np.linalg.norm(drive.qpos[-1, :2] - trial.scene.qpos0[:2]))
    tilt = float(drive.tilt.max())
    _must(moved < SETTLED, f"told to hold its place it moved {moved:.2f} m in {STAND_SECONDS:g} s")
    _must(tilt < UPRIGHT, f"tilted {math.degrees(tilt):.0f} degrees")
    return (f"{STAND_SECONDS:g} s: moved {1000 * moved:.0f} mm, tilted at most "
            f"{math.degrees(tilt):.0f} degrees")


def _goes(trial: _Trial) -> str:
    kind, drive = trial.kind, trial.went
    along = drive.qpos[:, 0] - trial.scene.qpos0[0]
    left = np.hypot(along - WAY, drive.qpos[:, 1] - trial.scene.qpos0[1])
    tilt = float(drive.tilt.max())
    _must(tilt < kind.fall_tilt, f"fell after {along[drive.tilt.argmax()]:.1f} m")
    there = np.flatnonzero(left < ARRIVED)
    seconds = len(drive.qpos) * CONTROL_PERIOD
    _must(there.size, f"came {along.max():.2f} m of {WAY:g} in {seconds:.0f} s")
    _must(left[-1] < 2 * ARRIVED,
          f"did not stay at its goal: {left[-1]:.2f} m away {REST_SECONDS:g} s later")
    _must(drive.tilt[-1] < UPRIGHT,
          f"came to rest tilted {math.degrees(drive.tilt[-1]):.0f} degrees")
    seconds = (int(there[0]) + 1) * CONTROL_PERIOD
    return (f"{WAY:g} m in {seconds:.1f} s, {WAY / seconds:.2f} m/s; tilted at most "
            f"{math.degrees(tilt):.0f} degrees")


def _limits(trial: _Trial) -> str:
    """Controls within ctrlrange, forces within forcerange, while it stood and went."""
    model = trial.scene.model
    low, high = model.actuator_ctrlrange.T
    slack = 1e-5 * (high - low)  # single precision
    force_low, force_high = np.where(model.actuator_forcelimited, model.actuator_forcerange.T,
                                     [[-np.inf], [np.inf]])
    share = 0.0
    for drive in (trial.stood, trial.went):
        _must(np.isfinite(drive.ctrl).all(), "controls are not all numbers")
        over = (drive.ctrl < low - slack) | (drive.ctrl > high + slack)
        _must(not over.any(), f"actuator {model.actuator(int(over.any(0).argmax())).name} is asked "
              "for more than its ctrlrange")
        _must(((drive.force >= force_low - 1e-9) & (drive.force <= force_high + 1e-9)).all(),
              "an actuator gives more than its forcerange")
        share = max(share, float((np.abs(drive.ctrl) / np.maximum(-low, high)).max()))
    _must(share > 0.0, "no actuator was used")
    return f"at most {100 * share:.0f} % of what they may be asked for"


def _survives(trial: _Trial) -> str:
    """Random states, tumbling, underground, not a number: finite controls within the limits."""
    kind, model = trial.kind, trial.model
    states, qpos, qvel = _standing(kind, model, STATES)
    rng = np.random.default_rng(0)
    qpos[1:] += rng.normal(0.0, 3.0, (STATES - 1, model.nq)).astype(np.float32)
    qvel[1:] += rng.normal(0.0, 5.0, (STATES - 1, model.nv)).astype(np.float32)
    start = jnp.asarray(qpos), jnp.asarray(qvel)  # before the bad numbers come
    states = jax.vmap(kind.init)(*start)
    qpos[1], qvel[2], qpos[3, 3:7] = np.nan, np.inf, 0.0
    lost = np.arange(STATES) % 7 == 6
    commands = _asked(rng.normal(0.0, 9.0, (STATES, 2)).astype(np.float32),
                       rng.uniform(-1.0, 3.0, STATES).astype(np.float32), lost)
    ctrl, _, told = _batched(kind)(states, jnp.float32(0.1), qpos, qvel, commands, _level())
    ctrl = np.asarray(ctrl)
    _must(np.isfinite(ctrl).all(), "some controls are not numbers; see jnp.nan_to_num")
    low, high = model.actuator_ctrlrange.astype(np.float32).T
    _must(((ctrl >= low) & (ctrl <= high)).all(), "some controls are beyond their ctrlrange")
    _must(not ctrl[lost].any(), "a lost robot's controls are not 0")
    _must((np.asarray(told.power)[4:] >= 0.0).all(), "power below 0 is told")
    return f"{STATES} states, not-a-number included: controls finite and within limits"


def _batches(trial: _Trial) -> str:
    """Jitted over B worlds as one by one, and a state that a scan can carry."""
    kind, model = trial.kind, trial.model
    states, qpos, qvel = _standing(kind, model, TWINS)
    qpos[:, :2] += np.linspace(0.0, 0.3, TWINS)[:, None]
    goals = np.stack([np.linspace(1.0, 4.0, TWINS), np.ones(TWINS)], axis=1)
    commands = _asked(goals.astype(np.float32), np.full(TWINS, kind.speed, np.float32),
                       np.zeros(TWINS, bool))
    together, after, told = _batched(kind)(
        states, jnp.float32(0.1), qpos, qvel, commands, _level())
    for part, shape in ((together, (TWINS, model.nu)), (told.power, (TWINS,)),
                        (told.propellant, (TWINS,))):
        _must(part.shape == shape, f"batched, an output has shape {part.shape}, not {shape}")
    before, later = (jax.tree.map(lambda a: (a.shape, a.dtype), s) for s in (states, after))
    _must(before == later, "the state changes its shapes or types from step to step")
    apart = 0.0
    span = float((model.actuator_ctrlrange[:, 1] - model.actuator_ctrlrange[:, 0]).max())
    for i in range(TWINS):
        alone, *_ = trial.control(jax.tree.map(lambda a, i=i: a[i], states), jnp.float32(0.1),
                                  qpos[i], qvel[i], jax.tree.map(lambda a, i=i: a[i], commands),
                                  _level())
        apart = max(apart, float(np.abs(np.asarray(together[i]) - np.asarray(alone)).max()) / span)
    _must(apart < 1e-4, f"batched and single controls are {100 * apart:.2g} % apart")
    return f"jits and vmaps; {TWINS} at once as one by one to {100 * apart:.2g} % of their range"


def _engines(trial: _Trial) -> str:
    """C MuJoCo and MJX drive the same way for a while."""
    kind, scene, steps = trial.kind, trial.scene, round(ENGINE_SECONDS / CONTROL_PERIOD)
    ends = []
    for engine in (NativeBackend(scene, threads=1), MjxBackend(scene)):
        commands = tuple(c._replace(xy=c.xy + jnp.array([[4.0, 0.0]]),
                                    speed=jnp.full(1, kind.speed)) for c in hold(scene, 1))
        state, log = engine.advance(engine.reset(), commands, steps)
        _must(not np.asarray(state.diverged).any(), f"blows up in {engine.name}")
        ends.append(np.asarray(log.qpos)[0, :, :3])
    apart = float(np.linalg.norm(ends[0] - ends[1], axis=1).max())
    _must(apart < DRIFT, f"native and mjx are {1000 * apart:.0f} mm apart after "
          f"{ENGINE_SECONDS:g} s; at most {1000 * DRIFT:.0f}")
    return f"native and mjx {1000 * apart:.1f} mm apart in {ENGINE_SECONDS:g} s (at most " \
           f"{1000 * DRIFT:.0f})"


def _asked(xy: Any, speed: Any, lost: Any) -> Command:
    """A command of host arrays, which jitted controllers take as well."""
    return Command(xy, speed, lost)


def _standing(kind: RobotKind, model: mujoco.MjModel, count: int):
    """Controller states, qpos [count, nq] and qvel [count, nv], all standing at the origin."""
    pose = np.concatenate([[0, 0, kind.spawn_height, 1, 0, 0, 0], kind.home]).astype(np.float32)
    qpos, qvel = np.tile(pose, (count, 1)), np.zeros((count, model.nv), np.float32)
    return jax.vmap(kind.init)(jnp.asarray(qpos), jnp.asarray(qvel)), qpos, qvel


def _batched(kind: RobotKind):
    return jax.jit(jax.vmap(kind.control, (0, None, 0, 0, 0, None)))


def _level() -> Surface:
    return Surface(jnp.zeros((33, 33)), SPACING)


CHECKS: dict[str, Callable[[_Trial], str]] = {
    "fields": _fields, "model": _model, "start": _starts, "stands": _stands, "goes": _goes,
    "limits": _limits, "survives": _survives, "batches": _batches, "engines": _engines}
"""By name, what the kind is asked, in order."""
