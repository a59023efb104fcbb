"""Numbers of the study ``anchor`` against the protocol's metrics, and properties of its draws."""

from __future__ import annotations

import itertools
import math
import statistics

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from rebar_depth_bench.studies.common import ViewPairs, pair_with_truth
from rebar_depth_bench.studies.scale_anchor.study import (
    ScaledArchive,
    ScaleErrors,
    anchor_row,
    draw_scales,
    errors_at_scales,
    mean_errors,
    summarize_draws,
    view_ratio,
)

from rebar_depth_bench.scoring.ground_truth import ViewTruth
from rebar_depth_bench.scoring.metrics import depth_metrics


def make_pairs(p_m: np.ndarray, z_m: np.ndarray, scored_px: int | None = None) -> ViewPairs:
    return ViewPairs("lattice/0000", scored_px or len(z_m), p_m, z_m)


@st.composite
def views(draw: st.DrawFn) -> ViewPairs:
    depths = hnp.arrays(np.float64, draw(st.integers(1, 40)), elements=st.floats(0.05, 50.0))
    z_m = draw(depths)
    return make_pairs(draw(hnp.arrays(np.float64, len(z_m), elements=st.floats(0.05, 50.0))), z_m)


@given(views(), st.lists(st.floats(1e-3, 1e3), min_size=1, max_size=5))
def test_errors_at_scales_match_scaled_prediction(pairs: ViewPairs, scales: list[float]) -> None:
    zero_crossings = pairs.z_m / pairs.p_m  # Scales at which a pixel's error changes sign.
    all_scales = np.array([*scales, 1.0, *zero_crossings[:5]])
    errors = errors_at_scales(pairs, all_scales)
    expected = [depth_metrics(scale * pairs.p_m, pairs.z_m) for scale in all_scales]
    assert errors.abs_rel == pytest.approx([m.abs_rel for m in expected], rel=1e-9, abs=1e-12)
    assert errors.rmse_cm == pytest.approx([m.rmse_cm for m in expected], rel=1e-9, abs=1e-11)


def test_exact_prediction_has_zero_error_at_scale_one() -> None:
    z_m = np.linspace(0.2, 17.0, 1001)
    errors = errors_at_scales(make_pairs(z_m.copy(), z_m), np.array([1.0, 1.25, 0.5]))
    assert errors.abs_rel[0] == errors.rmse_cm[0] == 0.0
    assert errors.abs_rel[1:] == pytest.approx([0.25, 0.5], rel=1e-14)


def test_overflowing_errors_are_infinite_without_warning() -> None:
    errors = errors_at_scales(make_pairs(np.array([1e200, 1.0]), np.array([1.0, 1.0])), np.array([1.0, 2.0]))
    assert np.isinf(errors.rmse_cm).all()
    huge = errors_at_scales(make_pairs(np.full(3, 1e308), np.full(3, 1e-3)), np.array([1.0]))
    assert np.isinf(huge.abs_rel).all()
    assert np.isinf(
        errors_at_scales(make_pairs(np.full(3, 1e308), np.full(3, 10.0)), np.array([1.0])).rmse_cm
    ).all()
    row = anchor_row(1, ScaledArchive(1.0, math.inf, math.inf), [ScaledArchive(1.0, math.inf, math.inf)])
    assert math.isnan(row.abs_rel_change.mean)


def test_mean_errors_average_over_views_not_pixels() -> None:
    few, many = make_pairs(np.array([2.0]), np.array([1.0])), make_pairs(np.full(99, 1.0), np.full(99, 1.0))
    mean = mean_errors([errors_at_scales(pairs, np.array([1.0])) for pairs in (few, many)])
    assert isinstance(mean, ScaleErrors)
    assert mean.abs_rel.tolist() == [0.5]
    assert mean.rmse_cm.tolist() == [50.0]


