"""Markers that OpenCV finds in pictures against the cameras that are said to have taken them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dataset_builder.audit.markers import (
    FoundMarkers,
    corner_figures,
    found_markers,
    inset_directions,
    least_width_px,
    marker_verdict,
    projected_corners_px,
    view_markers,
)
from dataset_builder.audit.report import Check
from dataset_builder.audit.views import AuditedConfig, AuditedEye, AuditedView
from rebar_depth_bench.geometry.aruco_board import marker_corners_m
from tests.builder.audit.audit_scene import BOARD, RIGS, config, view, with_baseline, with_K_shift

GRID = pytest.mark.parametrize("rig", RIGS)


def verdict(*views: AuditedView, of: AuditedConfig | None = None) -> Check:
    audited = of or config()
    return marker_verdict(audited, [view_markers(audited, seen) for seen in views])


@GRID
def test_markers_of_good_pictures_are_where_the_cameras_say(rig: str) -> None:
    found = [found_markers(eye, BOARD) for eye in view(rig).eyes.values()]
    assert all(len(eye.found_px) == eye.expected >= 2 for eye in found)
    inset_px, rms_px, place_px = corner_figures(found)
    assert abs(inset_px) < 0.3  # no tone curve in these pictures
    assert rms_px < 0.3
    assert place_px < 0.15
    assert verdict(view(rig)).passed


@GRID
@pytest.mark.parametrize("axis", [0, 1])
def test_both_principal_points_half_a_pixel_off_are_noticed(rig: str, axis: int) -> None:
    check = verdict(with_K_shift(view(rig), ("left", "right"), axis, 0.5))
    assert any("found markers lie" in problem for problem in check.problems), check


@GRID
def test_one_principal_point_half_a_pixel_off_is_noticed(rig: str) -> None:
    assert not verdict(with_K_shift(view(rig), ("right",), 0, 0.5)).passed


def test_a_baseline_that_is_off_is_noticed() -> None:
    assert not verdict(with_baseline(view("ideal"), 0.002)).passed


def test_forgotten_distortion_is_noticed() -> None:
    seen = view("raw")
    left = replace(seen.left, camera=replace(seen.left.camera, distortion=np.zeros(5)))
    check = verdict(replace(seen, left=left))
    assert any("markers" in problem for problem in check.problems), check


def without_markers(eye: AuditedEye) -> AuditedEye:
    return replace(eye, rgb=np.full_like(eye.rgb, 128))


def test_markers_that_are_not_found_are_counted() -> None:
    seen = view("ideal")
    bare = AuditedView("x", without_markers(seen.left), without_markers(seen.right))
    check = verdict(bare)
    assert any(problem.startswith("0 of ") for problem in check.problems)
    assert verdict(bare, of=config(variants=("spotlight",))).passed  # hard light may hide them
    assert not verdict(bare, of=config(variants=("clutter",))).passed


def test_markers_behind_things_are_not_asked_for() -> None:
    eye = view("ideal").left
    asked = found_markers(eye, BOARD).expected
    hidden = found_markers(replace(eye, depth_m=eye.depth_m * np.float32(0.9)), BOARD)
    assert asked >= 2
    assert (hidden.expected, len(hidden.found_px)) == (0, 0)
    steel = found_markers(replace(eye, mask=np.ones_like(eye.mask)), BOARD)
    assert steel.expected == 0


def test_without_large_markers_or_a_board_nothing_is_asked() -> None:
    far = view("ideal", distance_m=1.6)
    assert verdict(far).found.startswith("none large enough")
    assert verdict(far, of=config(board=None)).found == "no board in this scene"


def test_an_inset_is_told_and_taken_off() -> None:
    square = np.array([[[0.0, 0.0], [40.0, 0.0], [40.0, 40.0], [0.0, 40.0]]])
    assert inset_directions(square)[0].tolist() == [[1, 1], [-1, 1], [-1, -1], [1, -1]]
    assert inset_directions(square[:, ::-1])[0].tolist() == [[1, -1], [-1, -1], [-1, 1], [1, 1]]
    found = square + 0.6 * inset_directions(square) + np.array([0.1, 0.0])
    figures = corner_figures([FoundMarkers(1, found, square, np.zeros((1, 4, 3)))])
    assert figures == pytest.approx((0.6, 0.1, 0.1))
    assert corner_figures([FoundMarkers(1, np.zeros((0, 4, 2)), np.zeros((0, 4, 2)), np.zeros((0, 4, 3)))]) == (
        0,
        0,
        0,
    )


def test_the_least_width_of_a_slanted_marker_is_its_height() -> None:
    slanted = np.array([[0.0, 0.0], [100.0, 0.0], [110.0, 20.0], [10.0, 20.0]])
    assert least_width_px(slanted) == pytest.approx(20.0)


def test_markers_behind_the_camera_are_no_number() -> None:
    camera = view("ideal").left.camera
    turned = replace(camera, cam_from_world=np.diag([1.0, -1.0, -1.0, 1.0]) @ camera.cam_from_world)
    assert all(np.isnan(quad).all() for quad in projected_corners_px(turned, marker_corners_m(BOARD)).values())
    assert found_markers(replace(view("ideal").left, camera=turned), BOARD).expected == 0
