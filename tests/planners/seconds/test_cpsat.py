"""CP-SAT by the clock, against the exact planner."""

import sys
import time

import pytest

from moonteam.errors import InputError
from moonteam.planners.seconds.cpsat import CpSatPlanner
from moonteam.planners.seconds.exact import ExactPlanner
from moonteam.planners.seconds.search.goal import value

pytest.importorskip("ortools")


def test_it_agrees_with_the_exact_planner_where_it_closes(instances):
    closed = 0
    for seed in range(40, 70):
        now = instances.instance(seed, 4)
        goal = (instances.OBJECTIVES[seed % 3], 1.0, 0.3)
        wanted = ExactPlanner(*goal).plan(now)
        got = CpSatPlanner(*goal, time_limit=2.0).plan(now)
        assert (got.status == "infeasible") == (wanted.status == "infeasible"), seed
        if wanted.status != "infeasible":
            cost = value(*goal, instances.judged(now, got).makespan, got.effort)
            assert got.bound <= wanted.bound + 1e-3
            assert cost >= wanted.bound - 1e-6
            if got.status == "optimal":
                closed += 1
                assert cost == pytest.approx(wanted.bound, abs=1e-3)
    assert closed > 15


def test_the_limit_is_kept_with_at_least_the_hint(instances):
    now = instances.large(0, 10, 25)
    CpSatPlanner(time_limit=0.1).plan(now)
    began = time.perf_counter()
    plan = instances.judged(now, CpSatPlanner(time_limit=1.0).plan(now))
    assert time.perf_counter() - began < 1.5
    assert plan.status == "feasible"
    assert plan.bound <= plan.makespan


def test_without_ortools_it_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "ortools.sat.python.cp_model", None)
    with pytest.raises(InputError, match=r"pip install moonteam\[ortools\]"):
        CpSatPlanner()