def test_view_ratio_is_median_of_pixel_ratios() -> None:
    p_m, z_m = np.array([1.0, 2.0, 8.0]), np.array([3.0, 2.0, 4.0])
    ratio = view_ratio(make_pairs(p_m, z_m, scored_px=4))
    assert (ratio.ratio, ratio.coverage) == (
        1.0,
        0.75,
    )  # The ratios are 3, 1 and 1/2; the ratio of medians is 3/2.
    assert view_ratio(make_pairs(p_m[:2], z_m[:2])).ratio == 2.0  # The mean of 3 and 1.
    assert view_ratio(make_pairs(p_m[:0], z_m[:0], scored_px=4)).ratio is None


def test_pairs_exclude_invalid_predictions() -> None:
    truth = ViewTruth("lattice/0000", np.array([0, 2, 3, 5], np.uint32), np.array([1, 2, 3, 4], np.float32), 2.5)
    pairs = pair_with_truth(truth, np.array([[2.0, 9.0, np.nan], [0.0, 9.0, 5.0]], np.float32))
    assert (pairs.p_m.tolist(), pairs.z_m.tolist(), pairs.scored_px) == ([2.0, 5.0], [1.0, 4.0], 4)
    assert pairs.p_m.dtype == pairs.z_m.dtype == np.float64


def test_views_are_drawn_without_replacement() -> None:
    ratios = 2.0 ** np.arange(5)
    possible = {float(np.median(three)) for three in itertools.combinations(ratios, 3)}
    assert possible == {2.0, 4.0, 8.0}
    assert set(draw_scales(ratios, 3, 300, 0).tolist()) == possible
    assert set(draw_scales(ratios, 5, 50, 0).tolist()) == {4.0}


def test_views_are_drawn_uniformly() -> None:
    draws = 6000
    values, counts = np.unique(draw_scales(np.arange(1.0, 7.0), 1, draws, 3), return_counts=True)
    assert values.tolist() == [1, 2, 3, 4, 5, 6]
    expected = draws / 6
    assert np.sum((counts - expected) ** 2 / expected) < 20.5  # Chi-square, 5 degrees of freedom: p = 0.001.


def test_draws_depend_only_on_seed_and_k() -> None:
    ratios = np.random.default_rng(0).uniform(0.5, 2.0, 50)
    first = draw_scales(ratios, 5, 24, 0)
    assert draw_scales(ratios, 5, 24, 0).tolist() == first.tolist()
    assert draw_scales(ratios, 5, 12, 0).tolist() == first[:12].tolist()
    assert draw_scales(ratios, 5, 24, 1).tolist() != first.tolist()
    assert len(set(first.tolist())) > 12


def test_draws_of_different_k_are_independent() -> None:
    ratios = 2.0 ** np.arange(20)
    single_draws, pair_draws = draw_scales(ratios, 1, 24, 0), draw_scales(ratios, 2, 24, 0)
    shared = sum(
        2 * pair_mean - single in ratios for single, pair_mean in zip(single_draws, pair_draws, strict=True)
    )  # A median of two is their mean.
    assert shared <= 12, "by chance a pair holds the single view in 2 of 20 draws"


@given(st.lists(st.floats(-1e6, 1e6), min_size=2, max_size=30))
def test_draw_summary_matches_statistics_module(values: list[float]) -> None:
    summary = summarize_draws(values)
    assert summary.mean == pytest.approx(statistics.fmean(values), rel=1e-12, abs=1e-9)
    assert summary.sd == pytest.approx(statistics.stdev(values), rel=1e-9, abs=1e-9)
    assert (summary.low, summary.high) == (min(values), max(values))


def test_single_draw_has_no_standard_deviation() -> None:
    assert summarize_draws([2.0]).sd is None


def test_deviation_is_relative_to_given_scale() -> None:
    row = anchor_row(2, ScaledArchive(2.0, 0.1, 1.0), [ScaledArchive(2.1, 0.3, 1.5), ScaledArchive(1.9, 0.1, 0.5)])
    assert (row.deviation_percent.low, row.deviation_percent.high) == pytest.approx((-5.0, 5.0))
    assert row.abs_rel_change.mean == pytest.approx(0.1)
    assert (row.rmse_cm_change.low, row.rmse_cm_change.high) == (-0.5, 0.5)
