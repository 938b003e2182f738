"""Missions by the clock on sliding points, over open ground or ground with a wall."""

from functools import partial

import msgspec
import numpy as np
import pytest

from moonteam.planners.seconds.base import TimedPlan, effort, makespan, timed_again
from moonteam.planners.seconds.keeper import Keeper
from moonteam.problem import mission as missions
from sim2grid.clock.execution import TimedExecution
from sim2grid.clock.roads import OpenGround
from sim2grid.frame import Frame
from sim2grid.loop.asked import Body
from sim2grid.loop.drive import run


class Fixed:
    """Plans that serve targets in a given order, and nothing else."""

    name = "fixed"

    def __init__(self, *order, spare=None):
        self.order, self.spare, self.asked = list(order), spare, []

    def plan(self, moment):
        self.asked.append(moment)
        known = [(j, team) for j, team in self.order if j < len(moment.solved)]
        services = timed_again(moment, known)
        if services is None and self.spare:
            services = timed_again(moment, [self.spare])
        if services is None:
            return TimedPlan(self.name, "makespan", "infeasible", (), None, None, None, 0.0, "no")
        return TimedPlan(self.name, "makespan", "feasible", services, makespan(moment, services),
                         effort(moment, services), None, 0.0)


SPEEDS = {"drone": 2.0, "legged": 0.4, "wheeled": 0.5}


def make_mission(robots, targets, size=(12, 12), **more):
    """Mappings as in a mission file."""
    value = {"clock": "seconds", "map": {"size": size}, "robots": robots, "targets": targets}
    return missions.check(msgspec.convert(value | more, missions.Mission), "test")


def run_by_the_clock(points, spec, *order, spare=None, faults=None, roads=None, traps=(),
                     light=None, chooser=None, **options):
    frame = Frame(spec.map.size, spec.map.cell_m)
    backend = points(frame.centre(np.array([r.start for r in spec.robots], float)),
                            faults or {}, list(traps))
    bodies = [Body(base=7 * i, speed=SPEEDS[r.kind], flies=r.kind == "drone", light=light)
              for i, r in enumerate(spec.robots)]
    keeper = chooser or Keeper(Fixed(*order, spare=spare))
    execution = TimedExecution(spec, spec.scenario(), keeper, bodies, frame,
                               roads or OpenGround(SPEEDS), **options)
    run([execution], backend, backend.pose())
    return execution


@pytest.fixture(scope="session")
def mission():
    return make_mission


@pytest.fixture
def drive(sliding):
    return partial(run_by_the_clock, sliding)
