"""From what networks put out to metres: against a camera's own geometry, not against the same formula again."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rebar_depth_bench.methods.monocular.conversions import (
    Fit,
    Margins,
    da3_depth_m,
    da3_focal_px,
    fit_keeping_ratio,
    margins_to_multiple,
    metric3d_depth_m,
    padded,
    positive_or_nan,
    without_margins,
)
from rebar_depth_bench.methods.stereo.disparity import MIN_PARALLAX_PX, disparity_to_depth_m

METRES = st.floats(0.1, 30)
FOCAL = st.floats(50, 3000)
SIDES = st.tuples(st.integers(1, 60), st.integers(1, 80))
LARGE_SIDES = st.tuples(st.integers(40, 2200), st.integers(40, 2200))


def K_of(fx: float, fy: float | None = None, cx: float = 0.0) -> np.ndarray:
    return np.array([[fx, 0, cx], [0, fy or fx, 0], [0, 0, 1.0]])


def test_metric3ds_fit_of_known_pictures() -> None:
    """1280 x 720 as Metric3D's own script would have it, and one that is bound by its height."""
    assert fit_keeping_ratio((720, 1280), (616, 1064)) == Fit(0.83125, 598, 1064, Margins(9, 9, 0, 0))
    assert fit_keeping_ratio((308, 300), (616, 1064)) == Fit(2.0, 616, 600, Margins(0, 0, 232, 232))
    assert fit_keeping_ratio((90, 160), (616, 1064)) == Fit(6.65, 598, 1064, Margins(9, 9, 0, 0))


@given(LARGE_SIDES)
def test_any_picture_fits_with_its_ratio_kept(grid: tuple[int, int]) -> None:
    target = (616, 1064)
    fit = fit_keeping_ratio(grid, target)
    m = fit.margins
    assert (m.top + fit.height_px + m.bottom, m.left + fit.width_px + m.right) == target
    assert min(m.top, m.bottom, m.left, m.right) >= 0
    assert 0 <= m.bottom - m.top <= 1
    assert 0 <= m.right - m.left <= 1
    assert fit.height_px >= target[0] - 1 or fit.width_px >= target[1] - 1, "one side is filled"
    assert abs(fit.height_px - grid[0] * fit.scale) < 1
    assert abs(fit.width_px - grid[1] * fit.scale) < 1


@given(SIDES, st.integers(1, 40))
def test_margins_to_a_multiple(grid: tuple[int, int], step: int) -> None:
    m = margins_to_multiple(grid, step)
    picture = np.arange(grid[0] * grid[1] * 3).reshape(*grid, 3)
    wide = padded(picture, m)
    assert all(side % step == 0 and side - step < old for side, old in zip(wide.shape, grid, strict=False))
    assert np.array_equal(
        wide, cv2.copyMakeBorder(picture, m.top, m.bottom, m.left, m.right, cv2.BORDER_REPLICATE)
    )
    assert np.array_equal(without_margins(wide[..., 0], m), picture[..., 0])


@given(SIDES, st.tuples(*[st.integers(0, 9)] * 4))
def test_margins_of_a_colour_are_those_of_opencv(grid: tuple[int, int], sides: tuple[int, int, int, int]) -> None:
    picture = np.full((*grid, 3), 7, np.uint8)
    found = padded(picture, Margins(*sides), (124, 116, 104))
    expected = cv2.copyMakeBorder(picture, *sides, cv2.BORDER_CONSTANT, value=(124, 116, 104))
    assert np.array_equal(found, expected)
    assert np.array_equal(without_margins(found[..., 0], Margins(*sides)), picture[..., 0])


