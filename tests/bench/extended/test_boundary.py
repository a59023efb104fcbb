"""Boundary F1 at the steel: a case by hand, an independent formula, and what no damage may do."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import ndarray

from rebar_depth_bench.extended.boundary import THRESHOLDS_PERCENT, boundary_samples, neighbour_pairs
from tests.bench.extended.thin_scenes import (
    random_pictures,
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
    # 1.03 with the right side in front: found at 1 and 2 %. 1.11 with the wrong side: a wrong contour up to 10 %.
    found = scores(np.array([1.03, 1.0, 1.0, 0.9]), truth)
    # t = 1 and 2 %: 1 right of 2 predicted and 2 true. t = 5 and 10 %: 1 wrong one. t = 20 %: none predicted.
    assert found == pytest.approx(
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


def test_a_missing_prediction_counts_as_a_wrong_contour_at_every_threshold() -> None:
    truth = steel_truth(np.array([[2.0, 1.0, 1.0, 1.5]]), np.array([[0, 1, 1, 0]]))
    found = scores(np.array([2.0, 1.0, 1.0, np.nan]), truth)
    assert found["boundary_precision"] == pytest.approx(1 / 2)
    assert found["boundary_recall"] == pytest.approx(1 / 2)
    assert found["boundary_f1"] == pytest.approx(2 * 1 / (2 + 2))
    assert found["boundary_missing"] == pytest.approx(1 / 3)


def dense_scores(p_m: ndarray, z_m: ndarray, steel: ndarray) -> dict[str, float]:
    """Return the scores from whole pictures, as the papers write them: for each of four directions."""
    p_m = np.where(np.isfinite(p_m) & (p_m > 0), p_m, np.nan)
    f1, precision, recall = {}, [], []
    for t in THRESHOLDS_PERCENT:
        true = predicted = right = 0
        for axis in (0, 1):
            for ahead in (True, False):
                (z_a, p_a, s_a), (z_b, p_b, s_b) = (
                    [np.moveaxis(picture, axis, 0)[part] for picture in (z_m, p_m, steel)]
                    for part in ((slice(None, -1), slice(1, None)) if ahead else (slice(1, None), slice(None, -1)))
                )
                counted = (s_a | s_b) & (z_a > 0) & (z_b > 0)
                with np.errstate(divide="ignore", invalid="ignore"):
                    z_contour, p_contour = z_b / z_a > 1 + t / 100, p_b / p_a > 1 + t / 100
                hole = np.isnan(p_a + p_b)
                true += np.sum(z_contour & counted)
                right += np.sum(z_contour & p_contour & counted)
                predicted += np.sum(p_contour & counted) + np.sum(hole & counted) / 2  # seen from both sides
        if true:
            f1[f"boundary_f1_{t}pct"] = float(2 * right / (true + predicted))
            precision.append(right / predicted if predicted else 0.0)
            recall.append(right / true)
    means = {"boundary_precision": precision, "boundary_recall": recall, "boundary_f1": list(f1.values())}
    return {**f1, **{name: float(np.mean(values)) for name, values in means.items() if values}}


@settings(max_examples=60)
@given(SEEDS)
def test_agrees_with_the_dense_formula_of_four_directions(seed: int) -> None:
    rng = np.random.default_rng(seed)
    depth_m, bars = random_pictures(rng)
    truth = steel_truth(depth_m, bars)
    p_m = random_prediction(rng, truth)
    picture_m = np.full(depth_m.size, np.nan)
    picture_m[truth.index] = p_m
    found = scores(p_m, truth)
    expected = dense_scores(picture_m.reshape(depth_m.shape), depth_m.astype(np.float64), bars > 0)
    assert {name: value for name, value in found.items() if name != "boundary_missing"} == pytest.approx(expected)


@settings(max_examples=60)
@given(SEEDS, st.floats(0.001, 1.0))
def test_no_hole_raises_any_score(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    truth = random_truth(rng)
    before_m = random_prediction(rng, truth)
    before, after = scores(before_m, truth), scores(with_holes(rng, before_m, share), truth)
    assert before.keys() == after.keys()
    assert all(after[name] <= before[name] for name in before if name != "boundary_missing")
    assert after["boundary_missing"] >= before["boundary_missing"]


@settings(max_examples=30)
@given(SEEDS, st.integers(-40, 40))
def test_does_not_depend_on_the_predictions_unit(seed: int, exponent: int) -> None:
    rng = np.random.default_rng(seed)
    truth = random_truth(rng)
    p_m = random_prediction(rng, truth)
    assert scores(p_m * 2.0**exponent, truth) == scores(p_m, truth)


@settings(max_examples=30)
@given(SEEDS)
def test_does_not_depend_on_how_the_picture_is_turned(seed: int) -> None:
    rng = np.random.default_rng(seed)
    depth_m, bars = random_pictures(rng)
    picture_m = depth_m * np.exp(rng.normal(0, 0.03, depth_m.shape))
    turned = [
        scores(view[0].ravel()[truth.index], truth)
        for view in (
            (picture_m, depth_m, bars),
            (picture_m[:, ::-1], depth_m[:, ::-1], bars[:, ::-1]),
            (picture_m.T, depth_m.T, bars.T),
        )
        for truth in [steel_truth(view[1], view[2])]
    ]
    assert turned[0] == turned[1] == turned[2]


@settings(max_examples=30)
@given(SEEDS, st.lists(st.floats(0.0, 1.0), min_size=2, max_size=2))
def test_flattening_loses_contours_and_invents_none(seed: int, flat: list[float]) -> None:
    """Every ratio to its power a <= 1: the larger a, the more contours stay, and all of them are right."""
    truth = random_truth(np.random.default_rng(seed))
    z_m = truth.depth_m.astype(np.float64)
    less, more = (scores(z_m ** (0.999 * power), truth) for power in sorted(flat))
    assert less["boundary_recall"] <= more["boundary_recall"]
    assert less["boundary_f1"] <= more["boundary_f1"]
    f1 = [value for name, value in more.items() if name.endswith("pct")]
    assert more["boundary_precision"] == pytest.approx(np.mean(np.array(f1) > 0))  # none predicted: 0, else 1


def test_truth_is_perfect_and_a_wall_has_no_contour() -> None:
    truth = random_truth(np.random.default_rng(3))
    perfect = scores(truth.depth_m.astype(np.float64), truth)
    assert perfect == {name: 0.0 if name == "boundary_missing" else 1.0 for name in perfect}
    wall = scores(np.ones(len(truth.index)), truth)
    assert set(wall.values()) == {0.0}


def test_pairs_end_at_the_frame_and_need_steel() -> None:
    index = np.arange(6, dtype=np.uint32)
    first, second = neighbour_pairs(index, np.ones(6, bool), 2, 3)
    found = sorted(zip(first.tolist(), second.tolist(), strict=True))
    assert found == [(0, 1), (0, 3), (1, 2), (1, 4), (2, 5), (3, 4), (4, 5)]  # 2 and 3 are in two rows
    first, second = neighbour_pairs(index[[0, 1, 3, 5]], np.array([False, True, False, True]), 2, 3)
    assert list(zip(first.tolist(), second.tolist(), strict=True)) == [(0, 1)]  # 0 over 3 is not steel


def test_a_view_without_steel_or_without_contour_says_nothing() -> None:
    empty = steel_truth(np.ones((3, 3)), np.zeros((3, 3), np.uint16))
    assert all(len(values) == 0 for values in boundary_samples(np.empty(0), empty).values())
    flat = steel_truth(np.ones((3, 3)), np.ones((3, 3), np.uint16))
    found = boundary_samples(np.linspace(1, 2, 9), flat)
    assert {name for name, values in found.items() if len(values)} == {"boundary_missing"}


def test_hostile_values_give_shares_and_no_warning() -> None:
    rng = np.random.default_rng(5)
    truth = random_truth(rng)
    p_m = rng.choice([1e308, 5e-324, np.inf, -np.inf, np.nan, 0.0, -0.0, -1e308, 1.0], len(truth.index))
    assert all(0.0 <= value <= 1.0 for value in scores(p_m, truth).values())
