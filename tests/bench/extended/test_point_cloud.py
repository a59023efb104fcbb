"""Accuracy and completeness as point clouds: cases by hand, every pair of points, and what no damage may do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import ndarray

from rebar_depth_bench.extended import point_cloud
from rebar_depth_bench.extended.measures import thinned
from rebar_depth_bench.extended.point_cloud import MAX_POINTS, TOLERANCES_MM, cloud_samples, true_cloud
from rebar_depth_bench.extended.steel_truth import SteelTruth
from tests.bench.extended.thin_scenes import random_prediction, random_truth, steel_truth, with_holes

SEEDS = st.integers(0, 2**32 - 1)


def scores(p_m: ndarray, truth: SteelTruth) -> dict[str, float]:
    return {name: float(values[0]) for name, values in cloud_samples(p_m, truth).items()}


def points_on_rays(depth_m: list[float], rays: list[tuple[float, float]]) -> SteelTruth:
    """Return a truth of interior pixels with any depth and any rays."""
    bare = steel_truth(np.ones((1, len(depth_m))), np.ones((1, len(depth_m)), np.uint16))
    return replace(
        bare, depth_m=np.array(depth_m, np.float32), rays=np.array(rays), interior=np.ones(len(depth_m), bool)
    )


def test_golden_case_by_hand() -> None:
    truth = points_on_rays([1.0, 2.0, 3.0, 4.0], [(0, 0)] * 4)
    found = scores(np.array([1.0015, 2.0, np.nan, 4.0075]), truth)
    accuracy = {1: 1 / 4, 2: 2 / 4, 5: 2 / 4, 10: 3 / 4, 20: 3 / 4}
    for t, share in accuracy.items():
        assert found[f"cloud_accuracy_{t}mm"] == pytest.approx(share)
        assert found[f"cloud_completeness_{t}mm"] == pytest.approx(share)
        assert found[f"cloud_f_{t}mm"] == pytest.approx(share)


def test_a_point_may_match_another_pixels() -> None:
    truth = points_on_rays([1.0, 2.0], [(0, 0), (0, 0)])
    found = scores(np.array([2.0, 2.0]), truth)  # both predicted points on the second true one
    assert found["cloud_accuracy_1mm"] == 1.0
    assert found["cloud_completeness_1mm"] == 0.5
    assert found["cloud_f_1mm"] == pytest.approx(2 / 3)


def test_distance_is_measured_in_space_not_along_the_axis() -> None:
    truth = points_on_rays([1.0], [(3.0, 4.0)])  # a ray of length sqrt(26) = 5.1
    found = scores(np.array([1.003]), truth)  # 15.3 mm
    assert found["cloud_accuracy_10mm"] == 0.0
    assert found["cloud_accuracy_20mm"] == 1.0


def test_a_tolerance_includes_its_end() -> None:
    truth = points_on_rays([1 / 32], [(0, 0)])
    p_m = np.array([1 / 32 - 0.02])  # exact, as 0.02 is between half and twice 1/32
    assert scores(p_m, truth)["cloud_accuracy_20mm"] == 1.0
    assert scores(np.nextafter(p_m, 0), truth)["cloud_accuracy_20mm"] == 0.0


def every_pair(p_m: ndarray, truth: SteelTruth) -> dict[str, float]:
    """Return the scores from the distances of all pairs of points."""
    inside = truth.interior
    rays = np.column_stack([truth.rays[inside], np.ones(np.count_nonzero(inside))])
    true_m = truth.depth_m[inside].astype(np.float64)[:, None] * rays
    known = np.isfinite(p_m[inside]) & (p_m[inside] > 0)
    predicted_m = p_m[inside][known][:, None] * rays[known]
    distance_m = np.linalg.norm(true_m[:, None] - predicted_m[None], axis=-1)
    found: dict[str, float] = {}
    for t in TOLERANCES_MM:
        within = distance_m <= t / 1000
        a, c = within.any(axis=0).sum() / len(true_m), within.any(axis=1).sum() / len(true_m)
        f = 2 / (1 / a + 1 / c) if a and c else 0.0
        found |= {f"cloud_accuracy_{t}mm": a, f"cloud_completeness_{t}mm": c, f"cloud_f_{t}mm": f}
    return found


@settings(max_examples=40)
@given(SEEDS)
def test_agrees_with_every_pair(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = random_truth(rng)
    p_m = random_prediction(rng, truth)
    assert scores(p_m, truth) == pytest.approx(every_pair(p_m, truth))


@settings(max_examples=40)
@given(SEEDS, st.floats(0.001, 1.0))
def test_neither_holes_nor_points_far_away_raise_a_score(seed: int, share: float) -> None:
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
def test_shares_grow_with_the_tolerance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = random_truth(rng)
    found = scores(random_prediction(rng, truth), truth)
    for kind in ("accuracy", "completeness", "f"):
        ascending = [found[f"cloud_{kind}_{t}mm"] for t in TOLERANCES_MM]
        assert ascending == sorted(ascending)
        assert 0.0 <= ascending[0] <= ascending[-1] <= 1.0


def test_thinning_is_even_and_the_same_for_both_clouds() -> None:
    assert np.array_equal(thinned(np.arange(7) * 3, MAX_POINTS), np.arange(7) * 3)
    kept = thinned(np.arange(MAX_POINTS * 5 // 2), MAX_POINTS)
    assert len(kept) == MAX_POINTS
    assert set(np.diff(kept)) == {2, 3}
    truth = steel_truth(np.full((90, 90), 0.5), np.ones((90, 90), np.uint16))
    assert np.count_nonzero(truth.interior) > MAX_POINTS
    assert set(scores(truth.depth_m.astype(np.float64), truth).values()) == {1.0}


@pytest.mark.parametrize("value", [0.0, -0.001])
def test_no_prediction_is_no_point_even_near_a_true_one(value: float) -> None:
    assert set(scores(np.array([value]), points_on_rays([0.0005], [(0, 0)])).values()) == {0.0}


def test_a_given_cloud_changes_nothing() -> None:
    rng = np.random.default_rng(1)
    truth = random_truth(rng)
    p_m = random_prediction(rng, truth)
    given_cloud = {name: float(v[0]) for name, v in cloud_samples(p_m, truth, true_cloud(truth)).items()}
    assert given_cloud == scores(p_m, truth)


def test_a_view_without_interior_says_nothing() -> None:
    truth = steel_truth(np.ones((2, 2)), np.ones((2, 2), np.uint16))
    assert all(len(values) == 0 for values in cloud_samples(np.ones(4), truth).values())


@pytest.mark.parametrize("value", [1e308, 5e-324, np.inf, -np.inf, np.nan, 0.0, -1.0])
def test_hostile_values_match_nothing_and_warn_of_nothing(value: float) -> None:
    truth = steel_truth(np.full((5, 5), 0.5), np.ones((5, 5), np.uint16))
    assert set(scores(np.full(25, value), truth).values()) == {0.0}


def test_look_ups_are_skipped_only_where_they_cannot_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    """With all points looked up the scores are the same."""
    rng = np.random.default_rng(2)
    truth = random_truth(rng)
    p_m = random_prediction(rng, truth)
    before = scores(p_m, truth)
    always = point_cloud._nearest_m
    monkeypatch.setattr(
        point_cloud, "_nearest_m", lambda tree, points, own, _: always(tree, points, own, np.ones(len(own), bool))
    )
    assert scores(p_m, truth) == before
