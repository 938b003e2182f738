"""The references: exhaustive search and CP-SAT agree with the exact planner; batch = single."""

import itertools
import sys

import numpy as np
import pytest

from moonteam import grid
from moonteam.errors import InputError
from moonteam.planners import batch, simulate
from moonteam.planners.base import Snapshot
from moonteam.planners.batch import solve_batch
from moonteam.planners.cpsat import CpSatPlanner
from moonteam.planners.exact import ExactPlanner
from moonteam.planners.exhaustive import ExhaustivePlanner
from moonteam.planners.search.schedules import segment_table, suffix_table
from moonteam.planners.search.task import value_of

GROUND = {"drone": 0.0, "legged": 0.15, "wheeled": 0.3}
OBJECTIVES = ("makespan", "moves", "weighted")


def value(plan):
    return value_of(plan.objective, 1.0, 0.05, plan.makespan, plan.moves)


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_exhaustive_search_agrees_up_to_five_targets(objective):
    for seed in range(24):
        found = grid.generate(seed, num_agents=2 + seed % 2, num_targets=2 + seed % 3,
                              num_skills=2 + seed % 2, blocked=GROUND if seed % 4 == 0 else None)
        snapshot = Snapshot.start(found)
        plain = ExhaustivePlanner(objective).plan(snapshot)
        plan = ExactPlanner(objective).plan(snapshot)
        assert plain.status == plan.status == "optimal"
        assert value(plain) == pytest.approx(value(plan)), f"seed {seed}"
        assert plain.bound == pytest.approx(plan.bound)


@pytest.mark.parametrize("objective", ["makespan", "moves"])
def test_exhaustive_search_agrees_on_certified_five_target_rows(golden, objective):
    for s in [s for s in golden if len(s.targets) == 5][:8]:
        plan = ExhaustivePlanner(objective).plan(Snapshot.start(s))
        assert getattr(plan, objective) == getattr(s.optimal, objective)


def test_exhaustive_search_refuses_more_than_it_can_do():
    with pytest.raises(InputError, match="takes up to 6"):
        ExhaustivePlanner().plan(Snapshot.start(grid.generate(0, num_targets=7)))


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_cpsat_agrees_where_it_closes(objective):
    closed = 0
    for seed in range(6):
        found = grid.generate(100 + seed, num_agents=3, num_targets=4 + seed % 2,
                              blocked=GROUND if seed % 3 == 0 else None)
        snapshot = Snapshot.start(found)
        best = ExactPlanner(objective).plan(snapshot)
        plan = CpSatPlanner(objective, time_limit=20.0).plan(snapshot)
        assert plan.bound <= best.bound + 2e-3
        assert value(plan) >= best.bound - 1e-9
        if plan.status == "optimal":
            closed += 1
            assert value(plan) == pytest.approx(best.bound)
    assert closed >= 4


def test_cpsat_that_finds_nothing_in_time_returns_its_hint():
    found = grid.generate(0, num_agents=8, num_targets=30, num_skills=3, max_steps=512)
    snapshot = Snapshot.start(found)
    plan = CpSatPlanner(time_limit=0.2).plan(snapshot)
    assert plan.status == "feasible"
    assert simulate.replay(snapshot, plan.actions).complete


def test_without_ortools_cpsat_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "ortools.sat.python.cp_model", None)
    with pytest.raises(InputError, match=r"pip install moonteam\[ortools\]"):
        CpSatPlanner()


def test_path_tables_against_permutations():
    rng = np.random.default_rng(0)
    cells = rng.integers(0, 20, (5, 2))
    between = np.abs(cells[:, None] - cells[None]).sum(-1).astype(np.int32)[None]
    suffix, segments = suffix_table(between), segment_table(between)
    for size in range(5):
        for inside in itertools.combinations(range(5), size):
            mask = sum(1 << i for i in inside)
            for first in set(range(5)) - set(inside):
                ways = [sum(between[0, i, j] for i, j in itertools.pairwise((first, *order)))
                        for order in itertools.permutations(inside)]
                assert suffix[0, mask, first] == min(ways)
                for last in set(range(5)) - set(inside) - {first}:
                    ways = [sum(between[0, i, j] for i, j in itertools.pairwise(
                        (first, *order, last))) for order in itertools.permutations(inside)]
                    assert segments[0, mask, first, last] == min(ways)


