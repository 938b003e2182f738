import dataclasses

import jax
import numpy as np
import pytest

from moonteam.errors import InputError
from moonteam.planners import learned, simulate
from moonteam.planners.base import Planner, Snapshot
from moonteam.planners.best_of import plan_best_of
from moonteam.planners.learned import LearnedPlanner
from moonteam.policies import recurrent
from moonteam.policies.policy import Policy
from moonteam.policies.policy_file import PolicyFile, load_policy, save_policy
from moonteam.policies.recurrent import RecurrentSpec
from moonteam.problem.scenario import Agent, Scenario, Target

SPEC = RecurrentSpec(num_agents=2, num_targets=2, size=(4, 4), width=8)
SCENARIO = Scenario(
    (4, 4), (Agent((0, 0), ("A",)), Agent((3, 3), ("B",))),
    (Target((0, 1), ("A", "B"), "AND"), Target((2, 2), ("A",), "OR")), max_steps=60)
START = Snapshot.start(SCENARIO)


def write(path, spec=SPEC, bias=(), config=None, kind="recurrent"):
    params = jax.device_get(recurrent.init(spec, jax.random.key(0)))
    params = jax.tree.map(np.array, params)
    for action, value in bias:
        params["actor"]["head"]["bias"][action] = value
    save_policy(path, PolicyFile(kind, config or dataclasses.asdict(spec), params))
    return path


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return write(tmp_path_factory.mktemp("policy") / "tiny.safetensors")


def walk(planner, snapshot, steps, seed):
    planner.reset(snapshot, seed)
    actions = []
    for _ in range(steps):
        actions.append(planner.act(snapshot))
        snapshot = simulate.step(snapshot, actions[-1])
    return np.array(actions)


def test_it_is_a_planner(path):
    planner = LearnedPlanner.load(path)
    assert isinstance(planner, Planner)
    assert planner.name == "policy"
    planner.reset(START)
    joint = planner.act(START)
    assert joint.shape == (2,)
    assert joint.dtype == np.int32
    assert ((joint >= 0) & (joint < 5)).all()


@pytest.mark.parametrize("decode", ["argmax", "sample"])
def test_same_seed_same_actions(path, decode):
    planner = LearnedPlanner.load(path, decode=decode)
    first, again = walk(planner, START, 12, 5), walk(planner, START, 12, 5)
    np.testing.assert_array_equal(first, again)
    if decode == "sample":
        assert not np.array_equal(first, walk(planner, START, 12, 6))


def test_memory_lasts_between_decisions_and_not_between_missions(path):
    planner = LearnedPlanner.load(path)
    planner.reset(START)
    planner.act(START)
    once = np.asarray(planner._memory)
    planner.act(START)
    assert not np.allclose(planner._memory, once)
    planner.reset(START)
    planner.act(START)
    np.testing.assert_array_equal(planner._memory, once)


def test_deciding_compiles_once(path):
    planner = LearnedPlanner.load(path)
    walk(planner, START, 3, 0)
    compiled = learned._decide._cache_size()
    later = dataclasses.replace(START, step=7, cells=np.array([[1, 1], [2, 0]], np.int32))
    walk(planner, later, 3, 1)
    assert learned._decide._cache_size() == compiled


def test_the_watch_breaks_an_argmax_deadlock(tmp_path):
    """A policy that always stays: argmax alone never moves, the watch draws on the return."""
    stays = write(tmp_path / "stays.safetensors", bias=[(4, 1.0)])
    still = LearnedPlanner.load(stays, watch=False)
    assert (walk(still, START, 8, 0) == 4).all()
    assert still.rescues == 0
    watched = LearnedPlanner.load(stays)
    actions = walk(watched, START, 8, 0)
    assert (actions[0] == 4).all()
    assert (actions[1:] != 4).any()
    assert watched.rescues > 0


