"""The arithmetic of the tables on rows made by hand."""

from collections import Counter

import numpy as np
import pytest

from moonteam.evaluation import metrics, optima
from moonteam.evaluation.metrics import Family, Outcomes, Reference
from moonteam.problem.scenario import Agent, Optimal, Scenario, Target
from moonteam.report.intervals import Bootstrap

FAMILY = Family(("a", "b", "c", "d"), np.full(4, 128), np.full(4, 3))
REFERENCE = Reference(np.array([30.0, 40.0, 50.0, 60.0]), np.array([60.0, 70.0, 80.0, 90.0]))


def outcomes(success, steps, moves):
    return Outcomes("x", np.array(success), np.array(steps), np.array(moves), seconds=2.0)


def test_figures_are_ratios_of_means_with_failures_counted():
    found = outcomes([True, True, True, False], [30, 50, 60, 128], [66, 70, 100, 200])
    row = metrics.summary(found, FAMILY, REFERENCE, Bootstrap(4, seed=0))
    assert row["success"] == 0.75
    assert row["makespan"] == (30 + 50 + 60 + 128) / 4
    assert row["moves"] == (66 + 70 + 100 + 200) / 4
    assert row["M_st"] == (98 + 78 + 68 + 0) / 4
    assert row["M_tte"] == (318 + 314 + 284 + 184) / 4
    assert row["st_ratio"] == pytest.approx((98 + 78 + 68 + 0) / (98 + 88 + 78 + 68))
    assert row["tte_ratio"] == pytest.approx((318 + 314 + 284 + 184) / (324 + 314 + 304 + 294))
    assert row["makespan_gap"] == pytest.approx(268 / 180 - 1)
    assert row["moves_gap"] == pytest.approx(436 / 300 - 1)
    assert row["seconds"] == 0.5


def test_the_optimum_itself_has_ratio_one_and_gap_zero():
    found = outcomes([True] * 4, [30, 40, 50, 60], [60, 70, 80, 90])
    row = metrics.summary(found, FAMILY, REFERENCE, Bootstrap(4, seed=0))
    assert (row["st_ratio"], row["tte_ratio"]) == (1.0, 1.0)
    assert (row["makespan_gap"], row["moves_gap"]) == (0.0, 0.0)
    assert row["intervals"]["makespan_gap"] == [0.0, 0.0]
    assert row["intervals"]["success"] == pytest.approx([0.5101, 1.0], abs=1e-4)  # Wilson, 4 of 4


def test_mixed_horizons_and_teams_are_counted_scenario_by_scenario():
    family = Family(("a", "b"), np.array([100, 10]), np.array([2, 1]))
    found = outcomes([True, False], [50, 10], [60, 10])
    known = Reference(np.array([40.0, np.nan]), np.array([np.nan, np.nan]))
    row = metrics.summary(found, family, known, Bootstrap(2, seed=0))
    assert row["M_st"] == (50 + 0) / 2
    assert row["M_tte"] == (140 + 0) / 2
    assert row["makespan_gap"] == pytest.approx(50 / 40 - 1)  # the scenario with an optimum
    assert np.isnan(row["moves_gap"])


def test_rows_say_null_where_a_planner_failed():
    found = outcomes([True, True, True, False], [30, 50, 60, 128], [66, 70, 100, 200])
    rows = metrics.rows(found, FAMILY, REFERENCE)
    assert rows[0] == {"id": "a", "planner": "x", "success": True, "makespan": 30, "moves": 66,
                       "optimal": {"makespan": 30, "moves": 60}}
    assert rows[3]["makespan"] is None
    assert rows[3]["moves"] == 200


def test_lengths_must_agree():
    with pytest.raises(ValueError, match="one length"):
        outcomes([True], [3, 4], [5, 6])


def scenario(optimal=None, targets=1):
    cells = [(x, y) for x in range(6) for y in range(6)][1:]
    return Scenario(size=(6, 6), agents=(Agent((0, 0), ("A",)),), optimal=optimal,
                    targets=tuple(Target(cells[i], ("A",), "OR") for i in range(targets)))


def test_optima_come_from_the_file_else_from_the_exact_planner_else_the_best_known():
    found = optima.reference([
        scenario(Optimal(makespan=9, moves=8)), scenario(),
        scenario(Optimal(best_makespan=50, best_moves=51), targets=20)])
    assert found.makespan.tolist() == [9, 1, 50]
    assert found.moves.tolist() == [8, 1, 51]
    for words in (optima.CERTIFIED, optima.SOLVED, optima.BEST):
        assert f"{words} (1 of 3)" in found.source


def test_sources_in_words():
    assert optima.describe(Counter(a=3), Counter(a=3), 3) == "a"
    assert optima.describe(Counter(a=3), Counter(a=2, b=1), 3) == (
        "makespan: a. moves: a (2 of 3); b (1 of 3)")
