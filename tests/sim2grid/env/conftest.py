"""Missions of the environment: driven by the engine, or, for the logic alone, by sliding points."""

import msgspec
import numpy as np
import pytest

from moonteam.problem import mission as missions
from sim2grid.env import session
from sim2grid.env.mission import MoonMission
from sim2grid.frame import Frame


def make_mission(robots, targets, max_seconds=60.0, events=()):
    """By the clock, on 8 x 8 cells of level ground; mappings as in a mission file."""
    return missions.check(msgspec.convert({
        "name": "trial", "clock": "seconds", "max_seconds": max_seconds,
        "map": {"size": [8, 8], "cell_m": 1.0}, "site": {"preset": "mare", "seed": 3},
        "robots": robots, "targets": targets, "events": list(events)}, missions.Mission), "test")


DRONES = [{"name": "a", "kind": "drone", "skills": ["A"], "start": [1, 1]},
          {"name": "b", "kind": "drone", "skills": ["B"], "start": [6, 1], "home": [6, 1]}]
TARGETS = [{"name": "far", "at": [1, 6], "skills": ["A"], "service": 3},
           {"name": "both", "at": [4, 4], "skills": ["A", "B"], "type": "AND"}]


@pytest.fixture(scope="session")
def mission():
    return make_mission


@pytest.fixture(scope="session")
def drones():
    """Two of them and two targets, one of which needs both."""
    return make_mission(DRONES, TARGETS)


@pytest.fixture
def on_points(monkeypatch, sliding):
    """An environment whose robots slide to where they are sent."""
    def made(*specs, **options):
        def engine(name, scene):
            spec = specs[0]
            frame = Frame(spec.map.size, spec.map.cell_m)
            return sliding(frame.centre(np.array([r.start for r in spec.robots], float)))

        monkeypatch.setattr(session, "make_backend", engine)
        return MoonMission(specs[0] if len(specs) == 1 else specs, **options)

    return made
