"""Tests of full-mask measures: a hand-computed case, and agreement with the scorer on the interior."""

from __future__ import annotations

import math
from dataclasses import asdict

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import ndarray

from rebar_depth_bench.extended.regions import FULL_MASK_MEASURES, region_samples
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.scoring.score import ViewTruth, score_view
from tests.bench.extended.thin_scenes import random_prediction, random_truth, steel_truth, with_holes

SEEDS = st.integers(0, 2**32 - 1)


def scores(p_m: ndarray, truth: SteelTruth) -> dict[str, float]:
    return {name: float(values[0]) for name, values in region_samples(p_m, truth).items() if len(values)}


def test_golden_case_by_hand() -> None:
    """Check nine steel pixels on a board: one is interior; of the others one is missing and one is 4 mm off."""
    depth_m, bars = np.full((5, 5), 3.0), np.zeros((5, 5), np.uint16)
    depth_m[1:4, 1:4], bars[1:4, 1:4] = 2.0, 1
    truth = steel_truth(depth_m, bars)
    p_m = truth.depth_m.astype(np.float64)
    p_m[0] = 99.0  # board, ignored
    p_m[6], p_m[7], p_m[12] = math.nan, 2.004, 3.0  # rim, rim, interior
    measured = scores(p_m, truth)
    assert measured["kept_share"] == pytest.approx(1 / 9)
    assert measured["full_mask_coverage"] == pytest.approx(8 / 9)
    assert measured["full_mask_abs_rel"] == pytest.approx((0.002 + 0.5) / 8)
    assert measured["full_mask_mae_cm"] == pytest.approx(100 * (0.004 + 1.0) / 8)
    assert measured["full_mask_rmse_cm"] == pytest.approx(100 * math.sqrt((0.004**2 + 1.0) / 8))
    assert measured["full_mask_delta1"] == pytest.approx(7 / 8)
    assert measured["full_mask_within_3mm"] == pytest.approx(6 / 9)
    assert measured["full_mask_within_5mm"] == pytest.approx(7 / 9)
    assert measured["interior_abs_rel"] == pytest.approx(0.5)
    assert measured["interior_within_20mm"] == 0.0
    assert measured["interior_coverage"] == 1.0


@settings(max_examples=40)
@given(SEEDS)
def test_interior_measures_equal_rebar_1(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = random_truth(rng)
    p_m = random_prediction(rng, truth)
    image_m = np.full(truth.height * truth.width, 7.0)
    image_m[truth.index] = p_m
    inside = truth.interior
    z_m = truth.depth_m[inside]
    view = ViewTruth(truth.view_id, truth.index[inside], z_m, float(np.median(z_m.astype(np.float64))))
    expected = score_view(view, image_m.reshape(truth.height, truth.width))
    measured = scores(p_m, truth)
    assert expected.native is not None
    for name, value in asdict(expected.native).items():
        assert measured[f"interior_{name}"] == pytest.approx(value, rel=1e-12)
    assert measured["interior_coverage"] == expected.coverage
    assert {t: measured[f"interior_within_{t}mm"] for t in expected.within_mm} == expected.within_mm


@settings(max_examples=40)
@given(SEEDS, st.floats(0.001, 1.0))
def test_holes_never_raise_shares(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    truth = random_truth(rng)
    p_m = random_prediction(rng, truth)
    before, after = scores(p_m, truth), scores(with_holes(rng, p_m, share), truth)
    ranked = [measure.sample for measure in FULL_MASK_MEASURES if measure.better]
    assert len(ranked) == 10
    assert all(after[name] <= before[name] for name in ranked)


def test_pixels_off_steel_are_ignored() -> None:
    rng = np.random.default_rng(8)
    truth = random_truth(rng)
    p_m = random_prediction(rng, truth)
    assert np.any(truth.bar_id == 0)
    assert scores(np.where(truth.bar_id == 0, 5.0, p_m), truth) == scores(p_m, truth)


def test_empty_masks_have_no_samples() -> None:
    rim = steel_truth(np.ones((2, 2)), np.ones((2, 2), np.uint16))
    measured = scores(np.ones(4), rim)
    assert not [name for name in measured if name.startswith("interior")]
    assert (measured["kept_share"], measured["full_mask_delta1"]) == (0.0, 1.0)
    unpredicted = scores(np.full(4, np.nan), rim)
    assert "full_mask_abs_rel" not in unpredicted
    assert unpredicted["full_mask_coverage"] == unpredicted["full_mask_within_20mm"] == 0.0
    empty = steel_truth(np.ones((2, 2)), np.zeros((2, 2), np.uint16))
    assert scores(np.empty(0), empty) == {}
