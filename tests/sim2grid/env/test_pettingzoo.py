"""PettingZoo's own test over every environment that has its face."""

import numpy as np
import pytest

import moonteam
from moonteam.grid import EnvConfig
from moonteam.grid.macro.draw import Draw

CONFIG = EnvConfig(num_agents=2, num_targets=2, width=4, height=4, max_steps=6)


@pytest.fixture
def made(on_points, drones):
    pytest.importorskip("pettingzoo")

    def one(name):
        from moonteam.grid import pettingzoo_face

        if name == "MoonGrid-v0":
            return moonteam.make(name, face="pettingzoo", config=CONFIG)
        if name == "MoonMacro-v0":
            family = Draw(agents=(2, 3), targets=(2, 3))
            return moonteam.make(name, face="pettingzoo", family=family)
        return pettingzoo_face.parallel(on_points(drones, max_decisions=4), name)

    return one


@pytest.mark.parametrize("name", ["MoonGrid-v0", "MoonMacro-v0", "MoonMission-v0"])
def test_pettingzoos_own_test(made, name):
    from pettingzoo import ParallelEnv
    from pettingzoo.test import parallel_api_test, parallel_seed_test

    env = made(name)
    assert isinstance(env, ParallelEnv)
    assert env.metadata["name"] == name
    parallel_api_test(env, num_cycles=30)
    if name == "MoonGrid-v0":
        parallel_seed_test(lambda: made(name), num_cycles=10)


def test_what_it_says_and_refuses(made):
    env = made("MoonGrid-v0")
    first, infos = env.reset(seed=3)
    again, _ = env.reset(seed=3)
    np.testing.assert_array_equal(first["agent_0"], again["agent_0"])
    other, _ = env.reset()
    assert any((other[a] != again[a]).any() for a in env.agents), "the next of the series"
    assert infos["agent_0"]["action_mask"].shape == (5,)
    with pytest.raises(moonteam.InputError, match=r"actions\[agent_1\].*0 to 4"):
        env.step({"agent_0": 0, "agent_1": 9})
    with pytest.raises(moonteam.InputError, match="agent_1"):
        env.step({"agent_0": 0})
    for t in range(CONFIG.max_steps):
        assert env.agents == ["agent_0", "agent_1"]
        seen, rewards, over, cut, infos = env.step(dict.fromkeys(env.agents, 4))
        assert set(seen) == set(rewards) == {"agent_0", "agent_1"}
        assert cut["agent_0"] == (t == CONFIG.max_steps - 1) == infos["agent_0"]["truncated"]
        assert not over["agent_1"]
    assert env.agents == []
    assert env.step({}) == ({}, {}, {}, {}, {})
    np.testing.assert_array_equal(env.state(), np.concatenate([seen["agent_0"], seen["agent_1"]]))
