"""The example that steps missions: a bundled policy takes the seconds of its rollout."""

import importlib.util
from pathlib import Path

import pytest

import moonteam

FILE = Path(__file__).parents[2] / "examples" / "mission_env.py"
MISSION = """
name: pair
clock: seconds
max_seconds: 60
map: {size: [8, 8], cell_m: 1.0}
site: {preset: mare, seed: 3}
robots:
  - {name: hopper, kind: drone, skills: [A], start: [2, 2]}
  - {name: other, kind: drone, skills: [B], start: [5, 2]}
targets:
  - {name: one, at: [3, 4], skills: [A, B], type: AND}
  - {name: two, at: [6, 5], skills: [A]}
"""


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("mission_env", FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def mission(tmp_path_factory):
    path = tmp_path_factory.mktemp("mission") / "pair.yaml"
    path.write_text(MISSION)
    return path


def test_by_a_policy_and_by_chance(example, mission, tmp_path):
    env = moonteam.make("MoonMission-v0", mission=mission)
    driven = moonteam.rollout(mission, "policy", policy="any_team_mappo", backend="native",
                              out=tmp_path / "run")
    state, seconds, success = example.play(env, "policy", policy="any_team_mappo")
    assert success == driven.success is True
    assert env.report(state).seconds == driven.seconds == pytest.approx(seconds, abs=1e-3)

    state, seconds, success = example.play(env, seed=1)
    assert seconds <= 60
    assert env.report(state).success == success
    for t, row in enumerate(state.history[:int(state.count)].tolist()):
        assert all(0 <= action <= env.num_targets for action in row), t
