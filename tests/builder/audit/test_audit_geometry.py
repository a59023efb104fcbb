"""Audit of depth against bar axes, the board and the other camera, on every grid."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dataset_builder.audit.camera_checks import MAX_PROJECTION_ERROR_PX, projection_error_px, projection_verdict
from dataset_builder.audit.checks import AuditedView
from dataset_builder.audit.geometry import (
    MAX_AXIS_RATIO,
    MAX_BOARD_ERROR_M,
    axis_verdict,
    bend_sagitta_m,
    board_error,
    board_verdict,
    max_axis_distance_ratio,
    polyline_distance_m,
)
from dataset_builder.audit.independent_depth import (
    MAX_CONTRADICTED_SHARE,
    EpipolarCounts,
    cycles_difference_m,
    cycles_verdict,
    epipolar_counts,
    epipolar_verdict,
    project_into,
)
from dataset_builder.scene.model import ESTIMATED_ROLE
from dataset_builder.scene.shapes.bending import bent_line_m
from tests.builder.audit.audit_scene import RIGS, config, scene, view, with_depth

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("rig", RIGS)
def test_correct_depth_passes_and_wrong_depth_fails_on_every_grid(rig: str) -> None:
    audited = view(rig)
    assert 0.98 < max_axis_distance_ratio(config(), audited) < 1.02  # plain bars
    error = board_error(config(), audited)
    assert error.pixels > 100_000
    assert error.off_m < MAX_BOARD_ERROR_M
    counts = epipolar_counts(config(), audited)
    assert counts.contradicted == 0
    assert counts.seen > 2000
    assert max(projection_error_px(eye) for eye in audited.eyes.values()) < MAX_PROJECTION_ERROR_PX

    larger = with_depth(audited, 1.01)
    assert not axis_verdict(config(), [max_axis_distance_ratio(config(), larger)]).passed
    assert not board_verdict(config(), [board_error(config(), larger)]).passed
    too_near = replace(audited, left=replace(audited.left, depth_m=audited.left.depth_m * np.float32(0.7)))
    contradicted = epipolar_counts(config(), too_near)
    assert contradicted.contradicted > 0.2 * counts.seen
    assert not epipolar_verdict(config(), [contradicted]).passed


def test_distortion_inconsistent_with_rays_is_reported() -> None:
    eye = view("raw").left
    bent = eye.camera.distortion + np.array([1e-7, 0, 0, 0, 0])
    other = replace(eye, camera=replace(eye.camera, distortion=bent))
    error_px = projection_error_px(other)
    assert MAX_PROJECTION_ERROR_PX < error_px < 1e-3
    check = projection_verdict(config(), [0.0, error_px])
    assert "px away from the pixel" in check.problems[0]
    assert not projection_verdict(config(), [float("nan")]).passed


def test_undistorted_depth_on_raw_grid_is_reported() -> None:
    """Audit a raw view that has the depth of an ideal camera with the same K."""
    eye = view("raw").left
    ideal = scene().caster.cast(replace(eye.camera, distortion=np.zeros(5)))
    wrong = replace(eye, depth_m=ideal.depth_m, mask=ideal.mask, bars=ideal.bars)
    assert board_error(config(), replace(view("raw"), left=wrong)).off_m > 1e-3


def test_board_check_is_skipped_without_board() -> None:
    without_board = config(board=None)
    check = board_verdict(without_board, [board_error(without_board, view("ideal"))])
    assert (check.skipped, check.measured) == (True, "no board in this scene")


def with_occluder(height_m: float, share: float) -> AuditedView:
    """Return a view with a flat occluder ``height_m`` above the board in a share of the rows of both images."""
    eyes = []
    for eye in view("ideal").eyes.values():
        rows = np.zeros(eye.mask.shape, dtype=bool)
        rows[: int(share * len(rows))] = True
        centre_m = np.linalg.inv(eye.camera.cam_from_world)[2, 3]
        occluder_m = eye.depth_m * np.float32((centre_m - height_m) / centre_m)
        eyes.append(replace(eye, depth_m=np.where(rows & ~eye.mask, occluder_m, eye.depth_m)))
    return AuditedView("scene/0000", *eyes)


def test_props_may_occlude_board_but_not_lie_below_it() -> None:
    cluttered = config(variants=("clutter",))

    def passed(audited: AuditedView, of: str = "things") -> bool:
        audited_config = cluttered if of == "things" else config(variants=("dusk",))
        return board_verdict(audited_config, [board_error(audited_config, audited)]).passed

    assert passed(with_occluder(0.02, 0.3))
    assert not passed(with_occluder(0.02, 0.3), of="light alone")
    assert not passed(with_occluder(-0.02, 0.3))
    assert not passed(with_occluder(5e-5, 0.3))
    assert not passed(with_occluder(0.02, 0.95))


def test_only_known_axes_are_checked() -> None:
    with_known_axes = config()
    known_bars, estimated_bar = with_known_axes.steel[:1], replace(with_known_axes.steel[1], role=ESTIMATED_ROLE)
    assert replace(with_known_axes, steel=(*known_bars, estimated_bar)).bars_with_known_axis == known_bars
    assert axis_verdict(replace(with_known_axes, steel=(estimated_bar,)), [7.0]).skipped
    assert not axis_verdict(with_known_axes, [MAX_AXIS_RATIO + 0.01]).passed


def test_epipolar_share_is_over_all_views() -> None:
    good = EpipolarCounts(seen=100_000, hidden=50)
    assert epipolar_verdict(config(), [good, EpipolarCounts(contradicted=1)]).passed
    few = int(2 * MAX_CONTRADICTED_SHARE * 100_000)
    assert not epipolar_verdict(config(), [good, EpipolarCounts(contradicted=few)]).passed
    assert epipolar_verdict(config(), []).skipped


def test_cycles_differences_are_relative_to_depth() -> None:
    depth_m = np.full(10_000, 8.0)
    noise_m = np.full(10_000, 3e-6 * 8.0)
    assert cycles_verdict(np.stack([noise_m, depth_m], axis=1), 2).passed
    assert not cycles_verdict(np.stack([noise_m, depth_m / 8], axis=1), 2).passed
    noise_m[:20] = 0.009  # 20 pixels on another surface
    assert not cycles_verdict(np.stack([noise_m, depth_m], axis=1), 2).passed
    noise_m[:20] = 0.007
    assert cycles_verdict(np.stack([noise_m, depth_m], axis=1), 2).passed
    assert not cycles_verdict(np.full((5, 2), np.nan), 2).passed
    assert cycles_verdict(cycles_difference_m(Path("none.ply"), [], print), 0).skipped
    assert cycles_verdict(np.zeros((0, 2)), 2).measured == "2 views: no steel"


def test_points_beyond_lens_model_are_not_in_frame() -> None:
    """Project with strong barrel distortion, which folds far rays back into the image."""
    eye = view("raw").left
    folding = replace(eye, camera=replace(eye.camera, distortion=np.array([-0.4, 0.0, 0.0, 0.0, 0.0])))
    slope = np.linspace(0.0, 3.0, 200)
    points_cam = np.stack([slope, np.zeros(200), np.ones(200)], axis=1)
    world_from_cam = np.linalg.inv(eye.camera.cam_from_world)
    projected = project_into(folding, points_cam @ world_from_cam[:3, :3].T + world_from_cam[:3, 3], 1)
    in_frame = (projected.px[:, 0] > 2) & (projected.px[:, 0] < eye.camera.width - 3)
    assert in_frame[slope > 1.2].any()
    assert not projected.inside[slope > 1.0].any()
    behind = project_into(
        eye, (np.array([[0.0, 0.0, -1.0]]) @ world_from_cam[:3, :3].T) + world_from_cam[:3, 3], 1
    )
    assert not behind.inside.any()


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.integers(2, 9), st.sampled_from([0.1, 5.0]))
def test_polyline_distance_is_that_of_nearest_segment(seed: int, corners: int, size_m: float) -> None:
    rng = np.random.default_rng(seed)
    axis_m, points_m = rng.uniform(-size_m, size_m, (corners, 3)), rng.uniform(-size_m, size_m, (40, 3))
    fractions = np.linspace(0, 1, 4001)[:, None]
    dense = np.concatenate([a + fractions * (b - a) for a, b in pairwise(axis_m)])
    sampled_distances_m = np.linalg.norm(points_m[:, None] - dense, axis=2).min(axis=1)
    distances_m = polyline_distance_m(points_m, axis_m)
    assert (distances_m <= sampled_distances_m + 1e-9).all()
    assert distances_m == pytest.approx(sampled_distances_m, abs=size_m / 500)


def test_distance_close_to_long_axis_is_precise() -> None:
    axis_m = np.array([[-2.4, -2.4, 6.6], [2.4, -2.4, 6.6], [2.4, 2.4, 6.6]])
    distances_m = polyline_distance_m(np.array([[1.3, -2.392, 6.6]]), axis_m)
    assert distances_m == pytest.approx([0.008], rel=1e-9)


@pytest.mark.parametrize("step_deg", [3.0, 6.0])
def test_bend_sagitta_matches_arc(step_deg: float) -> None:
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0]])
    line_m = bent_line_m(corners, 0.1, step_deg)
    assert bend_sagitta_m(line_m) == pytest.approx(0.1 * (1 - np.cos(np.deg2rad(step_deg / 2))), rel=0.02)
    assert bend_sagitta_m(corners) == 0.0  # a sharp corner without arc
    assert bend_sagitta_m(corners[:2]) == 0.0
