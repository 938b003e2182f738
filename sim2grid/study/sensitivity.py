"""How success and mission seconds depend on ground, grip, localisation and delay.

One quantity is varied at a time, the others keep their usual value, the missions their numbers:

- slope: a plane of so many degrees, rising to the east, is added to the ground.
- boulders: as many times the boulders of the preset, the further ones taken from its other seeds.
- friction: between ground and wheels or feet.
- noise: m, standard deviation, each axis, of the error of a robot's position in all that the
  executor sees and the waypoints that it sends: a first-order Gauss-Markov process of
  `NOISE_TIME_S`, so that a robot drives to where it believes the waypoint to be. The physics, the
  log and whether a target is truly reached know nothing of it.
- delay: s, after which a command reaches the controllers.

Legend: B rows of the engine, R robots, T samples.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import numpy.typing as npt

from moonteam import trees
from moonteam.errors import InputError
from moonteam.planners.base import Planner
from moonteam.report.intervals import Bootstrap, wilson
from moonteam.robots.base import CONTROL_PERIOD, Command
from moonteam.terrain.site import Boulder, make_site
from moonteam.terrain.site import Site as Ground
from sim2grid.loop.asked import Route
from sim2grid.loop.drive import Backend
from sim2grid.loop.execution import Execution
from sim2grid.measure.slip import ground_height
from sim2grid.study.evaluation import Contender, Evaluation, Group, Row
from sim2grid.study.fleet import Fleet, Recipe, make_fleet
from sim2grid.study.summary import failures

Quantity = Literal["slope", "boulders", "friction", "noise", "delay"]

NOISE_TIME_S = 10.0
"""Correlation time of the position error, s."""


@dataclass(frozen=True)
class Sweep:
    """What is varied: its unit, the value that it has in all the other sweeps, the values."""

    label: str
    usual: float
    values: tuple[float, ...]


SWEEPS: dict[Quantity, Sweep] = {
    "slope": Sweep("added slope, degrees", 0.0, (0.0, 5.0, 10.0, 15.0)),
    "boulders": Sweep("boulders, times the preset's", 1.0, (0.0, 1.0, 8.0, 32.0)),
    "friction": Sweep("friction", 0.75, (0.15, 0.3, 0.5, 0.75, 1.0)),
    "noise": Sweep("position error, m", 0.0, (0.0, 0.1, 0.2, 0.4, 0.8)),
    "delay": Sweep("delay of commands, s", 0.0, (0.0, 0.2, 0.5, 1.0, 2.0)),
}


@dataclass(frozen=True)
class Setting:
    """One point of a curve."""

    quantity: Quantity
    value: float

    @property
    def key(self) -> str:
        """Names the setting; the usual one has one name whatever was to be varied."""
        usual = self.value == SWEEPS[self.quantity].usual
        return "usual" if usual else f"{self.quantity} {self.value:g}"


def settings(quantities: Sequence[Quantity]) -> list[Setting]:
    """All points of the curves of these quantities."""
    return [Setting(quantity, value) for quantity in quantities
            for value in SWEEPS[quantity].values]


def run_setting(setting: Setting, recipe: Recipe, count: int, contenders: Sequence[Contender], *,
                seed: int, width: int, done: dict[tuple[str, int], Row],
                keep: Callable[[Row], None]) -> str:
    """Runs the missions of one setting that are not `done`; returns why there are none, or "".

    `keep` is called with each new row.
    """
    evaluation = Evaluation([recipe], count, contenders, seed, width, keep=keep,
                            rows=dict(done), label=f"{setting.key}: ")
    try:
        fleet = make_fleet(recipe, count, changed_ground(setting))
    except InputError as error:
        return str(error.problem)
    if setting.quantity == "friction":
        set_friction(fleet, setting.value)
    _Shaken(evaluation, fleet, setting).run()
    return ""


class _Shaken(Group):
    """The missions of a site under a setting."""

    def __init__(self, evaluation: Evaluation, fleet: Fleet, setting: Setting):
        super().__init__(evaluation, fleet, 0)
        self._setting = setting

    def _execution(self, contender: Contender, make: Callable[[], Planner], k: int,
                   route: Route | None) -> Execution:
        if self._setting.quantity != "noise" or self._setting.value == 0.0:
            return super()._execution(contender, make, k, route)
        fleet = self._fleet
        return NoisyExecution(
            fleet.missions[k], fleet.scenarios[k], make(), fleet.bodies, fleet.frame,
            seed=self._seed(k), mode=contender.mode, route=route, noise_m=self._setting.value)

    def _backend(self, name: str) -> Backend:
        engine = super()._backend(name)
        if self._setting.quantity == "delay" and not isinstance(engine, DelayedBackend):
            engine = self._engines[name] = DelayedBackend(engine, self._setting.value)
        return engine


def changed_ground(setting: Setting) -> Callable[[Ground], Ground]:
    """What a setting does to a site."""
    if setting.quantity == "slope":
        return lambda ground: tilted(ground, math.radians(setting.value))
    if setting.quantity == "boulders":
        return lambda ground: strewn(ground, setting.value)
    return lambda ground: ground


def tilted(ground: Ground, angle: float) -> Ground:
    """The site with a plane added that rises to the east by `angle` rad."""
    rise = math.tan(angle)
    columns = ground.heights.shape[1]
    east = (np.arange(columns) - (columns - 1) / 2) * ground.spacing
    heights = (ground.heights + rise * east[None, :]).astype(np.float32)
    boulders = tuple(replace(b, centre=b.centre + np.array([0.0, 0.0, rise * b.centre[0]]))
                     for b in ground.boulders)
    return replace(ground, heights=heights, boulders=boulders)


def strewn(ground: Ground, times: float) -> Ground:
    """The site with `times` as many boulders: its own, then those of other seeds in turn.

    Of the last seed a share is taken, the largest left out first. Each keeps its depth in the
    ground.
    """
    ny, nx = ground.heights.shape
    extent = ((nx - 1) * ground.spacing, (ny - 1) * ground.spacing)
    here = ground_height(ground.heights, ground.spacing)
    chosen: list[Boulder] = []
    for index in range(math.ceil(times)):
        other = ground if index == 0 else make_site(
            ground.name, ground.seed + 1000 * index, extent, ground.spacing)
        there = ground_height(other.heights, other.spacing)
        small_first = sorted(other.boulders, key=lambda b: b.radius)
        for boulder in small_first[:round(min(times - index, 1.0) * len(small_first))]:
            xy = boulder.centre[:2]
            shift = float(here(xy) - there(xy))
            chosen.append(replace(boulder, centre=boulder.centre + np.array([0.0, 0.0, shift])))
    return replace(ground, boulders=tuple(chosen))


def set_friction(fleet: Fleet, friction: float) -> None:
    """Sets the sliding friction of ground and boulders, which decides all their contacts."""
    model = fleet.scene.model
    for geom in range(model.ngeom):
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom) or ""
        if name == "ground" or name.startswith("boulder"):
            model.geom_friction[geom, 0] = friction


class NoisyExecution(Execution):
    """An execution that takes every robot to be where it is not.

    Targets are solved by where the robots truly are.
    """

    def __init__(self, *given: Any, noise_m: float, **options: Any):
        super().__init__(*given, **options)
        self.noise_m = noise_m
        self._random = np.random.default_rng([self.asked.seed, 77])
        self._error = self._random.normal(scale=noise_m, size=(len(self.asked.bodies), 2))

    def observe(self, qpos: npt.NDArray, power: npt.NDArray, propellant: npt.NDArray,
                period: float = CONTROL_PERIOD) -> None:
        """As without noise; the error drifts a little between two looks."""
        held = math.exp(-period * len(qpos) / NOISE_TIME_S)
        fresh = self._random.normal(scale=self.noise_m, size=self._error.shape)
        self._error = held * self._error + math.sqrt(1.0 - held * held) * fresh
        super().observe(qpos, power, propellant, period)

    def commands(self) -> list[tuple[npt.NDArray, float, bool]]:
        """Waypoints as the robots come to them: off by their error."""
        return [(point - self._error[i], speed, lost)
                for i, (point, speed, lost) in enumerate(super().commands())]

    def _positions(self, qpos: npt.NDArray) -> npt.NDArray:
        poses = super()._positions(qpos)
        poses[:, :, :2] += self._error
        return poses

    def _places(self) -> tuple[npt.NDArray, npt.NDArray[np.int32]]:
        xy = np.nan_to_num(self.known.xy - self._error)
        return xy, self.asked.frame.cell(xy)


class DelayedBackend:
    """A backend whose controllers get each command `seconds` later; until then what came before,
    or at a mission's start: hold your place.
    """

    def __init__(self, engine: Backend, seconds: float):
        self._engine = engine
        self.log_every = engine.log_every
        steps = round(seconds / CONTROL_PERIOD / self.log_every)
        self.delay_s = steps * self.log_every * CONTROL_PERIOD
        self._late = steps  # samples of the log
        self._sent: deque[tuple[Command, ...]] = deque()  # one a sample, the oldest first

    def reset(self, qpos: Any = None, batch: int = 1) -> Any:
        """As the engine's."""
        return self._engine.reset(qpos, batch)

    def advance(self, state: Any, commands: tuple[Command, ...], num_control_steps: int
                ) -> tuple[Any, Any]:
        """As the engine's, with the commands of a while ago."""
        fresh = np.asarray(state.time) <= 0.0
        hold = tuple(
            Command(xy=jnp.where(fresh[:, None], self._places(state, i), command.xy),
                    speed=jnp.where(fresh, 0.0, command.speed), lost=command.lost)
            for i, command in enumerate(commands))
        if not self._sent:
            self._sent.extend([hold] * self._late)
        elif fresh.any():
            mixed = {id(old): trees.where(fresh, hold, old) for old in self._sent}
            self._sent = deque(mixed[id(old)] for old in self._sent)
        self._sent.extend([commands] * (num_control_steps // self.log_every))
        logs, left = [], num_control_steps // self.log_every
        while left:
            due = self._sent[0]
            run = 0
            while run < left and self._sent[0] is due:
                self._sent.popleft()
                run += 1
                if not self._sent:
                    break
            state, log = self._engine.advance(state, due, run * self.log_every)
            logs.append(log)
            left -= run
        return state, jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=1), *logs)

    def _places(self, state: Any, robot: int) -> jax.Array:
        """Where a robot stands in every row, [B, 2] m."""
        base = self._engine.scene.robots[robot].qpos.start  # pyright: ignore
        return jnp.asarray(np.asarray(state.qpos)[:, base:base + 2], jnp.float32)


def point(rows: Sequence[Row], seed: int) -> dict[str, Any]:
    """Success with its Wilson interval, seconds of the missions that succeeded with their
    bootstrap interval, causes of failure with mission numbers.
    """
    won = [row for row in rows if row.report.success]
    found: dict[str, Any] = {"missions": len(rows), "solved": len(won), "success": None,
                             "seconds": None, "failures": failures(rows),
                             "intervals": {"success": [None, None], "seconds": [None, None]}}
    if rows:
        found["success"] = len(won) / len(rows)
        found["intervals"]["success"] = [round(end, 4) for end in wilson(len(won), len(rows))]
    if won:
        mean = Bootstrap(len(won), seed).mean([row.report.seconds for row in won])
        found["seconds"] = round(mean.value, 4)
        found["intervals"]["seconds"] = [round(mean.low, 4), round(mean.high, 4)]
    return found
