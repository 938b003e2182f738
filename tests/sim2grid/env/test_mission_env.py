"""Missions in physics as an environment: as `rollout` drives them, and a pure function of data."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import moonteam
from moonteam.problem.rules import centre
from sim2grid.env import session

KEY = jax.random.key(0)


def joint(env, *actions):
    return {agent: jnp.int32(action) for agent, action in zip(env.agents, actions, strict=True)}


def test_the_same_choices_take_the_same_seconds_as_a_rollout(mission, tmp_path):
    """The engine itself: the planner of a rollout asked in the environment, then its choices."""
    spec = mission(
        [{"name": "hopper", "kind": "drone", "skills": ["A"], "start": [6, 1], "home": [6, 1]},
         {"name": "rover", "kind": "wheeled", "skills": ["B"], "start": [2, 2]}],
        [{"name": "one", "at": [3, 4], "skills": ["A", "B"], "type": "AND", "service": 2},
         {"name": "two", "at": [6, 5], "skills": ["A"], "appears": 4}],
        events=[{"at_s": 3, "target": {"name": "news", "at": [2, 5.5], "skills": ["B"]}}])
    driven = moonteam.rollout(spec, "greedy", backend="native", out=tmp_path / "run")
    assert driven.success

    env = moonteam.make("MoonMission-v0", mission=spec)
    keeper = env.keeper("greedy")
    _, state = env.reset(KEY)
    rewards, done = 0.0, False
    while not done:
        actions = env.actions(keeper.act(env.moment(state)))
        _, state, paid, dones, infos = env.step_env(KEY, state, actions)
        rewards, done = rewards + float(paid["agent_0"]), bool(dones["__all__"])
    assert infos["success"].tolist() == [True, True]
    report = env.report(state, "greedy")
    assert report.seconds == driven.seconds
    assert report.decisions == driven.report.decisions == int(state.count) >= 3
    assert [t.time_s for t in report.targets] == [t.time_s for t in driven.targets]
    assert [r.energy_j for r in report.robots] == [r.energy_j for r in driven.robots]
    for name in ("qpos", "power"):
        theirs, ours = (np.concatenate(getattr(r, name))
                        for r in (driven.record, env.execution(state).record))
        np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_allclose(-rewards * env.unit_s, driven.seconds, rtol=1e-5)

    taken = np.asarray(state.history)[:int(state.count)]

    @jax.jit
    def again(choices):
        def one(state, row):
            _, state, _, _, infos = env.step_env(KEY, state, joint(env, *row))
            return state, infos["seconds"][0]

        return jax.lax.scan(one, env.reset(KEY)[1], choices)

    end, seconds = again(taken)
    assert bool(end.seen.success)
    assert float(end.seen.now) == float(state.seen.now)
    np.testing.assert_allclose(np.asarray(seconds).sum(), driven.seconds, rtol=1e-5)


def test_a_state_can_be_branched_from(on_points, drones):
    env = on_points(drones)
    _, start = env.reset(KEY)

    def go(state, *actions):
        return env.step_env(KEY, state, joint(env, *actions))

    wait, home = env.num_targets, env.num_targets + 1
    first = go(start, 0, wait)
    then = go(first[1], 1, 1)
    other = go(first[1], wait, home)
    assert float(then[1].seen.now) != float(other[1].seen.now)
    jax.tree.map(np.testing.assert_array_equal, go(first[1], 1, 1), then)
    jax.tree.map(np.testing.assert_array_equal, go(start, 0, wait), first)

    both = jax.jit(jax.vmap(lambda state, a, b: env.step_env(
        KEY, state, {"agent_0": a, "agent_1": b})[1], in_axes=(None, 0, 0)))(
            first[1], jnp.array([1, wait]), jnp.array([1, home]))
    for i, (_, alone, *_) in enumerate((then, other)):
        jax.tree.map(lambda x, y, i=i: np.testing.assert_array_equal(x[i], y), both, alone)


def test_what_may_be_done_and_what_is_not_goes_on(on_points, drones):
    env = on_points(drones)
    observations, state = env.reset(KEY)
    may = {a: m.astype(int).tolist() for a, m in env.get_avail_actions(state).items()}
    assert may == {"agent_0": [1, 1, 1, 0], "agent_1": [0, 1, 1, 1]}, "skills, waiting, home"
    for agent, seen in observations.items():
        assert seen.shape == env.observation_space(agent).shape
        assert bool(env.observation_space(agent).contains(seen))
    # b has no skill for target 0 and goes on with waiting; a serves alone.
    _, state, rewards, _, infos = env.step_env(KEY, state, joint(env, 0, 0))
    assert state.history[0].tolist() == [0, 2]
    assert state.seen.problem.target_mask.tolist() == [False, True]
    np.testing.assert_allclose(rewards["agent_1"], -infos["seconds"][0] / env.unit_s, rtol=1e-6)
    assert float(infos["seconds"][0]) > 3.0, "its service"


def test_nobody_waits_for_ever(on_points, drones):
    """One waits for the other, who waits for nothing: after a while both are asked again."""
    env = on_points(drones, max_decisions=2)
    _, state = env.reset(KEY)
    way = np.linalg.norm(centre(np.array([4.0, 4.0]), (8, 8), 1.0)
                         - centre(np.array([1.0, 1.0]), (8, 8), 1.0))
    _, state, _, dones, infos = env.step_env(KEY, state, joint(env, 1, 2))
    seconds = float(infos["seconds"][0])
    assert session.STILL_S < seconds < session.STILL_S + way / 0.5 + 5.0
    assert not bool(dones["__all__"])
    _, state, _, dones, infos = env.step_env(KEY, state, joint(env, 1, 2))
    assert bool(dones["__all__"])
    assert infos["truncated"].tolist() == [True, True], "max_decisions"
    before = state
    _, state, rewards, dones, _ = env.step_env(KEY, state, joint(env, 1, 1))
    assert bool(dones["__all__"])
    assert float(rewards["agent_0"]) == 0.0
    jax.tree.map(np.testing.assert_array_equal, state, before)


def test_failing_costs_all_the_time_there_is(on_points, mission, drones):
    spec = mission([{"name": "a", "kind": "drone", "skills": ["A"], "start": [1, 1]}],
                   [{"at": [1, 3], "skills": ["A"]},
                    {"at": [6, 6], "skills": ["A"], "lapses": 2}], max_seconds=40)
    env = on_points(spec)
    _, state = env.reset(KEY)
    paid, done = 0.0, False
    while not done:
        _, state, rewards, dones, infos = env.step_env(KEY, state, joint(env, 0))
        paid, done = paid + float(rewards["agent_0"]), bool(dones["__all__"])
    assert infos["terminated"].tolist() == [True]
    assert infos["success"].tolist() == [False]
    assert float(state.seen.now) < 20
    np.testing.assert_allclose(paid, -40 / env.unit_s, rtol=1e-6)
    again = env.step(KEY, state, joint(env, 0))[1]
    assert int(again.count) == 0, "a new episode"


def test_several_missions_are_drawn_from(on_points, mission, drones):
    other = mission([{"name": "x", "kind": "drone", "skills": ["C"], "start": [1, 1]},
                     {"name": "y", "kind": "drone", "skills": ["A"], "start": [6, 1]}],
                    [{"at": [3, 3], "skills": ["C"]}])
    env = on_points(drones, other)
    assert env.num_targets == 2
    drawn = jax.vmap(lambda key: env.reset(key)[1].mission)(jax.random.split(KEY, 32))
    assert set(drawn.tolist()) == {0, 1}
    state = next(s for s in (env.reset(jax.random.key(k))[1] for k in range(32)) if s.mission == 1)
    may = {a: m.astype(int).tolist() for a, m in env.get_avail_actions(state).items()}
    assert may == {"agent_0": [1, 0, 1, 0], "agent_1": [0, 0, 1, 0]}
    _, state, *_ = env.step_env(KEY, state, joint(env, 0, 2))
    assert bool(state.seen.success)
    alone = mission([{"name": "a", "kind": "drone", "skills": ["A"], "start": [1, 1]}],
                    [{"at": [1, 3], "skills": ["A"]}])
    with pytest.raises(moonteam.InputError, match="2, 1"):
        on_points(drones, alone)
    with pytest.raises(moonteam.InputError, match="native or mjx"):
        moonteam.make("MoonMission-v0", mission=drones, backend="fused")
