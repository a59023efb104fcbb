"""Boundary F1: cases by hand, independent formulas, and invariances."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import ndarray

from rebar_depth_bench.extended.boundary import THRESHOLDS_PERCENT, boundary_samples, neighbour_pairs
from rebar_depth_bench.extended.published import RADII, image_boundary_samples
from tests.bench.extended.thin_scenes import random_images, random_prediction, random_truth, steel_truth

# Boundary F1.


SEEDS = st.integers(0, 2**32 - 1)


def boundary_scores(p_m: ndarray, truth: object) -> dict[str, float]:
    return {name: float(values[0]) for name, values in boundary_samples(p_m, truth).items() if len(values)}  # type: ignore[arg-type]


def test_boundary_by_hand() -> None:
    # Board, bar, bar, board in one row: the pairs' true ratios are 2, 1 and 1.5, so two contours at every t.
    truth = steel_truth(np.array([[2.0, 1.0, 1.0, 1.5]]), np.array([[0, 1, 1, 0]]))
    # Ratio 1.03, correct side in front: detected at 1 and 2 %. Ratio 1.11, wrong side: a wrong contour up to 10 %.
    measured = boundary_scores(np.array([1.03, 1.0, 1.0, 0.9]), truth)
    # t = 1 and 2 %: 1 correct of 2 predicted and 2 true. t = 5 and 10 %: 1 wrong. t = 20 %: none predicted.
    assert measured == pytest.approx(
        {
            "boundary_f1": (0.5 + 0.5) / 5,
            "boundary_precision": (0.5 + 0.5) / 5,
            "boundary_recall": (0.5 + 0.5) / 5,
            "boundary_missing": 0.0,
        }
    )
    # A missing prediction is a wrong contour at every t.
    measured = boundary_scores(np.array([2.0, 1.0, 1.0, np.nan]), truth)
    assert [measured[f"boundary_{name}"] for name in ("precision", "recall", "f1")] == [0.5] * 3
    assert measured["boundary_missing"] == pytest.approx(1 / 3)


def dense_scores(p_m: ndarray, z_m: ndarray, steel: ndarray) -> dict[str, float]:
    """Return the scores of boundaries from whole images as the papers define them: over four directions."""
    p_m = np.where(np.isfinite(p_m) & (p_m > 0), p_m, np.nan)
    f1, precision, recall = [], [], []
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
            f1.append(2 * correct / (true + predicted))
            precision.append(correct / predicted if predicted else 0.0)
            recall.append(correct / true)
    means = {"boundary_precision": precision, "boundary_recall": recall, "boundary_f1": f1}
    return {name: float(np.mean(values)) for name, values in means.items() if values}


@settings(max_examples=60)
@given(SEEDS)
def test_scores_agree_with_dense_formula(seed: int) -> None:
    rng = np.random.default_rng(seed)
    depth_m, bars = random_images(rng)
    truth = steel_truth(depth_m, bars)
    p_m = random_prediction(rng, truth)
    image_m = np.full(depth_m.size, np.nan)
    image_m[truth.index] = p_m
    measured = boundary_scores(p_m, truth)
    expected = dense_scores(image_m.reshape(depth_m.shape), depth_m.astype(np.float64), bars > 0)
    assert {name: value for name, value in measured.items() if name != "boundary_missing"} == pytest.approx(
        expected
    )


def test_ground_truth_is_perfect_and_plane_scores_zero() -> None:
    truth = random_truth(np.random.default_rng(3))
    perfect = boundary_scores(truth.depth_m.astype(np.float64), truth)
    assert perfect == {name: 0.0 if name == "boundary_missing" else 1.0 for name in perfect}
    plane = boundary_scores(np.ones(len(truth.index)), truth)
    assert set(plane.values()) == {0.0}


def test_neighbour_pairs_stay_in_image_and_touch_steel() -> None:
    index = np.arange(6, dtype=np.uint32)
    first, second = neighbour_pairs(index, np.ones(6, bool), 2, 3)
    pairs = sorted(zip(first.tolist(), second.tolist(), strict=True))
    assert pairs == [(0, 1), (0, 3), (1, 2), (1, 4), (2, 5), (3, 4), (4, 5)]  # 2 and 3 lie in different rows
    first, second = neighbour_pairs(index[[0, 1, 3, 5]], np.array([False, True, False, True]), 2, 3)
    assert list(zip(first.tolist(), second.tolist(), strict=True)) == [(0, 1)]  # neither 0 nor 3 is steel


def test_view_without_contour_has_no_scores() -> None:
    flat = steel_truth(np.ones((3, 3)), np.ones((3, 3), np.uint16))
    measured = boundary_samples(np.linspace(1, 2, 9), flat)
    assert {name for name, values in measured.items() if len(values)} == {"boundary_missing"}


def test_extreme_values_give_shares_without_warning() -> None:
    rng = np.random.default_rng(5)
    truth = random_truth(rng)
    p_m = rng.choice([1e308, 5e-324, np.inf, -np.inf, np.nan, 0.0, -0.0, -1e308, 1.0], len(truth.index))
    assert all(0.0 <= value <= 1.0 for value in boundary_scores(p_m, truth).values())


# Boundary F1 of Depth Pro and MoGe.


def f1_of(precision: float, recall: float) -> float:
    return 2 * precision * recall / (precision + recall) if precision + recall else 0.0


def share(part: int, whole: int) -> float:
    return part / whole if whole else 0.0


def edge_pairs(depth_m: ndarray, down: int, right: int, t: float, rim: int = 0) -> set[tuple[int, int]]:
    """Return the pixels, ``rim`` or more from the border, from which another one is over t times as far away."""
    height, width = depth_m.shape
    return {
        (row, column)
        for row in range(rim, height - rim)
        for column in range(rim, width - rim)
        if 0 <= row + down < height and 0 <= column + right < width
        if depth_m[row + down, column + right] / depth_m[row, column] > t
    }


def published_f1s(p_m: ndarray, z_m: ndarray) -> dict[str, float]:
    """Return the published definitions from whole depth maps with NaN where there is no depth."""
    p_m = np.where(np.isnan(z_m), np.nan, p_m)
    steps, numbers = [0.05 + 0.2 * number / 9 for number in range(10)], {}
    f1s = []
    for step in steps:
        shares = []
        for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            found, true = (edge_pairs(depth_m, down, right, 1 + step) for depth_m in (p_m, z_m))
            shares.append((share(len(found & true), len(found)), share(len(found & true), len(true))))
        f1s.append(f1_of(*np.mean(shares, axis=0)))
    numbers["depth_pro_f1"] = sum((1 + t) * f1 for t, f1 in zip(steps, f1s, strict=True)) / sum(
        1 + t for t in steps
    )
    for radius in RADII:
        f1s = []
        for step in steps:
            found_px = true_px = both_px = 0
            for down in range(-radius, radius + 1):
                for right in range(-radius, radius + 1):
                    if 0 < down * down + right * right <= radius * radius:
                        found, true = (
                            edge_pairs(depth_m, down, right, 1 + step, radius) for depth_m in (p_m, z_m)
                        )
                        found_px, true_px = found_px + len(found), true_px + len(true)
                        both_px += len(found & true)
            f1s.append(f1_of(share(both_px, found_px), share(both_px, true_px)))
        numbers[f"moge_f1_{radius}px"] = sum(t * f1 for t, f1 in zip(steps, f1s, strict=True)) / sum(steps)
    return numbers


def image_scores(p_m: ndarray, z_m: ndarray) -> dict[str, float]:
    truth = steel_truth(np.nan_to_num(z_m), np.zeros(z_m.shape, np.uint16))
    return {name: float(values[0]) for name, values in image_boundary_samples(p_m, truth).items() if len(values)}


@settings(max_examples=6, deadline=None)
@given(SEEDS)
def test_published_boundaries_by_pixel_loops(seed: int) -> None:
    """Compare maps with steps, slopes, noise, shifts, holes in the prediction and pixels without true depth."""
    rng = np.random.default_rng(seed)
    z_m = random_images(rng, 12, 20)[0].astype(np.float64)
    z_m[z_m == 0] = np.nan
    p_m = np.roll(np.nan_to_num(z_m, nan=0.7), rng.integers(0, 2), axis=1) * np.exp(rng.normal(0, 0.02, z_m.shape))
    p_m[rng.random(z_m.shape) < 0.05] = np.nan
    expected = published_f1s(p_m, z_m)
    measured = image_scores(p_m, z_m)
    assert {**dict.fromkeys(expected, 0.0), **measured} == pytest.approx(expected)
    assert image_scores(3.0 * p_m, z_m) == pytest.approx(measured)


def test_published_boundaries_by_hand() -> None:
    """The one step of 1.2 is above seven thresholds, in one of the four directions of Depth Pro."""
    z_m = np.where(np.arange(12) < 6, 1.0, 1.2) * np.ones((9, 1))
    steps = np.linspace(0.05, 0.25, 10)
    in_moge, in_depth_pro = steps[:7].sum() / steps.sum(), 0.25 * (1 + steps[:7]).sum() / (1 + steps).sum()
    names = [f"moge_f1_{radius}px" for radius in RADII]
    exact = {"depth_pro_f1": in_depth_pro, **dict.fromkeys(names, in_moge)}
    assert image_scores(z_m, z_m) == pytest.approx(exact)
    # One column to the right, the step has no pair of neighbours in common with the true one.
    moved = image_scores(np.where(np.arange(12) < 7, 1.0, 1.2) * np.ones((9, 1)), z_m)
    assert (moved["depth_pro_f1"], moved["moge_f1_1px"]) == (0.0, 0.0)
    # Both have five pairs a row: one 1 px apart in the row, two 2 px apart, of which one is common, two diagonal.
    assert moved["moge_f1_2px"] == pytest.approx(1 / 5 * in_moge)
    # A missing prediction misses true edges only; without true edges there is no number.
    assert image_scores(np.full(z_m.shape, np.nan), z_m) == dict.fromkeys(exact, 0.0)
    assert image_scores(z_m, np.ones(z_m.shape)) == {}
