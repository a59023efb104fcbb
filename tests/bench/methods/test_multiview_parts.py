"""Parts of the multi-view methods without COLMAP: choices of views, plane sweep, resampling and metric scale."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("cv2")
pytest.importorskip("pycolmap")

import cv2
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import Float64, UInt8
from numpy import ndarray
from scipy.spatial.transform import Rotation

from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.geometry.aruco_board import BoardSpec, marker_corners_m
from rebar_depth_bench.geometry.aruco_detection import Corners
from rebar_depth_bench.geometry.cameras import ideal_K, look_at, pixel_rays, project, rigid, transform
from rebar_depth_bench.geometry.rectification import PinholeGrid
from rebar_depth_bench.methods.multiview.dense import (
    MAX_NEIGHBOURS,
    PosedImage,
    consistency_mask,
    read_depth_map,
    select_neighbours,
    sweep_depth,
)
from rebar_depth_bench.methods.multiview.pipeline import (
    Similarity,
    camera_errors,
    fit_board,
    triangulate,
)
from rebar_depth_bench.methods.multiview.sfm import LeftImages, SparseReconstruction, reconstruct, select_pairs

K = ideal_K(1280, 720)
BOARD = BoardSpec()
STEP_DEG = 24
RING = {
    f"{turn:04d}.png": look_at(
        0.6 * np.array([np.cos(np.radians(turn)), np.sin(np.radians(turn)), 0.8]), np.zeros(3)
    )
    for turn in range(0, 360, STEP_DEG)
}
ARC = {
    f"{k:04d}.png": look_at(
        np.array([0.5 * np.cos(turn), 0.5 * np.sin(turn), 0.3 + 0.02 * k]), np.array([0.0, 0.0, 0.05])
    )
    for k, turn in enumerate(np.radians(np.arange(0, 120, 15)))
}


def project_corners(poses: dict[str, np.ndarray]) -> dict[str, Corners]:
    """Return the exact corners of the board's markers in the image of each pose."""
    corners_m = marker_corners_m(BOARD)
    return {
        name: {marker: project(K, transform(pose, corners)) for marker, corners in corners_m.items()}
        for name, pose in poses.items()
    }


def rotation_between_deg(first: str, second: str) -> float:
    relative = RING[first][:3, :3] @ RING[second][:3, :3].T
    return float(np.degrees(np.arccos((np.trace(relative) - 1) / 2)))


def test_images_over_60_degrees_apart_are_not_paired() -> None:
    pairs = select_pairs(project_corners(RING), BOARD, K)
    names = sorted(RING)
    expected = {(a, b) for a in names for b in names if a < b and rotation_between_deg(a, b) <= 60}
    assert set(pairs) == expected
    assert 0 < len(expected) < len(names) * (len(names) - 1) / 4


def test_image_without_markers_is_paired_with_all() -> None:
    corners_by_image = project_corners(RING)
    without_markers = sorted(RING)[4]
    corners_by_image[without_markers] = {}
    pairs = select_pairs(corners_by_image, BOARD, K)
    assert sum(without_markers in pair for pair in pairs) == len(RING) - 1


def make_reconstruction() -> SparseReconstruction:
    """Return a reconstruction of points in a small cube that every camera of the ring sees."""
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (50, 3))
    return SparseReconstruction(RING, points, {name: np.arange(50) for name in RING}, 0.5)


def test_neighbours_are_adjacent_views_best_angle_first() -> None:
    neighbours = select_neighbours(make_reconstruction())
    names = sorted(RING)
    for index, name in enumerate(names):
        adjacent = {names[(index + step) % len(names)] for step in (-2, -1, 1, 2)}
        assert set(neighbours[name]) == adjacent
        assert set(neighbours[name][:2]) == {names[(index + step) % len(names)] for step in (-1, 1)}
    assert len(neighbours[names[0]]) == MAX_NEIGHBOURS


