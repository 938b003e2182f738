"""A robot on a piece of ground, driven by its controller in C MuJoCo."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import jax
import mujoco
import numpy as np
import pytest

from moonteam.physics.scene import Placement, Scene, build_scene
from moonteam.robots.base import CONTROL_PERIOD, PHYSICS_DT, Command, RobotKind
from moonteam.terrain.site import Site

SPACING = 0.25


def command(xy, speed: float, lost: bool = False) -> Command:
    return Command(np.asarray(xy, np.float32), np.float32(speed), np.array(lost))


@dataclass
class Track:
    """What happened at each control step; arrays [steps, ...]."""

    time: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    ctrl: np.ndarray
    power: np.ndarray
    propellant: np.ndarray

    @property
    def tilt(self) -> np.ndarray:
        """rad, base z axis from the vertical."""
        x, y = self.qpos[:, 4], self.qpos[:, 5]
        return np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0))

    def cross_track(self, start, goal) -> np.ndarray:
        """m, distance from the line through start and goal."""
        line = np.subtract(goal, start) / np.linalg.norm(np.subtract(goal, start))
        away = self.qpos[:, :2] - start
        return line[0] * away[:, 1] - line[1] * away[:, 0]


@dataclass
class World:
    """One robot on one ground; `drive` goes on from where it is."""

    kind: RobotKind
    scene: Scene
    control: Callable
    data: mujoco.MjData = field(init=False)

    def __post_init__(self):
        self.data = mujoco.MjData(self.scene.model)
        self.data.qpos[:] = self.scene.qpos0
        mujoco.mj_forward(self.scene.model, self.data)
        self.state = self.kind.init(*self._slices())

    def _slices(self):
        robot = self.scene.robots[0]
        return (self.data.qpos[robot.qpos].astype(np.float32),
                self.data.qvel[robot.qvel].astype(np.float32))

    def drive(self, choose: Callable | Command, seconds: float) -> Track:
        """Runs for `seconds`; `choose` is a command, or a function of qpos that gives one."""
        rows = []
        for _ in range(round(seconds / CONTROL_PERIOD)):
            qpos, qvel = self._slices()
            now = choose if isinstance(choose, Command) else choose(qpos)
            ctrl, self.state, telemetry = self.control(
                self.state, np.float32(self.data.time), qpos, qvel, now, self.scene.surface)
            self.data.ctrl[:] = ctrl
            mujoco.mj_step(self.scene.model, self.data, round(CONTROL_PERIOD / PHYSICS_DT))
            rows.append((self.data.time, *(a.copy() for a in (
                self.data.qpos, self.data.qvel, self.data.ctrl)), *telemetry))
        return Track(*(np.array(column, float) for column in zip(*rows, strict=True)))


@pytest.fixture(scope="session")
def make_world():
    """make_world(kind, heights [ny, nx] m, xy, yaw, boulders) -> World.

    Controllers compile once a kind.
    """
    compiled = {}

    def make(kind: RobotKind, heights, xy=(0.0, 0.0), yaw: float = 0.0, boulders=()) -> World:
        if kind.name not in compiled:
            compiled[kind.name] = jax.jit(kind.control)
        site = Site("test", 0, np.asarray(heights, np.float32), SPACING, tuple(boulders))
        scene = build_scene(site, [Placement("robot", kind, xy, yaw)])
        return World(kind, scene, compiled[kind.name])

    return make


@pytest.fixture(scope="session")
def ground():
    """Grounds of 81 x 81 samples, 20 m x 20 m."""
    return Ground(81)


@dataclass(frozen=True)
class Ground:
    samples: int

    def flat(self) -> np.ndarray:
        return np.zeros((self.samples, self.samples), np.float32)

    def ramp(self, degrees: float) -> np.ndarray:
        """Flat in the west, rising to the east from x = 0."""
        x = (np.arange(self.samples) - self.samples // 2) * SPACING
        rise = np.maximum(x, 0.0) * np.tan(np.deg2rad(degrees))
        return np.tile(rise, (self.samples, 1)).astype(np.float32)

    def rough(self, rms: float, length: float, seed: int) -> np.ndarray:
        """Gaussian relief of `rms` m, smooth over about `length` m."""
        noise = np.random.default_rng(seed).standard_normal((self.samples, self.samples))
        f = np.fft.fftfreq(self.samples, SPACING)
        k = np.hypot(f[:, None], f[None, :])
        relief = np.real(np.fft.ifft2(np.fft.fft2(noise) * np.exp(-2.0 * (k * length) ** 2)))
        return (relief * rms / relief.std()).astype(np.float32)
