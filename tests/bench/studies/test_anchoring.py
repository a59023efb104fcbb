"""The numbers of the study ``anchor`` against the protocol's own, and what its draws must hold."""

from __future__ import annotations

import itertools
import math
import statistics

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rebar_depth_bench.data.ground_truth import ViewTruth
from rebar_depth_bench.scoring.metrics import depth_metrics
from rebar_depth_bench.studies.common import ViewPairs, pairs
from rebar_depth_bench.studies.scale_anchor.study import (
    ScaledArchive,
    ScaleErrors,
    anchor_row,
    drawn_scales,
    errors_at,
    mean_errors,
    spread,
    view_ratio,
)


def view(p_m: np.ndarray, z_m: np.ndarray, scored_px: int | None = None) -> ViewPairs:
    return ViewPairs("lattice/0000", scored_px or len(z_m), p_m, z_m)


@st.composite
def views(draw: st.DrawFn) -> ViewPairs:
    depths = hnp.arrays(np.float64, draw(st.integers(1, 40)), elements=st.floats(0.05, 50.0))
    z_m = draw(depths)
    return view(draw(hnp.arrays(np.float64, len(z_m), elements=st.floats(0.05, 50.0))), z_m)


@given(views(), st.lists(st.floats(1e-3, 1e3), min_size=1, max_size=5))
def test_errors_at_any_scale_are_those_of_the_scaled_prediction(one: ViewPairs, scales: list[float]) -> None:
    crossings = one.z_m / one.p_m  # where a pixel's error changes its sign
    every = np.array([*scales, 1.0, *crossings[:5]])
    found = errors_at(one, every)
    plain = [depth_metrics(scale * one.p_m, one.z_m) for scale in every]
    assert found.abs_rel == pytest.approx([m.abs_rel for m in plain], rel=1e-9, abs=1e-12)
    assert found.rmse_cm == pytest.approx([m.rmse_cm for m in plain], rel=1e-9, abs=1e-11)


def test_an_exact_prediction_has_exactly_no_error_at_one_and_a_known_one_elsewhere() -> None:
    z_m = np.linspace(0.2, 17.0, 1001)
    found = errors_at(view(z_m.copy(), z_m), np.array([1.0, 1.25, 0.5]))
    assert found.abs_rel[0] == found.rmse_cm[0] == 0.0
    assert found.abs_rel[1:] == pytest.approx([0.25, 0.5], rel=1e-14)


def test_values_too_large_to_square_give_infinity_and_no_warning() -> None:
    found = errors_at(view(np.array([1e200, 1.0]), np.array([1.0, 1.0])), np.array([1.0, 2.0]))
    assert np.isinf(found.rmse_cm).all()
    huge = errors_at(view(np.full(3, 1e308), np.full(3, 1e-3)), np.array([1.0]))
    assert np.isinf(huge.abs_rel).all()
    assert np.isinf(errors_at(view(np.full(3, 1e308), np.full(3, 10.0)), np.array([1.0])).rmse_cm).all()
    row = anchor_row(1, ScaledArchive(1.0, math.inf, math.inf), [ScaledArchive(1.0, math.inf, math.inf)])
    assert math.isnan(row.abs_rel_change.mean)


def test_the_mean_goes_over_views_and_not_over_pixels() -> None:
    few, many = view(np.array([2.0]), np.array([1.0])), view(np.full(99, 1.0), np.full(99, 1.0))
    mean = mean_errors([errors_at(one, np.array([1.0])) for one in (few, many)])
    assert isinstance(mean, ScaleErrors)
    assert mean.abs_rel.tolist() == [0.5]
    assert mean.rmse_cm.tolist() == [50.0]


