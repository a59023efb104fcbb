"""Tests of boundary F1 at the steel: a hand-computed case, an independent formula and monotonicity."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import ndarray

from rebar_depth_bench.extended.boundary import THRESHOLDS_PERCENT, boundary_samples, neighbour_pairs
from tests.bench.extended.thin_scenes import (
    random_images,
    random_prediction,
    random_truth,
    steel_truth,
    with_holes,
)

SEEDS = st.integers(0, 2**32 - 1)


def scores(p_m: ndarray, truth: object) -> dict[str, float]:
    return {name: float(values[0]) for name, values in boundary_samples(p_m, truth).items() if len(values)}  # type: ignore[arg-type]


def test_golden_case_by_hand() -> None:
    # Board, bar, bar, board in one row: the pairs' true ratios are 2, 1 and 1.5, so two contours at every t.
    truth = steel_truth(np.array([[2.0, 1.0, 1.0, 1.5]]), np.array([[0, 1, 1, 0]]))
    # Ratio 1.03, correct side in front: detected at 1 and 2 %. Ratio 1.11, wrong side: a wrong contour up to 10 %.
    measured = scores(np.array([1.03, 1.0, 1.0, 0.9]), truth)
    # t = 1 and 2 %: 1 correct of 2 predicted and 2 true. t = 5 and 10 %: 1 wrong. t = 20 %: none predicted.
    assert measured == pytest.approx(
        {
            "boundary_f1": (0.5 + 0.5) / 5,
            "boundary_precision": (0.5 + 0.5) / 5,
            "boundary_recall": (0.5 + 0.5) / 5,
            "boundary_f1_1pct": 0.5,
            "boundary_f1_2pct": 0.5,
            "boundary_f1_5pct": 0.0,
            "boundary_f1_10pct": 0.0,
            "boundary_f1_20pct": 0.0,
            "boundary_missing": 0.0,
        }
    )


def test_missing_prediction_counts_as_wrong_contour() -> None:
    truth = steel_truth(np.array([[2.0, 1.0, 1.0, 1.5]]), np.array([[0, 1, 1, 0]]))
    measured = scores(np.array([2.0, 1.0, 1.0, np.nan]), truth)
    assert measured["boundary_precision"] == pytest.approx(1 / 2)
    assert measured["boundary_recall"] == pytest.approx(1 / 2)
    assert measured["boundary_f1"] == pytest.approx(2 * 1 / (2 + 2))
    assert measured["boundary_missing"] == pytest.approx(1 / 3)


def dense_scores(p_m: ndarray, z_m: ndarray, steel: ndarray) -> dict[str, float]:
    """Return the scores from whole images as the papers define them: over four directions."""
    p_m = np.where(np.isfinite(p_m) & (p_m > 0), p_m, np.nan)
    f1, precision, recall = {}, [], []
    for t in THRESHOLDS_PERCENT:
        true = predicted = correct = 0
        for axis in (0, 1):
            for ahead in (True, False):
                (z_a, p_a, s_a), (z_b, p_b, s_b) = (
                    [np.moveaxis(image, axis, 0)[part] for image in (z_m, p_m, steel)]
                    for part in ((slice(None, -1), slice(1, None)) if ahead else (slice(1, None), slice(None, -1)))
                )
                counted = (s_a | s_b) & (z_a > 0) & (z_b > 0)
                with np.errstate(divide="ignore", invalid="ignore"):
                    z_contour, p_contour = z_b / z_a > 1 + t / 100, p_b / p_a > 1 + t / 100
                missing = np.isnan(p_a + p_b)
                true += np.sum(z_contour & counted)
                correct += np.sum(z_contour & p_contour & counted)
                predicted += np.sum(p_contour & counted) + np.sum(missing & counted) / 2  # counted from both sides
        if true:
            f1[f"boundary_f1_{t}pct"] = float(2 * correct / (true + predicted))
            precision.append(correct / predicted if predicted else 0.0)
            recall.append(correct / true)
    means = {"boundary_precision": precision, "boundary_recall": recall, "boundary_f1": list(f1.values())}
    return {**f1, **{name: float(np.mean(values)) for name, values in means.items() if values}}


@settings(max_examples=60)
@given(SEEDS)
def test_scores_agree_with_dense_formula(seed: int) -> None:
    rng = np.random.default_rng(seed)
    depth_m, bars = random_images(rng)
    truth = steel_truth(depth_m, bars)
    p_m = random_prediction(rng, truth)
    image_m = np.full(depth_m.size, np.nan)
    image_m[truth.index] = p_m
    measured = scores(p_m, truth)
    expected = dense_scores(image_m.reshape(depth_m.shape), depth_m.astype(np.float64), bars > 0)
    assert {name: value for name, value in measured.items() if name != "boundary_missing"} == pytest.approx(
        expected
    )


@settings(max_examples=60)
@given(SEEDS, st.floats(0.001, 1.0))
def test_holes_never_raise_scores(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    truth = random_truth(rng)
    before_m = random_prediction(rng, truth)
    before, after = scores(before_m, truth), scores(with_holes(rng, before_m, share), truth)
    assert before.keys() == after.keys()
    assert all(after[name] <= before[name] for name in before if name != "boundary_missing")
    assert after["boundary_missing"] >= before["boundary_missing"]


@settings(max_examples=30)
@given(SEEDS, st.integers(-40, 40))
def test_scores_are_independent_of_unit(seed: int, exponent: int) -> None:
    rng = np.random.default_rng(seed)
    truth = random_truth(rng)
    p_m = random_prediction(rng, truth)
    assert scores(p_m * 2.0**exponent, truth) == scores(p_m, truth)


@settings(max_examples=30)
@given(SEEDS)
def test_scores_are_invariant_to_flip_and_transpose(seed: int) -> None:
    rng = np.random.default_rng(seed)
    depth_m, bars = random_images(rng)
    image_m = depth_m * np.exp(rng.normal(0, 0.03, depth_m.shape))
    turned = [
        scores(view[0].ravel()[truth.index], truth)
        for view in (
            (image_m, depth_m, bars),
            (image_m[:, ::-1], depth_m[:, ::-1], bars[:, ::-1]),
            (image_m.T, depth_m.T, bars.T),
        )
        for truth in [steel_truth(view[1], view[2])]
    ]
    assert turned[0] == turned[1] == turned[2]


@settings(max_examples=30)
@given(SEEDS, st.lists(st.floats(0.0, 1.0), min_size=2, max_size=2))
def test_flattening_removes_contours_and_adds_none(seed: int, flat: list[float]) -> None:
    """Check ratios raised to a power a <= 1: the larger a, the more contours remain, and all are correct."""
    truth = random_truth(np.random.default_rng(seed))
    z_m = truth.depth_m.astype(np.float64)
    less, more = (scores(z_m ** (0.999 * power), truth) for power in sorted(flat))
    assert less["boundary_recall"] <= more["boundary_recall"]
    assert less["boundary_f1"] <= more["boundary_f1"]
    f1 = [value for name, value in more.items() if name.endswith("pct")]
    assert more["boundary_precision"] == pytest.approx(np.mean(np.array(f1) > 0))  # none predicted: 0, else 1


def test_ground_truth_is_perfect_and_plane_scores_zero() -> None:
    truth = random_truth(np.random.default_rng(3))
    perfect = scores(truth.depth_m.astype(np.float64), truth)
    assert perfect == {name: 0.0 if name == "boundary_missing" else 1.0 for name in perfect}
    plane = scores(np.ones(len(truth.index)), truth)
    assert set(plane.values()) == {0.0}


def test_neighbour_pairs_stay_in_image_and_touch_steel() -> None:
    index = np.arange(6, dtype=np.uint32)
    first, second = neighbour_pairs(index, np.ones(6, bool), 2, 3)
    pairs = sorted(zip(first.tolist(), second.tolist(), strict=True))
    assert pairs == [(0, 1), (0, 3), (1, 2), (1, 4), (2, 5), (3, 4), (4, 5)]  # 2 and 3 lie in different rows
    first, second = neighbour_pairs(index[[0, 1, 3, 5]], np.array([False, True, False, True]), 2, 3)
    assert list(zip(first.tolist(), second.tolist(), strict=True)) == [(0, 1)]  # neither 0 nor 3 is steel


def test_view_without_steel_or_contour_has_no_scores() -> None:
    empty = steel_truth(np.ones((3, 3)), np.zeros((3, 3), np.uint16))
    assert all(len(values) == 0 for values in boundary_samples(np.empty(0), empty).values())
    flat = steel_truth(np.ones((3, 3)), np.ones((3, 3), np.uint16))
    measured = boundary_samples(np.linspace(1, 2, 9), flat)
    assert {name for name, values in measured.items() if len(values)} == {"boundary_missing"}


def test_extreme_values_give_shares_without_warning() -> None:
    rng = np.random.default_rng(5)
    truth = random_truth(rng)
    p_m = rng.choice([1e308, 5e-324, np.inf, -np.inf, np.nan, 0.0, -0.0, -1e308, 1.0], len(truth.index))
    assert all(0.0 <= value <= 1.0 for value in scores(p_m, truth).values())
