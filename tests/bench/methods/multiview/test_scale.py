"""Metres from triangulated markers: exact on exact corners, a wrong one left out, too few refused in words."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.geometry.aruco_board import BoardSpec, marker_corners_m
from rebar_depth_bench.geometry.aruco_detection import Corners
from rebar_depth_bench.geometry.cameras import ideal_K, look_at, project, rigid, transform
from rebar_depth_bench.methods.multiview.metric_scale import board_fit, triangulated
from rebar_depth_bench.methods.multiview.pose_errors import Similarity, placed_report, scaled_report

K = ideal_K(1280, 720)
BOARD = BoardSpec()
TRUTH = {
    f"{k:04d}.png": look_at(
        np.array([0.5 * np.cos(turn), 0.5 * np.sin(turn), 0.3 + 0.02 * k]), np.array([0.0, 0.0, 0.05])
    )
    for k, turn in enumerate(np.radians(np.arange(0, 120, 15)))
}


def reconstruction(unit_m: float, turn: tuple[float, float, float]) -> tuple[dict[str, np.ndarray], Similarity]:
    """The true cameras in another frame and unit, and the way back to metres."""
    rotation = Rotation.from_rotvec(turn).as_matrix()
    away = Similarity(1 / unit_m, rotation, np.array([3.0, -1.0, 2.0]))
    back = Similarity(unit_m, rotation.T, -unit_m * rotation.T @ away.translation)
    return {name: seen_from(away, pose) for name, pose in TRUTH.items()}, back


def seen_from(moved: Similarity, pose: np.ndarray) -> np.ndarray:
    """The rigid pose of a camera that a similarity has moved: its centre goes where a point goes."""
    rotation = pose[:3, :3] @ moved.rotation.T
    centre = moved.points(-pose[:3, :3].T @ pose[:3, 3])
    return rigid(rotation, -rotation @ centre)


def seen_corners() -> dict[str, Corners]:
    return {
        name: {marker: project(K, transform(pose, corners)) for marker, corners in marker_corners_m(BOARD).items()}
        for name, pose in TRUTH.items()
    }


@settings(max_examples=30)
@given(st.floats(0.01, 50.0), st.tuples(*[st.floats(-3.0, 3.0)] * 3))
def test_exact_corners_give_the_exact_scale_and_the_cameras_in_the_boards_frame(
    unit_m: float, turn: tuple[float, float, float]
) -> None:
    poses, back = reconstruction(unit_m, turn)
    fit = board_fit(seen_corners(), poses, K, BOARD)
    assert fit.metric.scale == pytest.approx(unit_m, rel=1e-8)
    assert fit.metric.translation == pytest.approx(back.translation, abs=1e-6 * max(unit_m, 1))
    assert fit.markers == tuple(range(6))
    assert fit.rms_m < 1e-8
    told = placed_report(poses, TRUTH, fit.metric)
    assert abs(told["scale_error_percent"]) < 1e-4
    assert told["centre_error_mm"]["largest"] < 1e-3
    assert told["rotation_error_deg"]["largest"] < 1e-3


def test_the_report_tells_a_scale_that_is_off_and_cameras_that_are() -> None:
    """With a scale 2 % too large about the origin every centre is off by 2 % of its distance from it."""
    poses, _ = reconstruction(0.07, (0.1, 0.2, 0.3))
    right = board_fit(seen_corners(), poses, K, BOARD).metric
    wrong = Similarity(1.02 * right.scale, right.rotation, 1.02 * right.translation)
    told = placed_report(poses, TRUTH, wrong)
    distances_m = [np.linalg.norm(pose[:3, :3].T @ pose[:3, 3]) for pose in TRUTH.values()]
    assert told["scale_error_percent"] == pytest.approx(2.0, abs=1e-3)
    assert told["centre_error_mm"]["largest"] == pytest.approx(20 * max(distances_m), rel=1e-3)
    assert told["cameras_compared"] == "in the board's frame"
    alone = scaled_report(poses, TRUTH, 1.02 * right.scale)
    assert alone["scale_error_percent"] == pytest.approx(2.0, abs=1e-3)
    assert alone["centre_error_mm"]["largest"] < 1e-3
    assert alone["cameras_compared"] == "after the best similarity"


@pytest.mark.parametrize("off_px", [9.0, 200.0])
def test_wrong_corners_in_one_view_are_left_out(off_px: float) -> None:
    poses, _ = reconstruction(0.07, (0.1, 0.2, 0.3))
    corners = seen_corners()
    name = next(iter(corners))
    corners[name] = {marker: quad + np.array([off_px, -off_px]) for marker, quad in corners[name].items()}
    fit = board_fit(corners, poses, K, BOARD)
    assert fit.metric.scale == pytest.approx(0.07, rel=1e-6)


def test_views_registered_on_the_wrong_side_take_no_part() -> None:
    """Two of eight cameras stand half a turn from where they are, as a symmetric lattice makes COLMAP put them."""
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    flipped = dict(TRUTH)
    for name in list(TRUTH)[2:4]:
        flipped[name] = TRUTH[name] @ half_turn
    fit = board_fit(seen_corners(), flipped, K, BOARD)
    assert fit.metric.scale == pytest.approx(1, rel=1e-6)
    assert fit.markers == tuple(range(6))


def test_a_camera_that_turns_on_one_spot_triangulates_nothing_and_one_on_a_slider_does() -> None:
    point = np.array([0.0, 0.0, 2.0])
    turning = [
        rigid(Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix(), np.zeros(3)) for angle in (-0.2, 0.0, 0.2)
    ]
    sliding = [rigid(np.eye(3), np.array([x, 0.0, 0.0])) for x in (-0.3, 0.0, 0.3)]
    seen = [[project(K, transform(pose, point)) for pose in poses] for poses in (turning, sliding)]
    assert triangulated(seen[0], turning, K) is None
    assert triangulated(seen[1], sliding, K) == pytest.approx(point, abs=1e-9)


def test_views_that_look_the_same_way_triangulate_nothing() -> None:
    pose = look_at(np.array([0.5, 0.0, 0.3]), np.zeros(3))
    pixel = project(K, transform(pose, np.zeros(3)))
    assert triangulated([pixel] * 4, [pose] * 4, K) is None
    poses = list(TRUTH.values())
    assert triangulated([project(K, transform(one, np.zeros(3))) for one in poses[:2]], poses[:2], K) is None
    found = triangulated([project(K, transform(one, np.zeros(3))) for one in poses], poses, K)
    assert found == pytest.approx(np.zeros(3), abs=1e-9)


def test_too_few_markers_are_refused_in_words() -> None:
    poses, _ = reconstruction(1.0, (0.0, 0.0, 0.0))
    corners = {name: {3: found[3]} for name, found in seen_corners().items()}
    with pytest.raises(MethodError, match=r"of the board's 6 markers 1 can be triangulated .*expected at least 2"):
        board_fit(corners, poses, K, BOARD)
