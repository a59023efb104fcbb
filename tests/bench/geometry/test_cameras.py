"""Tests of camera geometry: axes, ideal K, projection, lens distortion and their inverses."""

from __future__ import annotations

import pytest

pytest.importorskip("cv2")

import cv2
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rebar_depth_bench.geometry.cameras import (
    camera_centre,
    distort,
    fold_radius,
    ideal_K,
    inverse_rigid,
    look_at,
    pixel_rays,
    project,
    right_camera_pose,
    rotation_matrix,
    rotation_vector,
    transform,
    undistort,
)

COORDINATE = st.floats(-5.0, 5.0)
POINT = st.tuples(st.floats(0.3, 5.0), COORDINATE, COORDINATE).map(np.array)


def test_ideal_K_matches_contract() -> None:
    assert ideal_K(1280, 720).tolist() == [[700, 0, 639.5], [0, 700, 359.5], [0, 0, 1]]
    assert ideal_K(320, 90).tolist() == [[175, 0, 159.5], [0, 87.5, 44.5], [0, 0, 1]]


def test_axes_are_right_down_forward() -> None:
    pose = look_at(np.array([0.0, -2.0, 1.0]), np.array([0.0, 0.0, 1.0]))
    assert transform(pose, np.array([0.0, 0.0, 1.0])) == pytest.approx([0, 0, 2])
    assert transform(pose, np.array([1.0, 0.0, 1.0]))[0] == pytest.approx(1)  # world +x is to the right
    assert transform(pose, np.array([0.0, 0.0, 2.0]))[1] == pytest.approx(-1)  # world up is camera -y


@given(POINT)
def test_look_at_puts_the_target_on_the_optical_axis(eye: np.ndarray) -> None:
    target = np.array([0.1, 0.2, 0.05])
    pose = look_at(eye, target)
    assert transform(pose, target) == pytest.approx([0, 0, np.linalg.norm(target - eye)], abs=1e-9)
    assert camera_centre(pose) == pytest.approx(eye, abs=1e-9)
    assert pose[:3, :3] @ pose[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)


def test_look_at_along_up_raises_value_error() -> None:
    with pytest.raises(ValueError, match="parallel to the up direction"):
        look_at(np.array([0.0, 0.0, 1.0]), np.zeros(3))


@given(POINT)
def test_inverse_rigid_inverts_pose(eye: np.ndarray) -> None:
    pose = look_at(eye, np.zeros(3))
    assert inverse_rigid(pose) @ pose == pytest.approx(np.eye(4), abs=1e-12)


def test_project_inverts_pixel_rays_at_pixel_centres() -> None:
    K = np.array([[70.0, 0, 31.2], [0, 65.0, 17.7], [0, 0, 1]])
    rays = pixel_rays(K, 64, 36)
    v, u = np.mgrid[:36, :64]
    assert project(K, rays * 3.7) == pytest.approx(np.stack([u, v], axis=-1), abs=1e-9)
    assert (rays[..., 2] == 1).all()  # the ray's parameter is planar depth


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


def test_each_distortion_coefficient_by_hand() -> None:
    x, y = 0.5, -0.25
    r2 = x * x + y * y
    shift = [
        distort(np.array([x, y]), np.eye(5)[n]) - [x, y] for n in range(5)
    ]  # each of k1 k2 p1 p2 k3 alone, set to 1
    assert shift[0] == pytest.approx([x * r2, y * r2])
    assert shift[1] == pytest.approx([x * r2**2, y * r2**2])
    assert shift[2] == pytest.approx([2 * x * y, r2 + 2 * y * y])
    assert shift[3] == pytest.approx([r2 + 2 * x * x, 2 * x * y])
    assert shift[4] == pytest.approx([x * r2**3, y * r2**3])


@given(BOUNDED, BOUNDED, st.sampled_from(LENSES))
def test_undistort_inverts_distort(x: float, y: float, distortion: np.ndarray) -> None:
    point = np.array([x, y])
    assert undistort(distort(point, distortion), distortion) == pytest.approx(point, abs=1e-14)


def test_undistort_equals_opencv_where_it_converges() -> None:
    v, u = np.mgrid[0:720:37, 0:1280:41].astype(np.float64)
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-16)
    expected = cv2.undistortPointsIter(pixels, RAW_K, ZED, np.eye(3), np.eye(3), criteria)
    ours = undistort((pixels[:, 0] - RAW_K[:2, 2]) / [RAW_K[0, 0], RAW_K[1, 1]], ZED)
    assert ours == pytest.approx(expected[:, 0], abs=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("distortion", LENSES)
def test_distorted_rays_project_to_their_pixel_centres(distortion: np.ndarray) -> None:
    rays = pixel_rays(RAW_K, 1280, 720, distortion)[::45, ::64]
    v, u = np.mgrid[:720:45, :1280:64]
    assert project(RAW_K, rays * 0.7, distortion) == pytest.approx(np.stack([u, v], axis=-1), abs=1e-9)
    assert (rays[..., 2] == 1).all()


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
