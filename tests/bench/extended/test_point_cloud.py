"""Tests of point-cloud accuracy and completeness: hand-computed cases, all pairs of points and monotonicity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import ndarray

from rebar_depth_bench.extended import point_cloud
from rebar_depth_bench.extended.measures import subsample
from rebar_depth_bench.extended.point_cloud import MAX_POINTS, TOLERANCES_MM, cloud_samples
from rebar_depth_bench.extended.steel import SteelTruth
from tests.bench.extended.thin_scenes import random_prediction, random_truth, steel_truth, with_holes

SEEDS = st.integers(0, 2**32 - 1)


def scores(p_m: ndarray, truth: SteelTruth) -> dict[str, float]:
    fresh = replace(truth)  # The true points are computed once, and some tests change their number.
    return {name: float(values[0]) for name, values in cloud_samples(p_m, fresh).items()}


def points_on_rays(depth_m: list[float], rays: list[tuple[float, float]]) -> SteelTruth:
    """Return the truth of interior pixels with these depths (metres) and rays (x/z, y/z)."""
    bare = steel_truth(np.ones((1, len(depth_m))), np.ones((1, len(depth_m)), np.uint16))
    return replace(
        bare, depth_m=np.array(depth_m, np.float32), rays=np.array(rays), interior=np.ones(len(depth_m), bool)
    )


def test_golden_case_by_hand() -> None:
    truth = points_on_rays([1.0, 2.0, 3.0, 4.0], [(0, 0)] * 4)
    measured = scores(np.array([1.0015, 2.0, np.nan, 4.0075]), truth)
    accuracy = {1: 1 / 4, 2: 2 / 4, 5: 2 / 4, 10: 3 / 4, 20: 3 / 4}
    for t, share in accuracy.items():
        assert measured[f"cloud_accuracy_{t}mm"] == pytest.approx(share)
        assert measured[f"cloud_completeness_{t}mm"] == pytest.approx(share)
        assert measured[f"cloud_f_{t}mm"] == pytest.approx(share)


def test_point_may_match_point_of_another_pixel() -> None:
    truth = points_on_rays([1.0, 2.0], [(0, 0), (0, 0)])
    measured = scores(np.array([2.0, 2.0]), truth)  # both predicted points equal the second true point
    assert measured["cloud_accuracy_1mm"] == 1.0
    assert measured["cloud_completeness_1mm"] == 0.5
    assert measured["cloud_f_1mm"] == pytest.approx(2 / 3)


def test_distance_is_euclidean_not_along_axis() -> None:
    truth = points_on_rays([1.0], [(3.0, 4.0)])  # a ray of length sqrt(26) = 5.1
    measured = scores(np.array([1.003]), truth)  # 15.3 mm
    assert measured["cloud_accuracy_10mm"] == 0.0
    assert measured["cloud_accuracy_20mm"] == 1.0


def test_tolerance_is_inclusive() -> None:
    truth = points_on_rays([1 / 32], [(0, 0)])
    p_m = np.array([1 / 32 - 0.02])  # exact, as 0.02 lies between half and twice 1/32
    assert scores(p_m, truth)["cloud_accuracy_20mm"] == 1.0
    assert scores(np.nextafter(p_m, 0), truth)["cloud_accuracy_20mm"] == 0.0


def brute_force_scores(p_m: ndarray, truth: SteelTruth, queries: int = MAX_POINTS) -> dict[str, float]:
    """Return the scores from the distances of all pairs of a queried and any other point."""
    rays = np.column_stack([truth.rays, np.ones(len(truth.rays))])
    true_m = truth.depth_m.astype(np.float64)[:, None] * rays
    predicted_m = np.where(np.isfinite(p_m) & (p_m > 0), p_m, np.nan)[:, None] * rays
    inside = np.flatnonzero(truth.interior)
    count = min(len(inside), queries)
    queried = inside[[k * len(inside) // count for k in range(count)]]
    steel_m = true_m[truth.bar_id > 0]
    to_steel_m = [np.linalg.norm(steel_m - point, axis=1).min() for point in predicted_m[queried]]
    to_predicted_m = [
        np.nanmin(np.r_[np.linalg.norm(predicted_m[inside] - point, axis=1), np.inf]) for point in true_m[queried]
    ]
    expected: dict[str, float] = {}
    for t in TOLERANCES_MM:
        a, c = (float(np.mean(np.array(found) <= t / 1000)) for found in (to_steel_m, to_predicted_m))
        f = 2 / (1 / a + 1 / c) if a and c else 0.0
        expected |= {f"cloud_accuracy_{t}mm": a, f"cloud_completeness_{t}mm": c, f"cloud_f_{t}mm": f}
    return expected


@settings(max_examples=40)
@given(SEEDS)
def test_scores_agree_with_brute_force(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = random_truth(rng)
    p_m = random_prediction(rng, truth)
    assert scores(p_m, truth) == pytest.approx(brute_force_scores(p_m, truth))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(point_cloud, "MAX_POINTS", 7)
        assert scores(p_m, truth) == pytest.approx(brute_force_scores(p_m, truth, 7))


def test_number_of_queries_does_not_set_the_distances(monkeypatch: pytest.MonkeyPatch) -> None:
    """A cylinder across the view, 2 % too far: two fifths of its points are within 5 mm of its surface."""
    y = (np.arange(120) - 59.5) / 60
    depth_m = np.broadcast_to(0.3 - 0.04 * np.sqrt(np.clip(1 - y**2, 0, 1))[:, None], (120, 160))
    truth = steel_truth(depth_m, np.ones((120, 160), np.uint16))
    assert np.count_nonzero(truth.interior) > 4 * MAX_POINTS
    p_m = 1.02 * truth.depth_m.astype(np.float64)
    all_points = scores(p_m, truth)
    assert 0.3 < all_points["cloud_accuracy_5mm"] < 0.5
    monkeypatch.setattr(point_cloud, "MAX_POINTS", 500)
    few = scores(p_m, truth)
    assert few == pytest.approx(brute_force_scores(p_m, truth, 500))
    assert few == pytest.approx(all_points, abs=0.05)


@settings(max_examples=40)
@given(SEEDS, st.floats(0.001, 1.0))
def test_holes_and_distant_points_never_raise_scores(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    truth = random_truth(rng)
    p_m = random_prediction(rng, truth)
    before = scores(p_m, truth)
    far_m = np.where(rng.random(len(p_m)) < share, rng.choice([1e-9, 50.0, 1e300], len(p_m)), p_m)
    for damaged_m in (with_holes(rng, p_m, share), far_m):
        after = scores(damaged_m, truth)
        assert all(after[name] <= before[name] for name in before)


@settings(max_examples=20)
@given(SEEDS)
def test_shares_increase_with_tolerance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = random_truth(rng)
    measured = scores(random_prediction(rng, truth), truth)
    for kind in ("accuracy", "completeness", "f"):
        ascending = [measured[f"cloud_{kind}_{t}mm"] for t in TOLERANCES_MM]
        assert ascending == sorted(ascending)
        assert 0.0 <= ascending[0] <= ascending[-1] <= 1.0


def test_subsampling_is_even_and_equal_for_both_clouds() -> None:
    assert np.array_equal(subsample(np.arange(7) * 3, MAX_POINTS), np.arange(7) * 3)
    subsampled = subsample(np.arange(MAX_POINTS * 5 // 2), MAX_POINTS)
    assert len(subsampled) == MAX_POINTS
    assert set(np.diff(subsampled)) == {2, 3}
    truth = steel_truth(np.full((90, 90), 0.5), np.ones((90, 90), np.uint16))
    assert np.count_nonzero(truth.interior) > MAX_POINTS
    assert set(scores(truth.depth_m.astype(np.float64), truth).values()) == {1.0}


@pytest.mark.parametrize("value", [0.0, -0.001])
def test_invalid_prediction_near_true_point_is_ignored(value: float) -> None:
    assert set(scores(np.array([value]), points_on_rays([0.0005], [(0, 0)])).values()) == {0.0}


def test_view_without_interior_has_no_scores() -> None:
    truth = steel_truth(np.ones((2, 2)), np.ones((2, 2), np.uint16))
    assert all(len(values) == 0 for values in cloud_samples(np.ones(4), truth).values())


@pytest.mark.parametrize("value", [1e308, 5e-324, np.inf, -np.inf, np.nan, 0.0, -1.0])
def test_extreme_values_match_no_point(value: float) -> None:
    truth = steel_truth(np.full((5, 5), 0.5), np.ones((5, 5), np.uint16))
    assert set(scores(np.full(25, value), truth).values()) == {0.0}


def test_skipped_lookups_do_not_change_scores(monkeypatch: pytest.MonkeyPatch) -> None:
    """Check that the scores are the same if the nearest point is looked up for every point."""
    rng = np.random.default_rng(2)
    truth = random_truth(rng)
    p_m = random_prediction(rng, truth)
    before = scores(p_m, truth)
    nearest_m = point_cloud._nearest_m
    monkeypatch.setattr(
        point_cloud,
        "_nearest_m",
        lambda tree, points, own, _: nearest_m(tree, points, own, np.ones(len(own), bool)),
    )
    assert scores(p_m, truth) == before
