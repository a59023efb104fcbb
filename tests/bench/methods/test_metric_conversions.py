"""Conversions from network output to metric depth, checked against camera geometry."""

from __future__ import annotations

import pytest

pytest.importorskip("cv2")

import cv2
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rebar_depth_bench.methods.paper.monocular import (
    Letterbox,
    Margins,
    crop_margins,
    da3_depth_m,
    da3_focal_px,
    fit_letterbox,
    margins_to_multiple,
    metric3d_depth_m,
    padded,
    positive_or_nan,
)
from rebar_depth_bench.methods.sgbm import MIN_PARALLAX_PX, disparity_to_depth_m

METRES = st.floats(0.1, 30)
FOCAL = st.floats(50, 3000)
SIDES = st.tuples(st.integers(1, 60), st.integers(1, 80))
LARGE_SIDES = st.tuples(st.integers(40, 2200), st.integers(40, 2200))


def make_K(fx: float, fy: float | None = None, cx: float = 0.0) -> np.ndarray:
    return np.array([[fx, 0, cx], [0, fy or fx, 0], [0, 0, 1.0]])


def test_letterbox_of_known_image_sizes() -> None:
    """1280 x 720 is fitted as in Metric3D's own script; the second image is limited by its height."""
    assert fit_letterbox((720, 1280), (616, 1064)) == Letterbox(0.83125, 598, 1064, Margins(9, 9, 0, 0))
    assert fit_letterbox((308, 300), (616, 1064)) == Letterbox(2.0, 616, 600, Margins(0, 0, 232, 232))
    assert fit_letterbox((90, 160), (616, 1064)) == Letterbox(6.65, 598, 1064, Margins(9, 9, 0, 0))


@given(LARGE_SIDES)
def test_letterbox_keeps_aspect_ratio(grid: tuple[int, int]) -> None:
    target = (616, 1064)
    fit = fit_letterbox(grid, target)
    margins = fit.margins
    assert (margins.top + fit.height_px + margins.bottom, margins.left + fit.width_px + margins.right) == target
    assert min(margins.top, margins.bottom, margins.left, margins.right) >= 0
    assert 0 <= margins.bottom - margins.top <= 1
    assert 0 <= margins.right - margins.left <= 1
    assert fit.height_px >= target[0] - 1 or fit.width_px >= target[1] - 1, "one side is filled"
    assert abs(fit.height_px - grid[0] * fit.scale) < 1
    assert abs(fit.width_px - grid[1] * fit.scale) < 1


@given(SIDES, st.integers(1, 40))
def test_margins_to_multiple_match_opencv(grid: tuple[int, int], step: int) -> None:
    margins = margins_to_multiple(grid, step)
    image = np.arange(grid[0] * grid[1] * 3).reshape(*grid, 3)
    extended = padded(image, margins)
    assert all(side % step == 0 and side - step < old for side, old in zip(extended.shape, grid, strict=False))
    assert np.array_equal(
        extended,
        cv2.copyMakeBorder(image, margins.top, margins.bottom, margins.left, margins.right, cv2.BORDER_REPLICATE),
    )
    assert np.array_equal(crop_margins(extended[..., 0], margins), image[..., 0])


@given(SIDES, st.tuples(*[st.integers(0, 9)] * 4))
def test_constant_margins_match_opencv(grid: tuple[int, int], sides: tuple[int, int, int, int]) -> None:
    image = np.full((*grid, 3), 7, np.uint8)
    extended = padded(image, Margins(*sides), (124, 116, 104))
    expected = cv2.copyMakeBorder(image, *sides, cv2.BORDER_CONSTANT, value=(124, 116, 104))
    assert np.array_equal(extended, expected)
    assert np.array_equal(crop_margins(extended[..., 0], Margins(*sides)), image[..., 0])


