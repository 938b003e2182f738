"""The exact planner by the clock, against everything tried."""

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from moonteam.errors import InputError
from moonteam.planners.seconds import exact
from moonteam.planners.seconds.base import NEVER
from moonteam.planners.seconds.exact import ExactPlanner
from moonteam.planners.seconds.exhaustive import ExhaustivePlanner
from moonteam.planners.seconds.search import plain
from moonteam.planners.seconds.search.goal import value
from moonteam.planners.seconds.search.work import compact


def compare(seeds, instances, most=5):
    """Statuses seen; every value must be that of the plain search to the millisecond."""
    seen = []
    for seed in seeds:
        now = instances.instance(seed, most)
        for objective in instances.OBJECTIVES:
            goal = (objective, 1.0, 0.3)
            wanted, got = ExhaustivePlanner(*goal).plan(now), ExactPlanner(*goal).plan(now)
            assert got.status == wanted.status, f"seed {seed}, {objective}"
            seen.append(got.status)
            if wanted.status == "infeasible":
                assert got.reason
                continue
            instances.judged(now, got)
            assert value(*goal, got.makespan, got.effort) == pytest.approx(
                wanted.bound, abs=1e-6, rel=0), f"seed {seed}, {objective}"
            assert got.bound == pytest.approx(wanted.bound, abs=1e-6, rel=0)
    return seen


def test_every_combination_of_options_agrees_with_everything_tried(instances):
    seen = compare(range(100), instances, most=3)
    seen += compare(range(1000, 1050), instances, most=4)
    seen += compare(range(2000, 2005), instances, most=5)
    assert 20 < seen.count("infeasible") < 150


@pytest.mark.soak
def test_many_more_agree(instances):
    compare(range(150, 650), instances)


def test_the_plain_case_is_solved_the_same_either_way(instances, monkeypatch):
    """What goes to the search in steps, services folded into ways, and what goes through labels."""
    nows = []
    for seed in range(30):
        now = instances.large(seed, 3, 4 + seed % 3, skills=2, most=1, service=seed % 2)
        nows.append(replace(now, home=np.zeros_like(now.home)))
    taken = 0
    for now in nows:
        work = compact(now).work
        taken += plain.fits(work, 1.0, 0.0)
        for objective in instances.OBJECTIVES:
            one = instances.judged(now, ExactPlanner(objective, 1.0, 0.3).plan(now))
            with monkeypatch.context() as patch:
                patch.setattr(plain, "fits", lambda *_: False)
                two = instances.judged(now, ExactPlanner(objective, 1.0, 0.3).plan(now))
            assert (one.status, two.status) == ("optimal", "optimal")
            assert one.bound == pytest.approx(two.bound, abs=1e-6, rel=0)
    assert taken > 15


def test_stopped_early_it_is_feasible_with_a_valid_bound(instances, monkeypatch):
    """By a clock that counts how often it is looked at; each time some teams later it goes on."""
    ticks = itertools.count()
    clock = SimpleNamespace(perf_counter=lambda: float(next(ticks)))
    monkeypatch.setattr(exact, "_TRIES", 5)
    monkeypatch.setattr(exact, "_SLICE", 1.0)
    seen = set()
    for seed in range(4):
        now = instances.large(seed, 3, 9, skills=2, most=1)
        for objective in instances.OBJECTIVES:
            goal = (objective, 1.0, 0.3)
            best = instances.judged(now, ExactPlanner(*goal).plan(now))
            assert best.status == "optimal"
            for looks in (1e-9, 20.0, 200.0, 1e9):
                with monkeypatch.context() as patched:
                    patched.setattr(exact, "time", clock)
                    early = ExactPlanner(*goal, time_limit=looks).plan(now)
                seen.add((early.status, looks, early.bound > 0))
                instances.judged(now, early)
                assert early.bound <= best.bound + 1e-6
                assert value(*goal, early.makespan, early.effort) >= best.bound - 1e-6
                assert early.status == "optimal" or looks < 1e9
    assert {("feasible", 1e-9, False), ("feasible", 20.0, True), ("feasible", 200.0, True)} <= seen


def test_from_the_middle_of_a_plan_what_remains_is_what_it_costs(instances):
    """After the first service has ended everybody stands where it is; the rest costs the rest."""
    for seed in range(10):
        now = instances.large(seed, 3, 6, skills=2, most=1)
        plan = ExactPlanner().plan(now)
        first = plan.services[0]
        j, team = first.target, list(first.agents)
        start, free, solved, ends = (now.start.copy(), now.free.copy(), now.solved.copy(),
                                     now.ends.copy())
        start[team], free[team], solved[j] = now.between[0, j], first.end, True
        ends[j] = first.end
        home_now = now.home_now.copy()
        home_now[team] = now.home[team, j]
        rest = replace(now, start=start, free=free, solved=solved, ends=ends, home_now=home_now)
        again = instances.judged(rest, ExactPlanner().plan(rest))
        assert again.makespan == plan.makespan


def test_reasons_are_named(instances):
    now = instances.large(0, 2, 3, skills=2, most=1)
    alone = replace(now, present=np.array([True, False]))
    assert "needs 1 agents with skill 1; the team has 0" in ExactPlanner().plan(alone).reason
    after = np.zeros((3, 3), bool)
    after[0, 1] = after[1, 0] = True
    circle = replace(now, after=after)
    assert ExactPlanner().plan(circle).reason == "targets [0, 1] wait for each other"
    tight = replace(now, limit=1)
    assert "limit of 1 ms" in ExactPlanner().plan(tight).reason
    short = replace(now, lapses=np.zeros(3, np.int64))
    assert "lapse" in ExactPlanner().plan(short).reason
    shut = replace(now, home=np.full_like(now.home, NEVER))
    assert "ways" in ExactPlanner().plan(shut).reason


def test_nothing_open_is_an_empty_plan(instances):
    now = instances.large(0, 2, 3, skills=2, most=1)
    done = replace(now, solved=np.ones(3, bool), ends=np.array([5, 9, 2]))
    plan = instances.judged(done, ExactPlanner().plan(done))
    assert (plan.status, plan.services, plan.makespan) == ("optimal", (), 9)
    assert ExactPlanner().plan(replace(done, limit=8)).status == "infeasible"


def test_too_much_and_nonsense_are_refused(instances):
    with pytest.raises(InputError, match="15 targets are open"):
        ExactPlanner().plan(instances.large(0, 3, 15))
    with pytest.raises(InputError, match="not one of"):
        ExactPlanner("moves")
    with pytest.raises(InputError, match="not allowed"):
        ExactPlanner("weighted", alpha=-1.0)
