"""Marker check on synthetic pictures: sound ones pass, and small errors of the cameras are reported."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dataset_builder.audit.checks import AuditedConfig, AuditedEye, AuditedView, Check
from rebar_depth_bench.geometry.aruco_board import marker_corners_m
from tests.builder.audit.audit_scene import BOARD, RIGS, config, view, with_baseline, with_K_shift
from tests.builder.blender.markers import (
    DetectedMarkers,
    detect_markers,
    detect_view_markers,
    fit_inset,
    inset_directions,
    marker_verdict,
    min_width_px,
    projected_corners_px,
)

pytestmark = pytest.mark.nightly

EVERY_GRID = pytest.mark.parametrize("rig", RIGS)


def verdict(*views: AuditedView, of: AuditedConfig | None = None) -> Check:
    audited = of or config()
    return marker_verdict(audited, [detect_view_markers(audited, audited_view) for audited_view in views])


@EVERY_GRID
def test_detected_markers_match_projections(rig: str) -> None:
    detections = [detect_markers(eye, BOARD) for eye in view(rig).eyes.values()]
    assert all(len(eye.detected_px) == eye.expected >= 2 for eye in detections)
    inset_px, corner_rms_px, centre_rms_px = fit_inset(detections)
    assert abs(inset_px) < 0.3  # These images have no tone curve.
    assert corner_rms_px < 0.3
    assert centre_rms_px < 0.15
    assert verdict(view(rig)).passed


@EVERY_GRID
@pytest.mark.parametrize("axis", [0, 1])
def test_half_pixel_shift_of_both_K_is_reported(rig: str, axis: int) -> None:
    check = verdict(with_K_shift(view(rig), ("left", "right"), axis, 0.5))
    assert any("detected markers are" in problem for problem in check.problems), check


@EVERY_GRID
def test_half_pixel_shift_of_right_K_is_reported(rig: str) -> None:
    assert not verdict(with_K_shift(view(rig), ("right",), 0, 0.5)).passed


def test_baseline_error_of_2_mm_is_reported() -> None:
    assert not verdict(with_baseline(view("ideal"), 0.002)).passed


def test_missing_distortion_is_reported() -> None:
    original = view("raw")
    left = replace(original.left, camera=replace(original.left.camera, distortion=np.zeros(5)))
    check = verdict(replace(original, left=left))
    assert any("markers" in problem for problem in check.problems), check


def without_markers(eye: AuditedEye) -> AuditedEye:
    return replace(eye, rgb=np.full_like(eye.rgb, 128))


def test_undetected_markers_are_reported() -> None:
    original = view("ideal")
    blank_view = AuditedView("x", without_markers(original.left), without_markers(original.right))
    check = verdict(blank_view)
    assert any(problem.startswith("0 of ") for problem in check.problems)
    assert verdict(
        blank_view, of=config(variants=("spotlight",))
    ).passed  # Hard light may make markers undetectable.
    assert not verdict(blank_view, of=config(variants=("clutter",))).passed
    assert not verdict(blank_view, of=config(variants=("night", "sensor"))).passed, (
        "exposed like the standard light"
    )


def with_slipped_corners(eyes: list[DetectedMarkers], markers: int) -> list[DetectedMarkers]:
    """Move one corner of the first ``markers`` detected markers by 3.5 pixels."""
    slipped = []
    for eye in eyes:
        detected_px = eye.detected_px.copy()
        detected_px[:markers, 0, 0] += 3.5
        markers -= min(markers, len(detected_px))
        slipped.append(replace(eye, detected_px=detected_px))
    return slipped


def test_only_a_single_slipped_corner_is_left_out() -> None:
    eyes = detect_view_markers(config(), view("ideal"))
    check = marker_verdict(config(), [with_slipped_corners(eyes, 1)])
    assert check.passed, check
    assert "1 with a slipped corner left out" in check.measured
    detected = sum(len(eye.detected_px) for eye in eyes)
    for count in (2, detected):
        problems = marker_verdict(config(), [with_slipped_corners(eyes, count)]).problems
        assert any(problem.startswith(f"{count} of {detected} markers have a corner") for problem in problems)


def test_half_pixel_shift_of_K_is_reported_with_sensor() -> None:
    shifted = with_K_shift(view("ideal"), ("left", "right"), 0, 0.5)
    check = verdict(shifted, of=config(variants=("sensor",)))
    assert any("detected markers are" in problem for problem in check.problems), check


def test_occluded_markers_are_not_expected() -> None:
    eye = view("ideal").left
    num_expected = detect_markers(eye, BOARD).expected
    hidden = detect_markers(replace(eye, depth_m=eye.depth_m * np.float32(0.9)), BOARD)
    assert num_expected >= 2
    assert (hidden.expected, len(hidden.detected_px)) == (0, 0)
    steel = detect_markers(replace(eye, mask=np.ones_like(eye.mask)), BOARD)
    assert steel.expected == 0


def test_check_is_skipped_without_large_markers_or_board() -> None:
    far = view("ideal", distance_m=1.6)
    assert verdict(far).measured.startswith("no unoccluded marker")
    assert verdict(far, of=config(board=None)).measured == "no board in this scene"


def test_inset_is_estimated_and_removed() -> None:
    camera = view("ideal").left.camera
    square = np.array([[[0.0, 0.0], [40.0, 0.0], [40.0, 40.0], [0.0, 40.0]]])
    assert inset_directions(square)[0].tolist() == [[1, 1], [-1, 1], [-1, -1], [1, -1]]
    assert inset_directions(square[:, ::-1])[0].tolist() == [[1, -1], [-1, -1], [-1, 1], [1, 1]]
    detected_px = square + 0.6 * inset_directions(square) + np.array([0.1, 0.0])
    inset_and_residuals = fit_inset([DetectedMarkers(camera, 1, detected_px, square, np.zeros((1, 4, 3)))])
    assert inset_and_residuals == pytest.approx((0.6, 0.1, 0.1))
    none = DetectedMarkers(camera, 1, np.zeros((0, 4, 2)), np.zeros((0, 4, 2)), np.zeros((0, 4, 3)))
    assert fit_inset([none]) == (0, 0, 0)


def test_minimum_width_of_slanted_marker_is_its_height() -> None:
    slanted = np.array([[0.0, 0.0], [100.0, 0.0], [110.0, 20.0], [10.0, 20.0]])
    assert min_width_px(slanted) == pytest.approx(20.0)


def test_markers_behind_camera_project_to_nan() -> None:
    camera = view("ideal").left.camera
    turned = replace(camera, cam_from_world=np.diag([1.0, -1.0, -1.0, 1.0]) @ camera.cam_from_world)
    assert all(np.isnan(quad).all() for quad in projected_corners_px(turned, marker_corners_m(BOARD)).values())
    assert detect_markers(replace(view("ideal").left, camera=turned), BOARD).expected == 0
