"""Metric scale from triangulated markers: exact corners, outliers, too few markers and error reports."""

from __future__ import annotations

import pytest

pytest.importorskip("cv2")

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.geometry.aruco_board import BoardSpec, marker_corners_m
from rebar_depth_bench.geometry.aruco_detection import Corners
from rebar_depth_bench.geometry.cameras import ideal_K, look_at, project, rigid, transform
from rebar_depth_bench.methods.multiview.pipeline import (
    Similarity,
    camera_errors,
    fit_board,
    triangulate,
)

K = ideal_K(1280, 720)
BOARD = BoardSpec()
TRUTH = {
    f"{k:04d}.png": look_at(
        np.array([0.5 * np.cos(turn), 0.5 * np.sin(turn), 0.3 + 0.02 * k]), np.array([0.0, 0.0, 0.05])
    )
    for k, turn in enumerate(np.radians(np.arange(0, 120, 15)))
}


def reconstruct_in_other_frame(
    unit_m: float, turn: tuple[float, float, float]
) -> tuple[dict[str, np.ndarray], Similarity]:
    """Return the true cameras in another frame and unit, and the similarity that maps them back to metres."""
    rotation = Rotation.from_rotvec(turn).as_matrix()
    other_from_metric = Similarity(1 / unit_m, rotation, np.array([3.0, -1.0, 2.0]))
    metric_from_other = Similarity(unit_m, rotation.T, -unit_m * rotation.T @ other_from_metric.translation)
    return {name: transform_pose(other_from_metric, pose) for name, pose in TRUTH.items()}, metric_from_other


def transform_pose(similarity: Similarity, pose: np.ndarray) -> np.ndarray:
    """Return the rigid pose of a camera moved by a similarity; its centre moves like a point."""
    rotation = pose[:3, :3] @ similarity.rotation.T
    centre = similarity.apply(-pose[:3, :3].T @ pose[:3, 3])
    return rigid(rotation, -rotation @ centre)


def project_corners() -> dict[str, Corners]:
    return {
        name: {marker: project(K, transform(pose, corners)) for marker, corners in marker_corners_m(BOARD).items()}
        for name, pose in TRUTH.items()
    }


@pytest.mark.slow
@settings(max_examples=30)
@given(st.floats(0.01, 50.0), st.tuples(*[st.floats(-3.0, 3.0)] * 3))
def test_exact_corners_give_exact_similarity(unit_m: float, turn: tuple[float, float, float]) -> None:
    poses, metric_from_other = reconstruct_in_other_frame(unit_m, turn)
    fit = fit_board(project_corners(), poses, K, BOARD)
    assert fit.metric.scale == pytest.approx(unit_m, rel=1e-8)
    assert fit.metric.translation == pytest.approx(metric_from_other.translation, abs=1e-6 * max(unit_m, 1))
    assert fit.markers == tuple(range(6))
    assert fit.rms_m < 1e-8
    report = camera_errors(poses, TRUTH, fit.metric.scale, fit.metric)
    assert abs(report["scale_error_percent"]) < 1e-4
    assert report["centre_error_mm"]["largest"] < 1e-3
    assert report["rotation_error_deg"]["largest"] < 1e-3


def test_reports_measure_scale_and_camera_errors() -> None:
    """A scale 2 % too large about the origin moves every centre by 2 % of its distance from the origin."""
    poses, _ = reconstruct_in_other_frame(0.07, (0.1, 0.2, 0.3))
    right = fit_board(project_corners(), poses, K, BOARD).metric
    wrong = Similarity(1.02 * right.scale, right.rotation, 1.02 * right.translation)
    report = camera_errors(poses, TRUTH, wrong.scale, wrong)
    distances_m = [np.linalg.norm(pose[:3, :3].T @ pose[:3, 3]) for pose in TRUTH.values()]
    assert report["scale_error_percent"] == pytest.approx(2.0, abs=1e-3)
    assert report["centre_error_mm"]["largest"] == pytest.approx(20 * max(distances_m), rel=1e-3)
    assert report["cameras_compared"] == "in the board's frame"
    aligned = camera_errors(poses, TRUTH, 1.02 * right.scale)
    assert aligned["scale_error_percent"] == pytest.approx(2.0, abs=1e-3)
    assert aligned["centre_error_mm"]["largest"] < 1e-3
    assert aligned["cameras_compared"] == "after the best similarity"


@pytest.mark.parametrize("off_px", [9.0, 200.0])
def test_outlier_corners_in_one_view_are_rejected(off_px: float) -> None:
    poses, _ = reconstruct_in_other_frame(0.07, (0.1, 0.2, 0.3))
    corners = project_corners()
    name = next(iter(corners))
    corners[name] = {marker: quad + np.array([off_px, -off_px]) for marker, quad in corners[name].items()}
    fit = fit_board(corners, poses, K, BOARD)
    assert fit.metric.scale == pytest.approx(0.07, rel=1e-6)


def test_views_registered_on_wrong_side_are_rejected() -> None:
    """Two of eight cameras are placed half a turn away, as COLMAP does on a symmetric lattice."""
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    flipped = dict(TRUTH)
    for name in list(TRUTH)[2:4]:
        flipped[name] = TRUTH[name] @ half_turn
    fit = fit_board(project_corners(), flipped, K, BOARD)
    assert fit.metric.scale == pytest.approx(1, rel=1e-6)
    assert fit.markers == tuple(range(6))


def test_triangulation_needs_translation_between_views() -> None:
    point = np.array([0.0, 0.0, 2.0])
    turning = [
        rigid(Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix(), np.zeros(3)) for angle in (-0.2, 0.0, 0.2)
    ]
    sliding = [rigid(np.eye(3), np.array([x, 0.0, 0.0])) for x in (-0.3, 0.0, 0.3)]
    pixels = [[project(K, transform(pose, point)) for pose in poses] for poses in (turning, sliding)]
    assert triangulate(pixels[0], turning, K) is None
    assert triangulate(pixels[1], sliding, K) == pytest.approx(point, abs=1e-9)


def test_triangulation_needs_enough_distinct_views() -> None:
    pose = look_at(np.array([0.5, 0.0, 0.3]), np.zeros(3))
    pixel = project(K, transform(pose, np.zeros(3)))
    assert triangulate([pixel] * 4, [pose] * 4, K) is None
    poses = list(TRUTH.values())
    assert (
        triangulate([project(K, transform(view_pose, np.zeros(3))) for view_pose in poses[:2]], poses[:2], K)
        is None
    )
    point = triangulate([project(K, transform(view_pose, np.zeros(3))) for view_pose in poses], poses, K)
    assert point == pytest.approx(np.zeros(3), abs=1e-9)


def test_too_few_markers_raise() -> None:
    poses, _ = reconstruct_in_other_frame(1.0, (0.0, 0.0, 0.0))
    corners = {name: {3: markers[3]} for name, markers in project_corners().items()}
    with pytest.raises(MethodError, match=r"1 of the board's 6 markers can be triangulated .*expected at least 2"):
        fit_board(corners, poses, K, BOARD)