@given(FOCAL, st.floats(0.2, 8), METRES)
def test_metric3ds_canonical_camera(fx: float, scale: float, size_m: float) -> None:
    """A piece of a wall, and the depth at which the canonical camera, 1000 px, sees it as large.

    A piece of ``size_m`` at depth z covers fx * scale * size / z pixels of the resized picture; the canonical
    camera sees as many of it at depth 1000 * size / pixels.
    """
    z_m = 2.5
    pixels = fx * scale * size_m / z_m
    canonical = np.full((2, 3), 1000 * size_m / pixels)
    np.testing.assert_allclose(metric3d_depth_m(canonical, K_of(fx, 7.0), scale), z_m, rtol=1e-6)


def test_metric3d_is_held_to_300_m_and_no_answer_is_nan() -> None:
    values = np.array([[1e9, np.inf, 300, 0, -1, np.nan, -np.inf]])
    found = metric3d_depth_m(values, K_of(1000.0), 1.0)
    np.testing.assert_array_equal(found, np.array([[300, 300, 300, *[np.nan] * 4]], np.float32))


@given(FOCAL, LARGE_SIDES, METRES)
def test_da3_sees_through_the_resized_camera(fx: float, grid: tuple[int, int], size_m: float) -> None:
    """As above with 300 px, on a picture squeezed differently along its sides: the mean of both is meant."""
    z_m, fy, seen = 1.7, 0.9 * fx, (280, 504)
    columns = fx * size_m / z_m * seen[1] / grid[1]
    rows = fy * size_m / z_m * seen[0] / grid[0]
    values = np.full((2, 3), 300 * size_m / ((columns + rows) / 2))
    focal_px = da3_focal_px(K_of(fx, fy), grid, seen)
    np.testing.assert_allclose(da3_depth_m(values, focal_px), z_m, rtol=1e-6)


def test_da3s_focal_length_of_the_benchmarks_camera() -> None:
    """700 px at 1280 x 720, seen at 504 x 280: 275.625 along, 272.2 down."""
    assert da3_focal_px(K_of(700.0), (720, 1280), (280, 504)) == pytest.approx((275.625 + 272.2222222) / 2)


def test_what_is_no_depth_is_nan() -> None:
    found = positive_or_nan(np.array([[1e-50, 1e300, -0.0, 2.0]]))
    np.testing.assert_array_equal(found, np.array([[np.nan, np.nan, np.nan, 2]], np.float32))
    assert found.dtype == np.float32


@given(FOCAL, METRES, st.floats(0.02, 0.4), st.floats(-5, 5), st.floats(-5, 5))
def test_a_point_seen_by_both_eyes_is_at_its_depth(
    fx: float, z_m: float, baseline_m: float, cx_left: float, cx_right: float
) -> None:
    """Project a point into both eyes, take the difference of its columns, and get its depth back."""
    left = np.array([fx * (x_m := 1.3) / z_m + cx_left])
    right = fx * (x_m - baseline_m) / z_m + cx_right
    disparity = np.full((1, 3000), left - right)
    found = disparity_to_depth_m(disparity, K_of(fx, cx=cx_left), K_of(fx, cx=cx_right), baseline_m)
    columns = np.arange(3000)
    parallax = fx * baseline_m / z_m
    told = (columns >= disparity[0]) & (disparity[0] > 0) & (parallax > MIN_PARALLAX_PX * (1 + 1e-9))
    np.testing.assert_allclose(found[0, told], z_m, rtol=1e-5)
    if abs(parallax - MIN_PARALLAX_PX) > 1e-6:
        assert np.isnan(found[0, ~told]).all()


def test_a_match_left_of_the_right_picture_is_none() -> None:
    found = disparity_to_depth_m(np.full((1, 6), 3.0, np.float32), K_of(10.0), K_of(10.0), 0.6)
    np.testing.assert_array_equal(found, np.array([[np.nan] * 3 + [2.0] * 3], np.float32))
    nothing = np.array([[np.nan, -2, 0, np.inf, 0.5, 1e-9]], np.float32)
    assert np.isnan(disparity_to_depth_m(nothing, K_of(10.0), K_of(10.0), 0.6)).all()
