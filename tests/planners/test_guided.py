"""Guided local search: what its guide does, what is passed over, and what guides are refused."""

import math

import numpy as np
import pytest

from moonteam import grid, paths
from moonteam.errors import InputError
from moonteam.planners import simulate
from moonteam.planners.base import Snapshot
from moonteam.planners.guided import GuidedPlanner
from moonteam.planners.lns import LnsPlanner, Weights, best_insertion, measure, searched
from moonteam.planners.search import guides, insertion, neighbourhoods
from moonteam.planners.search.guides import PLAIN, parts_of, vector_of
from moonteam.planners.search.task import Task
from moonteam.planners.search.teams import teams_of
from moonteam.planners.search.travel import travel_times
from moonteam.policies.policy_file import PolicyFile, save_policy


def problem(seed, agents, targets):
    start = Snapshot.start(grid.generate(seed, num_agents=agents, num_targets=targets,
                                         max_steps=256))
    task = Task.of(start, travel_times(start))
    goal = Weights.of("makespan", 1.0, 0.05, task)
    return task, goal, best_insertion(task, goal, hurry=True)


@pytest.mark.parametrize(("agents", "targets", "places", "count"),
                         [(8, 40, 60_000, 40), (20, 100, 200_000, 16)])
def test_the_bundled_guide_is_ahead_of_the_plain_one(agents, targets, places, count):
    """As many places tried, problems that training never drew."""
    gains = []
    for seed in range(count):
        task, goal, first = problem(seed, agents, targets)
        plain, guided = (measure(task, searched(task, goal, first, seed, places, guide))[0]
                         for guide in (PLAIN, guides.load()))
        gains.append(math.log(guided / plain))
    mean, error = np.mean(gains), np.std(gains) / math.sqrt(count)
    assert mean + error < 0.0


def test_a_guided_plan_replays_and_its_seed_repeats_it():
    start = Snapshot.start(grid.generate(1, num_agents=6, num_targets=24, max_steps=256))
    one, again, other = (GuidedPlanner(iterations=600, seed=seed) for seed in (3, 3, 4))
    plan = one.plan(start)
    trace = simulate.replay(start, plan.actions)
    assert trace.complete
    assert (trace.makespan, trace.moves) == (plan.makespan, plan.moves)
    np.testing.assert_array_equal(plan.actions, again.plan(start).actions)
    assert other.plan(start).actions.tolist() != plan.actions.tolist()


def test_of_other_objectives_the_plain_guide_takes_care():
    start = Snapshot.start(grid.generate(2, num_agents=6, num_targets=24, max_steps=256))
    one, other = (kind("moves", iterations=40) for kind in (GuidedPlanner, LnsPlanner))
    np.testing.assert_array_equal(one.plan(start).actions, other.plan(start).actions)


def _every_place(t, ways, teams, line, length, makespan, moves, hold):
    """Costs by coalition, nothing passed over, from what `measure` says of each whole list."""
    costs = {}
    for place in range(length + 1):
        for c in range(teams.first[t], teams.first[t + 1]):
            trial = insertion.empty(ways, teams)
            trial.order[:], trial.crew[:] = line.order, line.crew
            insertion.put(trial, length, place, t, c)
            span, total = insertion.measure(ways, teams, trial, length + 1)
            chain = int(trial.head[place] + trial.tail[place])
            cost = insertion.price(span, total, 1.0, 0.05, 10_000) + hold * chain
            costs[c] = min(costs.get(c, math.inf), cost)
    return sorted(costs.values())


@pytest.mark.parametrize("hold", [0.0, 0.05])
def test_what_is_passed_over_would_change_nothing(hold):
    rng = np.random.default_rng(0)
    for seed in range(6):
        task, _, _ = problem(seed, 5, 9)
        ways = insertion.Ways(task.start, task.between, task.kinds)
        teams = teams_of(task.start, task.skills, task.need, task.both)
        line = insertion.empty(ways, teams)
        line.order[:] = rng.permutation(9)
        line.crew[:] = [rng.integers(*teams.first[t:t + 2]) for t in line.order]
        last = int(line.order[-1])
        before = insertion.measure(ways, teams, line, 8)
        best, second, _, _ = insertion.best_place(
            last, ways, teams, line, 8, *before, 1.0, 0.05, 10_000, hold, 0.0)
        costs = _every_place(last, ways, teams, line, 8, *before, hold)
        assert best == pytest.approx(costs[0])
        assert second == pytest.approx(costs[1] if len(costs) > 1 else math.inf)


def test_a_vector_holds_each_weight_where_its_name_is():
    vector = np.arange(len(PLAIN), dtype=np.float64)
    guide = neighbourhoods.guide_of(vector)
    assert guide._fields == tuple(neighbourhoods.SHAPES)
    for name, part in parts_of(vector).items():
        np.testing.assert_array_equal(getattr(guide, name), part)
    np.testing.assert_array_equal(vector_of(parts_of(vector)), vector)


def test_a_guide_decides_what_is_taken_out():
    """One that takes who is near takes the nearest; one that takes little takes two at most."""
    task, _, first = problem(5, 6, 30)
    parts = {name: part.copy() for name, part in parts_of(PLAIN).items()}
    parts["ways"][:, 0] = -50.0, 50.0, -50.0, -50.0
    parts["size"][1] = math.log(2.0), 0.0, 0.0
    vector = vector_of(parts)
    ways = insertion.Ways(task.start, task.between, task.kinds)
    line = insertion.empty(ways, first.teams)
    line.order[:], line.crew[:] = first.order, first.crew
    makespan, _ = insertion.measure(ways, first.teams, line, 30)
    look = neighbourhoods.Look(*(np.zeros(30) for _ in range(5)))
    neighbourhoods.look_at(ways, first.teams, line, makespan, look)
    assert look.slack.min() == 0
    assert look.wait.min() == 0 <= look.detour.min()
    removed = np.zeros(30, np.bool_)
    guide, moment = neighbourhoods.guide_of(vector), neighbourhoods.of_moment(6, 30)
    near = []
    for _ in range(200):
        count = neighbourhoods.choose_removed(guide, moment, first.teams, ways, first.order,
                                              first.crew, look, 10.0, removed)
        taken = first.order[removed]
        assert count == removed.sum() <= 2
        if count == 2:
            near.append(task.between[0, taken[0], taken[1]])
    assert 20 < len(near) < 180
    assert np.mean(near) < 0.4 * task.between[0].mean()


def test_what_is_no_guide_is_one_line(tmp_path):
    with pytest.raises(InputError, match="a guide of local search is needed"):
        guides.load(paths.assets() / "policies" / "any_team_mappo.safetensors")
    with pytest.raises(InputError, match="bundled guides: local_search"):
        guides.load("none_such")
    parts = {name: part.astype(np.float32) for name, part in parts_of(PLAIN).items()}
    save_policy(tmp_path / "short.safetensors",
                PolicyFile(guides.KIND, {}, parts | {"row": parts["row"][1:]}))
    with pytest.raises(InputError, match=r"parameter row has shape \[5\]"):
        GuidedPlanner(guide=tmp_path / "short.safetensors")
