"""Intervals: bootstrap for means and for ratios of means, Wilson for shares.

Every mean of a report is resampled with the same draws, scenario by scenario, so that
planners on one set are compared on the same resampled sets. A share is not resampled: where all or
none are hits no draw is otherwise, and two of two would be a certain thing. Legend: S scenarios,
R draws.
"""

from __future__ import annotations

import math
from functools import cached_property
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

LEVEL = 0.95
RESAMPLES = 2000


class Figure(NamedTuple):
    """A value and the ends of its interval; not-a-number where nothing was measured."""

    value: float
    low: float
    high: float


NOTHING = Figure(math.nan, math.nan, math.nan)


def wilson(hits: float, count: float) -> tuple[float, float]:
    """The score interval of a share (Wilson 1927): honest where all or none of `count` are hits.

    (0, 1) where nothing was counted. `count` need not be whole: see `share`.
    """
    if count <= 0:
        return 0.0, 1.0
    z = NormalDist().inv_cdf((1 + LEVEL) / 2)
    rate, more = hits / count, z**2 / count
    half = z * math.sqrt(rate * (1 - rate) / count + more / (4 * count))
    middle = rate + more / 2
    return (0.0 if hits == 0 else (middle - half) / (1 + more),
            1.0 if hits == count else (middle + half) / (1 + more))


def share(hits: npt.ArrayLike, counts: npt.ArrayLike | None = None) -> Figure:
    """Sum of `hits` [S] over sum of `counts` [S] (1 each if not given), with Wilson's interval.

    Hits of one scenario are often alike, such as one robot's moves: the interval is that of as
    many independent ones as would spread alike (the design effect of Rao and Scott 1992, a ratio
    of variances; at least 1). Entries that are not a number are left out.
    """
    top = np.asarray(hits, np.float64)
    bottom = np.ones_like(top) if counts is None else np.asarray(counts, np.float64)
    known = np.isfinite(top) & np.isfinite(bottom)
    top, bottom = top[known], bottom[known]
    count = float(bottom.sum())
    if count == 0.0:
        return NOTHING
    rate = float(top.sum()) / count
    alone = rate * (1 - rate) * count
    effect = max(1.0, float(((top - rate * bottom) ** 2).sum()) / alone) if alone > 0 else 1.0
    return Figure(rate, *wilson(rate * count / effect, count / effect))


class Bootstrap:
    """Percentile bootstrap over S scenarios (Efron and Tibshirani 1993, section 13.3)."""

    def __init__(self, count: int, seed: int, resamples: int = RESAMPLES):
        self.count = count
        self.seed = seed
        self.resamples = resamples

    def mean(self, values: npt.ArrayLike) -> Figure:
        """The mean of values [S]; not-a-number entries are left out of it."""
        numbers = np.asarray(values, np.float64)
        return self.ratio(numbers, np.ones_like(numbers))

    def ratio(self, above: npt.ArrayLike, below: npt.ArrayLike) -> Figure:
        """Mean of `above` [S] over mean of `below` [S], over the scenarios that have both."""
        top, bottom = np.asarray(above, np.float64), np.asarray(below, np.float64)
        known = np.isfinite(top) & np.isfinite(bottom)
        top, bottom = np.where(known, top, 0.0), np.where(known, bottom, 0.0)
        if not known.any() or bottom.sum() == 0.0:
            return NOTHING
        sums = self._weights @ np.stack([top, bottom], axis=1)  # [R, 2]
        draws = sums[sums[:, 1] != 0.0]
        tail = 100 * (1 - LEVEL) / 2
        low, high = np.percentile(draws[:, 0] / draws[:, 1], [tail, 100 - tail])
        return Figure(float(top.sum() / bottom.sum()), float(low), float(high))

    @cached_property
    def _weights(self) -> npt.NDArray[np.float64]:
        """[R, S] how often each scenario is drawn into each resampled set."""
        generator = np.random.default_rng([self.seed, self.count])
        chances = np.full(self.count, 1.0 / self.count)
        return generator.multinomial(self.count, chances, size=self.resamples).astype(np.float64)
