"""The batch of environments judges what planners do, and lets new targets appear."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from moonteam.errors import InputError
from moonteam.evaluation import replanning, rollouts
from moonteam.evaluation import world as worlds
from moonteam.evaluation.contenders import Options, Planned, contenders
from moonteam.evaluation.draw import Draw
from moonteam.grid import env
from moonteam.grid.config import EnvConfig
from moonteam.grid.scenarios import generate, to_problem
from moonteam.planners import simulate
from moonteam.planners.base import Snapshot
from moonteam.planners.best_of import prices
from moonteam.planners.decode import parse
from moonteam.planners.learned import LearnedPlanner
from moonteam.policies import policy_file, recurrent
from moonteam.policies.policy import Policy
from moonteam.policies.recurrent import RecurrentSpec
from moonteam.problem import scenario as files

GOLDEN = "tests/golden/certified_optima.jsonl"


@pytest.fixture(scope="module")
def golden():
    found = files.load_set(GOLDEN)
    return [*found[:3], *found[-3:]]  # of unlike sizes: padding is part of the test


def test_replay_is_the_host_replay(golden):
    world = worlds.build(golden)
    rng = np.random.default_rng(0)
    plans = [rng.integers(0, 5, (int(rng.integers(20, 128)), len(s.agents))) for s in golden]
    walk = worlds.replay(world.config, world.start, world.horizon,
                         worlds.joint_actions(world, plans))
    for i, (scenario, plan) in enumerate(zip(golden, plans, strict=True)):
        trace = simulate.replay(Snapshot.start(scenario), plan)
        count = len(scenario.agents)
        assert np.asarray(walk.state.cells)[i, :count].tolist() == trace.cells[-1].tolist()
        assert bool(walk.done[i]) == trace.complete
        assert int(walk.moves[i]) == trace.moves


def test_what_comes_after_the_end_does_not_count(golden):
    world = worlds.build(golden[:1])
    plan = contenders(Options(["exact"]))[0]
    assert isinstance(plan, Planned)
    actions = plan.planner.plan(Snapshot.start(golden[0])).actions
    wasteful = np.concatenate([actions, np.zeros((20, 3), np.int32)])
    walk = worlds.replay(world.config, world.start, world.horizon,
                         worlds.joint_actions(world, [wasteful]))
    assert golden[0].optimal is not None
    assert int(walk.state.step[0]) == golden[0].optimal.makespan
    assert int(walk.moves[0]) == int((actions != 4).sum())


def replanned(count=2, seed=0):
    return worlds.build(Draw(count, seed, num_targets=10).scenarios("r"), num_buffer=5)


def test_exact_replanning_solves_all_ten_and_one_environment_agrees():
    world = replanned()
    planner = contenders(Options(["exact"]))[0]
    assert isinstance(planner, Planned)
    found = planner.run(world)
    assert found.success.all()
    # The same plans, one episode at a time in the plain environment.
    config = EnvConfig(max_steps=128)
    begin = jax.jit(lambda problem, cells: env.reset_to(config, problem, cells)[0])
    step = jax.jit(lambda state, actions: env.step(config, state, actions))
    for i, scenario in enumerate(world.scenarios):
        state = begin(*to_problem(scenario, num_buffer=5))
        solved, moves, actions = 0, 0, []
        single = worlds.build([scenario], num_buffer=5)
        while not bool(state.solved.all()):
            if not len(actions):
                walk = worlds.Walk(jax.tree.map(lambda x: x[None], state),
                                   jnp.zeros(1, jnp.int32), jnp.zeros(1, bool))
                moment = worlds.snapshots(single, walk)[0]
                actions = planner.planner.plan(moment).actions
            out = step(state, jnp.asarray(actions[0]))
            moves += int((actions[0] != 4).sum())
            new = bool(out.newly_solved.any()) and not bool(out.state.solved.all())
            solved += int(out.newly_solved.sum())
            appeared = int(out.state.problem.buffer.used) > int(state.problem.buffer.used)
            assert new or not appeared
            actions = [] if appeared else actions[1:]
            state = out.state
        assert solved == 10
        assert int(state.step) == found.steps[i]
        assert moves == found.moves[i]


def test_every_planner_meets_the_same_new_targets():
    one, other = (Draw(count, 7, num_targets=10).scenarios("r") for count in (3, 5))
    assert one == other[:3]
    assert Draw(3, 8, num_targets=10).scenarios("r") != one


def test_a_target_solved_at_the_start_is_refused():
    scenario = generate(0, num_targets=6)
    first = scenario.targets[0]
    agents = tuple(files.Agent(first.at, ("A", "B")) for _ in scenario.agents)
    started = files.Scenario(size=scenario.size, agents=agents, targets=scenario.targets, id="s")
    with pytest.raises(InputError, match="solved before the first step"):
        replanning.evaluate([started], contenders(Options(["exact"])), 3, 0, "t", "c")


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    spec = RecurrentSpec(num_agents=2, num_targets=2, size=(5, 4), width=8)
    path = tmp_path_factory.mktemp("policy") / "tiny.safetensors"
    config = {"num_agents": 2, "num_targets": 2, "size": [5, 4], "width": 8}
    shapes = jax.eval_shape(lambda key: recurrent.init(spec, key), jax.random.key(0))
    rng = np.random.default_rng(1)
    params = jax.tree.map(lambda x: rng.normal(0, 0.5, x.shape).astype(np.float32), shapes)
    policy_file.save_policy(path, policy_file.PolicyFile("recurrent", config, params))
    return Policy.load(path)


@pytest.fixture(scope="module")
def small():
    return worlds.build([generate(i, num_agents=2, num_targets=2, size=(5, 4), max_steps=90)
                         for i in range(6)])


def test_plain_argmax_is_what_the_planner_does_alone(policy, small):
    tries = rollouts.run(policy, small, parse("plain-argmax"), 0.0, 0, "")
    alone = LearnedPlanner(policy, watch=False)
    for i, scenario in enumerate(small.scenarios):
        now = Snapshot.start(scenario)
        alone.reset(now)
        moves = 0
        while not now.solved.all() and now.step < now.max_steps:
            joint = alone.act(now)
            moves += int((joint != 4).sum())
            now = simulate.step(now, joint)
        assert bool(tries.success[i, 0]) == bool(now.solved.all())
        assert tries.steps[i, 0] == now.step
        assert tries.moves[i, 0] == moves


def test_the_watch_draws_where_argmax_circles(policy, small):
    plain = rollouts.run(policy, small, parse("plain-argmax"), 0.0, 0, "")
    watched = rollouts.run(policy, small, parse("argmax"), 0.0, 0, "")
    assert plain.rescues.sum() == 0
    assert not plain.success.all()  # an untrained policy runs against walls
    assert (watched.rescues[~plain.success] > 0).all()
    assert watched.success.sum() > plain.success.sum()


def test_the_best_does_not_depend_on_the_pool(policy, small, monkeypatch):
    cost = prices("moves")

    def best(decode="best-of-3", **how):
        tries = rollouts.run(policy, small, parse(decode), 0.0, 5, "", cost, **how)
        choice = rollouts.best(tries, cost)
        return [rollouts.picked(v, choice).tolist() for v in (
            tries.success, tries.steps, tries.moves)]

    whole, alone = best(), best(alone=True)
    monkeypatch.setattr(rollouts, "MOST_EPISODES", 5)
    assert best() == whole == alone
    # More tries can only be better, whichever of them were given up.
    many = best("best-of-9")
    assert sum(many[0]) >= sum(whole[0])
    assert all(m <= w for m, w, ok in zip(many[2], whole[2], whole[0], strict=True) if ok)


def test_tries_differ_and_only_the_dear_are_given_up(policy, small):
    free = rollouts.run(policy, small, parse("best-of-4@1.5"), 0.0, 5, "", (0.0, 0.0))
    assert len(set(map(tuple, free.moves.T.tolist()))) == 4
    tight = rollouts.run(policy, small, parse("best-of-4@1.5"), 0.0, 5, "")
    lost = free.success & ~tight.success
    fastest = np.where(free.success, free.steps, 999).min(axis=1, keepdims=True)
    assert (free.steps > fastest)[lost].all()


def test_best_of_prefers_success_then_the_objective():
    tries = rollouts.Tries(
        success=np.array([[False, True, True], [False, False, False]]),
        steps=np.array([[9, 20, 21], [128, 128, 128]]),
        moves=np.array([[1, 40, 30], [7, 5, 6]]), rescues=np.zeros((2, 3), np.int64),
        seconds=0.0, compiling=0.0)
    assert rollouts.best(tries, prices("makespan")).tolist() == [1, 1]
    assert rollouts.best(tries, prices("moves")).tolist() == [2, 1]
    assert rollouts.best(tries, prices("weighted", 1.0, 1.0)).tolist() == [2, 1]


@pytest.mark.parametrize("text", ["best-of-0", "best-of-", "best-of-x", "best-of--3", "beam",
                                  "best-of-1000000", "", "sample@0", "sample@hot",
                                  "plain-argmax@2", "argmax-sym"])
def test_unknown_decodings_are_refused(text):
    with pytest.raises(InputError, match="--decode"):
        parse(text)


def test_temperature_is_part_of_the_decoding():
    assert parse("sample@0.25").temperature == 0.25
    assert parse("best-of-16@0.250").name == "best-of-16@0.25"
    assert parse("argmax@1.0") == parse("argmax")
    assert parse("sample@0.5").temperature == parse("sample").temperature
    assert parse("sample@0.5").name == "sample@0.5"  # usual for steps, not for targets


def test_time_limits_make_rows():
    names = [c.name for c in contenders(Options(["greedy", "lns"], time_limits=(0.1, 1.0)))]
    assert names == ["greedy(makespan)", "lns(makespan, 0.1 s)", "lns(makespan, 1 s)"]
    rows = contenders(Options(["lns", "cpsat"], time_limits=(0.1,)))
    assert [c.name for c in rows] == ["lns(makespan)", "cpsat(makespan)"]
    assert [c.planner.time_limit for c in rows] == [0.1, 0.1]
    with pytest.raises(InputError, match=r"time-limit: 0\.0 is not allowed"):
        contenders(Options(["lns"], time_limits=(0.0,)))
