"""Scored pixels, depth metrics and rank error: hand-computed cases, definitions and properties."""

from __future__ import annotations

import math
from fractions import Fraction
from itertools import product

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy import ndarray

from rebar_depth_bench.scoring.columns import rounded
from rebar_depth_bench.scoring.metrics import (
    depth_metrics,
    is_valid_prediction,
    mean,
    median,
    median_scale,
    metrics_at_scales,
    rank_error,
)
from rebar_depth_bench.scoring.protocol import WITHIN_MM, interior, scored_pixels
from rebar_depth_bench.scoring.view_numbers import ViewTruth, view_numbers

MASKS = hnp.arrays(bool, st.tuples(st.integers(1, 12), st.integers(1, 12)))
INVALID = (np.nan, 0.0, -0.0, -1.0, np.inf, -np.inf)


@settings(max_examples=50)
@example(np.ones((5, 7), bool))
@given(MASKS)
def test_scored_pixels_are_those_with_depth_and_steel_all_around(mask: ndarray) -> None:
    """The border of the image is never scored."""
    height, width = mask.shape
    inside = np.zeros_like(mask)
    for v, u in product(range(1, height - 1), range(1, width - 1)):
        inside[v, u] = mask[v - 1 : v + 2, u - 1 : u + 2].all()
    assert np.array_equal(interior(mask), inside)
    depth_m = np.where(np.arange(mask.size).reshape(mask.shape) % 3, 1.0, 0.0).astype(np.float32)
    pixels = scored_pixels(mask, depth_m)
    assert pixels.dtype == np.uint32
    assert np.array_equal(pixels, np.flatnonzero(inside & (depth_m > 0)))


def depth_pairs() -> st.SearchStrategy[tuple[ndarray, ndarray]]:
    arrays = [hnp.arrays(np.float64, st.shared(st.integers(1, 40)), elements=st.floats(0.05, 50.0))] * 2
    return st.tuples(*arrays)


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


@pytest.mark.slow
@given(depth_pairs())
def test_metrics_agree_with_exact_rational_arithmetic(pair: tuple[ndarray, ndarray]) -> None:
    p, z = pair
    n = len(z)
    errors = [abs(Fraction(a) - Fraction(b)) for a, b in zip(p.tolist(), z.tolist(), strict=True)]
    metrics = depth_metrics(p, z)
    abs_rel = sum(e / Fraction(b) for e, b in zip(errors, z.tolist(), strict=True)) / n
    assert metrics.abs_rel == pytest.approx(float(abs_rel), rel=1e-12, abs=1e-15)
    assert metrics.mae_cm == pytest.approx(100 * float(sum(errors) / n), rel=1e-12, abs=1e-13)
    assert metrics.rmse_cm == pytest.approx(100 * math.sqrt(sum(e * e for e in errors) / n), rel=1e-12, abs=1e-13)


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


def scored(p_m: ndarray, z_m: ndarray) -> dict[str, float]:
    truth = ViewTruth("lattice/0000", np.arange(len(z_m), dtype=np.uint32), z_m, float(np.median(z_m)))
    return view_numbers(p_m.reshape(1, -1), truth)


def ranked_value(*views: dict[str, float]) -> float:
    """Return the number that ranks: the mean over views, rounded as in the JSON."""
    value = rounded(mean([view["rank_error"] for view in views]))
    assert value is not None
    return value


def noisy_view(seed: int, pixels: int = 300) -> tuple[ndarray, ndarray]:
    rng = np.random.default_rng(seed)
    z_m = rng.uniform(0.2, 17.0, pixels).astype(np.float32)
    p_m = (z_m * rng.lognormal(0, rng.choice([0.001, 0.1, 2.0]), pixels)).astype(np.float32)
    p_m[rng.uniform(size=pixels) < 0.2] = rng.choice(INVALID)
    return p_m, z_m


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_rank_error_equals_the_sum_in_pixel_order(dtype: type) -> None:
    p_m, z_m = noisy_view(1, 20_000)
    p_m = p_m.astype(dtype)
    total = 0.0
    for p, z in zip(p_m.astype(float).tolist(), z_m.astype(float).tolist(), strict=True):
        total += abs(p - z) / max(p, z) if 0 < p < float("inf") else 1.0
    assert rank_error(p_m, z_m, is_valid_prediction(p_m)) == total / len(z_m)


@pytest.mark.parametrize(
    ("p", "expected"),
    [(1.0, 0.0), (2.0, 0.5), (0.5, 0.5), (1e308, 1.0), (5e-324, 1.0), *((value, 1.0) for value in INVALID)],
)
def test_rank_error_of_one_pixel(p: float, expected: float) -> None:
    assert scored(np.array([p]), np.ones(1, np.float32))["rank_error"] == expected


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.floats(0, 1), st.sampled_from(INVALID))
def test_no_removal_improves_what_ranks_or_coverage_or_tolerances(seed: int, share: float, invalid: float) -> None:
    p_m, z_m = noisy_view(seed)
    removed = p_m.copy()
    removed[np.random.default_rng(seed + 1).uniform(size=len(p_m)) < share] = invalid
    worst = p_m.copy()
    worst[np.argsort(-np.abs(p_m - z_m))[: int(share * len(p_m))]] = invalid
    other = scored(*noisy_view(seed + 2))
    complete = scored(p_m, z_m)
    for reduced in (scored(removed, z_m), scored(worst, z_m)):
        assert ranked_value(complete, other) <= ranked_value(reduced, other)
        for place in ("coverage", *(f"within_mm.{limit}" for limit in WITHIN_MM)):
            assert reduced[place] <= complete[place]
