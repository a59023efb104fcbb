"""Estimates over views, with their intervals."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from rebar_depth_bench.extended.estimates import estimate
from rebar_depth_bench.extended.measures import STATISTICS, Measure, Samples, Statistic
from rebar_depth_bench.scoring.bootstrap import resample

RNG = np.random.default_rng(7)
BY_VIEW = [{"s": RNG.normal(3.0, 1.0, size)} for size in RNG.integers(0, 30, 300)]
INDICES = range(0, 300 * 12, 12)  # so far apart that each view is a block


def measure(statistic: Statistic) -> Measure:
    return Measure("m", "M", "mm", "lower", "for this test", "s", statistic)


@pytest.mark.parametrize(
    ("statistic", "truth"), [("mean", 3.0), ("median", 3.0), ("std", 1.0), ("p95", 3 + 1.6449)]
)
def test_estimate_is_pooled_with_an_interval_as_wide_as_the_spread_over_new_samples(
    statistic: Statistic, truth: float
) -> None:
    pooled = np.concatenate([samples["s"] for samples in BY_VIEW])
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
    rng = np.random.default_rng(1)
    values = [STATISTICS[statistic](rng.normal(3, 1, found.samples)) for _ in range(300)]
    low, high = np.percentile(values, [2.5, 97.5])
    assert found.interval[1] - found.interval[0] == pytest.approx(high - low, rel=0.25)
    assert abs(np.mean(found.interval) - truth) < high - low


def test_views_and_tables_without_samples() -> None:
    no_samples: list[Samples] = [{}] * 8
    assert estimate(measure("p95"), no_samples, resample(range(8))) == estimate(measure("mean"), [], resample([]))
    one_view = [{"s": np.ones(3)}, *no_samples[1:]]
    estimated = estimate(measure("mean"), one_view, resample(range(8)))
    assert (estimated.value, estimated.interval, estimated.samples) == (1.0, None, 3)


def test_infinite_samples_have_no_interval() -> None:
    samples = [{"s": np.array([1.0, math.inf])}] * 10
    assert estimate(measure("p95"), samples, resample(range(10))).value == math.inf
    assert estimate(measure("p95"), samples, resample(range(10))).interval is None
