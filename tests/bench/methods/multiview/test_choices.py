"""Which pictures are matched, which views help a view, and between which depths: against counts made by hand."""

from __future__ import annotations

import numpy as np
import pytest

from rebar_depth_bench.geometry.aruco_board import BoardSpec, marker_corners_m
from rebar_depth_bench.geometry.aruco_detection import Corners
from rebar_depth_bench.geometry.cameras import ideal_K, look_at, project, transform
from rebar_depth_bench.methods.multiview.dense import NEIGHBOURS, depth_range, neighbours
from rebar_depth_bench.methods.multiview.images import plausible_pairs
from rebar_depth_bench.methods.multiview.sfm import Structure

K = ideal_K(1280, 720)
BOARD = BoardSpec()
STEP_DEG = 24
RING = {
    f"{turn:04d}.png": look_at(
        0.6 * np.array([np.cos(np.radians(turn)), np.sin(np.radians(turn)), 0.8]), np.zeros(3)
    )
    for turn in range(0, 360, STEP_DEG)
}


def corners(name: str) -> Corners:
    pose = RING[name]
    return {marker: project(K, transform(pose, quad)) for marker, quad in marker_corners_m(BOARD).items()}


def turned_deg(one: str, other: str) -> float:
    relative = RING[one][:3, :3] @ RING[other][:3, :3].T
    return float(np.degrees(np.arccos((np.trace(relative) - 1) / 2)))


def test_pictures_turned_far_against_each_other_are_not_matched() -> None:
    pairs = plausible_pairs({name: corners(name) for name in RING}, BOARD, K)
    names = sorted(RING)
    wanted = {(a, b) for a in names for b in names if a < b and turned_deg(a, b) <= 60}
    assert set(pairs) == wanted
    assert 0 < len(wanted) < len(names) * (len(names) - 1) / 4


def test_a_picture_without_markers_is_matched_with_all() -> None:
    seen = {name: corners(name) for name in RING}
    blind = sorted(RING)[4]
    seen[blind] = {}
    pairs = plausible_pairs(seen, BOARD, K)
    assert sum(blind in pair for pair in pairs) == len(RING) - 1


def structure() -> Structure:
    """Points in a small cube that every camera of the ring sees."""
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (50, 3))
    return Structure(RING, points, {name: np.arange(50) for name in RING}, 0.5)


def test_neighbours_are_the_views_beside_a_view_nearest_to_the_best_angle_first() -> None:
    found = neighbours(structure())
    names = sorted(RING)
    for place, name in enumerate(names):
        beside = {names[(place + step) % len(names)] for step in (-2, -1, 1, 2)}
        assert set(found[name]) == beside
        assert set(found[name][:2]) == {names[(place + step) % len(names)] for step in (-1, 1)}
    assert len(found[names[0]]) == NEIGHBOURS


def test_views_that_share_no_point_are_no_neighbours() -> None:
    whole = structure()
    name = sorted(RING)[0]
    apart = Structure(RING, whole.points, {**whole.seen, name: np.array([], np.int64)}, 0.5)
    assert neighbours(apart)[name] == ()
    assert all(name not in near for near in neighbours(apart).values())


def test_the_range_of_depths_holds_the_points_with_a_margin() -> None:
    whole = structure()
    name = sorted(RING)[3]
    depths = whole.depths(name)
    assert depths == pytest.approx([float((RING[name] @ [*point, 1.0])[2]) for point in whole.points])
    near, far = depth_range(whole, name)
    assert near < depths.min() < depths.max() < far
    assert near > 0.8 * depths.min()
    assert far < 1.2 * depths.max()
