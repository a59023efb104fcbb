"""Selection of image pairs, neighbour views and depth ranges for multi-view methods."""

from __future__ import annotations

import pytest

pytest.importorskip("cv2")
pytest.importorskip("pycolmap")

import numpy as np

from rebar_depth_bench.geometry.aruco_board import BoardSpec, marker_corners_m
from rebar_depth_bench.geometry.aruco_detection import Corners
from rebar_depth_bench.geometry.cameras import ideal_K, look_at, project, transform
from rebar_depth_bench.methods.multiview.dense import MAX_NEIGHBOURS, depth_range, select_neighbours
from rebar_depth_bench.methods.multiview.sfm import SparseReconstruction, select_pairs

K = ideal_K(1280, 720)
BOARD = BoardSpec()
STEP_DEG = 24
RING = {
    f"{turn:04d}.png": look_at(
        0.6 * np.array([np.cos(np.radians(turn)), np.sin(np.radians(turn)), 0.8]), np.zeros(3)
    )
    for turn in range(0, 360, STEP_DEG)
}


def project_markers(name: str) -> Corners:
    pose = RING[name]
    return {marker: project(K, transform(pose, quad)) for marker, quad in marker_corners_m(BOARD).items()}


def rotation_between_deg(first: str, second: str) -> float:
    relative = RING[first][:3, :3] @ RING[second][:3, :3].T
    return float(np.degrees(np.arccos((np.trace(relative) - 1) / 2)))


def test_images_over_60_degrees_apart_are_not_paired() -> None:
    pairs = select_pairs({name: project_markers(name) for name in RING}, BOARD, K)
    names = sorted(RING)
    expected = {(a, b) for a in names for b in names if a < b and rotation_between_deg(a, b) <= 60}
    assert set(pairs) == expected
    assert 0 < len(expected) < len(names) * (len(names) - 1) / 4


def test_image_without_markers_is_paired_with_all() -> None:
    corners_by_image = {name: project_markers(name) for name in RING}
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


def test_depth_range_covers_points_with_margin() -> None:
    whole = make_reconstruction()
    name = sorted(RING)[3]
    depths = whole.depths(name)
    assert depths == pytest.approx([float((RING[name] @ [*point, 1.0])[2]) for point in whole.points])
    near, far = depth_range(whole, name)
    assert near < depths.min() < depths.max() < far
    assert near > 0.8 * depths.min()
    assert far < 1.2 * depths.max()
