"""Depth against axes, board and the other eye: right on every grid, wrong where anything is off."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dataset_builder.audit.cameras import MAX_PROJECTION_ERROR_PX, projection_error_px, projection_verdict
from dataset_builder.audit.cycles_depth import cycles_difference_m, cycles_verdict
from dataset_builder.audit.geometry import (
    MAX_AXIS_RATIO,
    MAX_BOARD_ERROR_M,
    axis_verdict,
    bend_sagitta_m,
    board_error,
    board_verdict,
    largest_axis_excess,
    largest_board_error,
    polyline_distance_m,
)
from dataset_builder.audit.stereo_consistency import (
    MAX_CONTRADICTED_SHARE,
    EpipolarCounts,
    epipolar_counts,
    epipolar_verdict,
    landed_in,
)
from dataset_builder.audit.views import AuditedView
from dataset_builder.scene.model import ESTIMATED
from dataset_builder.scene.shapes.bending import bent_line_m
from rebar_depth_bench.geometry.cameras import pixel_rays
from tests.builder.audit.audit_scene import BOARD, RIGS, config, scene, view, with_depth

GRID = pytest.mark.parametrize("rig", RIGS)


@GRID
def test_good_depth_passes_on_every_grid(rig: str) -> None:
    seen = view(rig)
    assert 0.98 < largest_axis_excess(config(), seen) < 1.02  # plain bars
    error = largest_board_error(config(), seen)
    assert error.pixels > 100_000
    assert error.off_m < MAX_BOARD_ERROR_M
    counts = epipolar_counts(seen, scene().steel)
    assert counts.contradicted == 0
    assert counts.seen > 2000
    assert max(projection_error_px(eye) for eye in seen.eyes.values()) < MAX_PROJECTION_ERROR_PX


@GRID
def test_depth_off_by_little_leaves_the_board_and_the_axes(rig: str) -> None:
    off = with_depth(view(rig), 1.01)
    assert not axis_verdict(config(), [largest_axis_excess(config(), off)]).passed
    assert not board_verdict(config(), [largest_board_error(config(), off)]).passed


@GRID
def test_wrong_depth_contradicts_the_other_eye(rig: str) -> None:
    good = view(rig)
    nearer = replace(good, left=replace(good.left, depth_m=good.left.depth_m * np.float32(0.7)))
    counts = epipolar_counts(nearer, scene().steel)
    assert counts.contradicted > 0.2 * epipolar_counts(good, scene().steel).seen
    assert not epipolar_verdict(config(), [counts]).passed


def test_distortion_that_is_not_the_rays_is_noticed() -> None:
    eye = view("raw").left
    bent = eye.camera.distortion + np.array([1e-7, 0, 0, 0, 0])
    other = replace(eye, camera=replace(eye.camera, distortion=bent))
    error_px = projection_error_px(other)
    assert MAX_PROJECTION_ERROR_PX < error_px < 1e-3
    check = projection_verdict(config(), [0.0, error_px])
    assert "px from it in cv2.projectPoints" in check.problems[0]
    assert not projection_verdict(config(), [float("nan")]).passed


def test_depth_of_the_undistorted_grid_is_noticed_on_the_raw_one() -> None:
    """The depth that an ideal camera of the same K would see, under the raw camera's name."""
    eye = view("raw").left
    camera = eye.camera
    ideal = scene().caster.cast(pixel_rays(camera.K, camera.width, camera.height), camera.cam_from_world)
    wrong = replace(eye, depth_m=ideal.depth_m, mask=ideal.mask, bars=ideal.bars)
    assert board_error(wrong, BOARD).off_m > 1e-3


def test_a_scene_without_a_board_leaves_the_board_out() -> None:
    bare = config(board=None)
    check = board_verdict(bare, [largest_board_error(bare, view("ideal"))])
    assert (check.passed, check.found, check.bound) == (True, "no board in this scene", "left out")


def with_a_thing(high_m: float, share: float) -> AuditedView:
    """The view with a flat thing that stands ``high_m`` over a share of the board's rows, in both eyes."""
    eyes = []
    for eye in view("ideal").eyes.values():
        rows = np.zeros(eye.mask.shape, dtype=bool)
        rows[: int(share * len(rows))] = True
        centre_m = np.linalg.inv(eye.camera.cam_from_world)[2, 3]
        lifted = eye.depth_m * np.float32((centre_m - high_m) / centre_m)
        eyes.append(replace(eye, depth_m=np.where(rows & ~eye.mask, lifted, eye.depth_m)))
    return AuditedView("scene/0000", *eyes)


def test_things_may_hide_the_board_but_nothing_lies_below_it() -> None:
    cluttered = config(variants=("clutter",))

    def passed(audited: AuditedView, of: str = "things") -> bool:
        chosen = cluttered if of == "things" else config(variants=("dusk",))
        return board_verdict(chosen, [largest_board_error(chosen, audited)]).passed

    assert passed(with_a_thing(0.02, 0.3))
    assert not passed(with_a_thing(0.02, 0.3), of="light alone")
    assert not passed(with_a_thing(-0.02, 0.3))
    assert not passed(with_a_thing(5e-5, 0.3))
    assert not passed(with_a_thing(0.02, 0.95))


