"""Tables of extended measures: pooled statistics and their intervals, against independent ones."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from rebar_depth_bench.extended.measures import STATISTICS, Measure, Statistic
from rebar_depth_bench.extended.result import estimate
from rebar_depth_bench.scoring.bootstrap import resample

RNG = np.random.default_rng(7)
BY_VIEW = [RNG.normal(3.0, 1.0, size) for size in RNG.integers(0, 30, 300)]
INDICES = range(0, 300 * 12, 12)  # so far apart that each view is a block


def measure(statistic: Statistic) -> Measure:
    return Measure("m", "s", statistic, "M", "mm", "lower", "for this test")


@pytest.mark.parametrize("statistic", list(STATISTICS))
def test_a_measure_is_the_statistic_of_all_samples_within_its_interval(statistic: Statistic) -> None:
    pooled = np.concatenate(BY_VIEW)
    by_hand: dict[str, Callable[[np.ndarray], float]] = {
        "mean": np.mean,
        "median": np.median,
        "std": np.std,
        "p95": lambda x: float(np.percentile(x, 95)),
    }
    found = estimate(measure(statistic), BY_VIEW, resample(INDICES))
    assert found.samples == len(pooled)
    assert found.value == pytest.approx(by_hand[statistic](pooled), rel=2e-3)
    assert found.interval is not None
    assert found.value is not None
    assert found.interval[0] < found.value < found.interval[1]


@pytest.mark.parametrize(
    ("statistic", "truth"), [("mean", 3.0), ("median", 3.0), ("std", 1.0), ("p95", 3 + 1.6449)]
)
def test_the_interval_is_as_wide_as_the_spread_over_fresh_samples(statistic: Statistic, truth: float) -> None:
    found = estimate(measure(statistic), BY_VIEW, resample(INDICES)).interval
    assert found is not None
    fresh = np.random.default_rng(1)
    values = [STATISTICS[statistic](fresh.normal(3, 1, sum(map(len, BY_VIEW)))) for _ in range(300)]
    low, high = np.percentile(values, [2.5, 97.5])
    assert found[1] - found[0] == pytest.approx(high - low, rel=0.25)
    assert abs(np.mean(found) - truth) < high - low


def test_views_without_samples_and_tables_without_any() -> None:
    none = [np.empty(0)] * 8
    assert estimate(measure("p95"), none, resample(range(8))) == estimate(measure("mean"), [], resample([]))
    some = [np.ones(3), *none[1:]]
    found = estimate(measure("mean"), some, resample(range(8)))
    assert (found.value, found.interval, found.samples) == (1.0, None, 3)


def test_infinite_samples_have_no_interval_and_no_warning() -> None:
    samples = [np.array([1.0, math.inf])] * 10
    assert estimate(measure("p95"), samples, resample(range(10))).value == math.inf
    assert estimate(measure("p95"), samples, resample(range(10))).interval is None