@given(FOCAL, st.floats(0.2, 8), METRES)
def test_metric3d_depth_follows_canonical_camera(fx: float, scale: float, size_m: float) -> None:
    """A wall patch is converted from the depth at which the canonical camera (1000 px) sees it equally large.

    A patch of ``size_m`` at depth z covers fx * scale * size / z pixels of the resized image; the canonical camera
    sees it with the same number of pixels at depth 1000 * size / pixels.
    """
    z_m = 2.5
    pixels = fx * scale * size_m / z_m
    canonical = np.full((2, 3), 1000 * size_m / pixels)
    np.testing.assert_allclose(metric3d_depth_m(canonical, make_K(fx, 7.0), scale), z_m, rtol=1e-6)


def test_metric3d_depth_is_capped_at_300_m_and_invalid_is_nan() -> None:
    values = np.array([[1e9, np.inf, 300, 0, -1, np.nan, -np.inf]])
    depth_m = metric3d_depth_m(values, make_K(1000.0), 1.0)
    np.testing.assert_array_equal(depth_m, np.array([[300, 300, 300, *[np.nan] * 4]], np.float32))


@given(FOCAL, LARGE_SIDES, METRES)
def test_da3_depth_uses_focal_length_of_resized_image(fx: float, grid: tuple[int, int], size_m: float) -> None:
    """The canonical focal length is 300 px; for unequal resizing the mean of both focal lengths is used."""
    z_m, fy, resized = 1.7, 0.9 * fx, (280, 504)
    columns = fx * size_m / z_m * resized[1] / grid[1]
    rows = fy * size_m / z_m * resized[0] / grid[0]
    values = np.full((2, 3), 300 * size_m / ((columns + rows) / 2))
    focal_px = da3_focal_px(make_K(fx, fy), grid, resized)
    np.testing.assert_allclose(da3_depth_m(values, focal_px), z_m, rtol=1e-6)


def test_da3_focal_length_of_benchmark_camera() -> None:
    """700 px at 1280 x 720, resized to 504 x 280: 275.625 px horizontally and 272.2 px vertically."""
    assert da3_focal_px(make_K(700.0), (720, 1280), (280, 504)) == pytest.approx((275.625 + 272.2222222) / 2)


def test_invalid_depth_is_nan() -> None:
    depth_m = positive_or_nan(np.array([[1e-50, 1e300, -0.0, 2.0]]))
    np.testing.assert_array_equal(depth_m, np.array([[np.nan, np.nan, np.nan, 2]], np.float32))
    assert depth_m.dtype == np.float32


@given(FOCAL, METRES, st.floats(0.02, 0.4), st.floats(-5, 5), st.floats(-5, 5))
def test_disparity_of_projected_point_gives_its_depth(
    fx: float, z_m: float, baseline_m: float, cx_left: float, cx_right: float
) -> None:
    """Project a point into both eyes and recover its depth from the difference of its columns."""
    left = np.array([fx * (x_m := 1.3) / z_m + cx_left])
    right = fx * (x_m - baseline_m) / z_m + cx_right
    disparity = np.full((1, 3000), left - right)
    depth_m = disparity_to_depth_m(disparity, make_K(fx, cx=cx_left), make_K(fx, cx=cx_right), baseline_m)
    columns = np.arange(3000)
    parallax = fx * baseline_m / z_m
    valid = (columns >= disparity[0]) & (disparity[0] > 0) & (parallax > MIN_PARALLAX_PX * (1 + 1e-9))
    np.testing.assert_allclose(depth_m[0, valid], z_m, rtol=1e-5)
    if abs(parallax - MIN_PARALLAX_PX) > 1e-6:
        assert np.isnan(depth_m[0, ~valid]).all()


def test_match_outside_right_image_is_nan() -> None:
    depth_m = disparity_to_depth_m(np.full((1, 6), 3.0, np.float32), make_K(10.0), make_K(10.0), 0.6)
    np.testing.assert_array_equal(depth_m, np.array([[np.nan] * 3 + [2.0] * 3], np.float32))
    invalid_disparity = np.array([[np.nan, -2, 0, np.inf, 0.5, 1e-9]], np.float32)
    assert np.isnan(disparity_to_depth_m(invalid_disparity, make_K(10.0), make_K(10.0), 0.6)).all()
