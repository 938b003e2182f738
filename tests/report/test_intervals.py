"""Intervals: the bootstrap on data whose spread is known, Wilson's by figures in the books."""

import math

import numpy as np
import pytest

from moonteam.report.intervals import Bootstrap, share, wilson


@pytest.mark.parametrize(("hits", "count", "low", "high"), [
    (50, 50, 0.9287, 1.0), (0, 50, 0.0, 0.0713), (25, 50, 0.3664, 0.6336),
    (10, 10, 0.7225, 1.0), (0, 10, 0.0, 0.2775), (5, 10, 0.2366, 0.7634)])
def test_wilsons_interval(hits, count, low, high):
    assert wilson(hits, count) == pytest.approx((low, high), abs=1e-4)


def test_wilsons_interval_of_nothing_says_nothing():
    assert wilson(0, 0) == (0.0, 1.0)


def test_wilsons_interval_is_that_of_the_formula():
    for count in (1, 7, 20, 200):
        for hits in range(count + 1):
            share, more = hits / count, 1.96**2 / count
            half = 1.96 * math.sqrt(share * (1 - share) / count + more / (4 * count))
            ends = ((share + more / 2 + sign * half) / (1 + more) for sign in (-1, 1))
            assert wilson(hits, count) == pytest.approx(tuple(ends), abs=2e-5)


def test_two_of_two_is_no_certain_thing():
    assert share([True, True]) == pytest.approx((1.0, 0.3424, 1.0), abs=1e-4)
    assert share([0, 0, 0]) == pytest.approx((0.0, 0.0, 0.5615), abs=1e-4)
    assert share([1.0, math.nan]) == pytest.approx((1.0, *wilson(1, 1)))
    assert all(math.isnan(v) for v in share([]))


def test_a_share_of_single_ones_is_wilsons():
    assert share([1, 0, 0, 1, 1]) == pytest.approx((0.6, *wilson(3, 5)))


def test_hits_that_come_together_count_for_less():
    spread, together = share([1] * 10, [10] * 10), share([10] + [0] * 9, [10] * 10)
    assert spread.value == together.value == 0.1
    assert spread == pytest.approx((0.1, *wilson(10, 100)))
    # All ten in one of ten scenarios: as one hit of ten.
    assert together == pytest.approx((0.1, *wilson(1, 10)))


def test_bootstrap_interval_is_that_of_the_normal_mean():
    values = np.random.default_rng(3).normal(5.0, 2.0, 400)
    figure = Bootstrap(400, seed=0).mean(values)
    half = 1.96 * values.std() / 20
    assert figure.value == pytest.approx(values.mean())
    assert figure.low == pytest.approx(values.mean() - half, abs=0.05)
    assert figure.high == pytest.approx(values.mean() + half, abs=0.05)


def test_bootstrap_covers_the_truth_about_as_often_as_it_says():
    rng = np.random.default_rng(1)
    hits = 0
    for trial in range(200):
        values = rng.exponential(1.0, (2, 80))
        figure = Bootstrap(80, seed=trial, resamples=400).ratio(values[0], values[1])
        hits += figure.low <= 1.0 <= figure.high
    assert 0.90 <= hits / 200 <= 0.985


def test_bootstrap_is_paired_and_repeatable():
    values = np.random.default_rng(0).normal(size=50)
    one, two = Bootstrap(50, seed=4), Bootstrap(50, seed=4)
    assert one.mean(values) == two.mean(values)
    assert one.mean(values) != Bootstrap(50, seed=5).mean(values)
    # Twice as long on every scenario: the gap has no spread, only paired draws show that.
    assert one.ratio(2 * np.abs(values), np.abs(values)) == pytest.approx((2.0, 2.0, 2.0))


def test_nothing_known_is_not_a_number():
    figure = Bootstrap(3, seed=0).ratio(np.ones(3), np.full(3, np.nan))
    assert all(np.isnan(v) for v in figure)
