"""Cameras, lens distortion, rectification of raw pairs, and closest points of segments."""

from __future__ import annotations

from typing import Any

import pytest

pytest.importorskip("cv2")

import cv2
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.geometry import rectification
from rebar_depth_bench.geometry.cameras import (
    camera_centre,
    distort,
    fold_radius,
    ideal_K,
    inverse_rigid,
    is_rectified,
    look_at,
    pixel_rays,
    project,
    right_camera_pose,
    rotation_matrix,
    rotation_vector,
    transform,
    undistort,
)
from rebar_depth_bench.geometry.segments import closest_points_m
from rebar_depth_bench.methods import find_method
from tests.bench.geometry.textured_plane import HEIGHT, WIDTH, ideal_row, raw_row
from tests.bench.methods.predictors import load_predictor

COORDINATE = st.floats(-5.0, 5.0)
POINT = st.tuples(st.floats(0.3, 5.0), COORDINATE, COORDINATE).map(np.array)


def test_ideal_K_matches_contract() -> None:
    assert ideal_K(1280, 720).tolist() == [[700, 0, 639.5], [0, 700, 359.5], [0, 0, 1]]
    assert ideal_K(320, 90).tolist() == [[175, 0, 159.5], [0, 175, 44.5], [0, 0, 1]]


def test_axes_are_right_down_forward() -> None:
    pose = look_at(np.array([0.0, -2.0, 1.0]), np.array([0.0, 0.0, 1.0]))
    assert transform(pose, np.array([0.0, 0.0, 1.0])) == pytest.approx([0, 0, 2])
    assert transform(pose, np.array([1.0, 0.0, 1.0]))[0] == pytest.approx(1)  # world +x is to the right
    assert transform(pose, np.array([0.0, 0.0, 2.0]))[1] == pytest.approx(-1)  # world up is camera -y


