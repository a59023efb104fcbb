"""Stereo rigs: ideal pinholes, and the ZED on its raw and rectified grids, compared with OpenCV's maps."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.cameras.rigs import rig_cameras, zed_rig
from dataset_builder.cameras.trajectories import look_at_with_rig
from dataset_builder.scene.model import WorldMesh
from dataset_builder.scene.raycast import RayCaster
from dataset_builder.specs.config_specs import STEREO_CAMERAS, FocalRigSpec, RigSpec, focal_of_view_px
from rebar_depth_bench.captures.calibration import StereoCalibration, scale_calibration
from rebar_depth_bench.geometry.cameras import (
    Camera,
    camera_centre,
    ideal_K,
    inverse_rigid,
    look_at,
    pixel_rays,
    project,
    right_camera_pose,
    rigid,
    transform,
)
from rebar_depth_bench.geometry.rectification import rectify

POSE = look_at(np.array([0.20, -0.24, 0.15]), np.array([0.0, 0.0, 0.05]))
CAMERA_NAMES = ("left", "right")
SIZES = [(1280, 720), (640, 360), (160, 90)]


def calibration_of(rig: RigSpec) -> StereoCalibration:
    assert rig.calibration is not None
    return scale_calibration(rig.calibration, rig.width, rig.height)


def test_ideal_rig_is_two_parallel_pinholes() -> None:
    cameras = rig_cameras(RigSpec(320, 180), POSE)
    assert tuple(cameras) == CAMERA_NAMES
    for eye, pose in (("left", POSE), ("right", right_camera_pose(POSE, 0.12))):
        assert cameras[eye].K.tobytes() == ideal_K(320, 180).tobytes()
        assert cameras[eye].cam_from_world.tobytes() == pose.tobytes()
        assert cameras[eye].distortion.tolist() == [0.0] * 5


@pytest.mark.parametrize("grid", ["raw", "rectified"])
def test_resized_rig_equals_rig_created_at_that_size(grid: str) -> None:
    resized = rig_cameras(replace(zed_rig(1280, 720, grid), width=320, height=180), POSE)
    direct = rig_cameras(zed_rig(320, 180, grid), POSE)
    for eye in CAMERA_NAMES:
        assert resized[eye].K.tobytes() == direct[eye].K.tobytes()
        assert resized[eye].cam_from_world.tobytes() == direct[eye].cam_from_world.tobytes()


def test_raw_cameras_have_calibrated_lenses_and_poses() -> None:
    rig = zed_rig(1280, 720, "raw")
    assert (rig.width, rig.height, rig.grid, zed_rig().grid) == (1280, 720, "raw", "rectified")
    assert rig.baseline_m == pytest.approx(0.119978, abs=1e-12)
    left, right = rig_cameras(rig, POSE).values()
    assert left.cam_from_world.tobytes() == POSE.tobytes()
    assert left.K.tolist() == [[701.88, 0, 641.285], [0, 701.70, 344.1835], [0, 0, 1]]
    assert right.distortion.tolist() == [-0.172795, 0.0265223, 1.64e-4, 1.02e-5, 0.0]
    points = np.random.default_rng(1).uniform(-0.3, 0.3, (20, 3))
    rotation = cv2.Rodrigues(np.array([-9.17e-4, 6.24e-3, 7.70e-4]))[0]
    expected = transform(left.cam_from_world, points) @ rotation.T + [-0.119978, 0.0, 0.0]
    assert transform(right.cam_from_world, points) == pytest.approx(expected, abs=1e-14)


@pytest.mark.parametrize("grid", ["raw", "rectified"])
def test_raw_and_rectified_centres_are_equal(grid: str) -> None:
    rig = zed_rig(160, 90, grid)
    left, right = (camera_centre(camera.cam_from_world) for camera in rig_cameras(rig, POSE).values())
    raw_right = camera_centre(rig_cameras(replace(rig, grid="raw"), POSE)["right"].cam_from_world)
    assert left == pytest.approx(camera_centre(POSE), abs=1e-15)
    assert right == pytest.approx(raw_right, abs=1e-13)
    assert np.linalg.norm(right - left) == pytest.approx(rig.baseline_m, abs=1e-13)


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_rectified_cameras_are_parallel_pinholes(width: int, height: int) -> None:
    rig = zed_rig(width, height)
    left, right = rig_cameras(rig, POSE).values()
    assert left.K.tobytes() == right.K.tobytes()
    assert not left.distortion.any()
    assert not right.distortion.any()
    assert right.cam_from_world.tobytes() == right_camera_pose(left.cam_from_world, rig.baseline_m).tobytes()
    assert left.cam_from_world[:3, :3] @ left.cam_from_world[:3, :3].T == pytest.approx(np.eye(3), abs=1e-14)
    R_left, R_right = rectification_of(calibration_of(rig))[1]
    turned = R_right @ calibration_of(rig).right_from_left[:3, :3] @ POSE[:3, :3]
    assert right.cam_from_world[:3, :3] == pytest.approx(turned, abs=1e-12)  # R2 of stereoRectify
    # Planar depth of the raw and the rectified grid differ by a rotation of about 0.4 degrees.
    turn = left.cam_from_world @ inverse_rigid(POSE)
    assert turn == pytest.approx(rigid(R_left, np.zeros(3)), abs=1e-13)
    assert 0.1 < np.degrees(np.arccos((np.trace(turn[:3, :3]) - 1) / 2)) < 1.0


@pytest.mark.slow
@pytest.mark.parametrize(("width", "height"), SIZES)
@pytest.mark.parametrize("eye", CAMERA_NAMES)
def test_rectified_to_raw_projection_matches_opencv_map(width: int, height: int, eye: str) -> None:
    raw = rig_cameras(zed_rig(width, height, "raw"), POSE)[eye]
    rectified = rig_cameras(zed_rig(width, height), POSE)[eye]
    opencv_px = opencv_rectify_map(calibration_of(zed_rig(width, height)), eye)
    rays = pixel_rays(rectified.K, width, height)
    world = transform(inverse_rigid(rectified.cam_from_world), rays)
    projected_px = project(raw.K, transform(raw.cam_from_world, world), raw.distortion)
    assert np.abs(projected_px - opencv_px).max() < 1e-6 + 2e-7 * width  # The maps are float32.


def rectification_of(calibration: StereoCalibration) -> tuple[ndarray, tuple[ndarray, ndarray]]:
    """Return K of the rectified cameras and the rotations of both (``rectify``)."""
    lenses = (calibration.left, calibration.right)
    Ks, distortions = [lens.K for lens in lenses], [np.array(lens.distortion) for lens in lenses]
    return rectify(Ks, distortions, calibration.right_from_left, calibration.width, calibration.height)


def opencv_rectify_map(calibration: StereoCalibration, eye: str) -> Float64[ndarray, "h w 2"]:
    """Return the position of each rectified pixel in the raw image, computed by OpenCV."""
    (Kl, Dl), (Kr, Dr) = ((lens.K, np.array(lens.distortion)) for lens in (calibration.left, calibration.right))
    size = (calibration.width, calibration.height)
    rotation, offset = cv2.Rodrigues(np.array(calibration.rotation_rad))[0], np.array(calibration.translation_m)
    R1, R2, P1, P2, *_ = cv2.stereoRectify(
        Kl, Dl, Kr, Dr, size, rotation, offset, flags=cv2.CALIB_ZERO_DISPARITY, alpha=0
    )
    K, D, R, P = {"left": (Kl, Dl, R1, P1), "right": (Kr, Dr, R2, P2)}[eye]
    maps = cv2.initUndistortRectifyMap(K, D, R, P[:, :3], size, cv2.CV_32FC1)
    return np.asarray(np.stack(maps, axis=-1), dtype=np.float64)


@pytest.mark.parametrize(
    ("rig", "words"),
    [
        (replace(zed_rig(), grid="warped"), "is 'warped', expected 'raw' or 'rectified'"),
        (replace(zed_rig(), grid="ideal"), "is 'ideal', expected 'raw' or 'rectified'"),
        (RigSpec(grid="raw"), "grid 'raw' requires a calibration"),
        (replace(zed_rig(), baseline_m=0.12), "baseline_m is 0.12, expected 0.119978 as in its calibration"),
    ],
)
def test_inconsistent_rig_is_rejected(rig: RigSpec, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        rig_cameras(rig, POSE)


@pytest.mark.parametrize("grid", ["raw", "rectified"])
@pytest.mark.parametrize("eye", CAMERA_NAMES)
def test_depth_of_plane_matches_analytic_depth(grid: str, eye: str) -> None:
    camera = rig_cameras(zed_rig(160, 90, grid), POSE)[eye]
    square = np.array([[-9.0, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]])
    mesh = WorldMesh(square, np.array([[0, 1, 2], [0, 2, 3]], np.int32), np.ones(2, np.uint16))
    depth_m = RayCaster(mesh).cast(camera).depth_m
    R, centre_m = camera.cam_from_world[:3, :3], camera_centre(camera.cam_from_world)
    checked = 0
    for v, u in [(0, 0), (0, 159), (89, 0), (89, 159), (44, 80), (60, 3)]:
        x, y = opencv_ray(camera, u, v)
        expected_m = -centre_m[2] / (R.T @ [x, y, 1.0])[2]
        if 0 < expected_m < 5:
            assert depth_m[v, u] == pytest.approx(expected_m, rel=1e-6)
            checked += 1
    assert checked >= 4


def opencv_ray(camera: Camera, u: int, v: int) -> tuple[float, float]:
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-16)
    pixel = np.array([[[float(u), float(v)]]])
    x, y = cv2.undistortPointsIter(pixel, camera.K, camera.distortion, np.eye(3), np.eye(3), criteria)[0, 0]
    return float(x), float(y)


def test_rolled_rig_turns_about_its_line_of_sight() -> None:
    centre_m, target_m, baseline_m = np.array([2.0, 1.0, 1.5]), np.array([0.1, 0.2, 0.3]), 0.1
    upright = look_at_with_rig(centre_m, target_m, baseline_m)
    rolled = look_at_with_rig(centre_m, target_m, baseline_m, 90.0)
    for pose in (upright, rolled):
        np.testing.assert_allclose(camera_centre(pose), centre_m, atol=1e-12)
        seen_m = pose[:3, :3] @ target_m + pose[:3, 3]
        np.testing.assert_allclose(seen_m[:2], [baseline_m / 2, 0.0], atol=1e-12)
    # A camera turned clockwise by 90 degrees has its x axis where its y axis, downwards, was.
    np.testing.assert_allclose(rolled[0, :3] @ upright[1, :3], 1.0, atol=0.01)


@pytest.mark.parametrize("camera", STEREO_CAMERAS.values(), ids=STEREO_CAMERAS)
def test_rig_of_a_named_camera_has_its_focal_length(camera: FocalRigSpec) -> None:
    eyes = rig_cameras(camera, np.eye(4))
    assert eyes["left"].K[0, 0] == eyes["left"].K[1, 1] == camera.focal_px
    assert eyes["right"].cam_from_world[0, 3] == -camera.baseline_m
    half = ideal_K(640, 360, camera.focal_px)
    assert (half[0, 0], half[0, 2]) == (camera.focal_px / 2, 319.5)


def test_field_of_view_gives_the_focal_length() -> None:
    assert focal_of_view_px(90.0) == pytest.approx(640.0)
    assert focal_of_view_px(2 * np.degrees(np.arctan(320 / 882.5)), 640) == pytest.approx(882.5)