def arrays(snapshots, agents, targets):
    """Snapshots as the padded arrays that `solve_batch` takes."""

    def pad(name, length, fill):
        rows = [getattr(s, name) for s in snapshots]
        return np.stack([np.concatenate([r, np.full((length - len(r), *r.shape[1:]), fill,
                                                    r.dtype)]) for r in rows])

    return {"cells": pad("cells", agents, 0), "agent_skills": pad("agent_skills", agents, 3),
            "agent_mask": pad("agent_mask", agents, False),
            "target_cells": pad("target_cells", targets, 0),
            "target_skills": pad("target_skills", targets, 1),
            "target_and": pad("target_and", targets, False),
            "solved": pad("solved", targets, True),
            "steps_left": np.array([s.max_steps - s.step for s in snapshots])}


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_batch_equals_single(golden, objective):
    rows = golden[::7]
    snapshots = [Snapshot.start(s) for s in rows]
    plans = solve_batch(**arrays(snapshots, 4, 8), objective=objective, threads=2)
    again = solve_batch(**arrays(snapshots, 5, 9), objective=objective, threads=1)
    assert (plans.status == batch.OPTIMAL).all()
    assert np.array_equal(plans.next_target, again.next_target[:, :4])
    assert np.array_equal(plans.makespan, again.makespan)
    for b, snapshot in enumerate(snapshots):
        single = ExactPlanner(objective).plan(snapshot)
        got = value_of(objective, 1.0, 0.05, int(plans.makespan[b]), int(plans.moves[b]))
        assert got == pytest.approx(single.bound)
        for a in range(len(snapshot.cells)):
            target = plans.next_target[b, a]
            if target < 0:
                assert (single.actions[:, a] == simulate.STAY).all()
                continue
            goal = snapshot.target_cells[target]
            assert plans.arrival[b, a] == np.abs(snapshot.cells[a] - goal).sum()
            assert plans.meeting[b, a] >= plans.arrival[b, a]
            assert plans.routes[b, a, 0] == target


def test_batch_on_blocked_maps_equals_single():
    found = [grid.generate(seed, num_targets=5, blocked=GROUND, kinds=sorted(GROUND))
             for seed in range(8)]
    snapshots = [Snapshot.start(s) for s in found]
    plans = solve_batch(**arrays(snapshots, 3, 5), objective="makespan",
                        agent_kinds=np.stack([s.agent_kinds for s in snapshots]),
                        passable=np.stack([s.passable for s in snapshots]))
    singles = [ExactPlanner("makespan").plan(s) for s in snapshots]
    assert plans.makespan.tolist() == [p.makespan for p in singles]
    assert plans.moves.tolist() == [p.moves for p in singles]


def test_batch_labels_what_can_be_done_where_not_all_can():
    base = {"cells": [[[0, 0], [9, 9]]], "agent_skills": [[1, 1]],
            "target_cells": [[[5, 0], [9, 5]]], "target_and": [[False, False]]}
    plans = solve_batch(**base, target_skills=[[1, 2]])
    assert plans.status.tolist() == [batch.INFEASIBLE]
    assert plans.next_target.tolist() == [[0, -1]]
    late = solve_batch(**base, target_skills=[[1, 1]], steps_left=4)
    assert late.status.tolist() == [batch.INFEASIBLE]
    assert late.next_target.tolist() == [[0, 1]]
    done = solve_batch(**base, target_skills=[[1, 1]], solved=[[True, True]])
    assert (done.status.tolist(), done.makespan.tolist()) == ([batch.OPTIMAL], [0])
    assert (done.next_target == -1).all()


def test_batch_refuses_too_many_open_targets():
    with pytest.raises(InputError, match="13 targets are open"):
        solve_batch(np.zeros((1, 1, 2)), [[1]], np.zeros((1, 13, 2)), np.ones((1, 13)),
                    np.zeros((1, 13)))