def test_progress_resets_the_watch(tmp_path):
    planner = LearnedPlanner.load(write(tmp_path / "p.safetensors", bias=[(4, 5.0)]))
    planner.reset(START)
    planner.act(START)
    planner.act(dataclasses.replace(START, solved=np.array([True, False])))
    assert planner.rescues == 0
    planner.act(dataclasses.replace(START, solved=np.array([True, False])))
    assert planner.rescues == 1


def test_a_lost_robot_stays(tmp_path):
    planner = LearnedPlanner.load(write(tmp_path / "p.safetensors", bias=[(0, 9.0)]))
    lost = dataclasses.replace(START, agent_mask=np.array([True, False]))
    planner.reset(lost)
    assert planner.act(lost).tolist() == [0, 4]


def test_blocked_moves_are_never_chosen(tmp_path):
    planner = LearnedPlanner.load(write(tmp_path / "p.safetensors", bias=[(0, 50.0), (3, 25.0)]))
    passable = np.ones((1, 4, 4), bool)
    passable[0, 1, 0] = False
    blocked = dataclasses.replace(START, passable=passable)
    planner.reset(blocked)
    first, second = planner.act(blocked)
    assert first == 3
    assert second not in (0, 3)  # the corner (3, 3)


@pytest.mark.parametrize(("change", "line"), [
    ({"size": (5, 4)}, "made for 2 robots and 2 targets on a map of 4 x 4; this mission has"),
    ({"agents": (*SCENARIO.agents, SCENARIO.agents[0])}, "this mission has 3 robots"),
    ({"targets": SCENARIO.targets[:1]}, "1 targets"),
    ({"agents": (Agent((0, 0), ("A",)), Agent((3, 3), ("C", "B")))}, "made for 2 skills")])
def test_missions_it_was_not_made_for(path, change, line):
    values = {f: getattr(SCENARIO, f) for f in SCENARIO.__struct_fields__} | change
    snapshot = Snapshot.start(Scenario(**values))
    with pytest.raises(InputError, match=line):
        LearnedPlanner.load(path).reset(snapshot)
    with pytest.raises(InputError, match=line):
        plan_best_of(Policy.load(path), snapshot, 2)


def test_files_that_do_not_fit_their_header(tmp_path, path):
    wide = dataclasses.asdict(dataclasses.replace(SPEC, width=16))
    with pytest.raises(InputError, match="has shape"):
        Policy.load(write(tmp_path / "a", config=wide))
    with pytest.raises(InputError, match="describes no recurrent network"):
        Policy.load(write(tmp_path / "b", config={"width": "wide"}))
    with pytest.raises(InputError, match="network kind 'oracle' is not one of"):
        Policy.load(write(tmp_path / "c", kind="oracle"))
    with pytest.raises(InputError, match="temperature: 0"):
        LearnedPlanner.load(path, temperature=0.0)
    assert load_policy(path).kind == "recurrent"


def test_best_of_is_a_plan_that_replays(path):
    policy = Policy.load(path)
    plans = [plan_best_of(policy, START, count, seed=1) for count in (1, 64)]
    best = plans[1]
    assert best.status == "feasible"
    trace = simulate.replay(START, best.actions)
    assert (trace.makespan, trace.moves) == (best.makespan, best.moves)
    assert {visit.target for visit in best.schedule} == {0, 1}
    alone = plans[0].makespan
    assert alone is None or best.makespan <= alone
    thrifty = plan_best_of(policy, START, 64, seed=1, objective="moves")
    assert thrifty.moves <= best.moves
    assert thrifty.makespan >= best.makespan


def test_best_of_says_when_nothing_was_found(path):
    short = dataclasses.replace(START, max_steps=1)
    plan = plan_best_of(Policy.load(path), short, 4)
    assert (plan.status, plan.makespan, len(plan.actions)) == ("infeasible", None, 0)
    assert "none of 4 sampled rollouts" in plan.reason


def test_a_whole_plan(path):
    planner = LearnedPlanner.load(path, decode="sample", seed=3)
    plan = planner.plan(START)
    assert plan.planner == "policy"
    if plan.status == "feasible":
        assert simulate.replay(START, plan.actions).makespan == plan.makespan