def test_views_without_shared_points_are_not_neighbours() -> None:
    whole = make_reconstruction()
    name = sorted(RING)[0]
    separated = SparseReconstruction(
        RING, whole.points, {**whole.visible_points, name: np.array([], np.int64)}, 0.5
    )
    assert select_neighbours(separated)[name] == ()
    assert all(name not in neighbours for neighbours in select_neighbours(separated).values())


SWEEP_WIDTH, SWEEP_HEIGHT = 160, 90
SWEEP_K = ideal_K(SWEEP_WIDTH, SWEEP_HEIGHT)
TEXTURE_PX_PER_M = 400


def texture() -> UInt8[ndarray, "h w"]:
    noise = np.random.default_rng(3).integers(0, 256, (1200, 1200)).astype(np.uint8)
    return np.asarray(cv2.GaussianBlur(noise, (0, 0), 2.0) * 2.0 - 128, np.float32).clip(0, 255).astype(np.uint8)


def render_view(pose: Float64[ndarray, "4 4"]) -> UInt8[ndarray, "h w"]:
    """Render the textured world plane z = 0 by intersecting every pixel's ray with it."""
    rays = pixel_rays(SWEEP_K, SWEEP_WIDTH, SWEEP_HEIGHT) @ pose[:3, :3]
    centre = -pose[:3, :3].T @ pose[:3, 3]
    points = centre + rays * (-centre[2] / rays[..., 2])[..., None]
    texture_px = (points[..., :2] * TEXTURE_PX_PER_M + 600).astype(np.float32)
    return np.asarray(cv2.remap(texture(), texture_px[..., 0], texture_px[..., 1], cv2.INTER_LINEAR))


def true_depth(pose: Float64[ndarray, "4 4"]) -> Float64[ndarray, "h w"]:
    """Return the depth of the world plane z = 0: the height of centre + depth * ray is zero."""
    rays_up = pixel_rays(SWEEP_K, SWEEP_WIDTH, SWEEP_HEIGHT) @ pose[:3, 2]
    centre_up = -(pose[:3, 2] @ pose[:3, 3])
    return np.asarray(-centre_up / rays_up)


def view_pose(x: float, y: float) -> Float64[ndarray, "4 4"]:
    return look_at(np.array([x, y, 1.0]), np.array([0.0, 0.1, 0.0]))


VIEW = view_pose(0.0, -0.4)
OTHERS = [view_pose(0.2, -0.4), view_pose(-0.2, -0.4), view_pose(0.0, -0.2), view_pose(0.1, -0.6)]


def test_slanted_plane_is_recovered() -> None:
    neighbours = [PosedImage(render_view(pose), pose) for pose in OTHERS]
    depth_m = sweep_depth(PosedImage(render_view(VIEW), VIEW), neighbours, SWEEP_K, (0.6, 2.0))
    abs_rel = np.abs(depth_m - true_depth(VIEW)) / true_depth(VIEW)
    known = np.isfinite(depth_m)
    assert known[10:-10, 10:-10].mean() > 0.9
    assert np.median(abs_rel[known]) < 0.005
    assert np.percentile(abs_rel[known], 95) < 0.02


def test_textureless_image_and_plane_outside_the_range_have_no_depth() -> None:
    plain = np.full((SWEEP_HEIGHT, SWEEP_WIDTH), 90, np.uint8)
    depth_m = sweep_depth(
        PosedImage(plain, VIEW), [PosedImage(plain, pose) for pose in OTHERS], SWEEP_K, (0.6, 2.0)
    )
    assert not np.isfinite(depth_m).any()
    # The plane is nearer than 1.5 m: of planes from 3 m on, an end plane is the best, or it matches badly.
    neighbours = [PosedImage(render_view(pose), pose) for pose in OTHERS]
    depth_m = sweep_depth(PosedImage(render_view(VIEW), VIEW), neighbours, SWEEP_K, (3.0, 9.0))
    assert np.isfinite(depth_m).mean() < 0.05


