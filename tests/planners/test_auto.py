"""The planner that chooses by itself, in steps and by the clock: which, and why."""

from dataclasses import replace

import numpy as np

from moonteam.commands import clocked, plan
from moonteam.loading import load_one
from moonteam.planners import auto, exact
from moonteam.planners.auto import AutoPlanner
from moonteam.planners.base import Snapshot
from moonteam.planners.kind import PlannerOptions
from moonteam.planners.seconds import auto as timed_auto
from moonteam.planners.seconds.base import moment, problems
from moonteam.planners.seconds.exact import ExactPlanner as ByTheClock
from moonteam.problem import timed


def steps(name):
    return Snapshot.start(plan.case_of(load_one(name)).scenario)


def seconds(name):
    return moment(timed.of(plan.case_of(load_one(name)).scenario))


def by_the_clock(now, limit):
    found = clocked.make_plan("auto", PlannerOptions(time_limit=limit), now)
    assert not problems(now, found.services)
    return found


def test_a_small_mission_is_certified():
    found, best = AutoPlanner(time_limit=20.0), exact.ExactPlanner()
    one, two = found.plan(steps("3x5:0")), best.plan(steps("3x5:0"))
    assert (one.status, one.makespan, one.planner) == ("optimal", two.makespan, "auto: exact")
    assert one.reason == "certified"
    by_clock = by_the_clock(seconds("3x5:0"), 20.0)
    assert by_clock.makespan == ByTheClock().plan(seconds("3x5:0")).makespan
    assert (by_clock.status, by_clock.planner) == ("optimal", "auto: exact")


def test_more_targets_than_exact_takes_are_searched():
    found = AutoPlanner(time_limit=0.2).plan(steps("5x20:0"))
    assert (found.status, found.planner) == ("feasible", "auto: guided")
    assert found.reason == "20 targets are more than the 12 that the exact planner takes"
    by_clock = by_the_clock(seconds("5x20:0"), 0.2)
    assert (by_clock.status, by_clock.planner) == ("feasible", "auto: local")
    assert "than the 14" in by_clock.reason


def test_what_is_not_certified_in_time_is_the_better_of_two(monkeypatch):
    monkeypatch.setattr(exact, "_FIRST_NODES", 1)
    monkeypatch.setattr(auto, "SHARE", 1e-6)
    cases = (steps(f"3x12:{i}") for i in range(20))
    now, first = next((now, plan) for now in cases if (
        plan := exact.ExactPlanner(time_limit=1e-6).plan(now)).status == "feasible")
    found = AutoPlanner(time_limit=0.2).plan(now)
    assert found.makespan is not None
    assert found.makespan <= (first.makespan or 0)
    assert (found.bound or 0) >= (first.bound or 0) > 0
    assert found.reason == "12 targets were not certified within 2e-07 s"


def test_by_the_clock_too_it_is_the_better_of_two(monkeypatch):
    monkeypatch.setattr(timed_auto, "SHARE", 1e-6)
    now = seconds("3x12:1")
    first, found = ByTheClock(time_limit=1e-6).plan(now), by_the_clock(now, 0.2)
    assert first.status == "feasible", "else this tests nothing"
    assert (found.makespan or 0) <= (first.makespan or 0)
    assert found.bound == first.bound
    assert "were not certified" in found.reason


def test_who_cannot_is_told_so():
    """Nobody has the skill: no planner is to blame, and none is named as chosen."""
    start = steps("3x5:0")
    poor = replace(start, agent_skills=np.zeros_like(start.agent_skills))
    assert AutoPlanner().plan(poor).status == "infeasible"


def test_the_command_says_which_and_why(capsys):
    assert plan.run(plan.Args("3x5:0", planner="auto")) == 0
    assert "auto: exact: certified" in capsys.readouterr().out
