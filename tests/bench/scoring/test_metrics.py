"""Tests of the protocol's metrics: hand-computed cases and properties of every prediction."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rebar_depth_bench.scoring.metrics import (
    depth_metrics,
    is_valid_prediction,
    median,
    median_scale,
    metrics_at_scales,
)

DEPTHS = hnp.arrays(np.float64, st.integers(1, 40), elements=st.floats(0.05, 50.0))


def depth_pairs() -> st.SearchStrategy[tuple[np.ndarray, np.ndarray]]:
    return st.integers(1, 40).flatmap(
        lambda n: st.tuples(
            hnp.arrays(np.float64, n, elements=st.floats(0.05, 50.0)),
            hnp.arrays(np.float64, n, elements=st.floats(0.05, 50.0)),
        )
    )


def test_golden_case_by_hand() -> None:
    z = np.array([1.0, 2.0, 4.0, 5.0])
    p = np.array([1.5, 2.0, 3.0, 7.0])
    metrics = depth_metrics(p, z)
    assert metrics.abs_rel == pytest.approx((0.5 / 1 + 0 + 1 / 4 + 2 / 5) / 4)
    assert metrics.rmse_cm == pytest.approx(100 * math.sqrt((0.25 + 0 + 1 + 4) / 4))
    assert metrics.mae_cm == pytest.approx(100 * (0.5 + 0 + 1 + 2) / 4)
    assert metrics.delta1 == 0.25  # ratios 1.5, 1, 1.33, 1.4
    assert median_scale(p, float(np.median(z))) == pytest.approx(3.0 / 2.5)  # means of the two middle values each


def test_delta1_is_strict_at_its_threshold() -> None:
    z = np.array([4.0, 4.0, 5.0])
    p = np.array([5.0, np.nextafter(5.0, 0), 4.0])
    assert depth_metrics(p, z).delta1 == pytest.approx(1 / 3)


def test_exact_prediction_has_zero_error() -> None:
    z = np.linspace(0.1, 17, 101)
    metrics = depth_metrics(z.copy(), z)
    assert (metrics.abs_rel, metrics.rmse_cm, metrics.mae_cm, metrics.delta1) == (0.0, 0.0, 0.0, 1.0)
    assert median_scale(z.copy(), float(np.median(z))) == 1.0


@pytest.mark.slow
@given(depth_pairs())
def test_metrics_agree_with_exact_rational_arithmetic(pair: tuple[np.ndarray, np.ndarray]) -> None:
    p, z = pair
    n = len(z)
    errors = [abs(Fraction(a) - Fraction(b)) for a, b in zip(p.tolist(), z.tolist(), strict=True)]
    metrics = depth_metrics(p, z)
    abs_rel = sum(e / Fraction(b) for e, b in zip(errors, z.tolist(), strict=True)) / n
    assert metrics.abs_rel == pytest.approx(float(abs_rel), rel=1e-12, abs=1e-15)
    assert metrics.mae_cm == pytest.approx(100 * float(sum(errors) / n), rel=1e-12, abs=1e-13)
    assert metrics.rmse_cm == pytest.approx(100 * math.sqrt(sum(e * e for e in errors) / n), rel=1e-12, abs=1e-13)


@pytest.mark.slow
@given(depth_pairs(), st.floats(1e-3, 1e3))
def test_scaled_error_is_independent_of_unit(pair: tuple[np.ndarray, np.ndarray], unit: float) -> None:
    p, z = pair
    first = depth_metrics(median_scale(p, float(np.median(z))) * p, z)
    second = depth_metrics(median_scale(unit * p, float(np.median(z))) * (unit * p), z)
    assert first.abs_rel == pytest.approx(second.abs_rel, rel=1e-9, abs=1e-12)
    assert first.rmse_cm == pytest.approx(second.rmse_cm, rel=1e-9, abs=1e-12)


@given(depth_pairs())
def test_metric_bounds_and_monotonic_tolerances(pair: tuple[np.ndarray, np.ndarray]) -> None:
    p, z = pair
    metrics = depth_metrics(p, z)
    assert 0.0 <= metrics.delta1 <= 1.0
    assert 0.0 <= metrics.mae_cm <= metrics.rmse_cm * (1 + 1e-12)
    _, counts = metrics_at_scales(p, z, (1.0,), (3, 5, 10, 20))
    assert list(counts.values()) == sorted(counts.values())
    assert all(0 <= count <= len(z) for count in counts.values())


@given(DEPTHS, st.integers(0, 2**32 - 1))
def test_metrics_are_independent_of_pixel_order(z: np.ndarray, seed: int) -> None:
    p = z[::-1] + 0.5
    order = np.random.default_rng(seed).permutation(len(z))
    first, second = depth_metrics(p, z), depth_metrics(p[order], z[order])
    assert first.abs_rel == pytest.approx(second.abs_rel, rel=1e-12)
    assert median_scale(p, 1.0) == median_scale(p[order], 1.0)


def test_tolerance_is_inclusive_and_uses_first_scale() -> None:
    z = np.array([4.0, 2.0**-9, 1.0, 0.5])
    p = z + np.array([0.0, 0.003, 0.0031, 0.015])  # adding 0.003 to 2^-9 does not round up
    assert abs(p[1] - z[1]) == 0.003
    assert metrics_at_scales(p, z, (1.0, 9.0), (3, 20))[1] == {3: 2, 20: 4}


@pytest.mark.parametrize("count", [1, 2, 3, 16383, 16384, 16385, 60_001])
@pytest.mark.parametrize("kind", ["smooth", "sorted", "equal", "two values", "misleading sample"])
@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_median_equals_numpy(count: int, kind: str, dtype: type) -> None:
    rng = np.random.default_rng(count)
    values = rng.uniform(0.2, 17.0, count)
    if kind == "sorted":
        values.sort()
    elif kind == "equal":
        values[:] = 0.3
    elif kind == "two values":
        values = np.where(rng.random(count) < 0.5, 0.3, 4.0)
    elif kind == "misleading sample":
        values[:: max(count // 4096, 1)] = 16.5  # exactly the pixels that a sample takes
    values = values.astype(dtype)
    assert median(values) == np.median(values.astype(np.float64))


def test_metrics_of_large_view_equal_numpy() -> None:
    rng = np.random.default_rng(6)
    z = rng.uniform(0.2, 17.0, 50_001)
    p = z * rng.uniform(0.7, 1.4, len(z)) + rng.normal(0, 0.01, len(z))
    metrics = depth_metrics(p, z, 0.9)
    error_m = np.abs(0.9 * p - z)
    assert metrics.abs_rel == pytest.approx(np.mean(error_m / z), rel=1e-12)
    assert metrics.rmse_cm == pytest.approx(100 * np.sqrt(np.mean(error_m**2)), rel=1e-12)
    assert metrics.mae_cm == pytest.approx(100 * np.mean(error_m), rel=1e-12)
    assert metrics.delta1 == np.mean(np.maximum(0.9 * p / z, z / (0.9 * p)) < 1.25)
    both, within = metrics_at_scales(p, z, (1.0, 0.9), (5, 20))
    assert within == {t: np.count_nonzero(np.abs(p - z) <= t / 1000) for t in (5, 20)}
    assert both == [depth_metrics(p, z), metrics]


def test_valid_prediction_is_finite_and_positive() -> None:
    values = np.array([1.0, 0.0, -1.0, np.nan, np.inf, -np.inf, 5e-324])
    assert is_valid_prediction(values).tolist() == [True, False, False, False, False, False, True]


@pytest.mark.parametrize("huge", [1e200, 1e308])
def test_overflow_gives_infinity_without_warning(huge: float) -> None:
    z = np.array([1.0, 2.0, 3.0])
    assert math.isinf(depth_metrics(np.full(3, huge), z).rmse_cm)
