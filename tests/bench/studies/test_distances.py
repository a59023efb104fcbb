"""Slopes and bins of the study ``distance``, for views of known scale."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rebar_depth_bench.studies.distance.study import ALL_CONFIGS, DistancePoint, bin_views, fit_scale_slope

from rebar_depth_bench.scoring.bootstrap import MIN_VIEWS
from rebar_depth_bench.scoring.metrics import DepthMetrics
from rebar_depth_bench.scoring.single_bar import SingleBarScore
from rebar_depth_bench.scoring.view_score import ViewScore

SWEEP_M = [0.22 * 7.0 ** (step / 11) for step in range(12) for _ in range(8)]


def point(
    distance_m: float, scale: float | None, index: int = 0, config: str = "lattice-distance"
) -> DistancePoint:
    metrics = None if scale is None else DepthMetrics(abs(1 / scale - 1), 1.0, 1.0, 0.5)
    coverage = 0.0 if scale is None else 1.0
    view = ViewScore(f"{config}/{index:04d}", 9, coverage, 0.5, scale, metrics, metrics, {})
    return DistancePoint(config, index, distance_m, view, SingleBarScore(0.5, coverage, metrics, metrics))


def sweep(scales: Sequence[float], config: str = "lattice-distance") -> list[DistancePoint]:
    return [
        point(distance_m, scale, index, config)
        for index, (distance_m, scale) in enumerate(zip(SWEEP_M, scales, strict=True))
    ]


def power_law(slope: float, noise: float, seed: int) -> list[DistancePoint]:
    rng = np.random.default_rng(seed)
    return sweep([0.5 * distance_m**slope * math.exp(rng.normal(0, noise)) for distance_m in SWEEP_M])


@pytest.mark.parametrize("slope", [-0.5, 0.0, 0.7, 1.0])
def test_power_law_is_recovered_exactly(slope: float) -> None:
    fit = fit_scale_slope("c", {"c": power_law(slope, 0.0, 0)})
    assert fit.slope.value == pytest.approx(slope, abs=1e-12)
    assert fit.slope.interval == pytest.approx((slope, slope), abs=1e-9)
    assert (fit.nearest_m, fit.farthest_m) == pytest.approx((0.22, 1.54))


def test_slope_interval_has_nominal_coverage() -> None:
    covered, widths = 0, []
    for seed in range(60):
        low, high = fit_scale_slope("c", {"c": power_law(0.6, 0.2, seed)}).slope.interval or (math.nan, math.nan)
        covered += low <= 0.6 <= high
        widths.append(high - low)
    assert 50 <= covered <= 60, "95 % of 60 are 57; percentile intervals are a little narrow"
    standard_error = 0.2 / (np.std(np.log(SWEEP_M)) * math.sqrt(len(SWEEP_M)))
    assert np.mean(widths) == pytest.approx(2 * 1.96 * standard_error, rel=0.25)


@given(st.lists(st.tuples(st.floats(0.1, 20.0), st.floats(0.05, 20.0)), min_size=3, max_size=40))
def test_slope_matches_polyfit(pairs: list[tuple[float, float]]) -> None:
    points = [point(distance_m, scale, index) for index, (distance_m, scale) in enumerate(pairs)]
    slope = fit_scale_slope("c", {"c": points}).slope.value
    x, y = np.log(np.array(pairs)).T
    if np.exp(np.ptp(x)) < 1.05 * (1 - 1e-12):
        assert slope is None
    elif np.exp(np.ptp(x)) > 1.06:
        assert slope == pytest.approx(np.polyfit(x, y, 1)[0], rel=1e-6, abs=1e-6)


def test_slope_of_shift_lies_between_its_end_derivatives() -> None:
    """p = z + b needs s = z / (z + b), whose log-log slope at distance z is b / (z + b)."""
    shift_m = 0.3
    slope = fit_scale_slope(
        "c", {"c": sweep([distance_m / (distance_m + shift_m) for distance_m in SWEEP_M])}
    ).slope
    assert slope.value is not None
    assert shift_m / (1.54 + shift_m) < slope.value < shift_m / (0.22 + shift_m)


def test_slope_of_all_configs_uses_all_views() -> None:
    near = [point(distance_m, 0.5, index, "a") for index, distance_m in enumerate(np.linspace(0.2, 0.4, 10))]
    far_away = [point(distance_m, 5.0, index, "b") for index, distance_m in enumerate(np.linspace(8.0, 16.0, 10))]
    fit = fit_scale_slope(ALL_CONFIGS, {"a": near, "b": far_away})
    x = np.log([view_point.distance_m for view_point in (*near, *far_away)])
    y = np.log([view_point.score.scale or math.nan for view_point in (*near, *far_away)])
    assert fit.slope.value == pytest.approx(np.polyfit(x, y, 1)[0])
    assert fit.slope.value is not None
    assert fit.slope.interval is not None
    assert 0 < fit.slope.interval[0] <= fit.slope.value <= fit.slope.interval[1]
    assert fit.views == 20


@pytest.mark.parametrize("far_m", [[], [0.5], [0.5] * 8, [0.5, 0.52]])
def test_no_slope_without_distinct_distances(far_m: list[float]) -> None:
    fit = fit_scale_slope(
        "c", {"c": [point(distance_m, 1.0 + index, index) for index, distance_m in enumerate(far_m)]}
    )
    assert (fit.slope.value, fit.slope.interval) == (None, None)


def test_few_views_give_slope_without_interval() -> None:
    points = [point(0.2 * 2**index, 0.3 * 2**index, index) for index in range(MIN_VIEWS - 1)]
    slope = fit_scale_slope("c", {"c": points}).slope
    assert slope.value == pytest.approx(1.0)
    assert slope.interval is None


def test_views_without_finite_scale_are_ignored() -> None:
    good = power_law(0.5, 0.0, 0)
    bad = [point(1.0, None, 96), point(1.0, math.inf, 97)]
    assert fit_scale_slope("c", {"c": [*good, *bad]}) == fit_scale_slope("c", {"c": good})


@given(st.lists(st.floats(0.05, 30.0), min_size=1, max_size=50), st.integers(1, 30))
def test_bins_partition_views(far_m: list[float], per_decade: int) -> None:
    points = [point(distance_m, 1.0, index) for index, distance_m in enumerate(far_m)]
    bins = bin_views(points, per_decade)
    assert sum(distance_bin.views for distance_bin in bins) == len(points)
    assert all(
        distance_bin.low_m * (1 - 1e-6) <= distance_bin.distance_m <= distance_bin.high_m * (1 + 1e-6)
        for distance_bin in bins
    )
    assert all(first.high_m <= second.low_m * (1 + 1e-9) for first, second in pairwise(bins))
    assert all(
        distance_bin.high_m / distance_bin.low_m == pytest.approx(10 ** (1 / per_decade)) for distance_bin in bins
    )


def test_bin_summarises_its_views() -> None:
    scales = [0.5, 0.8, 1.0, 1.25, 2.0, 4.0, None]
    [distance_bin] = bin_views([point(1.0, scale, index) for index, scale in enumerate(scales)], 10)
    assert (distance_bin.low_m, distance_bin.views, distance_bin.views_scored) == (1.0, 7, 6)
    assert distance_bin.scale.value == 1.125
    assert distance_bin.scale_range == (0.5, 4.0)
    errors = [1.0, 0.25, 0.0, 0.2, 0.5, 0.75]
    assert distance_bin.native_abs_rel.value == pytest.approx(np.mean(errors))
    for estimate, values in ((distance_bin.scale, [0.5, 4.0]), (distance_bin.native_abs_rel, errors)):
        assert estimate.interval is not None
        assert estimate.value is not None
        assert min(values) <= estimate.interval[0] < estimate.value < estimate.interval[1] <= max(values)


def test_bin_without_prediction_has_no_values() -> None:
    [distance_bin] = bin_views([point(1.0, None, index) for index in range(8)], 10)
    assert (distance_bin.views, distance_bin.views_scored, distance_bin.scale.value, distance_bin.scale_range) == (
        8,
        0,
        None,
        None,
    )
    assert (distance_bin.native_abs_rel.value, distance_bin.native_abs_rel.interval) == (None, None)
