"""The host's twin of the grid rules, and travel times, against the environment's own."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from moonteam import grid
from moonteam.planners import simulate
from moonteam.planners.base import Snapshot
from moonteam.planners.exact import ExactPlanner
from moonteam.planners.plans.stepwise import plan_from_planner
from moonteam.planners.search.travel import travel_times, walk

GROUND = {"drone": 0.0, "legged": 0.2, "wheeled": 0.4}


def scenarios(count):
    return [grid.generate(seed, num_agents=4, num_targets=6, size=(6, 6), blocked=GROUND,
                          kinds=("drone", "legged", "wheeled", "wheeled"))
            for seed in range(count)]


def test_the_twin_steps_as_the_environment():
    step = jax.jit(grid.step, static_argnums=0)
    begin = jax.jit(grid.reset_to, static_argnums=0)
    rng = np.random.default_rng(0)
    solved = 0
    for found in scenarios(6):
        problem, cells = grid.to_problem(found)
        config = grid.config_for(found)
        state, _ = begin(config, problem, cells)
        now = Snapshot.start(found)
        for _ in range(40):
            joint = rng.integers(0, 5, 4).astype(np.int32)
            state, now = step(config, state, jnp.asarray(joint)).state, simulate.step(now, joint)
            assert np.array_equal(state.cells, now.cells)
            assert np.array_equal(state.solved, now.solved)
            assert int(state.step) == now.step
        solved += int(now.solved.sum())
    assert solved > 5


@pytest.mark.parametrize("blocked", [GROUND, None], ids=["blocked", "open"])
def test_a_whole_replay_is_the_replay_step_by_step(blocked):
    rng = np.random.default_rng(1)
    ended = 0
    for seed in range(30):
        kinds = ("drone", "legged", "wheeled") if blocked else None
        start = Snapshot.start(grid.generate(seed, num_targets=2, size=(4, 4), max_steps=30,
                                             blocked=blocked, kinds=kinds))
        start = replace(start, agent_mask=np.array([True, seed % 3 > 0, True]))
        joint = rng.integers(0, 5, (40, 3)).astype(np.int32)
        slow, fast = simulate.replay(start, iter(joint)), simulate.replay_whole(start, joint)
        for name in ("cells", "solved", "actions"):
            np.testing.assert_array_equal(getattr(slow, name), getattr(fast, name))
        ended += slow.complete
    assert 0 < ended < 30


def test_travel_times_are_the_environments():
    distance_fields = jax.jit(grid.distance_fields)
    for found in scenarios(4):
        snapshot = Snapshot.start(found)
        problem, _ = grid.to_problem(found)
        fields = np.asarray(distance_fields(problem.passable, problem.target_cells))
        travel = travel_times(snapshot)
        assert np.array_equal(travel.fields, fields)
        x, y = snapshot.target_cells.T
        assert np.array_equal(travel.between, fields[:, :, y, x].transpose(0, 2, 1))


def test_walks_are_as_long_as_travel_says_and_get_there():
    for found in scenarios(4):
        snapshot = Snapshot.start(found)
        travel = travel_times(snapshot)
        for a, kind in enumerate(snapshot.agent_kinds):
            for t, goal in enumerate(snapshot.target_cells):
                if travel.start[a, t] > 100:
                    with pytest.raises(ValueError, match="no way"):
                        walk(snapshot.cells[a], goal, travel.fields[kind, t],
                             snapshot.passable[kind])
                    continue
                way = walk(snapshot.cells[a], goal, travel.fields[kind, t],
                           snapshot.passable[kind])
                assert len(way) == travel.start[a, t]
                now = snapshot
                for action in way:
                    joint = np.full(4, simulate.STAY)
                    joint[a] = action
                    now = simulate.step(now, joint)
                assert np.array_equal(now.cells[a], goal)


def test_walks_on_an_open_map():
    assert walk((1, 1), (3, 0)) == [3, 3, 1]
    assert walk((1, 1), (0, 4)) == [0, 0, 0, 2]
    assert walk((1, 1), (1, 1)) == []


def test_an_agent_on_closed_ground_may_leave_it():
    found = grid.generate(0, num_agents=1, num_targets=1, num_skills=1, size=(5, 5))
    closed = np.ones((1, 5, 5), bool)
    x, y = found.agents[0].at
    closed[0, y, x] = False
    snapshot = Snapshot(**{**Snapshot.start(found).__dict__, "passable": closed})
    travel = travel_times(snapshot)
    assert travel.start[0, 0] == np.abs(snapshot.cells[0] - snapshot.target_cells[0]).sum()


def test_a_plan_from_a_planners_own_decisions(golden):
    for s in golden[:5]:
        plan = plan_from_planner(ExactPlanner(), Snapshot.start(s), "makespan")
        assert (plan.status, plan.makespan) == ("feasible", s.optimal.makespan)
        assert sorted(v.target for v in plan.schedule) == list(range(len(s.targets)))
        assert plan.bound is None


def test_a_planner_that_stands_still_is_told_off(golden):
    class Idle:
        name = "idle"

        def reset(self, snapshot, seed=0):
            pass

        def act(self, snapshot):
            return np.full(len(snapshot.cells), simulate.STAY, np.int32)

    plan = plan_from_planner(Idle(), Snapshot.start(golden[0]))
    assert plan.status == "infeasible"
    assert plan.reason == "idle left targets 0, 1, 2, 3, 4 unsolved after 128 steps"