def test_estimated_axes_are_left_out_and_drawn_ones_judged() -> None:
    drawn = config()
    known, guessed = drawn.steel[:1], replace(drawn.steel[1], role=ESTIMATED)
    assert replace(drawn, steel=(*known, guessed)).drawn_steel == known
    assert axis_verdict(replace(drawn, steel=(guessed,)), [7.0]).bound == "left out"
    assert not axis_verdict(drawn, [MAX_AXIS_RATIO + 0.01]).passed


def test_epipolar_share_is_that_of_all_views() -> None:
    good = EpipolarCounts(seen=100_000, hidden=50)
    assert epipolar_verdict(config(), [good, EpipolarCounts(contradicted=1)]).passed
    few = int(2 * MAX_CONTRADICTED_SHARE * 100_000)
    assert not epipolar_verdict(config(), [good, EpipolarCounts(contradicted=few)]).passed
    assert epipolar_verdict(config(), []).bound == "left out"


def test_differences_from_cycles_are_held_against_the_depth() -> None:
    depth_m = np.full(10_000, 8.0)
    noise_m = np.full(10_000, 3e-6 * 8.0)
    assert cycles_verdict("c", np.stack([noise_m, depth_m], axis=1), 2).passed
    assert not cycles_verdict("c", np.stack([noise_m, depth_m / 8], axis=1), 2).passed
    noise_m[:20] = 0.009  # twenty pixels on another surface
    assert not cycles_verdict("c", np.stack([noise_m, depth_m], axis=1), 2).passed
    noise_m[:20] = 0.007
    assert cycles_verdict("c", np.stack([noise_m, depth_m], axis=1), 2).passed
    assert not cycles_verdict("c", np.full((5, 2), np.nan), 2).passed
    assert cycles_verdict("c", cycles_difference_m(Path("none.ply"), [], print), 0).found == "skipped"
    assert cycles_verdict("c", np.zeros((0, 2)), 2).found == "2 views: no steel"


def test_points_far_outside_a_lens_do_not_land_in_the_frame() -> None:
    """A strong barrel lens sends far rays back into the picture."""
    eye = view("raw").left
    folding = replace(eye, camera=replace(eye.camera, distortion=np.array([-0.4, 0.0, 0.0, 0.0, 0.0])))
    slope = np.linspace(0.0, 3.0, 200)
    points_cam = np.stack([slope, np.zeros(200), np.ones(200)], axis=1)
    to_world = np.linalg.inv(eye.camera.cam_from_world)
    landed = landed_in(folding, points_cam @ to_world[:3, :3].T + to_world[:3, 3], 1)
    in_frame = (landed.px[:, 0] > 2) & (landed.px[:, 0] < eye.camera.width - 3)
    assert in_frame[slope > 1.2].any()
    assert not landed.inside[slope > 1.0].any()
    behind = landed_in(eye, (np.array([[0.0, 0.0, -1.0]]) @ to_world[:3, :3].T) + to_world[:3, 3], 1)
    assert not behind.inside.any()


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.integers(2, 9), st.sampled_from([0.1, 5.0]))
def test_distance_from_a_polyline_is_that_of_the_nearest_segment(seed: int, corners: int, size_m: float) -> None:
    rng = np.random.default_rng(seed)
    axis_m, points_m = rng.uniform(-size_m, size_m, (corners, 3)), rng.uniform(-size_m, size_m, (40, 3))
    shares = np.linspace(0, 1, 4001)[:, None]
    dense = np.concatenate([a + shares * (b - a) for a, b in pairwise(axis_m)])
    brute = np.linalg.norm(points_m[:, None] - dense, axis=2).min(axis=1)
    found = polyline_distance_m(points_m, axis_m)
    assert (found <= brute + 1e-9).all()
    assert found == pytest.approx(brute, abs=size_m / 500)


def test_distance_close_to_a_long_axis_keeps_its_digits() -> None:
    axis_m = np.array([[-2.4, -2.4, 6.6], [2.4, -2.4, 6.6], [2.4, 2.4, 6.6]])
    found = polyline_distance_m(np.array([[1.3, -2.392, 6.6]]), axis_m)
    assert found == pytest.approx([0.008], rel=1e-9)


@pytest.mark.parametrize("step_deg", [3.0, 6.0])
def test_the_sagitta_of_a_bend_is_that_of_its_arc(step_deg: float) -> None:
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0]])
    line_m = bent_line_m(corners, 0.1, step_deg)
    assert bend_sagitta_m(line_m) == pytest.approx(0.1 * (1 - np.cos(np.deg2rad(step_deg / 2))), rel=0.02)
    assert bend_sagitta_m(corners) == 0.0  # a corner, no arc
    assert bend_sagitta_m(corners[:2]) == 0.0
