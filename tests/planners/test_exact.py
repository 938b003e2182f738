"""The exact planner against the environment, certified optima and a joint-state search."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from moonteam import grid
from moonteam.errors import InputError
from moonteam.planners import exact, simulate
from moonteam.planners.base import Planner, Snapshot, Visit
from moonteam.planners.exact import ExactPlanner
from moonteam.planners.greedy import GreedyPlanner
from moonteam.planners.lns import LnsPlanner
from moonteam.planners.search.task import value_of
from moonteam.problem.scenario import Agent, Scenario, Target

GROUND = {"drone": 0.0, "legged": 0.15, "wheeled": 0.3}


def scenario(agents, targets, **more):
    return Scenario(size=more.pop("size", (8, 8)), targets=tuple(Target(*t) for t in targets),
                    agents=tuple(Agent(*a) for a in agents), **more)


@pytest.mark.parametrize("objective", ["makespan", "moves", "weighted"])
def test_certified_optima_and_exact_replays(golden, judge, objective):
    plans = [ExactPlanner(objective).plan(Snapshot.start(s)) for s in golden]
    assert len(golden) == 160
    assert {p.status for p in plans} == {"optimal"}
    if objective != "weighted":
        wanted = [getattr(s.optimal, objective) for s in golden]
        assert [getattr(p, objective) for p in plans] == wanted
        assert [p.bound for p in plans] == wanted
    assert judge(golden, plans) == [(p.makespan, p.moves) for p in plans]


def test_weighted_lies_between_the_two_objectives(golden):
    for s in golden[:60]:
        plan = ExactPlanner("weighted", alpha=2.0, beta=0.5).plan(Snapshot.start(s))
        assert plan.makespan >= s.optimal.makespan
        assert plan.moves >= s.optimal.moves
        assert plan.bound == pytest.approx(2.0 * plan.makespan + 0.5 * plan.moves)


@pytest.mark.parametrize("blocked", [None, GROUND])
@pytest.mark.parametrize(("alpha", "beta"), [(1, 0), (0, 1), (2, 1)])
def test_agrees_with_a_joint_state_search(joint_state_search, alpha, beta, blocked):
    for seed in range(10):
        found = grid.generate(seed, num_agents=2, num_targets=3 + seed % 2,
                              num_skills=2 + seed % 2, size=(5, 5), blocked=blocked)
        snapshot = Snapshot.start(found)
        plan = ExactPlanner("weighted", alpha=alpha, beta=beta).plan(snapshot)
        assert plan.status == "optimal"
        value = alpha * plan.makespan + beta * plan.moves
        assert value == joint_state_search(snapshot, alpha, beta), f"seed {seed}"


@pytest.mark.parametrize(("alpha", "beta"), [(1, 0), (0, 1)])
def test_three_agents_that_must_meet_agree_with_the_joint_state_search(joint_state_search, alpha,
                                                                       beta):
    rng = np.random.default_rng(5)
    for _ in range(2):
        cells = [(int(c) % 3, int(c) // 3) for c in rng.permutation(9)]
        found = scenario(
            [(cells[0], ("A",)), (cells[1], ("B",)), (cells[2], ("C",))],
            [(cells[3], ("A", "B", "C"), "AND"), (cells[4], ("A", "C"), "AND"),
             (cells[5], ("B", "C"), "AND")], size=(3, 3))
        snapshot = Snapshot.start(found)
        plan = ExactPlanner("weighted", alpha=alpha, beta=beta).plan(snapshot)
        value = alpha * plan.makespan + beta * plan.moves
        assert value == joint_state_search(snapshot, alpha, beta)


def test_among_the_fastest_plans_the_one_of_fewest_moves(joint_state_search):
    for seed in range(8):
        found = grid.generate(seed, num_agents=2, num_targets=3, size=(5, 5))
        snapshot = Snapshot.start(found)
        plan = ExactPlanner("makespan").plan(snapshot)
        assert joint_state_search(snapshot, 1000, 1) == 1000 * plan.makespan + plan.moves


def test_blocked_maps_replay_to_the_promise(judge):
    found = [grid.generate(seed, num_targets=5, blocked=GROUND) for seed in range(20)]
    for objective in ("makespan", "moves"):
        plans = [ExactPlanner(objective).plan(Snapshot.start(s)) for s in found]
        assert {p.status for p in plans} == {"optimal"}
        assert judge(found, plans) == [(p.makespan, p.moves) for p in plans]


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), agents=st.integers(1, 4), targets=st.integers(1, 7),
       objective=st.sampled_from(["makespan", "moves", "weighted"]), rough=st.booleans())
def test_no_plan_beats_the_optimum(seed, agents, targets, objective, rough):
    found = grid.generate(seed, num_agents=agents, num_targets=targets, size=(12, 12),
                          num_skills=3, blocked=GROUND if rough else None, max_steps=500)
    snapshot = Snapshot.start(found)

    def value(plan):
        trace = simulate.replay(snapshot, plan.actions)
        assert trace.complete
        assert (trace.makespan, trace.moves) == (plan.makespan, plan.moves)
        return value_of(objective, 1.0, 0.05, trace.makespan, trace.moves)

    best = ExactPlanner(objective).plan(snapshot)
    assert value(best) == pytest.approx(best.bound)
    for planner in (GreedyPlanner(objective), LnsPlanner(objective, iterations=60, seed=seed)):
        plan = planner.plan(snapshot)
        assert value(plan) >= best.bound - 1e-9
        assert plan.bound <= best.bound + 1e-9


@pytest.mark.parametrize("objective", ["makespan", "moves"])
def test_from_the_middle_of_a_plan_what_remains_is_what_it_costs(golden, objective):
    for s in golden[::9]:
        now = Snapshot.start(s)
        plan = ExactPlanner(objective).plan(now)
        spent = 0
        for t, joint in enumerate(plan.actions):
            if t % 7 == 3:
                rest = ExactPlanner(objective).plan(now)
                assert getattr(rest, objective) == getattr(plan, objective) - (
                    t if objective == "makespan" else spent)
            now = simulate.step(now, joint)
            spent += int((joint != simulate.STAY).sum())
        assert now.solved.all()


def test_lost_agents_and_solved_targets_are_as_if_absent(golden):
    for s in golden[:40]:
        whole = Snapshot.start(s)
        masked = replace(whole, agent_mask=np.arange(len(s.agents)) != 0,
                         solved=np.arange(len(s.targets)) < 2)
        plan = ExactPlanner().plan(masked)
        rest = Scenario(size=s.size, agents=s.agents[1:], targets=s.targets[2:])
        alone = ExactPlanner().plan(Snapshot.start(rest))
        assert (plan.status, plan.makespan, plan.moves) == (
            alone.status, alone.makespan, alone.moves)
        assert (plan.actions[:, 0] == simulate.STAY).all()


def test_a_requirement_that_holds_at_once_costs_nothing():
    found = scenario([((2, 2), ("A",)), ((2, 2), ("B",))], [((2, 2), ("A", "B"), "AND")])
    plan = ExactPlanner().plan(Snapshot.start(found))
    assert (plan.status, plan.makespan, plan.moves, len(plan.actions)) == ("optimal", 0, 0, 0)
    open_still = replace(Snapshot.start(found), solved=np.array([False]))
    assert ExactPlanner().plan(open_still).schedule == (Visit(0, (0, 1), 0),)


def test_missing_skills_are_named():
    found = scenario([((0, 0), ("A",))], [((1, 1), ("A", "B", "C"), "AND"), ((2, 2), ("A",), "OR")])
    plan = ExactPlanner().plan(Snapshot.start(found))
    assert plan.status == "infeasible"
    assert plan.reason == "target 0 at [1, 1]: nobody in the team has skill B or C"
    assert plan.makespan is None
    assert len(plan.actions) == 0


def test_named_skills_keep_their_names():
    found = scenario([((0, 0), ("dig",))], [((1, 1), ("weld",), "OR")])
    assert "has skill weld" in ExactPlanner().plan(Snapshot.start(found)).reason


def test_a_skill_lost_with_its_robot_is_named():
    found = scenario([((0, 0), ("A",)), ((3, 3), ("B",))], [((1, 1), ("B",), "OR")])
    now = replace(Snapshot.start(found), agent_mask=np.array([True, False]))
    assert ExactPlanner().plan(now).reason.endswith("nobody in the team has skill B")


def test_a_target_behind_walls_is_named():
    wall = {"wheeled": tuple((4, y) for y in range(8))}
    found = scenario([((0, 0), ("A",), "wheeled"), ((0, 1), ("B",), "drone")],
                     [((6, 6), ("A", "B"), "AND")], blocked=wall)
    plan = ExactPlanner().plan(Snapshot.start(found))
    assert plan.reason == "target 0 at [6, 6]: cannot be reached by an agent with skill A"


def test_too_few_steps_left_is_infeasible_to_the_step():
    found = scenario([((0, 0), ("A",))], [((7, 7), ("A",), "OR")], max_steps=14)
    assert ExactPlanner().plan(Snapshot.start(found)).status == "optimal"
    late = replace(Snapshot.start(found), step=1)
    plan = ExactPlanner().plan(late)
    assert (plan.status, plan.reason) == ("infeasible", "no plan within the 13 steps left")


def test_fewest_moves_within_the_steps_left():
    """One agent alone takes 10 steps and 10 moves; within 9 steps two must share the work."""
    found = scenario([((4, 0), ("A",)), ((5, 7), ("A",))],
                     [((0, 0), ("A",), "OR"), ((7, 0), ("A",), "OR")], max_steps=12)
    easy = ExactPlanner("moves").plan(Snapshot.start(found))
    tight = ExactPlanner("moves").plan(replace(Snapshot.start(found), max_steps=9))
    assert (easy.moves, easy.makespan) == (10, 10)
    assert (tight.moves, tight.makespan) == (13, 9)


def test_stopped_early_it_is_feasible_with_a_valid_bound(monkeypatch):
    monkeypatch.setattr(exact, "_FIRST_NODES", 1)
    outcomes = set()
    for seed in range(10):
        snapshot = Snapshot.start(grid.generate(seed, num_agents=4, num_targets=8, num_skills=3))
        for objective in ("makespan", "moves", "weighted"):
            best = ExactPlanner(objective).plan(snapshot)
            early = ExactPlanner(objective, time_limit=1e-9).plan(snapshot)
            outcomes.add(early.status)
            assert early.bound <= best.bound + 1e-9
            value = value_of(objective, 1.0, 0.05, early.makespan, early.moves)
            assert value >= best.bound - 1e-9
            assert simulate.replay(snapshot, early.actions).complete
    assert "feasible" in outcomes


def test_a_time_limit_that_suffices_changes_nothing():
    for seed in range(5):
        snapshot = Snapshot.start(grid.generate(seed, num_agents=4, num_targets=8))
        best, limited = (ExactPlanner("moves", time_limit=t).plan(snapshot) for t in (None, 1e6))
        assert (limited.status, limited.moves) == ("optimal", best.moves)


def test_the_same_question_gets_the_same_plan(golden):
    one, two = (ExactPlanner("weighted").plan(Snapshot.start(golden[30])) for _ in range(2))
    assert np.array_equal(one.actions, two.actions)
    assert one.schedule == two.schedule


def test_too_many_open_targets_and_wrong_weights_are_refused():
    snapshot = Snapshot.start(grid.generate(0, num_agents=3, num_targets=13))
    with pytest.raises(InputError, match="13 targets are open"):
        ExactPlanner().plan(snapshot)
    solved = np.zeros(13, bool)
    solved[0] = True
    assert ExactPlanner("moves").plan(replace(snapshot, solved=solved)).status == "optimal"
    with pytest.raises(InputError, match="not allowed"):
        ExactPlanner("weighted", alpha=-1.0)
    with pytest.raises(InputError, match="not allowed"):
        ExactPlanner("weighted", alpha=0.0, beta=0.0)


def test_as_a_planner_it_plans_once_and_again_when_the_world_differs(golden):
    snapshot = Snapshot.start(golden[85])
    planner = ExactPlanner()
    assert isinstance(planner, Planner)
    planner.reset(snapshot)
    now = snapshot
    while not now.solved.all():
        now = simulate.step(now, planner.act(now))
    assert now.step == golden[85].optimal.makespan
    assert planner.replans == 1
    planner.reset(snapshot)
    planner.act(snapshot)
    planner.act(snapshot)  # nobody moved
    assert planner.replans == 2


def test_what_can_be_solved_is_solved_where_not_all_can():
    found = scenario([((0, 0), ("A",))], [((1, 1), ("B",), "OR"), ((5, 5), ("A",), "OR")])
    planner, now = ExactPlanner(), Snapshot.start(found)
    planner.reset(now)
    for _ in range(10):
        now = simulate.step(now, planner.act(now))
    assert now.solved.tolist() == [False, True]
