"""Semi-global matching: left-right consistency, and disparity to depth, checked against camera geometry."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rebar_depth_bench.methods.sgbm import (
    MAX_LEFT_RIGHT_DIFFERENCE_PX,
    MIN_PARALLAX_PX,
    disparity_to_depth_m,
    left_right_consistent,
    without_invisible,
)
from tests.bench.methods.predictors import load_predictor

METRES = st.floats(0.1, 30)
FOCAL = st.floats(50, 3000)


def test_left_right_check_on_known_row() -> None:
    left = np.array([[0, 1, 2, 2, 3, 9, 2, -1]], np.float32)
    right = np.array([[2, 5, 2, 0, 2, 7, 0, 0]], np.float32)
    # Left column -> right column (left disparity, right disparity): 1 -> 0 (1, 2), 2 -> 0 (2, 2), 3 -> 1 (2, 5),
    # 4 -> 1 (3, 5), 5 -> outside the image, 6 -> 4 (2, 2). Columns 0 and 7 have no disparity.
    assert left_right_consistent(left, right).tolist() == [[False, True, True, False, True, False, True, False]]


@given(st.integers(1, 30), st.integers(0, 2**32 - 1))
def test_consistent_plane_is_confirmed_where_both_see_it(disparity: int, seed: int) -> None:
    half_px = MAX_LEFT_RIGHT_DIFFERENCE_PX / 2
    noise = np.random.default_rng(seed).uniform(-half_px, half_px, (2, 4, 64))
    left, right = (disparity + 1.5 + noise).astype(np.float32)
    consistent = left_right_consistent(left, right)
    assert consistent[:, disparity + 3 :].all()
    assert not consistent[:, : max(disparity - 1, 0)].any()
    assert not left_right_consistent(left, right + np.float32(3 * MAX_LEFT_RIGHT_DIFFERENCE_PX)).any()


@pytest.mark.parametrize("where", ["bar", "none"])
def test_pixels_seen_by_one_eye_have_no_depth(where: str) -> None:
    """A textured bar stands in front of a textured wall; beside its edge the wall is hidden from the right eye."""
    pytest.importorskip("cv2")
    rng = np.random.default_rng(1)
    wall, bar = (rng.integers(0, 255, (60, 240, 3), np.uint8) for _ in range(2))
    left, right = wall[:, :200].copy(), wall[:, 8:208].copy()  # The wall has 8 px of disparity.
    if where == "bar":
        left[:, 100:120], right[:, 70:90] = bar[:, :20], bar[:, :20]  # The bar has 30 px.
    K = np.array([[700.0, 0, 99.5], [0, 700.0, 29.5], [0, 0, 1.0]])
    right_cam_from_world = np.eye(4)
    right_cam_from_world[0, 3] = -0.12
    row = {
        "left_rgb": left,
        "right_rgb": right,
        **dict.fromkeys(("left_K", "right_K"), K),
        **dict.fromkeys(("left_distortion", "right_distortion"), np.zeros(5)),
        "left_cam_from_world": np.eye(4),
        "right_cam_from_world": right_cam_from_world,
        "baseline_m": 0.12,
    }
    checked, filled = (load_predictor(name)(row) for name in ("sgbm", "sgbm-filled"))
    truth_m = np.full((60, 200), 700 * 0.12 / 8)
    if where == "bar":
        truth_m[:, 100:120] = 700 * 0.12 / 30
    known = np.isfinite(checked[:, 40:])
    abs_rel = np.abs(checked[:, 40:] - truth_m[:, 40:])[known] / truth_m[:, 40:][known]
    assert np.array_equal(checked[np.isfinite(checked)], filled[np.isfinite(checked)])
    assert np.mean(known) > 0.6
    assert np.mean(abs_rel > 0.1) < 0.01
    if where == "bar":
        hidden = np.isfinite(checked[:, 80:97])  # 22 px are hidden from the right eye.
        assert hidden.mean() < 0.2
        assert np.isfinite(filled).sum() > np.isfinite(checked).sum()


def make_K(fx: float, cx: float = 0.0) -> np.ndarray:
    return np.array([[fx, 0, cx], [0, fx, 0], [0, 0, 1.0]])


@given(FOCAL, METRES, st.floats(0.02, 0.4), st.floats(-5, 5), st.floats(-5, 5))
def test_disparity_of_projected_point_gives_its_depth(
    fx: float, z_m: float, baseline_m: float, cx_left: float, cx_right: float
) -> None:
    """Project a point into both eyes and recover its depth from the difference of its columns."""
    left = np.array([fx * (x_m := 1.3) / z_m + cx_left])
    right = fx * (x_m - baseline_m) / z_m + cx_right
    disparity = np.full((1, 3000), left - right)
    visible_px = without_invisible(disparity)
    depth_m = disparity_to_depth_m(visible_px, make_K(fx, cx=cx_left), make_K(fx, cx=cx_right), baseline_m)
    columns = np.arange(3000)
    parallax = fx * baseline_m / z_m
    valid = (columns >= disparity[0]) & (disparity[0] > 0) & (parallax > MIN_PARALLAX_PX * (1 + 1e-9))
    np.testing.assert_allclose(depth_m[0, valid], z_m, rtol=1e-5)
    if abs(parallax - MIN_PARALLAX_PX) > 1e-6:
        assert np.isnan(depth_m[0, ~valid]).all()


def test_match_outside_right_image_is_nan() -> None:
    visible_px = without_invisible(np.full((1, 6), 3.0, np.float32))
    depth_m = disparity_to_depth_m(visible_px, make_K(10.0), make_K(10.0), 0.6)
    np.testing.assert_array_equal(depth_m, np.array([[np.nan] * 3 + [2.0] * 3], np.float32))
    invalid_px = without_invisible(np.array([[np.nan, -2, 0, np.inf, 0.5, 1e-9]], np.float32))
    assert np.isnan(disparity_to_depth_m(invalid_px, make_K(10.0), make_K(10.0), 0.6)).all()