def test_consistency_mask_accepts_only_true_depth() -> None:
    truth = true_depth(VIEW).astype(np.float32)
    others = [(true_depth(pose).astype(np.float32), pose) for pose in OTHERS]
    spoiled = truth.copy()
    spoiled[:, 70:90] *= 1.1
    spoiled[:5] = np.nan
    consistent = consistency_mask(spoiled, VIEW, others, SWEEP_K)
    assert consistent[20:70, 20:60].mean() > 0.99
    assert not consistent[:, 70:90].any()
    assert not consistent[:5].any()
    empty = [(np.full_like(depth, np.nan), pose) for depth, pose in others]
    assert not consistency_mask(truth, VIEW, empty, SWEEP_K).any()


def write_depth_map(path: Path, header: str, values: Any) -> Path:
    path.write_bytes(header.encode() + np.asarray(values, "<f4").tobytes())
    return path


def test_colmap_depth_map_is_read_row_by_row(tmp_path: Path) -> None:
    written_m = np.arange(-1, 11, dtype=np.float32).reshape(3, 4)
    read_m = read_depth_map(write_depth_map(tmp_path / "a.bin", "4&3&1&", written_m))
    assert read_m.dtype == np.float32
    assert np.isnan(read_m[0, :2]).all(), "0 and below is no depth"
    assert np.array_equal(read_m.ravel()[2:], np.arange(1, 11))


@pytest.mark.parametrize("header", ["4&3&2&", "4&2&1&", "4x3", "", "9999999&9999999&1&"])
def test_invalid_colmap_depth_map_raises(header: str, tmp_path: Path) -> None:
    with pytest.raises(MethodError, match=r"is not a COLMAP depth map: .* expected WIDTH&HEIGHT&1&"):
        read_depth_map(write_depth_map(tmp_path / "a.bin", header, np.zeros(12)))


