"""Measures over pixels: alignment, errors as papers print them, disparity, and rules for all families."""

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
from rebar_depth_bench.extended import boundary, disparity, point_cloud, published, single_bar
from rebar_depth_bench.extended.alignment import alignment_samples, scale_invariant_log
from rebar_depth_bench.extended.measures import Measure, Samples
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.geometry.cameras import Camera, rotation_matrix
from tests.bench.extended.thin_scenes import pixel_truth, random_prediction, random_truth, steel_truth, with_holes

SEEDS = st.integers(0, 2**32 - 1)


# Rules for the families over pixels.


def cloud_samples(p_m: ndarray, truth: SteelTruth) -> Samples:
    return point_cloud.cloud_samples(p_m, point_cloud.true_cloud(truth))


FAMILIES: dict[str, tuple[Callable[..., Samples], Sequence[Measure]]] = {
    "boundary": (boundary.boundary_samples, boundary.MEASURES),
    "clouds": (cloud_samples, point_cloud.MEASURES),
    "single_bar": (single_bar.single_bar_samples, single_bar.MEASURES),
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
    for array in (p_m, truth.index, truth.depth_m, truth.bar_id, truth.interior, truth.rays):
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


# Alignments.


def depths(seed: int, count: int = 400) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.2, 1.0, count).astype(np.float32).astype(float)


def aligned(p: np.ndarray, z: np.ndarray) -> dict[str, float]:
    return {name: samples[0] for name, samples in alignment_samples(p, pixel_truth(z)).items() if len(samples)}


def test_alignments_by_hand() -> None:
    measured = aligned(np.array([1.0, 2.0, 4.0]), np.array([1.0, 1.0, 2.0]))
    assert measured["log_of_scale"] == pytest.approx(math.log(0.5))
    # Offsets 0, -ln 2, -ln 2: mean -2/3 ln 2, spread sqrt(2)/3 ln 2.
    assert measured["silog"] == pytest.approx(np.sqrt(2) / 3 * np.log(2))


@given(SEEDS, st.floats(0.05, 20))
def test_silog_is_that_of_the_paper_and_independent_of_scale(seed: int, factor: float) -> None:
    z = depths(seed)
    p = 2 * z + 0.3 + np.random.default_rng(seed).normal(0, 0.05, len(z))
    d = np.log(p) - np.log(z)
    for scaled in (p, factor * p):
        assert scale_invariant_log(scaled, z) == pytest.approx(np.sqrt(np.mean(d**2) - np.mean(d) ** 2))


def test_missing_constant_and_extreme_predictions_are_aligned_without_warning() -> None:
    z = depths(4)
    assert aligned(np.full(len(z), np.nan), z) == {}
    for value in (1e300, 1e-300):
        assert aligned(np.full(len(z), value), z)["silog"] == pytest.approx(np.std(np.log(z)))


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
