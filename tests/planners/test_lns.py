"""Insertion, large-neighbourhood search and lower bounds, against the exact optimum."""

from dataclasses import replace

import numpy as np
import pytest

from moonteam import grid
from moonteam.errors import InputError
from moonteam.planners import simulate
from moonteam.planners.base import Snapshot
from moonteam.planners.exact import ExactPlanner
from moonteam.planners.exhaustive import coalitions
from moonteam.planners.greedy import GreedyPlanner
from moonteam.planners.lns import LnsPlanner
from moonteam.planners.search import insertion
from moonteam.planners.search.bounds import lower_bounds
from moonteam.planners.search.task import Task
from moonteam.planners.search.teams import teams_of
from moonteam.planners.search.travel import travel_times
from moonteam.problem.scenario import Agent, Scenario, Target

GROUND = {"drone": 0.0, "legged": 0.15, "wheeled": 0.3}


def task_of(found):
    snapshot = Snapshot.start(found)
    return Task.of(snapshot, travel_times(snapshot))


@pytest.mark.parametrize("objective", ["makespan", "moves"])
def test_within_one_percent_of_the_optimum_at_seven_targets(golden, objective):
    rows = [s for s in golden if len(s.targets) == 7]
    assert len(rows) == 40
    best = sum(getattr(s.optimal, objective) for s in rows)
    plans = [LnsPlanner(objective, iterations=1000).plan(Snapshot.start(s)) for s in rows]
    greedy = [GreedyPlanner(objective).plan(Snapshot.start(s)) for s in rows]
    found = sum(getattr(p, objective) for p in plans)
    assert best <= found <= 1.01 * best
    assert found <= sum(getattr(p, objective) for p in greedy) <= 1.15 * best


def test_large_teams_replay_and_improve_on_greedy():
    found = grid.generate(3, num_agents=10, num_targets=60, num_skills=3, max_steps=256)
    snapshot = Snapshot.start(found)
    for objective in ("makespan", "moves"):
        plans = [GreedyPlanner(objective).plan(snapshot),
                 LnsPlanner(objective, iterations=300).plan(snapshot)]
        for plan in plans:
            trace = simulate.replay(snapshot, plan.actions)
            assert trace.complete
            assert (trace.makespan, trace.moves) == (plan.makespan, plan.moves)
            assert plan.status == "feasible"
            assert plan.bound <= getattr(plan, objective)
        greedy, lns = ((getattr(p, objective), p.moves) for p in plans)
        assert lns < greedy


def test_an_iteration_budget_makes_it_repeatable():
    snapshot = Snapshot.start(grid.generate(1, num_agents=5, num_targets=20))
    one, two = (LnsPlanner("moves", iterations=400, seed=7).plan(snapshot) for _ in range(2))
    assert np.array_equal(one.actions, two.actions)


def test_threads_search_side_by_side_and_the_best_counts():
    snapshot = Snapshot.start(grid.generate(1, num_agents=8, num_targets=40))
    one, two, again = (LnsPlanner("makespan", iterations=60, seed=7, threads=t).plan(snapshot)
                       for t in (1, 3, 3))
    assert two.makespan <= one.makespan
    assert np.array_equal(two.actions, again.actions)


def test_fifty_robots_and_five_hundred_targets_are_planned_in_seconds():
    snapshot = Snapshot.start(grid.generate(0, num_agents=50, num_targets=500))
    plan = LnsPlanner(time_limit=1.0).plan(snapshot)
    assert simulate.replay(snapshot, plan.actions).complete
    assert plan.bound <= plan.makespan
    assert plan.seconds < 10.0


def test_no_iterations_are_the_greedy_plan():
    snapshot = Snapshot.start(grid.generate(1, num_agents=5, num_targets=20))
    none, greedy = LnsPlanner("moves", iterations=0), GreedyPlanner("moves")
    np.testing.assert_array_equal(none.plan(snapshot).actions, greedy.plan(snapshot).actions)


