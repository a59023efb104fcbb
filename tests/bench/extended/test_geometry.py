"""Geometry of the extended measures: straight segments of bars, cylinder fits and point clouds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import ndarray

from rebar_depth_bench.base.errors import DatasetError
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.extended import axes, point_cloud
from rebar_depth_bench.extended.axes import MAX_MATCH_RADIUS_M, CageTruth, assign_segments, cage_truth
from rebar_depth_bench.extended.fits import CylinderFits, fit_cylinders
from rebar_depth_bench.extended.measures import subsample
from rebar_depth_bench.extended.point_cloud import MAX_POINTS, TOLERANCES_MM, cloud_samples, true_cloud
from rebar_depth_bench.extended.steel import SteelTruth
from tests.bench.extended.cage_scenes import bar
from tests.bench.extended.thin_scenes import pixel_truth, random_prediction, random_truth, steel_truth

# Straight segments and their neighbours.


def polyline(points: np.ndarray, bar_id: int = 1, diameter_m: float = 0.01) -> Bar:
    return Bar(bar_id, "bar", diameter_m, tuple(map(tuple, points.tolist())))


def arc(radius_m: float, from_deg: float, to_deg: float, steps: int) -> np.ndarray:
    angle = np.deg2rad(np.linspace(from_deg, to_deg, steps + 1))
    return np.column_stack([radius_m * np.cos(angle), radius_m * np.sin(angle), np.zeros(steps + 1)])


def pairs_of(cage: CageTruth) -> set[tuple[int, int]]:
    ids = cage.bar_id[cage.neighbours]
    return {(int(first), int(second)) for first, second in ids}


# L-shaped: 0.2 m along x, a bend of 25 mm radius in 5-degree steps, 0.15 m along y.
BEND = arc(0.025, -90, 0, 18) + np.array([0.2, 0.025, 0])
L_BAR = polyline(np.concatenate([[[0, 0, 0]], BEND, [[0.225, 0.175, 0]]]))


def test_bent_bar_has_a_segment_on_each_side_of_bend() -> None:
    cage = cage_truth([L_BAR])
    assert cage.bar_id.tolist() == [1, 1]
    np.testing.assert_allclose(np.column_stack([cage.start_m, cage.end_m]), [
        (0, 0, 0, 0.2, 0, 0), (0.225, 0.025, 0, 0.225, 0.175, 0),
    ], atol=1e-12)  # fmt: skip


def test_collinear_pieces_and_repeated_points_are_merged() -> None:
    points = np.array([[0, 0, 0], [0.1, 0.0005, 0], [0.1, 0.0005, 0], [0.2, 0, 0], [0.5, 0.001, 0]])
    cage = cage_truth([polyline(points)])
    assert (cage.start_m.tolist(), cage.end_m.tolist()) == ([[0, 0, 0]], [[0.5, 0.001, 0]])


@pytest.mark.parametrize("steps", [72, 720, 7200])
def test_hoop_has_no_segment_at_any_resolution(steps: int) -> None:
    assert len(cage_truth([polyline(arc(0.4, 0, 300, steps))])) == 0


def test_short_straight_pieces_are_no_segments() -> None:
    assert len(cage_truth([bar(1, (0, 0, 0), (0.041, 0, 0), 0.01)])) == 1
    assert len(cage_truth([bar(1, (0, 0, 0), (0.039, 0, 0), 0.01)])) == 0


def test_grid_neighbours_exclude_diagonals() -> None:
    grid = [
        bar(1 + 3 * i + j, (0.02 * i, 0.02 * j, 0), (0.02 * i, 0.02 * j, 1), 0.007)
        for i in range(3)
        for j in range(3)
    ]
    sides = {(n, n + 3) for n in range(1, 7)} | {(n, n + 1) for n in range(1, 10) if n % 3}
    cage = cage_truth(grid)
    assert pairs_of(cage) == sides
    np.testing.assert_allclose(cage.match_radius_m, 0.01)


def test_bar_between_two_bars_separates_them() -> None:
    left, right = bar(1, (0, 0, 0), (0, 0, 1)), bar(2, (0.2, 0, 0), (0.2, 0, 1))
    assert pairs_of(cage_truth([left, right])) == {(1, 2)}
    assert pairs_of(cage_truth([left, right, bar(3, (0.1, 0, 0), (0.1, 0, 1))])) == {(1, 3), (2, 3)}
    # A bar that ends below the middle of the two does not separate them there.
    assert (1, 2) in pairs_of(cage_truth([left, right, bar(3, (0.1, 0, 0), (0.1, 0, 0.4))]))


@pytest.mark.parametrize(
    ("other", "why"),
    [
        (bar(2, (0.1, 0, 0), (0.2, 0, 1)), "5.7 degrees off"),
        (bar(2, (0.1, 0, 0.95), (0.1, 0, 2)), "50 mm of overlap"),
        (bar(2, (0.0202, 0, 0), (0.0202, 0, 1)), "lapped"),
        (bar(2, (0.51, 0, 0), (0.51, 0, 1)), "too far"),
        (bar(1, (0.1, 0, 0), (0.1, 0, 1)), "the same bar"),
    ],
)
def test_bars_that_are_no_neighbours(other: Bar, why: str) -> None:
    assert pairs_of(cage_truth([bar(1, (0, 0, 0), (0, 0, 1)), other])) == set(), why


def test_pairs_are_independent_of_direction_and_order() -> None:
    forward = [bar(i, (0.1 * i, 0, 0), (0.1 * i, 0, 1)) for i in range(1, 5)]
    backward = [bar(i, (0.1 * i, 0, 1), (0.1 * i, 0, 0)) if i % 2 else forward[i - 1] for i in range(1, 5)]
    unordered = {frozenset(pair) for pair in pairs_of(cage_truth(backward[::-1]))}
    assert unordered == {frozenset(pair) for pair in pairs_of(cage_truth(forward))}


def test_match_radius_is_half_the_spacing_and_bounded() -> None:
    bars = [bar(1, (0, 0, 0), (0, 0, 1)), bar(2, (0.06, 0, 0), (0.06, 0, 1)), bar(3, (0.4, 0, 0), (0.4, 0, 1))]
    np.testing.assert_allclose(cage_truth(bars).match_radius_m, [0.03, 0.03, MAX_MATCH_RADIUS_M])
    np.testing.assert_allclose(cage_truth(bars[:1]).match_radius_m, [MAX_MATCH_RADIUS_M])


def test_points_on_bends_and_ends_belong_to_no_segment() -> None:
    cage = cage_truth([L_BAR, bar(2, (0, 0, 0.1), (0.2, 0, 0.1), 0.01)])
    on_bend_m = arc(0.025, -85, -5, 8) + np.array([0.2, 0.025, 0.005])
    points_m = np.concatenate([
        [[0.1, 0, 0.005], [0.225, 0.1, 0.005], [0.2305, 0.1, 0]],  # both legs, and a rib's top
        [[-0.001, 0, 0.005], [0, 0, 0.002], [0.1, 0, 0.03]],  # past the end, on the flat end, far off
        [[0.1, 0, 0.095]],  # on bar 2
        on_bend_m,
    ])  # fmt: skip
    bar_id = np.ones(len(points_m), dtype=np.uint16)
    bar_id[6] = 2
    expected = [0, 1, 1, -1, -1, -1, 2] + [-1] * len(on_bend_m)
    segment_index = assign_segments(points_m, bar_id, cage)
    assert segment_index.dtype == np.int16
    assert segment_index.tolist() == expected
    order = np.random.default_rng(0).permutation(len(points_m))
    assert assign_segments(points_m[order], bar_id[order], cage).tolist() == np.array(expected)[order].tolist()


def test_points_of_other_bars_belong_to_no_segment() -> None:
    cage = cage_truth([L_BAR])
    assert assign_segments(np.array([[0.1, 0, 0.005]]), np.array([9], dtype=np.uint16), cage).tolist() == [-1]
    assert assign_segments(np.empty((0, 3)), np.empty(0, dtype=np.uint16), cage).tolist() == []
    assert assign_segments(
        np.array([[0.1, 0, 0.005]]), np.array([1], dtype=np.uint16), cage_truth([])
    ).tolist() == [-1]


def test_too_many_segments_raise_dataset_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(axes, "MAX_SEGMENTS", 1)
    with pytest.raises(DatasetError, match="2 straight runs, expected up to 1"):
        cage_truth([L_BAR])


# Cylinder fits.


RADIUS_M, HALF_M = 0.008, 0.05


def half_cylinder(
    count: int,
    offset_m: tuple[float, float] = (0, 0),
    slope: tuple[float, float] = (0, 0),
    radius_m: float = RADIUS_M,
) -> np.ndarray:
    """Return random points (metres) on the side facing the camera, up to 64 degrees around; slopes are exact."""
    rng = np.random.default_rng(0)
    u = np.array([*slope, 1.0]) / np.sqrt(1 + slope[0] ** 2 + slope[1] ** 2)
    across = np.array([1.0, 0, 0]) - u[0] * u
    across /= np.linalg.norm(across)
    sine = rng.uniform(-0.9, 0.9, count)
    axis_m = np.array([*offset_m, 0.0]) + rng.uniform(-HALF_M, HALF_M, count)[:, None] * u
    outward = sine[:, None] * across - np.sqrt(1 - sine**2)[:, None] * np.cross(u, across)
    return np.asarray(axis_m + radius_m * outward)


def fit(
    points_m: np.ndarray, used: np.ndarray | None = None, start_m: tuple[float, float] = (0, 0)
) -> CylinderFits:
    ones = np.ones(1)
    used_mask = np.ones((1, len(points_m)), dtype=bool) if used is None else used[None]
    start = np.array([start_m], dtype=np.float64)
    return fit_cylinders(points_m[None], used_mask, start, HALF_M * ones, RADIUS_M * ones, ones > 0)


@pytest.mark.parametrize("offset_m", [(0, 0), (0.001, -0.002), (-0.002, 0.006), (0.0, 0.02)])
@pytest.mark.parametrize("slope", [(0, 0), (0.03, -0.05), (0, 0.1)])
def test_exact_cylinder_is_recovered(offset_m: tuple[float, float], slope: tuple[float, float]) -> None:
    fits = fit(half_cylinder(60, offset_m, slope), start_m=(offset_m[0] + 0.001, offset_m[1] - 0.003))
    assert fits.converged.all()
    np.testing.assert_allclose(fits.offset_m[0], offset_m, atol=2e-5)
    np.testing.assert_allclose(fits.slope[0], slope, atol=1e-3)
    np.testing.assert_allclose(fits.diameter_m, 2 * RADIUS_M, rtol=2e-3)


@pytest.mark.parametrize("ratio", [0.7, 0.9, 1.2, 1.5])
def test_fitted_diameter_follows_radius(ratio: float) -> None:
    fits = fit(half_cylinder(60, radius_m=ratio * RADIUS_M))
    np.testing.assert_allclose(fits.diameter_m, 2 * ratio * RADIUS_M, rtol=0.01)


def test_fit_tolerates_one_third_outliers() -> None:
    points_m = half_cylinder(64, (0, 0.004))
    points_m[::3, 1] += np.random.default_rng(1).uniform(0.02, 1.0, 22)
    fits = fit(points_m)
    assert fits.converged.all()
    np.testing.assert_allclose(fits.offset_m[0], (0, 0.004), atol=5e-4)


def test_depth_noise_does_not_bias_axis_position() -> None:
    rng = np.random.default_rng(3)
    sets = np.stack([half_cylinder(64)] * 200)
    sets[..., 1] += 5 * RADIUS_M * rng.standard_normal(sets.shape[:2])
    used, ones = np.ones(sets.shape[:2], dtype=bool), np.ones(200)
    fits = fit_cylinders(sets, used, np.zeros((200, 2)), HALF_M * ones, RADIUS_M * ones, ones < 0)
    assert fits.converged.mean() > 0.95
    # Each of the 200 fits has an error of about 5 R / 8: their mean is known to 0.05 R; the far side is 2 R away.
    assert abs(fits.offset_m[:, 1].mean()) < 0.2 * RADIUS_M
    # Depth noise does not move a bar across the line of sight.
    assert np.abs(fits.offset_m[:, 0]).max() < 0.5 * RADIUS_M


def test_points_on_one_flank_determine_the_axis() -> None:
    points_m = half_cylinder(200)
    flank_m = points_m[points_m[:, 0] > 0.5 * RADIUS_M]
    fits = fit(flank_m, start_m=(0.0005, 0.0005))
    np.testing.assert_allclose(fits.offset_m[0], (0, 0), atol=5e-4)


def test_unused_points_and_other_sets_have_no_effect() -> None:
    points_m = half_cylinder(40, (0.001, 0.002))
    padded = np.concatenate([points_m, np.full((24, 3), 1e9)])
    used = np.arange(64) < 40
    alone, with_padding = fit(points_m), fit(padded, used)
    np.testing.assert_allclose(with_padding.offset_m, alone.offset_m, atol=1e-12)
    together = fit_cylinders(
        np.stack([padded, 3 * padded]), np.stack([used, used]), np.zeros((2, 2)), HALF_M * np.ones(2),
        np.array([RADIUS_M, 3 * RADIUS_M]), np.array([True, False]),
    )  # fmt: skip
    np.testing.assert_allclose(together.offset_m[0], alone.offset_m[0], atol=1e-12)
    assert np.isnan(together.diameter_m).tolist() == [False, True]


def test_empty_input_does_not_converge() -> None:
    empty = fit(half_cylinder(10), used=np.zeros(10, dtype=bool))
    assert not empty.converged.any()
    assert np.isnan(empty.diameter_m).all()
    no_sets = fit_cylinders(
        np.empty((0, 9, 3)), np.empty((0, 9), dtype=bool), np.empty((0, 2)), np.empty(0), np.empty(0),
        np.empty(0, dtype=bool),
    )  # fmt: skip
    assert no_sets.offset_m.shape == (0, 2)


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.sampled_from([1e-9, 1e-3, 1.0, 1e3, 1e6, 1e150, 1e300]))
def test_random_points_never_raise_or_warn(seed: int, size_m: float) -> None:
    points_m = size_m * np.random.default_rng(seed).standard_normal((30, 3))
    fits = fit(points_m)
    assert np.isfinite(fits.offset_m[fits.converged]).all()


# Point clouds.


SEEDS = st.integers(0, 2**32 - 1)


def cloud_scores(p_m: ndarray, truth: SteelTruth) -> dict[str, float]:
    samples = cloud_samples(p_m, true_cloud(truth))
    return {name: float(values[0]) for name, values in samples.items() if len(values)}


def test_clouds_by_hand() -> None:
    truth = pixel_truth([1.0, 2.0, 3.0, 4.0], rays=[(0, 0)] * 4)
    measured = cloud_scores(np.array([1.003, 2.0, np.nan, 4.0075]), truth)
    accuracy = {5: 2 / 4, 10: 3 / 4}
    for t, share in accuracy.items():
        assert measured[f"cloud_accuracy_{t}mm"] == pytest.approx(share)
        assert measured[f"cloud_completeness_{t}mm"] == pytest.approx(share)
        assert measured[f"cloud_f_{t}mm"] == pytest.approx(share)


def test_tolerance_is_inclusive() -> None:
    truth = pixel_truth([1 / 64], rays=[(0, 0)])
    p_m = np.array([1 / 64 - 0.01])  # exact, as 0.01 lies between half and twice 1/64
    assert cloud_scores(p_m, truth)["cloud_accuracy_10mm"] == 1.0
    assert cloud_scores(np.nextafter(p_m, 0), truth)["cloud_accuracy_10mm"] == 0.0


def brute_force_scores(p_m: ndarray, truth: SteelTruth, queries: int = MAX_POINTS) -> dict[str, float]:
    """Return the scores of point clouds from the distances of all pairs of a queried point and any other."""
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


@pytest.mark.slow
@settings(max_examples=40)
@given(SEEDS)
def test_scores_agree_with_brute_force(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = random_truth(rng)
    p_m = random_prediction(rng, truth)
    assert cloud_scores(p_m, truth) == pytest.approx(brute_force_scores(p_m, truth))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(point_cloud, "MAX_POINTS", 7)
        assert cloud_scores(p_m, truth) == pytest.approx(brute_force_scores(p_m, truth, 7))


def test_subsampling_is_even_and_equal_for_both_clouds() -> None:
    assert np.array_equal(subsample(np.arange(7) * 3, MAX_POINTS), np.arange(7) * 3)
    subsampled = subsample(np.arange(MAX_POINTS * 5 // 2), MAX_POINTS)
    assert len(subsampled) == MAX_POINTS
    assert set(np.diff(subsampled)) == {2, 3}
    truth = steel_truth(np.full((90, 90), 0.5), np.ones((90, 90), np.uint16))
    assert np.count_nonzero(truth.interior) > MAX_POINTS
    assert set(cloud_scores(truth.depth_m.astype(np.float64), truth).values()) == {1.0}


@pytest.mark.parametrize("value", [1e308, 5e-324, np.inf, -np.inf, np.nan, 0.0, -0.001])
def test_extreme_values_match_no_point(value: float) -> None:
    truth = steel_truth(np.full((5, 5), 0.5), np.ones((5, 5), np.uint16))
    assert set(cloud_scores(np.full(25, value), truth).values()) == {0.0}
    if not 0 < value < 1:
        assert set(cloud_scores(np.array([value]), pixel_truth([0.0005], rays=[(0, 0)])).values()) == {0.0}
    no_interior = steel_truth(np.ones((2, 2)), np.ones((2, 2), np.uint16))
    assert cloud_scores(np.full(4, value), no_interior) == {}