@given(POINT)
def test_look_at_is_a_rigid_pose_with_the_target_on_the_optical_axis(eye: np.ndarray) -> None:
    target = np.array([0.1, 0.2, 0.05])
    pose = look_at(eye, target)
    assert transform(pose, target) == pytest.approx([0, 0, np.linalg.norm(target - eye)], abs=1e-9)
    assert camera_centre(pose) == pytest.approx(eye, abs=1e-9)
    assert pose[:3, :3] @ pose[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    assert inverse_rigid(pose) @ pose == pytest.approx(np.eye(4), abs=1e-12)


def test_look_at_along_up_raises_value_error() -> None:
    with pytest.raises(ValueError, match="parallel to the up direction"):
        look_at(np.array([0.0, 0.0, 1.0]), np.zeros(3))


def test_right_camera_is_one_baseline_along_x() -> None:
    left = look_at(np.array([0.3, -0.2, 0.25]), np.array([0.0, 0.0, 0.05]))
    right = right_camera_pose(left, 0.12)
    shift = camera_centre(right) - camera_centre(left)
    assert shift == pytest.approx(0.12 * left[0, :3])
    assert np.array_equal(right[:3, :3], left[:3, :3])


ZED = np.array([-0.175286, 0.0283094, 6.68e-5, -1.50e-4, 1e-10])
STRONG = np.array([-0.28, 0.11, 0.004, -0.006, -0.015])
PINCUSHION = np.array([0.12, 0.03, -0.002, 0.001, 0.004])
LENSES = [ZED, STRONG, PINCUSHION]
RAW_K = np.array([[701.88, 0, 641.285], [0, 701.70, 344.1835], [0, 0, 1]])
BOUNDED = st.floats(-0.7, 0.7)


@given(BOUNDED, BOUNDED, st.sampled_from(LENSES))
def test_distortion_equals_opencv(x: float, y: float, distortion: np.ndarray) -> None:
    point = np.array([[x, y, 1.0]])
    expected, _ = cv2.projectPoints(point * 3.3, np.zeros(3), np.zeros(3), RAW_K, distortion)
    assert project(RAW_K, point * 3.3, distortion) == pytest.approx(expected[:, 0], abs=1e-9)


@given(BOUNDED, BOUNDED, st.sampled_from(LENSES))
def test_undistort_inverts_distort(x: float, y: float, distortion: np.ndarray) -> None:
    point = np.array([x, y])
    assert undistort(distort(point, distortion), distortion) == pytest.approx(point, abs=1e-14)


@pytest.mark.parametrize("distortion", [np.zeros(5), *LENSES])
def test_rays_project_to_their_pixel_centres(distortion: np.ndarray) -> None:
    K = RAW_K * [[0.25], [0.25], [1]]
    rays = pixel_rays(K, 320, 180, distortion)[::11, ::16]
    v, u = np.mgrid[:180:11, :320:16]
    np.testing.assert_allclose(project(K, rays * 0.7, distortion), np.stack([u, v], axis=-1), atol=1e-9)
    assert (rays[..., 2] == 1).all()  # The ray's parameter is planar depth.


def test_zero_distortion_equals_pinhole_bitwise() -> None:
    zeros = np.zeros(5)
    assert pixel_rays(RAW_K, 64, 36, zeros).tobytes() == pixel_rays(RAW_K, 64, 36).tobytes()
    points = np.random.default_rng(3).uniform(0.5, 2.0, (100, 3))
    assert project(RAW_K, points, zeros).tobytes() == project(RAW_K, points).tobytes()


@pytest.mark.parametrize(
    ("distortion", "point"),
    [
        ((-0.5, 0.0, 0.0, 0.0, 0.0), (0.6, 0.0)),  # r - 0.5 r^3 never exceeds 0.5443
        ((-0.5, 0.0, 0.0, 0.0, 0.0), (0.0, -0.545)),
        ((-0.5, 0.0, 0.0, 0.0, 0.0), (0.54434, 0.0)),
        ((-0.4, 0.16, 0.0, 0.0, -0.02), (3.0, 3.0)),  # Newton's method ends beyond the fold or diverges
        ((0.1, 0.0, 0.0, 0.0, 0.0), (np.nan, 0.0)),
    ],
)
def test_undistort_beyond_fold_raises_value_error(
    distortion: tuple[float, ...], point: tuple[float, float]
) -> None:
    points = np.array([(0.0, 0.0), point])
    with pytest.raises(
        ValueError, match=r"cannot be inverted at 1 of 2 points, first at \(x, y\) = .* folds back"
    ):
        undistort(points, np.array(distortion))


def test_fold_radius_by_hand() -> None:
    assert fold_radius(np.array([-0.5, 0, 0, 0, 0])) == pytest.approx((2 / 3) ** 0.5)
    assert fold_radius(ZED) == fold_radius(np.zeros(5)) == np.inf
    just_inside = np.array([0.99 * (2 / 3) ** 0.5, 0.0])
    distortion = np.array([-0.5, 0, 0, 0, 0])
    assert undistort(distort(just_inside, distortion), distortion) == pytest.approx(just_inside, abs=1e-13)


@given(st.tuples(BOUNDED, BOUNDED, BOUNDED).map(np.array))
def test_rotation_vector_equals_opencv_and_round_trips(vector: np.ndarray) -> None:
    matrix = rotation_matrix(vector)
    assert matrix == pytest.approx(cv2.Rodrigues(vector)[0], abs=1e-14)
    assert rotation_vector(matrix) == pytest.approx(vector, abs=1e-13)


@pytest.fixture(scope="module", name="raw_row")
def _raw_row() -> dict[str, Any]:
    return raw_row()


@pytest.fixture(scope="module")
def pair(raw_row: dict[str, Any]) -> rectification.RectifiedPair:
    return rectification.rectified_pair(raw_row)


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
    assert np.nanmedian(np.abs(ideal_error)) < 3e-3
    # The rectified optical axis differs from the raw one: uncorrected, depth would be off by 0.4 to 0.7 % at the
    # sides and corners.
    for region in (error, error[:, -60:], error[:60], error[-60:], error[:60, -60:], error[-60:, -60:]):
        assert abs(np.nanmedian(region) - np.nanmedian(ideal_error)) < 1e-3


def test_rectified_rows_of_texture_match(raw_row: dict[str, Any], pair: rectification.RectifiedPair) -> None:
    """Check that the rectified right image, shifted by the analytic disparity, equals the left one."""
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


def test_every_raw_pixel_maps_into_the_canvas(pair: rectification.RectifiedPair) -> None:
    canvas = np.array(pair.left_rgb.shape[1::-1])
    assert (pair.pixel >= 0).all()
    assert (pair.pixel < canvas).all()
    planar = rectification.raw_depth_m(pair, np.full(pair.left_rgb.shape[:2], 2.0, np.float32))
    np.testing.assert_allclose(planar, 2.0 * pair.depth_ratio, rtol=1e-6)
    assert np.isnan(rectification.raw_depth_m(pair, np.full(pair.left_rgb.shape[:2], np.nan, np.float32))).all()


def test_no_match_outside_raw_right_image(pair: rectification.RectifiedPair) -> None:
    nowhere = np.full(pair.left_rgb.shape[:2], 10_000.0, np.float32)
    assert not rectification.matched_in_right(pair, nowhere).any()
    assert np.array_equal(rectification.matched_in_right(pair, 0 * nowhere), pair.seen_by_right)
    assert 0.5 < pair.seen_by_right.mean() < 0.999


def test_is_rectified_detects_rotation_and_distortion(raw_row: dict[str, Any]) -> None:
    ideal = ideal_row()
    assert is_rectified(ideal)
    assert not is_rectified(raw_row)
    rotated = raw_row["right_cam_from_world"]
    assert not is_rectified(ideal | {"right_cam_from_world": rotated})
    assert not is_rectified(ideal | {"right_distortion": raw_row["right_distortion"]})


def grid_distance_m(a: np.ndarray, b: np.ndarray) -> float:
    shares = np.linspace(0, 1, 201)[:, None]
    on_a, on_b = (ends[0] + shares * (ends[1] - ends[0]) for ends in (a, b))
    return float(np.linalg.norm(on_a[:, None] - on_b[None], axis=2).min())


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["random", "parallel", "collinear", "crossing", "points", "point and segment"])
def test_distance_is_that_of_the_nearest_points(kind: str) -> None:
    random = np.random.default_rng(7)
    a, b = random.uniform(-1, 1, (2, 60, 2, 3))
    if kind == "parallel":
        b = a + random.uniform(-1, 1, (60, 1, 3))
    elif kind == "collinear":
        b = a + random.uniform(-3, 3, (60, 1, 1)) * (a[:, 1:] - a[:, :1])
    elif kind == "crossing":
        b = np.stack([2 * a.mean(axis=1) - b[:, 0], b[:, 0]], axis=1)
    elif kind == "points":
        a[:, 1], b[:, 1] = a[:, 0], b[:, 0]
    elif kind == "point and segment":
        a[:, 1] = a[:, 0]
    for first, second in ((a, b), (b, a)):
        on_first, on_second = closest_points_m(first[:, 0], first[:, 1], second[:, 0], second[:, 1])
        found_m = np.linalg.norm(on_first - on_second, axis=1)
        for index in range(60):
            grid_m = grid_distance_m(first[index], second[index])
            step_m = max(np.linalg.norm(ends[index, 1] - ends[index, 0]) for ends in (first, second)) / 200
            assert grid_m - step_m - 1e-12 <= found_m[index] <= grid_m + 1e-12
        for points, ends in ((on_first, first), (on_second, second)):
            detour_m = np.linalg.norm(points - ends[:, 0], axis=1) + np.linalg.norm(points - ends[:, 1], axis=1)
            np.testing.assert_allclose(detour_m, np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1), atol=1e-9)
