"""The numbers of the study ``distance``: slopes and bins of views whose scales are known."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rebar_depth_bench.scoring.bootstrap import MIN_VIEWS
from rebar_depth_bench.scoring.metrics import DepthMetrics
from rebar_depth_bench.scoring.result import ViewScore
from rebar_depth_bench.studies.distance.study import ALL, ViewPoint, bins_of, slope_of

SWEEP_M = [0.22 * 7.0 ** (step / 11) for step in range(12) for _ in range(8)]


def point(distance_m: float, scale: float | None, index: int = 0, config: str = "lattice-distance") -> ViewPoint:
    metrics = None if scale is None else DepthMetrics(abs(1 / scale - 1), 1.0, 1.0, 0.5)
    coverage = 0.0 if scale is None else 1.0
    view = ViewScore(f"{config}/{index:04d}", 9, coverage, scale, metrics, metrics, {})
    return ViewPoint(config, index, distance_m, view)


def sweep(scales: Sequence[float], config: str = "lattice-distance") -> list[ViewPoint]:
    return [
        point(far, scale, index, config) for index, (far, scale) in enumerate(zip(SWEEP_M, scales, strict=True))
    ]


def power_law(slope: float, noise: float, seed: int) -> list[ViewPoint]:
    rng = np.random.default_rng(seed)
    return sweep([0.5 * far**slope * math.exp(rng.normal(0, noise)) for far in SWEEP_M])


@pytest.mark.parametrize("slope", [-0.5, 0.0, 0.7, 1.0])
def test_a_power_law_is_recovered_exactly(slope: float) -> None:
    found = slope_of("c", {"c": power_law(slope, 0.0, 0)})
    assert found.slope.value == pytest.approx(slope, abs=1e-12)
    assert found.slope.interval == pytest.approx((slope, slope), abs=1e-9)
    assert (found.nearest_m, found.farthest_m) == pytest.approx((0.22, 1.54))


def test_the_interval_holds_the_true_slope_about_as_often_as_it_says() -> None:
    held, widths = 0, []
    for seed in range(60):
        low, high = slope_of("c", {"c": power_law(0.6, 0.2, seed)}).slope.interval or (math.nan, math.nan)
        held += low <= 0.6 <= high
        widths.append(high - low)
    assert 50 <= held <= 60, "95 % of 60 are 57; percentile intervals are a little narrow"
    standard_error = 0.2 / (np.std(np.log(SWEEP_M)) * math.sqrt(len(SWEEP_M)))
    assert np.mean(widths) == pytest.approx(2 * 1.96 * standard_error, rel=0.25)


@given(st.lists(st.tuples(st.floats(0.1, 20.0), st.floats(0.05, 20.0)), min_size=3, max_size=40))
def test_the_slope_is_that_of_numpys_polyfit(pairs: list[tuple[float, float]]) -> None:
    points = [point(far, scale, index) for index, (far, scale) in enumerate(pairs)]
    found = slope_of("c", {"c": points}).slope.value
    x, y = np.log(np.array(pairs)).T
    if np.exp(np.ptp(x)) < 1.05 * (1 - 1e-12):
        assert found is None
    elif np.exp(np.ptp(x)) > 1.06:
        assert found == pytest.approx(np.polyfit(x, y, 1)[0], rel=1e-6, abs=1e-6)


def test_a_shift_has_the_slope_of_its_derivative() -> None:
    """p = z + b needs s = z / (z + b), whose slope in logarithms is b / (z + b) at distance z."""
    shift_m = 0.3
    found = slope_of("c", {"c": sweep([far / (far + shift_m) for far in SWEEP_M])}).slope
    assert found.value is not None
    assert shift_m / (1.54 + shift_m) < found.value < shift_m / (0.22 + shift_m)


def test_the_slope_of_all_goes_over_the_views_of_all() -> None:
    near = [point(far, 0.5, index, "a") for index, far in enumerate(np.linspace(0.2, 0.4, 10))]
    far_away = [point(far, 5.0, index, "b") for index, far in enumerate(np.linspace(8.0, 16.0, 10))]
    found = slope_of(ALL, {"a": near, "b": far_away})
    x = np.log([one.distance_m for one in (*near, *far_away)])
    y = np.log([one.score.scale or math.nan for one in (*near, *far_away)])
    assert found.slope.value == pytest.approx(np.polyfit(x, y, 1)[0])
    assert found.slope.value is not None
    assert found.slope.interval is not None
    assert 0 < found.slope.interval[0] <= found.slope.value <= found.slope.interval[1]
    assert found.views == 20


@pytest.mark.parametrize("far_m", [[], [0.5], [0.5] * 8, [0.5, 0.52]])
def test_no_slope_without_distances(far_m: list[float]) -> None:
    found = slope_of("c", {"c": [point(far, 1.0 + index, index) for index, far in enumerate(far_m)]})
    assert (found.slope.value, found.slope.interval) == (None, None)


def test_few_views_have_a_slope_and_no_interval() -> None:
    points = [point(0.2 * 2**index, 0.3 * 2**index, index) for index in range(MIN_VIEWS - 1)]
    found = slope_of("c", {"c": points}).slope
    assert found.value == pytest.approx(1.0)
    assert found.interval is None


def test_views_without_a_usable_scale_do_not_count() -> None:
    good = power_law(0.5, 0.0, 0)
    bad = [point(1.0, None, 96), point(1.0, math.inf, 97)]
    assert slope_of("c", {"c": [*good, *bad]}) == slope_of("c", {"c": good})


@given(st.lists(st.floats(0.05, 30.0), min_size=1, max_size=50), st.integers(1, 30))
def test_bins_hold_every_view_once(far_m: list[float], per_decade: int) -> None:
    points = [point(far, 1.0, index) for index, far in enumerate(far_m)]
    found = bins_of(points, per_decade)
    assert sum(one.views for one in found) == len(points)
    assert all(one.low_m * (1 - 1e-6) <= one.distance_m <= one.high_m * (1 + 1e-6) for one in found)
    assert all(first.high_m <= second.low_m * (1 + 1e-9) for first, second in pairwise(found))
    assert all(one.high_m / one.low_m == pytest.approx(10 ** (1 / per_decade)) for one in found)


def test_a_bin_says_what_its_views_say() -> None:
    scales = [0.5, 0.8, 1.0, 1.25, 2.0, 4.0, None]
    [found] = bins_of([point(1.0, scale, index) for index, scale in enumerate(scales)], 10)
    assert (found.low_m, found.views, found.views_scored) == (1.0, 7, 6)
    assert found.scale.value == 1.125
    assert found.scale_range == (0.5, 4.0)
    errors = [1.0, 0.25, 0.0, 0.2, 0.5, 0.75]
    assert found.native_abs_rel.value == pytest.approx(np.mean(errors))
    for estimate, values in ((found.scale, [0.5, 4.0]), (found.native_abs_rel, errors)):
        assert estimate.interval is not None
        assert estimate.value is not None
        assert min(values) <= estimate.interval[0] < estimate.value < estimate.interval[1] <= max(values)


def test_a_bin_without_any_prediction_has_no_numbers() -> None:
    [found] = bins_of([point(1.0, None, index) for index in range(8)], 10)
    assert (found.views, found.views_scored, found.scale.value, found.scale_range) == (8, 0, None, None)
    assert (found.native_abs_rel.value, found.native_abs_rel.interval) == (None, None)
