"""Measures over pixels: full mask, alignment, profiles by distance and width, and rules for all families."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import ndarray

from rebar_depth_bench.data.rows import EyeTruth
from rebar_depth_bench.extended import boundary, depth_layers, disparity, point_cloud, published, regions
from rebar_depth_bench.extended.alignment import MEASURES as ALIGNMENT_MEASURES
from rebar_depth_bench.extended.alignment import (
    alignment_samples,
    log_scale,
    scale_and_shift,
    scale_invariant_log,
)
from rebar_depth_bench.extended.measures import Measure, Samples
from rebar_depth_bench.extended.profiles import (
    DISTANCE_EDGES_M,
    MIN_PIXELS,
    WIDTH_EDGES_PX,
    profile_samples,
)
from rebar_depth_bench.extended.profiles import MEASURES as PROFILE_MEASURES
from rebar_depth_bench.extended.regions import region_samples
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.geometry.cameras import Camera, rotation_matrix
from rebar_depth_bench.scoring.columns import METRICS
from rebar_depth_bench.scoring.protocol import WITHIN_MM
from rebar_depth_bench.scoring.view_numbers import ViewTruth, view_numbers
from tests.bench.extended.thin_scenes import pixel_truth, random_prediction, random_truth, steel_truth, with_holes

SEEDS = st.integers(0, 2**32 - 1)


# Rules for the families of boundary, point clouds, depth layers and full mask.


def cloud_samples(p_m: ndarray, truth: SteelTruth) -> Samples:
    return point_cloud.cloud_samples(p_m, point_cloud.true_cloud(truth))


FAMILIES: dict[str, tuple[Callable[..., Samples], Sequence[Measure]]] = {
    "boundary": (boundary.boundary_samples, boundary.MEASURES),
    "clouds": (cloud_samples, point_cloud.MEASURES),
    "layers": (depth_layers.layer_samples, depth_layers.MEASURES),
    "full_mask": (regions.region_samples, regions.FULL_MASK_MEASURES),
    "disparity": (disparity.disparity_samples, disparity.MEASURES),
    "published": (published.error_samples, published.ERROR_MEASURES),
}


every_family = pytest.mark.parametrize(("sampled", "measures"), FAMILIES.values(), ids=FAMILIES)


@every_family
def test_samples_are_those_of_the_measures_and_leave_inputs_alone(
    sampled: Callable[..., Samples], measures: Sequence[Measure]
) -> None:
    truth = random_truth(np.random.default_rng(0))
    p_m = truth.depth_m.astype(np.float64)
    for array in (p_m, truth.index, truth.depth_m, truth.bar_id, truth.interior, truth.rays, truth.front_m):
        array.flags.writeable = False  # Writing raises.
    samples = sampled(p_m, truth)
    for name in {measure.sample for measure in measures}:
        assert (samples[name].dtype, samples[name].shape) == (np.float64, (1,)), name


@every_family
@settings(max_examples=25)
@given(seed=SEEDS, share=st.floats(0.001, 1.0))
def test_holes_never_improve_a_measure(
    sampled: Callable[..., Samples], measures: Sequence[Measure], seed: int, share: float
) -> None:
    rng = np.random.default_rng(seed)
    truth = random_truth(rng)
    p_m = random_prediction(rng, truth)
    before, after = sampled(p_m, truth), sampled(with_holes(rng, p_m, share), truth)
    for measure in measures:
        if measure.better and measure.sample in before:  # A random truth may have no contour.
            [gain] = after[measure.sample] - before[measure.sample]
            assert gain <= 0 if measure.better == "higher" else gain >= 0, measure.name


@every_family
def test_no_steel_gives_no_sample(sampled: Callable[..., Samples], measures: Sequence[Measure]) -> None:
    truth = steel_truth(np.ones((3, 3)), np.zeros((3, 3), np.uint16))
    assert not any(len(values) for values in sampled(np.empty(0), truth).values())


# Full mask and interior.


def mask_scores(p_m: ndarray, truth: SteelTruth) -> dict[str, float]:
    return {name: float(values[0]) for name, values in region_samples(p_m, truth).items() if len(values)}


def test_full_mask_by_hand() -> None:
    """Check nine steel pixels on a board: one is interior; of the others one is missing and one is 4 mm off."""
    depth_m, bars = np.full((5, 5), 3.0), np.zeros((5, 5), np.uint16)
    depth_m[1:4, 1:4], bars[1:4, 1:4] = 2.0, 1
    truth = steel_truth(depth_m, bars)
    p_m = truth.depth_m.astype(np.float64)
    p_m[0] = 99.0  # board, ignored
    p_m[6], p_m[7], p_m[12] = math.nan, 2.004, 3.0  # rim, rim, interior
    measured = mask_scores(p_m, truth)
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
    expected = view_numbers(image_m.reshape(truth.height, truth.width), view)
    measured = mask_scores(p_m, truth)
    for name in METRICS:
        assert measured[f"interior_{name}"] == pytest.approx(expected[f"native.{name}"], rel=1e-12)
    assert measured["interior_coverage"] == expected["coverage"]
    for t in WITHIN_MM:
        assert measured[f"interior_within_{t}mm"] == expected[f"within_mm.{t}"]


def test_empty_masks_have_no_samples() -> None:
    rim = steel_truth(np.ones((2, 2)), np.ones((2, 2), np.uint16))
    measured = mask_scores(np.ones(4), rim)
    assert not [name for name in measured if name.startswith("interior")]
    assert (measured["kept_share"], measured["full_mask_delta1"]) == (0.0, 1.0)
    unpredicted = mask_scores(np.full(4, np.nan), rim)
    assert "full_mask_abs_rel" not in unpredicted
    assert unpredicted["full_mask_coverage"] == unpredicted["full_mask_within_20mm"] == 0.0


# Alignments.


def depths(seed: int, count: int = 400) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.2, 1.0, count).astype(np.float32).astype(float)


def aligned(p: np.ndarray, z: np.ndarray) -> dict[str, float]:
    return {name: samples[0] for name, samples in alignment_samples(p, pixel_truth(z)).items() if len(samples)}


def test_alignments_by_hand() -> None:
    measured = aligned(np.array([1.0, 2.0, 4.0]), np.array([1.0, 1.0, 2.0]))
    assert measured["scale"] == 0.5
    # native: |1-1|/1, |2-1|/1, |4-2|/2 -> 2/3; with s = 1/2: |0.5-1|/1, 0, 0 -> 1/6
    assert measured["scale_explains"] == pytest.approx(1 - (1 / 6) / (2 / 3))
    # log: offsets 0, -ln 2, -ln 2 -> mean -2/3 ln 2, spread sqrt(2)/3 ln 2
    assert measured["silog"] == pytest.approx(np.sqrt(2) / 3 * np.log(2))
    q = 2 ** (-2 / 3)
    assert measured["log_scaled_abs_rel"] == pytest.approx((abs(q - 1) + abs(2 * q - 1) + abs(4 * q - 2) / 2) / 3)
    # least squares through (1, 1), (2, 1), (4, 2): a = 5/14, b = 1/2
    assert measured["shift_cm"] == pytest.approx(50)
    errors = np.array([5 / 14 + 0.5 - 1, 10 / 14 + 0.5 - 1, 20 / 14 + 0.5 - 2])
    assert measured["shifted_rmse_cm"] == pytest.approx(100 * np.sqrt(np.mean(errors**2)))


@settings(max_examples=40)
@given(SEEDS, st.floats(0.05, 20), st.floats(-0.1, 5))
def test_known_scale_and_shift_are_recovered(seed: int, factor: float, shift_m: float) -> None:
    z = depths(seed)
    scaled = aligned(factor * z, z)
    assert scaled["scale"] == pytest.approx(1 / factor)
    assert scaled["log_scaled_abs_rel"] == pytest.approx(0, abs=1e-9)
    assert scaled["silog"] == pytest.approx(0, abs=1e-6)
    if abs(factor - 1) > 1e-3:
        assert scaled["scale_explains"] == pytest.approx(1, abs=1e-6)
    moved = factor * z + factor * shift_m
    measured = aligned(moved, z)
    assert measured["shift_cm"] == pytest.approx(-100 * shift_m, abs=1e-5)
    assert measured["shifted_abs_rel"] == pytest.approx(0, abs=1e-6)
    assert measured["shifted_delta1"] == 1.0


@given(SEEDS)
def test_alignments_agree_with_independent_solvers(seed: int) -> None:
    z = depths(seed)
    p = 2 * z + 0.3 + np.random.default_rng(seed).normal(0, 0.05, len(z))
    a, b_m = scale_and_shift(p, z)
    assert (a, b_m) == pytest.approx(tuple(np.polyfit(p, z, 1)))
    best = log_scale(p, z)
    cost = [np.sum((np.log(s * p) - np.log(z)) ** 2) for s in (0.999 * best, best, 1.001 * best)]
    assert min(cost) == cost[1]
    d = np.log(p) - np.log(z)
    assert scale_invariant_log(p, z) == pytest.approx(np.sqrt(np.mean(d**2) - np.mean(d) ** 2))


def test_missing_constant_and_extreme_predictions_are_aligned_without_warning() -> None:
    z = depths(4)
    assert aligned(np.full(len(z), np.nan), z) == {}
    assert scale_and_shift(np.full(len(z), 2.0), z) == pytest.approx((1.0, z.mean() - 2.0))
    assert set(aligned(np.full(len(z), 1e300), z)) <= {measure.sample for measure in ALIGNMENT_MEASURES}
    assert aligned(np.full(len(z), 1e-300), z)["scale"] > 1e299


# Errors as papers print them.


def test_published_errors_by_hand() -> None:
    """Ratios of 1, 1.02, 1.03, 1.5, 1.6 and 2 to one side or the other; a missing prediction is left out."""
    z = np.array([1.0, 0.5, 2.0, 1.0, 1.0, 1.0, 1.0])
    p = np.array([1.0, 0.51, 2.06, 1 / 1.5, 1.6, 0.5, np.nan])
    measured = {name: values.tolist() for name, values in published.error_samples(p, pixel_truth(z)).items()}
    logs = [0, math.log10(1.02), math.log10(1.03), math.log10(1.5), math.log10(1.6), math.log10(2)]
    assert measured == {
        "log10": [pytest.approx(sum(logs) / 6)],
        "inlier_1.03": [2 / 6],
        "delta2": [4 / 6],  # 1.25^2 = 1.5625
        "delta3": [5 / 6],  # 1.25^3 = 1.953125
    }


# Disparity.


def stereo_pair(rng: np.random.Generator, width: int = 60, height: int = 12) -> tuple[EyeTruth, EyeTruth]:
    """Return two random depths before a rectified pair, f B = 8 px m, whose principal points differ by 2 px."""
    eyes = []
    for cx, x_m in ((25.0, 0.0), (23.0, 0.1)):
        K = np.array([[80.0, 0, cx], [0, 70.0, 5.0], [0, 0, 1.0]])
        depth_m = rng.choice([0.5, 0.52, 1.0, 2.0, 0.0], (height, width)).astype(np.float32)
        pose = np.eye(4)
        pose[0, 3] = -x_m
        eyes.append(EyeTruth(Camera(K, np.zeros(5), pose, width, height), None, depth_m, depth_m > 0, None))
    return eyes[0], eyes[1]


@settings(max_examples=20)
@given(SEEDS)
def test_non_occluded_pixels_and_disparity_errors_by_pixel_loops(seed: int) -> None:
    rng = np.random.default_rng(seed)
    left, right = stereo_pair(rng)
    scored = np.flatnonzero(left.depth_m).astype(np.uint32)
    parallax_px_m, seen = disparity.match_right((left, right), scored)
    assert parallax_px_m == pytest.approx(8.0)
    z_m, p_m = left.depth_m.ravel()[scored].astype(float), np.full(len(scored), np.nan)
    expected_seen, errors = [], []
    for place, pixel in enumerate(scored.tolist()):
        v, u = divmod(pixel, 60)
        d = 8.0 / z_m[place]
        match = round(u - d - (25.0 - 23.0))
        there = float(right.depth_m[v, match]) if 0 <= match < 60 else 0.0
        expected_seen.append(there > 0 and abs(8.0 / there - d) <= 1.0)
        if rng.random() < 0.8:
            p_m[place] = z_m[place] * rng.choice([1.0, 1.1, 0.8, 0.6])
            errors.append((abs(8.0 / p_m[place] - d), d, expected_seen[-1]))
        else:
            errors.append((math.inf, d, expected_seen[-1]))
    assert seen.tolist() == expected_seen
    truth = replace(pixel_truth(z_m), parallax_px_m=parallax_px_m, seen_by_right=seen)
    measured = {name: values.tolist() for name, values in disparity.disparity_samples(p_m, truth).items()}
    expected = {"disparity_seen_by_right": [sum(expected_seen) / len(scored)]}
    for prefix, chosen in (("disparity", errors), ("disparity_noc", [one for one in errors if one[2]])):
        found = [error for error, _, _ in chosen if error < math.inf]
        expected[f"{prefix}_epe_px"] = [sum(found) / len(found)]
        expected[f"{prefix}_bad1"] = [sum(error > 1 for error, _, _ in chosen) / len(chosen)]
        expected[f"{prefix}_bad2"] = [sum(error > 2 for error, _, _ in chosen) / len(chosen)]
        expected[f"{prefix}_d1"] = [sum(error > 3 and error > 0.05 * d for error, d, _ in chosen) / len(chosen)]
    assert measured.keys() == expected.keys()
    for name, value in expected.items():
        assert measured[name] == pytest.approx(value, rel=1e-9), name


def test_views_that_are_no_rectified_pair_have_no_disparity() -> None:
    left, right = stereo_pair(np.random.default_rng(0))
    scored = np.flatnonzero(left.depth_m).astype(np.uint32)
    turned, lens, swapped = np.eye(4), np.array([1e-3, 0, 0, 0, 0]), right.camera.cam_from_world.copy()
    turned[:3, :3] = rotation_matrix([0, 0.01, 0])
    swapped[0, 3] *= -1
    others = [
        replace(right.camera, cam_from_world=turned @ right.camera.cam_from_world),
        replace(right.camera, cam_from_world=swapped),
        replace(right.camera, distortion=lens),
        replace(right.camera, K=right.camera.K + np.diag([1.0, 0, 0])),
    ]
    pairs = [(left,), *((left, replace(right, camera=camera)) for camera in others)]
    for pair in pairs:
        parallax_px_m, seen = disparity.match_right(pair, scored)
        assert parallax_px_m == 0.0
        assert not seen.any()
    assert disparity.disparity_samples(np.ones(3), replace(pixel_truth([1.0, 1.0, 1.0]), parallax_px_m=0.0)) == {}


# Profiles.


def bin_values(p: np.ndarray, z: np.ndarray, bar_id: np.ndarray, diameter_m: np.ndarray) -> dict[str, float]:
    samples = profile_samples(p, pixel_truth(z, bar_id, diameter_m=diameter_m))
    return {name: value[0] for name, value in samples.items() if len(value)}


def test_values_by_distance_and_width_bin() -> None:
    near, far = np.full(100, 0.35), np.full(60, 0.8)
    z = np.r_[near, far]
    p = np.r_[2 * near, 4 * far]
    bar_id = np.r_[np.full(100, 1), np.full(60, 2)]
    values = bin_values(
        p, z, bar_id, np.array([np.nan, 0.004, 0.016])
    )  # 700 * 4 / 350 = 8 px, 700 * 16 / 800 = 14 px
    assert values == pytest.approx(
        {
            "scale_at_0.3-0.4m": 0.5,
            "abs_rel_at_0.3-0.4m": 1.0,
            "single_bar_share_at_0.3-0.4m": 1.0,
            "single_bar_abs_rel_at_0.3-0.4m": 1.0,
            "scale_at_0.7-1m": 0.25,
            "abs_rel_at_0.7-1m": 3.0,
            "single_bar_share_at_0.7-1m": 1.0,
            "single_bar_abs_rel_at_0.7-1m": 3.0,
            "scale_at_8-12px": 0.5,
            "abs_rel_at_8-12px": 1.0,
            "scale_at_12-16px": 0.25,
            "abs_rel_at_12-16px": 3.0,
        },
        rel=1e-6,
    )


def test_bin_with_few_predictions_has_no_value() -> None:
    z = np.full(MIN_PIXELS, 0.35)
    p = z.copy()
    assert bin_values(p, z, np.ones(len(z)), np.array([np.nan, 0.01]))
    p[0] = np.nan
    values = bin_values(p, z, np.ones(len(z)), np.array([np.nan, 0.01]))
    assert values == {"single_bar_share_at_0.3-0.4m": 1.0}  # The share needs no prediction.


def test_every_bin_has_a_measure() -> None:
    names = {measure.sample for measure in PROFILE_MEASURES}
    assert len(names) == len(PROFILE_MEASURES) == 4 * (len(DISTANCE_EDGES_M) - 1) + 2 * (len(WIDTH_EDGES_PX) - 1)
    z = np.full(60, 0.35)
    assert set(profile_samples(z, pixel_truth(z, diameter_m=np.array([np.nan, 0.01])))) == names
    for edge in DISTANCE_EDGES_M[:-1]:
        z = np.full(60, np.float32(edge) + np.float32(1e-6))
        assert any(f"{edge:g}-" in name for name in bin_values(z, z, np.ones(60), np.array([np.nan, 1e-6])))
