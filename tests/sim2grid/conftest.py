"""Stand-ins for tests only: points that slide to their waypoints, planners that read a script.

The product has no such physics; these let the executor's logic be tested without an engine.
"""

from dataclasses import dataclass, field
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from moonteam.problem import mission as missions
from moonteam.problem.scenario import ACTIONS
from moonteam.robots.base import CONTROL_PERIOD
from sim2grid.frame import Frame
from sim2grid.loop.asked import Body
from sim2grid.loop.drive import run
from sim2grid.loop.execution import Execution
from sim2grid.loop.replan import grid_problem


@dataclass
class SlidingPoints:
    """A backend of one world; each robot has a free joint only and slides at its speed.

    `faults`: (robot, from second) -> "still", "tilt", "nan", "slow", "leisurely", "diverge",
    ("drift", vx, vy), or "none", which ends the others; else the first one given holds.
    """

    start: np.ndarray  # [R, 2] m
    faults: dict = field(default_factory=dict)
    traps: list = field(default_factory=list)  # (centre m, radius m) that nobody gets through

    def pose(self) -> np.ndarray:
        qpos = np.zeros((len(self.start), 7))
        qpos[:, :2] = self.start
        qpos[:, 3] = 1.0
        return qpos.ravel()

    log_every = 1

    def reset(self, qpos=None, batch=1):
        return SimpleNamespace(time=0.0, poses=self.pose().reshape(-1, 7),
                               diverged=np.zeros(1, bool))

    def advance(self, state, commands, num_control_steps):
        time, poses = state.time, state.poses
        asked = [(np.asarray(c.xy[0]), float(c.speed[0]), bool(c.lost[0])) for c in commands]
        log = []
        for _ in range(num_control_steps):
            time += CONTROL_PERIOD
            poses = poses.copy()
            for i, command in enumerate(asked):
                self.move(poses[i], i, command, time)
            log.append(poses.ravel())
        flat = np.stack(log)[None]
        ones = np.ones((1, num_control_steps, len(commands)))
        bad = ("diverge" in [w for (_, since), w in self.faults.items() if time >= since])
        after = SimpleNamespace(time=time, poses=poses, diverged=np.array([bad]))
        return after, SimpleNamespace(qpos=flat, power=10 * ones, propellant_rate=0.001 * ones)

    def move(self, pose, robot, command, time):
        goal, speed, lost = command
        active = [what for (i, since), what in self.faults.items() if i == robot and time >= since]
        what = active[0] if active and "none" not in active else None
        if what == "still" or lost:
            return
        if what == "tilt":
            pose[3:7] = np.cos(0.6), np.sin(0.6), 0.0, 0.0  # 68.8 degrees about x
            return
        if what == "nan":
            pose[:] = np.nan
            return
        if isinstance(what, tuple):
            pose[:2] += np.array(what[1:]) * CONTROL_PERIOD
            return
        away = goal - pose[:2]
        step = speed * CONTROL_PERIOD * {"slow": 0.02, "leisurely": 0.3}.get(what, 1.0)
        distance = np.hypot(*away)
        there = pose[:2] + (away if distance <= step else away / distance * step)
        if not any(np.hypot(*(there - centre)) < radius for centre, radius in self.traps):
            pose[:2] = there


class Script:
    """A planner that reads its joint actions from a list of strings such as "right stay"."""

    name = "script"

    def __init__(self, *steps: str):
        self.steps = [[ACTIONS.index(word) for word in step.split()] for step in steps]
        self.seen = []

    def reset(self, snapshot, seed=0):
        self.seen = []

    def act(self, snapshot):
        self.seen.append(snapshot)
        count = len(self.seen) - 1
        row = self.steps[count] if count < len(self.steps) else [4] * len(snapshot.cells)
        return np.array(row, np.int32)


def make_mission(robots, targets, size=(4, 4), cell_m=1.0, **more) -> missions.Mission:
    """robots: "name kind SKILLS x y"; targets: "SKILLS TYPE x y" (a skill is a letter)."""
    value = {
        "map": {"size": size, "cell_m": cell_m},
        "robots": [{"name": n, "kind": k, "skills": list(s), "start": [int(x), int(y)]}
                   for n, k, s, x, y in (r.split() for r in robots)],
        "targets": [{"skills": list(s), "type": t, "at": [int(x), int(y)]}
                    for s, t, x, y in (r.split() for r in targets)],
    }
    return missions.check(msgspec.convert(value | more, missions.Mission), "test")


def run_on_points(spec, planner, *, faults=None, passable=None, speed=0.5, traps=(),
                  light=None, **options) -> Execution:
    """Runs a mission on sliding points to its end."""
    height, width = spec.map.size[1], spec.map.size[0]
    free = {r.kind: np.ones((height, width), bool) for r in spec.robots} | (passable or {})
    frame = Frame(spec.map.size, spec.map.cell_m)
    backend = SlidingPoints(frame.centre(np.array([r.start for r in spec.robots], float)),
                            faults or {}, list(traps))
    bodies = [Body(base=7 * i, speed=speed, flies=r.kind == "drone", light=light)
              for i, r in enumerate(spec.robots)]
    execution = Execution(spec, grid_problem(spec, free), planner, bodies, frame, **options)
    run([execution], backend, backend.pose())
    return execution


@pytest.fixture(scope="session")
def mission():
    return make_mission


@pytest.fixture
def execute():
    return run_on_points


@pytest.fixture
def script():
    return Script


@pytest.fixture
def sliding():
    return SlidingPoints
