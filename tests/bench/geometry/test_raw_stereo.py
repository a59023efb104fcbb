"""Tests of stereo on the raw (distorted) grid: a textured plane of known depth, seen through two real lenses."""

from __future__ import annotations

from typing import Any

import pytest

pytest.importorskip("cv2")

import cv2
import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.geometry import rectification
from rebar_depth_bench.geometry.cameras import ideal_K, right_camera_pose
from rebar_depth_bench.methods import find_method
from tests.bench.geometry.textured_plane import HEIGHT, LEFT_CAM_FROM_WORLD, WIDTH, ideal_row, raw_row
from tests.bench.methods.predictors import load_predictor


@pytest.fixture(scope="module", name="raw_row")
def _raw_row() -> dict[str, Any]:
    return raw_row()


def relative_error(row: dict[str, Any]) -> Float64[ndarray, "h w"]:
    """Return the relative depth error of ``sgbm`` in the columns that the right camera also sees."""
    method = find_method("sgbm")
    predicted_m = load_predictor(method)({name: row[name] for name in method.info.columns})
    assert predicted_m.shape == (HEIGHT, WIDTH)
    assert predicted_m.dtype == np.float32
    return np.asarray(predicted_m / row["depth_m"] - 1)[:, WIDTH // 3 :]


@pytest.mark.slow
def test_sgbm_returns_planar_depth_on_raw_grid(raw_row: dict[str, Any]) -> None:
    """Compare with two ideal pinholes, where the matcher itself is about 0.14 px off on this plane."""
    error, ideal_error = relative_error(raw_row), relative_error(ideal_row())
    assert np.isfinite(error).mean() > 0.9
    assert np.nanmedian(np.abs(error)) < 3e-3
    # The rectified optical axis differs from the raw one: uncorrected, depth would be off by 0.4 to 0.7 % at the
    # sides and corners.
    for region in (error, error[:, -60:], error[:60], error[-60:], error[:60, -60:], error[-60:, -60:]):
        assert abs(np.nanmedian(region) - np.nanmedian(ideal_error)) < 1e-3


def test_rectified_rows_of_texture_match(raw_row: dict[str, Any]) -> None:
    """Check that the rectified right image, shifted by the analytic disparity, equals the left one."""
    pair = rectification.rectified_pair(raw_row)
    rectified_m = np.full(pair.left_rgb.shape[:2], np.nan)
    column, row = np.moveaxis(pair.pixel, -1, 0)
    rectified_m[row, column] = raw_row["depth_m"] / pair.depth_ratio
    disparity = pair.K[0, 0] * pair.baseline_m / rectified_m
    visible = np.isfinite(disparity) & rectification.matched_in_right(pair, disparity.astype(np.float32))
    v, u = np.indices(visible.shape).astype(np.float32)
    match_u = (u - np.nan_to_num(disparity)).astype(np.float32)
    matched = cv2.remap(pair.right_rgb[..., 0], match_u, v, cv2.INTER_CUBIC)[visible]
    difference = np.abs(matched.astype(float) - pair.left_rgb[..., 0][visible])
    assert visible.mean() > 0.4
    assert np.median(difference) <= 4
    assert np.corrcoef(matched, pair.left_rgb[..., 0][visible])[0, 1] > 0.97


@pytest.mark.slow
def test_every_raw_pixel_maps_into_the_canvas(raw_row: dict[str, Any]) -> None:
    pair = rectification.rectified_pair(raw_row)
    canvas = np.array(pair.left_rgb.shape[1::-1])
    assert (pair.pixel >= 0).all()
    assert (pair.pixel < canvas).all()
    planar = rectification.raw_depth_m(pair, np.full(pair.left_rgb.shape[:2], 2.0, np.float32))
    assert planar == pytest.approx(2.0 * pair.depth_ratio, rel=1e-6)
    assert np.isnan(rectification.raw_depth_m(pair, np.full(pair.left_rgb.shape[:2], np.nan, np.float32))).all()


def test_no_match_outside_raw_right_image(raw_row: dict[str, Any]) -> None:
    pair = rectification.rectified_pair(raw_row)
    nowhere = np.full(pair.left_rgb.shape[:2], 10_000.0, np.float32)
    assert not rectification.matched_in_right(pair, nowhere).any()
    assert np.array_equal(rectification.matched_in_right(pair, 0 * nowhere), pair.seen_by_right)
    assert 0.5 < pair.seen_by_right.mean() < 0.999


def test_is_rectified_detects_rotation_and_distortion(raw_row: dict[str, Any]) -> None:
    ideal = ideal_row()
    assert rectification.is_rectified(ideal)
    assert not rectification.is_rectified(raw_row)
    rotated = raw_row["right_cam_from_world"]
    assert not rectification.is_rectified(ideal | {"right_cam_from_world": rotated})
    assert not rectification.is_rectified(ideal | {"right_distortion": raw_row["right_distortion"]})


def test_sgbm_matches_rectified_row_directly() -> None:
    rng = np.random.default_rng(5)
    texture = cv2.GaussianBlur(rng.integers(0, 256, (90, 200, 3), dtype=np.uint8), (0, 0), 1.0)
    K, shift_px = ideal_K(160, 90), 20
    row = {
        "left_rgb": texture[:, :160],
        "right_rgb": texture[:, shift_px : shift_px + 160],
        "left_K": K,
        "right_K": K,
        "left_distortion": np.zeros(5),
        "right_distortion": np.zeros(5),
        "left_cam_from_world": LEFT_CAM_FROM_WORLD,
        "right_cam_from_world": right_camera_pose(LEFT_CAM_FROM_WORLD, 0.12),
        "baseline_m": 0.12,
    }
    depth_m = load_predictor("sgbm")(row)
    assert np.nanmedian(depth_m) == pytest.approx(K[0, 0] * 0.12 / shift_px, rel=5e-3)