def test_a_time_limit_stops_it():
    snapshot = Snapshot.start(grid.generate(1, num_agents=5, num_targets=20))
    plan = LnsPlanner("moves", time_limit=0.05).plan(snapshot)
    assert simulate.replay(snapshot, plan.actions).complete


def test_the_steps_left_are_kept_where_they_can_be():
    found = Scenario(size=(8, 8), agents=(Agent((4, 0), ("A",)), Agent((5, 7), ("A",))),
                     targets=(Target((0, 0), ("A",), "OR"), Target((7, 0), ("A",), "OR")),
                     max_steps=9)
    plan = LnsPlanner("moves", iterations=50).plan(Snapshot.start(found))
    assert (plan.moves, plan.makespan) == (13, 9)
    late = replace(Snapshot.start(found), max_steps=3)
    assert LnsPlanner("moves", iterations=50).plan(late).status == "infeasible"


def test_too_many_agents_are_refused():
    with pytest.raises(InputError, match="at most 62"):
        GreedyPlanner().plan(Snapshot.start(grid.generate(0, num_agents=63)))


def test_lower_bounds_hold():
    for seed in range(25):
        found = grid.generate(seed, num_agents=1 + seed % 4, num_targets=3 + seed % 6,
                              num_skills=1 + seed % 3, blocked=GROUND if seed % 3 else None,
                              max_steps=900)
        snapshot = Snapshot.start(found)
        makespan, moves = lower_bounds(task_of(found), parts=1 if seed % 2 else 0)
        assert 0 < makespan <= ExactPlanner("makespan").plan(snapshot).makespan
        assert 0 < moves <= ExactPlanner("moves").plan(snapshot).moves


def test_parts_solved_exactly_raise_the_bound():
    task = task_of(grid.generate(2, num_agents=4, num_targets=9))
    plan = ExactPlanner("makespan").plan(Snapshot.start(
        grid.generate(2, num_agents=4, num_targets=9)))
    assert lower_bounds(task, parts=1)[0] == plan.makespan  # nine targets are one part


def test_coalitions_are_those_of_the_plain_list():
    for seed in range(20):
        task = task_of(grid.generate(seed, num_agents=5, num_targets=6, num_skills=3))
        teams = teams_of(task.start, task.skills, task.need, task.both)
        for t in range(len(task.targets)):
            those = range(teams.first[t], teams.first[t + 1])
            plain = sorted(sum(1 << a for a in team) for team in coalitions(task, t))
            assert sorted(teams.masks[those].tolist()) == plain
            for a in range(len(task.start)):
                place = t * len(task.start) + a
                having = teams.having[teams.begin[place]:teams.begin[place + 1]]
                assert sorted(having) == [c for c in those if teams.masks[c] >> a & 1]
            for c in those:
                members = [a for a in teams.members[c] if a >= 0]
                assert sum(1 << int(a) for a in members) == teams.masks[c]


def test_inserting_one_event_costs_what_the_place_said():
    """The rule that makes insertion fast: max(makespan, head + tail), and the detours' sum."""
    rng = np.random.default_rng(0)
    for seed in range(10):
        task = task_of(grid.generate(seed, num_agents=4, num_targets=8, blocked=GROUND))
        count = len(task.targets)
        ways = insertion.Ways(task.start, task.between, task.kinds)
        teams = teams_of(task.start, task.skills, task.need, task.both)
        line = insertion.empty(ways, teams)
        line.order[:] = rng.permutation(count)
        line.crew[:] = [rng.integers(*teams.first[t:t + 2]) for t in line.order]
        before = insertion.measure(ways, teams, line, count - 1)
        last = int(line.order[-1])
        cost, _, place, crew = insertion.best_place(
            last, ways, teams, line, count - 1, *before, 1.0, 0.01, 10_000, 0.0, 0.0)
        insertion.put(line, count - 1, place, last, crew)
        makespan, moves = insertion.measure(ways, teams, line, count)
        assert cost == pytest.approx(makespan + 0.01 * moves)