def test_unrelated_images_raise(tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    names = [f"{k}.png" for k in range(3)]
    for k, name in enumerate(names):
        noise = np.random.default_rng(k).integers(0, 256, (90, 160, 3)).astype(np.uint8)
        cv2.imwrite(str(images / name), noise)
    grid = PinholeGrid(ideal_K(160, 90), 160, 90, None)
    left_images = LeftImages(images, {name: name for name in names}, grid, {}, {})
    with pytest.raises(MethodError, match="no matching pair among 3 images"):
        reconstruct(left_images, None, tmp_path)
    assert not (tmp_path / "model").exists()


def reconstruct_in_other_frame(
    unit_m: float, turn: tuple[float, float, float]
) -> tuple[dict[str, np.ndarray], Similarity]:
    """Return the true cameras in another frame and unit, and the similarity that maps them back to metres."""
    rotation = Rotation.from_rotvec(turn).as_matrix()
    other_from_metric = Similarity(1 / unit_m, rotation, np.array([3.0, -1.0, 2.0]))
    metric_from_other = Similarity(unit_m, rotation.T, -unit_m * rotation.T @ other_from_metric.translation)
    return {name: transform_pose(other_from_metric, pose) for name, pose in ARC.items()}, metric_from_other


def transform_pose(similarity: Similarity, pose: np.ndarray) -> np.ndarray:
    """Return the rigid pose of a camera moved by a similarity; its centre moves like a point."""
    rotation = pose[:3, :3] @ similarity.rotation.T
    centre = similarity.apply(-pose[:3, :3].T @ pose[:3, 3])
    return rigid(rotation, -rotation @ centre)


@pytest.mark.slow
@settings(max_examples=30)
@given(st.floats(0.01, 50.0), st.tuples(*[st.floats(-3.0, 3.0)] * 3))
def test_exact_corners_give_exact_similarity(unit_m: float, turn: tuple[float, float, float]) -> None:
    poses, metric_from_other = reconstruct_in_other_frame(unit_m, turn)
    fit = fit_board(project_corners(ARC), poses, K, BOARD)
    assert fit.metric.scale == pytest.approx(unit_m, rel=1e-8)
    assert fit.metric.translation == pytest.approx(metric_from_other.translation, abs=1e-6 * max(unit_m, 1))
    assert fit.markers == tuple(range(6))
    assert fit.rms_m < 1e-8
    report = camera_errors(poses, ARC, fit.metric.scale, fit.metric)
    assert abs(report["scale_error_percent"]) < 1e-4
    assert report["centre_error_mm"]["largest"] < 1e-3
    assert report["rotation_error_deg"]["largest"] < 1e-3


def test_reports_measure_scale_and_camera_errors() -> None:
    """A scale 2 % too large about the origin moves every centre by 2 % of its distance from the origin."""
    poses, _ = reconstruct_in_other_frame(0.07, (0.1, 0.2, 0.3))
    right = fit_board(project_corners(ARC), poses, K, BOARD).metric
    wrong = Similarity(1.02 * right.scale, right.rotation, 1.02 * right.translation)
    report = camera_errors(poses, ARC, wrong.scale, wrong)
    distances_m = [np.linalg.norm(pose[:3, :3].T @ pose[:3, 3]) for pose in ARC.values()]
    assert report["scale_error_percent"] == pytest.approx(2.0, abs=1e-3)
    assert report["centre_error_mm"]["largest"] == pytest.approx(20 * max(distances_m), rel=1e-3)
    assert report["cameras_compared"] == "in the board's frame"
    aligned = camera_errors(poses, ARC, 1.02 * right.scale)
    assert aligned["scale_error_percent"] == pytest.approx(2.0, abs=1e-3)
    assert aligned["centre_error_mm"]["largest"] < 1e-3
    assert aligned["cameras_compared"] == "after the best similarity"


@pytest.mark.parametrize("off_px", [9.0, 200.0])
def test_outlier_corners_in_one_view_are_rejected(off_px: float) -> None:
    poses, _ = reconstruct_in_other_frame(0.07, (0.1, 0.2, 0.3))
    corners = project_corners(ARC)
    name = next(iter(corners))
    corners[name] = {marker: quad + np.array([off_px, -off_px]) for marker, quad in corners[name].items()}
    fit = fit_board(corners, poses, K, BOARD)
    assert fit.metric.scale == pytest.approx(0.07, rel=1e-6)


def test_views_registered_on_wrong_side_are_rejected() -> None:
    """Two of eight cameras are placed half a turn away, as COLMAP does on a symmetric lattice."""
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    flipped = dict(ARC)
    for name in list(ARC)[2:4]:
        flipped[name] = ARC[name] @ half_turn
    fit = fit_board(project_corners(ARC), flipped, K, BOARD)
    assert fit.metric.scale == pytest.approx(1, rel=1e-6)
    assert fit.markers == tuple(range(6))


def test_triangulation_needs_distinct_views_and_translation_between_them() -> None:
    point = np.array([0.0, 0.0, 2.0])
    turning = [
        rigid(Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix(), np.zeros(3)) for angle in (-0.2, 0.0, 0.2)
    ]
    sliding = [rigid(np.eye(3), np.array([x, 0.0, 0.0])) for x in (-0.3, 0.0, 0.3)]
    pixels = [[project(K, transform(pose, point)) for pose in poses] for poses in (turning, sliding)]
    assert triangulate(pixels[0], turning, K) is None
    assert triangulate(pixels[1], sliding, K) == pytest.approx(point, abs=1e-9)
    assert triangulate(pixels[1][:1] * 4, sliding[:1] * 4, K) is None
    assert triangulate(pixels[1][:2], sliding[:2], K) is None


def test_too_few_markers_raise() -> None:
    poses, _ = reconstruct_in_other_frame(1.0, (0.0, 0.0, 0.0))
    corners = {name: {3: markers[3]} for name, markers in project_corners(ARC).items()}
    with pytest.raises(MethodError, match=r"1 of the board's 6 markers can be triangulated .*expected at least 2"):
        fit_board(corners, poses, K, BOARD)