def test_the_ratio_is_the_median_of_ratios_and_not_the_ratio_of_medians() -> None:
    p_m, z_m = np.array([1.0, 2.0, 8.0]), np.array([3.0, 2.0, 4.0])
    found = view_ratio(view(p_m, z_m, scored_px=4))
    assert (found.ratio, found.coverage) == (1.0, 0.75)  # of 3, 1 and 1/2; the medians' ratio is 3/2
    assert view_ratio(view(p_m[:2], z_m[:2])).ratio == 2.0  # the middle of 3 and 1
    assert view_ratio(view(p_m[:0], z_m[:0], scored_px=4)).ratio is None


def test_pairs_leave_out_what_is_no_prediction() -> None:
    truth = ViewTruth("lattice/0000", np.array([0, 2, 3, 5], np.uint32), np.array([1, 2, 3, 4], np.float32), 2.5)
    found = pairs(truth, np.array([[2.0, 9.0, np.nan], [0.0, 9.0, 5.0]], np.float32))
    assert (found.p_m.tolist(), found.z_m.tolist(), found.scored_px) == ([2.0, 5.0], [1.0, 4.0], 4)
    assert found.p_m.dtype == found.z_m.dtype == np.float64


def test_views_are_drawn_without_replacement() -> None:
    ratios = 2.0 ** np.arange(5)
    possible = {float(np.median(three)) for three in itertools.combinations(ratios, 3)}
    assert possible == {2.0, 4.0, 8.0}
    assert set(drawn_scales(ratios, 3, 300, 0).tolist()) == possible
    assert set(drawn_scales(ratios, 5, 50, 0).tolist()) == {4.0}


def test_every_view_is_drawn_as_often_as_any_other() -> None:
    draws = 6000
    found, counts = np.unique(drawn_scales(np.arange(1.0, 7.0), 1, draws, 3), return_counts=True)
    assert found.tolist() == [1, 2, 3, 4, 5, 6]
    expected = draws / 6
    assert np.sum((counts - expected) ** 2 / expected) < 20.5  # chi-square, 5 degrees of freedom: 1 in 1000


def test_draws_depend_on_seed_and_k_alone() -> None:
    ratios = np.random.default_rng(0).uniform(0.5, 2.0, 50)
    first = drawn_scales(ratios, 5, 24, 0)
    assert drawn_scales(ratios, 5, 24, 0).tolist() == first.tolist()
    assert drawn_scales(ratios, 5, 12, 0).tolist() == first[:12].tolist()
    assert drawn_scales(ratios, 5, 24, 1).tolist() != first.tolist()
    assert len(set(first.tolist())) > 12


def test_draws_of_one_k_do_not_hold_those_of_another() -> None:
    ratios = 2.0 ** np.arange(20)
    ones, twos = drawn_scales(ratios, 1, 24, 0), drawn_scales(ratios, 2, 24, 0)
    shared = sum(2 * two - one in ratios for one, two in zip(ones, twos, strict=True))  # two is the mean of a pair
    assert shared <= 12, "by chance a pair holds the single view in 2 of 20 draws"


@given(st.lists(st.floats(-1e6, 1e6), min_size=2, max_size=30))
def test_spread_is_that_of_the_standard_library(values: list[float]) -> None:
    found = spread(values)
    assert found.mean == pytest.approx(statistics.fmean(values), rel=1e-12, abs=1e-9)
    assert found.sd == pytest.approx(statistics.stdev(values), rel=1e-9, abs=1e-9)
    assert (found.low, found.high) == (min(values), max(values))


def test_a_single_draw_has_no_spread() -> None:
    assert spread([2.0]).sd is None


def test_deviation_is_told_against_the_given_scale() -> None:
    row = anchor_row(2, ScaledArchive(2.0, 0.1, 1.0), [ScaledArchive(2.1, 0.3, 1.5), ScaledArchive(1.9, 0.1, 0.5)])
    assert (row.deviation_percent.low, row.deviation_percent.high) == pytest.approx((-5.0, 5.0))
    assert row.abs_rel_change.mean == pytest.approx(0.1)
    assert (row.rmse_cm_change.low, row.rmse_cm_change.high) == (-0.5, 0.5)
